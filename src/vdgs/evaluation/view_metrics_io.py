"""What views came to, as a file for each, so that several processes may measure them: read back, every bit is there."""

from __future__ import annotations

import io
import json
import zipfile
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vdgs.errors import RunError
from vdgs.evaluation.block_seams import BlockFigures
from vdgs.evaluation.by_block import BlockMetrics, SeamMetrics
from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.comparison_images import Thumbnail
from vdgs.evaluation.depth_errors import DepthErrors
from vdgs.evaluation.view_metrics import ViewFigures
from vdgs.system.atomic_files import write_bytes
from vdgs.system.documents import JsonObject

FORMAT = "vdgs-view-1"


def save_view(path: Path, figures: ViewFigures, of_blocks: BlockFigures | None = None) -> None:
    """Write an .npz file (without pickle), atomically. Its arrays are named PART/NAME."""
    parts: dict[str, dict[str, np.ndarray]] = {"view": {"format": np.array(FORMAT), "row": _text(figures.row)}}
    if figures.by_visibility is not None:
        parts["visibility"] = figures.by_visibility.arrays()
    parts |= {f"depth-{kind}": errors.arrays() for kind, errors in figures.depth_errors.items()}
    if figures.cell is not None:
        cell = figures.cell
        parts["cell"] = {
            "words": np.array([cell.name, cell.caption], np.str_), "photograph": cell.photograph, "render": cell.render
        }  # fmt: skip
    if of_blocks is not None:
        parts["blocks"] = of_blocks.by_block.arrays() | {"row": _text(of_blocks.row)}
        parts["seams"] = of_blocks.seams.arrays()
    buffer = io.BytesIO()
    named = {f"{part}/{name}": array for part, arrays in parts.items() for name, array in arrays.items()}
    np.savez(buffer, allow_pickle=False, **named)
    write_bytes(path, buffer.getvalue())


def load_view(path: Path) -> tuple[ViewFigures, BlockFigures | None]:
    """The inverse of `save_view`. Raises RunError if the file is missing or damaged."""
    try:
        return _read(path)
    # What zipfile and numpy raise on damaged bytes has no common base.
    except (OSError, ValueError, KeyError, TypeError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise RunError(
            f"{path}: is missing or damaged ({error}). Delete {path.parent} and run the same command again."
        ) from error


def _read(path: Path) -> tuple[ViewFigures, BlockFigures | None]:
    parts = defaultdict[str, dict[str, np.ndarray]](dict)
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
        for key in file.files:
            part, _, name = key.partition("/")
            parts[part][name] = file[key]
    if str(parts["view"]["format"]) != FORMAT:
        raise ValueError(f"it is not a {FORMAT} file")
    depth = {part.removeprefix("depth-"): DepthErrors.of(each) for part, each in parts.items() if part[:6] == "depth-"}
    visibility = VisibilityHistogram.of(parts["visibility"]) if "visibility" in parts else None
    figures = ViewFigures(_row(parts["view"]), visibility, depth, _cell(parts["cell"]) if "cell" in parts else None)
    if "blocks" not in parts:
        return figures, None
    blocks = parts["blocks"]
    return figures, BlockFigures(_row(blocks), BlockMetrics.of(blocks), SeamMetrics.of(parts["seams"]))


def _cell(part: Mapping[str, np.ndarray]) -> Thumbnail:
    name, caption = (str(each) for each in part["words"])
    return Thumbnail(name, caption, part["photograph"], part["render"])


def _text(row: Mapping[str, Any]) -> np.ndarray:
    """JSON: it says every digit of a float, NaN and infinity too."""
    return np.array(json.dumps(row, ensure_ascii=False))


def _row(part: Mapping[str, np.ndarray]) -> JsonObject:
    return dict(json.loads(str(part["row"])))
