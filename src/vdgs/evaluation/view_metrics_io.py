"""What views came to, as a file for each, so that several processes may measure them: read back, every bit is there."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vdgs.evaluation.block_seams import BlockViewMetrics
from vdgs.evaluation.by_block import BlockMetrics, SeamMetrics
from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.comparison_images import Thumbnail
from vdgs.evaluation.depth_errors import DepthErrors
from vdgs.evaluation.view_metrics import ViewMetrics
from vdgs.system.array_files import explain_damaged_part, load_arrays, save_arrays
from vdgs.system.documents import JsonObject

FILE_FORMAT = "vdgs-view-1"


def save_view_metrics(path: Path, metrics: ViewMetrics, block_metrics: BlockViewMetrics | None = None) -> None:
    """Write an .npz file (without pickle), atomically. Its arrays are named PART/NAME."""
    parts: dict[str, dict[str, np.ndarray]] = {"view": {"format": np.array(FILE_FORMAT), "row": _text(metrics.row)}}
    if metrics.by_visibility is not None:
        parts["visibility"] = metrics.by_visibility.to_arrays()
    if metrics.by_angle is not None:
        parts["angle"] = metrics.by_angle.to_arrays()
    parts |= {f"depth-{kind}": errors.to_arrays() for kind, errors in metrics.depth_errors.items()}
    if metrics.cell is not None:
        cell = metrics.cell
        parts["cell"] = {
            "words": np.array([cell.name, cell.caption], np.str_), "photograph": cell.photograph, "render": cell.render
        }  # fmt: skip
    if block_metrics is not None:
        parts["blocks"] = block_metrics.by_block.to_arrays() | {"row": _text(block_metrics.row)}
        parts["seams"] = block_metrics.seams.to_arrays()
    save_arrays(path, {f"{part}/{name}": array for part, arrays in parts.items() for name, array in arrays.items()})


def load_view_metrics(path: Path) -> tuple[ViewMetrics, BlockViewMetrics | None]:
    """The inverse of `save_view_metrics`. Raises RunError if the file is missing or damaged."""
    with explain_damaged_part(path):
        return _read(path)


def _read(path: Path) -> tuple[ViewMetrics, BlockViewMetrics | None]:
    parts = defaultdict[str, dict[str, np.ndarray]](dict)
    for key, array in load_arrays(path).items():
        part, _, name = key.partition("/")
        parts[part][name] = array
    if str(parts["view"]["format"]) != FILE_FORMAT:
        raise ValueError(f"it is not a {FILE_FORMAT} file")
    depth = {part.removeprefix("depth-"): DepthErrors.of(each) for part, each in parts.items() if part[:6] == "depth-"}
    visibility, angle = (
        VisibilityHistogram.of(parts[name]) if name in parts else None for name in ("visibility", "angle")
    )
    cell = _cell(parts["cell"]) if "cell" in parts else None
    figures = ViewMetrics(_row(parts["view"]), visibility, depth, angle, cell)
    if "blocks" not in parts:
        return figures, None
    blocks = parts["blocks"]
    return figures, BlockViewMetrics(_row(blocks), BlockMetrics.of(blocks), SeamMetrics.of(parts["seams"]))


def _cell(part: Mapping[str, np.ndarray]) -> Thumbnail:
    name, caption = (str(each) for each in part["words"])
    return Thumbnail(name, caption, part["photograph"], part["render"])


def _text(row: Mapping[str, Any]) -> np.ndarray:
    """JSON: it says every digit of a float, NaN and infinity too."""
    return np.array(json.dumps(row, ensure_ascii=False))


def _row(part: Mapping[str, np.ndarray]) -> JsonObject:
    return dict(json.loads(str(part["row"])))
