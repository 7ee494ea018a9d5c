"""Every method measured on the same pixels by visibility.

A run's own evaluation groups pixels by V as its own coarse model draws it; methods with other coarse models would then
be compared on other pixels. Here one V of the scene (`pixel_visibility.py`) says for every pixel of the test views how
many training cameras see the place, and the renders that each run left are measured against that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from experiments.bench.definitions import RECORD_FILE
from experiments.bench.pixel_visibility import PixelVisibility, visibility_from_frusta, visibility_from_truth
from vdgs.captures.image_cache import ImageCache
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import VdgsError
from vdgs.evaluation import metrics
from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.color_correction import correct_colors
from vdgs.evaluation.comparison_images import unique_file_stems
from vdgs.evaluation.evaluate_run import IMAGE_CACHE_BYTES
from vdgs.system.atomic_files import read_json, to_jsonable, write_json

#: In a run folder: its figures by visibility, and the V and the key of the run that they hold for.
GROUPS_FILE = "by_visibility.json"
#: The same by the frusta that hold the true surface, of generated scenes.
FRUSTA_FILE = "by_frusta.json"
FIGURES = ("squared_error", "ssim", "squared_error_cc", "ssim_cc")


def final_evaluation_folder(run: Path) -> Path:
    """Where the figures of a run's final model are: the merged one, or the coarse one of a run without blocks."""
    merged = run / "evaluation"
    return merged if (merged / "metrics.json").exists() else run / "coarse" / "evaluation"


def measure_groups(
    visibility: PixelVisibility, runs: Mapping[Path, str], bins: int, on_progress: Callable[[str], None]
) -> None:
    """Write GROUPS_FILE (of V by frusta FRUSTA_FILE) into every run of a scene that has none for this V and its key.

    `runs`: folder -> key. The test views are read once for all. Raises VdgsError where a picture is missing.
    """
    file = FRUSTA_FILE if visibility.source == "frusta" else GROUPS_FILE
    record = {"visibility_source": visibility.source, "visibility_identity": visibility.identity, "bins": bins}
    records = {folder: record | {"run": key} for folder, key in runs.items()}
    to_measure = [folder for folder, record in records.items() if not _is_measured(folder / file, record)]
    if not to_measure:
        return
    views = visibility.capture.test_views
    stems = unique_file_stems([view.name for view in views])
    histograms = {folder: VisibilityHistogram(FIGURES) for folder in to_measure}
    unseen, pixels = 0, 0
    with ImageCache(views, IMAGE_CACHE_BYTES) as images:
        for index, view in enumerate(views):
            on_progress(f"test view {index + 1} of {len(views)}")
            photograph, views_of_pixels = images.get(index), visibility.visibility_map(view.camera)
            mask = None if photograph.mask is None else photograph.mask.numpy() > 0
            valid = np.ones(views_of_pixels.shape, bool) if mask is None else mask
            unseen, pixels = unseen + int((visibility.unseen(view.camera) & valid).sum()), pixels + int(valid.sum())
            for folder in to_measure:
                render = _read_render(final_evaluation_folder(folder) / "renders" / f"{stems[index]}.png", folder)
                histograms[folder].add(views_of_pixels, pixel_values(render, photograph.image.numpy(), mask), mask)
    for folder in to_measure:
        groups = {"groups": histograms[folder].bins(bins), "unseen_share": unseen / max(pixels, 1)}
        write_json(folder / file, to_jsonable(records[folder] | groups))


def measure_by_truth(root: Path, options: CaptureOptions, run: Path, key: str, bins: int) -> None:
    """Measure one run of a generated scene by its truth, which waits for no other run; nothing without truth."""
    for find in (visibility_from_truth, visibility_from_frusta):
        visibility = find(root, options)
        if visibility is not None:
            measure_groups(visibility, {run: key}, bins, lambda text: None)


def pixel_values(
    render: UInt8[np.ndarray, "h w 3"], photograph: UInt8[np.ndarray, "h w 3"], mask: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Squared error and SSIM at every pixel [h, w], raw and after the color correction."""
    corrected = metrics.to_8bit(correct_colors(render, photograph, mask).image)
    return {
        "squared_error": metrics.squared_error(render, photograph),
        "ssim": metrics.ssim_map(render, photograph, mask),
        "squared_error_cc": metrics.squared_error(corrected, photograph),
        "ssim_cc": metrics.ssim_map(corrected, photograph, mask),
    }


def group_names(count: int) -> list[str]:
    """What the groups are called, least seen first."""
    part = {2: "half", 3: "third", 4: "quarter", 5: "fifth"}.get(count, f"1/{count}")
    if count == 1:
        return ["all pixels"]
    between = [f"{part} {index + 1}" for index in range(1, count - 1)]
    return [f"least seen {part}", *between, f"best seen {part}"]


def _is_measured(file: Path, record: Mapping[str, Any]) -> bool:
    try:
        saved = read_json(file)
    except (VdgsError, FileNotFoundError):
        return False
    return isinstance(saved, dict) and all(saved.get(name) == value for name, value in record.items())


def _read_render(path: Path, run: Path) -> UInt8[np.ndarray, "h w 3"]:
    render = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if render is None:
        raise VdgsError(
            f"{path}: the rendered test view is missing or damaged. Delete {run / RECORD_FILE} and give the same "
            "command: the run is then only measured again."
        )
    return np.ascontiguousarray(render[..., ::-1])
