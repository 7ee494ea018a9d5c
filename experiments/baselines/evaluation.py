"""Any model of a baseline measured on the test views as the package's own are."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from rich.console import Console

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import check_same_capture
from vdgs.evaluation.by_visibility import DEFAULT_BINS
from vdgs.evaluation.evaluate_model import evaluate_model
from vdgs.evaluation.evaluate_run import (
    cached_reference_views,
    make_evaluation_settings,
    make_true_depth,
    with_off_path_truth,
)
from vdgs.evaluation.lpips import load_lpips
from vdgs.evaluation.opacity_coverage import coverage_map
from vdgs.evaluation.renderable_model import EvaluatedModel, EvaluationSettings, RenderableModel
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.atomic_files import write_json

#: In an evaluation folder: how many seconds measuring took. A baseline trains and measures in one stage.
EVALUATION_STATUS = "status.json"


class BaselineModel(Protocol):
    """What can be measured."""

    @property
    def background(self) -> tuple[float, float, float]: ...
    def render(self, camera: Camera, *, depth: bool = False) -> Raster: ...


@runtime_checkable
class ModelOfSplats(BaselineModel, Protocol):
    """One whose needles can be counted."""

    def splats(self, camera: Camera) -> Splats: ...


@dataclass(frozen=True, kw_only=True)
class BaselineFacts:
    """What a baseline reports of a model beside its pictures."""

    name: str
    #: `capture_metadata` of what it was trained on.
    capture: Mapping[str, Any]
    #: Where it was trained, for its size, time and memory.
    trained: StageFolder | None = None
    num_anchors: int | None = None
    num_gaussians: int | None = None

    def evaluated_model(self) -> EvaluatedModel:
        if self.trained is None:
            return EvaluatedModel(model=self.name, n_anchors=self.num_anchors)
        status = self.trained.status()
        return EvaluatedModel(
            model=self.name, n_anchors=self.num_anchors,
            model_bytes=sum(file.stat().st_size for file in self.trained.path.glob("*.safetensors")),
            train_seconds=status.seconds, peak_memory_bytes=status.peak_memory_bytes,
        )  # fmt: skip


def evaluate_baseline(
    model: BaselineModel,
    facts: BaselineFacts,
    capture: Capture,
    output: Path,
    console: Console | None = None,
    *,
    lpips_weights: Path | None = None,
    settings: EvaluationSettings | None = None,
    visibility_map: Any = None,
) -> dict[str, Any]:
    """Measure a model on the test views, and on the off-path views where the capture has them; writes the evaluation
    folder `output` (and `output`_off_path), how long that took (`EVALUATION_STATUS`), and returns what its metrics.json
    holds.

    `visibility_map(camera)` is V per pixel; without it there are no figures by visibility. Raises RunError without test
    views or for another capture than the model's.
    """
    began = time.monotonic()
    check_same_capture(output, facts.capture, capture)
    lpips, note = load_lpips(lpips_weights)

    def render_depth(camera: Camera) -> Raster:
        return model.render(camera, depth=True)

    measured = RenderableModel(
        render=model.render, visibility_map=visibility_map, metadata=facts.evaluated_model(),
        background=model.background,
        coverage_map=coverage_map(render_depth, [view.camera for view in capture.train_views]),
        true_depth=make_true_depth(capture, capture.test_views), render_depth=render_depth,
        camera_height=camera_height(capture),
        decode_splats=model.splats if isinstance(model, ModelOfSplats) else None,
        training_cameras=[view.camera for view in capture.train_views],
    )  # fmt: skip
    if capture.off_path_views:
        with cached_reference_views(capture.off_path_views) as photographs:
            evaluate_model(
                photographs, with_off_path_truth(measured, capture), output.with_name(f"{output.name}_off_path"),
                lpips=lpips, lpips_note=note, settings=make_evaluation_settings(DEFAULT_BINS, "off-path"),
                console=console,
            )  # fmt: skip
    with cached_reference_views(capture.test_views) as photographs:
        result = evaluate_model(
            photographs, measured, output, lpips=lpips, lpips_note=note, settings=settings, console=console
        )
    write_json(output / EVALUATION_STATUS, {"seconds": time.monotonic() - began})
    if facts.num_gaussians is None:
        return dict(result)
    of_gaussians = {**dict(result), "n_gaussians": facts.num_gaussians}
    write_json(output / "metrics.json", of_gaussians)
    return of_gaussians
