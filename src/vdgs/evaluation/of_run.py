"""`vdgs eval`: a run's test views rendered, measured and shown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32
from rich.console import Console
from torch import Tensor

from vdgs.anchors import AnchorModel
from vdgs.captures.capture import Capture, View
from vdgs.captures.facts import refuse_another_capture
from vdgs.captures.images import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.captures.options import CaptureOptions
from vdgs.errors import RunError
from vdgs.evaluation.evaluate import EvaluationSettings, ModelFacts, evaluate
from vdgs.evaluation.lpips import load_lpips
from vdgs.kernels import native as kernels
from vdgs.render import render, render_values
from vdgs.run import RunFolder

#: Photographs kept decoded during an evaluation, which needs one at a time.
EVALUATION_IMAGES_BYTES = 256_000_000


@dataclass(frozen=True)
class TrainedRun:
    """A run opened for looking at it: its capture as it was trained on, and its model."""

    folder: RunFolder
    capture: Capture
    model: AnchorModel
    model_path: Path
    status: dict[str, Any]

    def views_of_anchors(self) -> Int32[Tensor, " n"]:
        """V_i: how many training cameras hold each anchor in their frustum."""
        return kernels.count_views(self.model.anchors.positions, [view.camera for view in self.capture.train_views])


def open_run(path: Path) -> TrainedRun:
    """Open a run. Raises RunError if it is none or not trained, CaptureError if its photographs are gone."""
    folder = RunFolder(path)
    settings = dict(folder.settings()["capture"])
    root = Path(settings.pop("path"))
    model_path = folder.coarse.model
    if not model_path.exists():
        status = folder.coarse.status()
        raise RunError(
            f"{path}: has no trained model yet (coarse stage: {status['state']}). Run the same `vdgs coarse` command "
            "again: it continues from the last saved state."
        )
    capture = load_capture(root, options_from(settings, folder.config_file))
    model = AnchorModel.load(model_path)
    refuse_another_capture(model_path, model.facts.get("capture", {}), capture)
    return TrainedRun(folder, capture, model, model_path, folder.coarse.status())


def options_from(settings: dict[str, Any], source: Path) -> CaptureOptions:
    """CaptureOptions from the plain values of config.yaml. Raises RunError on unknown settings."""
    paths = {"gps", "georef", "test_list", "undistorted_folder"}
    values: Any = {name: Path(v) if name in paths and v is not None else v for name, v in settings.items()}
    try:
        return CaptureOptions(**values)
    except TypeError as error:
        raise RunError(f"{source}: holds capture settings that this version does not know ({error})") from error


def evaluate_run(path: Path, lpips_weights: Path | None, bins: int, console: Console) -> None:
    """Measure a run's test views; writes RUN/evaluation and prints a table."""
    if bins < 1:
        raise RunError(f"--bins is {bins}; it must be at least 1")
    run = open_run(path)
    views = run.capture.test_views
    counts = run.views_of_anchors().float()
    index = {view.name: i for i, view in enumerate(views)}
    lpips, note = load_lpips(lpips_weights)
    facts = ModelFacts(
        n_anchors=len(run.model.anchors),
        model_bytes=run.model_path.stat().st_size,
        train_seconds=run.status.get("seconds"),
        peak_memory_bytes=run.status.get("peak_memory_bytes"),
    )
    with ImageCache(views, EVALUATION_IMAGES_BYTES) as images:

        def load_mask(view: View) -> np.ndarray | None:
            mask = images.get(index[view.name]).mask
            return None if mask is None else mask.numpy() > 0

        evaluate(
            views,
            load_image=lambda view: images.get(index[view.name]).image.numpy(),
            render=lambda camera: render(run.model, camera),
            output=run.folder.evaluation,
            visibility_map=lambda camera: render_values(run.model, counts, camera).numpy(),
            lpips=lpips,
            lpips_note=note,
            load_mask=load_mask,
            facts=facts,
            settings=EvaluationSettings(visibility_bins=bins),
            console=console,
        )
    console.print(f"pictures and figures: {run.folder.evaluation}", highlight=False)
