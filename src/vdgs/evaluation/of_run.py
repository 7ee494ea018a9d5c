"""`vdgs eval`: a run's test views rendered, measured and shown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int32
from rich.console import Console
from torch import Tensor

from vdgs.anchors import AnchorModel
from vdgs.cameras import Camera
from vdgs.captures.capture import Capture
from vdgs.captures.images import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.captures.options import CaptureOptions
from vdgs.errors import RunError
from vdgs.kernels import native as kernels
from vdgs.progress import peak_memory_bytes
from vdgs.render import render, render_values
from vdgs.run import RunFolder


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
    return TrainedRun(folder, capture, AnchorModel.load(model_path), model_path, folder.coarse.status())


def options_from(settings: dict[str, Any], source: Path) -> CaptureOptions:
    """CaptureOptions from the plain values of config.yaml. Raises RunError on unknown settings."""
    paths = {"gps", "georef", "test_list"}
    values = {name: Path(v) if name in paths and v is not None else v for name, v in settings.items()}
    try:
        return CaptureOptions(**values)
    except TypeError as error:
        raise RunError(f"{source}: holds capture settings that this version does not know ({error})") from error


def evaluate_run(path: Path, lpips_weights: Path | None, bins: int, console: Console) -> None:
    """Measure a run's test views; writes RUN/evaluation and prints a table."""
    from vdgs.evaluation.evaluate import EvaluationSettings, ModelFacts, evaluate
    from vdgs.evaluation.lpips import Lpips

    run = open_run(path)
    views = run.capture.test_views
    counts = run.views_of_anchors().float()
    with_images = ImageCache(views, budget_bytes=256_000_000)
    index = {view.name: i for i, view in enumerate(views)}

    def load(view: Any) -> tuple[np.ndarray, np.ndarray | None]:
        image, mask = with_images.get(index[view.name])
        return image.numpy(), None if mask is None else mask.numpy() > 0

    def visibility(camera: Camera) -> np.ndarray:
        return render_values(run.model, counts, camera).numpy()

    facts = ModelFacts(
        n_anchors=len(run.model.anchors),
        model_bytes=run.model_path.stat().st_size,
        train_seconds=run.status.get("seconds"),
        peak_memory_bytes=run.status.get("peak_memory_bytes") or peak_memory_bytes(),
    )
    with torch.no_grad():
        evaluate(
            views, load, lambda camera: render(run.model, camera), visibility, run.folder.evaluation,
            lpips=Lpips.load(lpips_weights), settings=EvaluationSettings(bins=bins), facts=facts, console=console,
        )  # fmt: skip
    with_images.close()
