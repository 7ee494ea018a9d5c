"""`vdgs eval`: a run's test views, or its training views, rendered, measured and shown."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture, View
from vdgs.captures.ground_truth import has_truth, load_truth
from vdgs.captures.image_cache import ImageCache
from vdgs.errors import RunError
from vdgs.evaluation.coverage import seen_map
from vdgs.evaluation.evaluate_model import evaluate
from vdgs.evaluation.lpips import load_lpips
from vdgs.evaluation.renderable_model import EvaluationSettings, MeasuredModel, ModelFacts, ReferenceViews
from vdgs.evaluation.view_exposures import exposures_of
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import decode_view, render, render_values
from vdgs.runs.open_run import TrainedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.visibility_store import visibility_of_run

#: Photographs kept decoded during an evaluation, which needs one at a time.
EVALUATION_IMAGES_BYTES = 256_000_000

#: How views are exposed, where exposures were fitted (`evaluation.exposures`).
EXPOSED = {
    "test": "in the exposure interpolated from the training photographs before and after, corrected for what is "
    "metered where that foretells these (no pixel of a test view is used)",
    "training": "in the exposure that was fitted to each",
}

#: What to measure on. A model that is good on training views and not on test views overfits.
Views = Literal["test", "training"]


def evaluate_run(
    run: TrainedRun,
    coarse: TrainedRun,
    lpips_weights: Path | None,
    bins: int,
    console: Console,
    views: Views = "test",
) -> None:
    """Measure a model of a run, opened beside its coarse one, and print a table. Writes `evaluation_folder`."""
    refuse_bins(bins)
    output = evaluation_folder(run.folder, run.name, views)
    lpips, note = load_lpips(lpips_weights)
    model, chosen = measured_model(run, coarse, views), views_of(run.capture, views)
    with cached_photographs(chosen) as photographs:
        evaluate(
            photographs, model, output, lpips=lpips, lpips_note=note, console=console, settings=settings_of(bins, views)
        )
    console.print(f"pictures and figures: {output}", highlight=False)


def refuse_bins(bins: int) -> None:
    if bins < 1:
        raise RunError(f"--bins is {bins}; it must be at least 1")


def settings_of(bins: int, views: Views) -> EvaluationSettings:
    return EvaluationSettings(visibility_bins=bins, title=f"{views} views", exposed=EXPOSED[views])


def views_of(capture: Capture, views: Views) -> list[View]:
    """The views that are measured."""
    return list(capture.test_views if views == "test" else capture.train_views)


def measured_model(run: TrainedRun, coarse: TrainedRun, views: Views) -> MeasuredModel:
    """The opened model as the evaluation sees it, beside the coarse model of its run."""
    facts = ModelFacts(
        model=run.name,
        n_anchors=len(run.model.anchors),
        model_bytes=run.model_path.stat().st_size,
        train_seconds=run.status.seconds,
        peak_memory_bytes=run.status.peak_memory_bytes,
        model_identity=run.status.model,
        key=run.key,
    )
    return MeasuredModel(
        render=lambda camera: render(run.model, camera), visibility_map=visibility_map(coarse), facts=facts,
        background=run.model.background, seen_map=seen_by_run(coarse),
        true_depth=true_depth(run.capture, views_of(run.capture, views)),
        render_depth=lambda camera: render(run.model, camera, depth=True), camera_height=camera_height(run.capture),
        splats_of=lambda camera: decode_view(run.model, camera)[1], exposure=exposures_of(run.model, run.capture),
    )  # fmt: skip


@contextmanager
def cached_photographs(views: Sequence[View]) -> Iterator[ReferenceViews]:
    """The photographs and masks of views, decoded when they are asked for."""
    index = {view.name: i for i, view in enumerate(views)}
    with ImageCache(views, EVALUATION_IMAGES_BYTES) as images:

        def load_mask(view: View) -> np.ndarray | None:
            mask = images.get(index[view.name]).mask
            return None if mask is None else mask.numpy() > 0

        yield ReferenceViews(views, lambda view: images.get(index[view.name]).image.numpy(), load_mask)


def evaluation_folder(run: RunFolder, name: str, views: Views = "test") -> Path:
    """Where the figures of a model ("coarse" or "merged") are: RUN/evaluation, RUN/coarse/evaluation; of training views
    beside them, in `evaluation_training`."""
    folder = run.evaluation if name == "merged" else run.coarse.path / "evaluation"
    return folder if views == "test" else folder.with_name(f"{folder.name}_training")


def visibility_map(coarse: TrainedRun) -> Callable[[Camera], np.ndarray]:
    """V at each pixel of a view, drawn with the coarse model of a run whatever model is measured.

    So the same pixels are compared between the models of a run.
    """
    visibility = visibility_of_run(coarse, [view.camera for view in coarse.capture.train_views]).float()
    return lambda camera: render_values(coarse.model, visibility, camera).cpu().numpy()


def seen_by_run(coarse: TrainedRun) -> Callable[[Camera], Bool[np.ndarray, "h w"]]:
    """Which pixels of a view show what enough training cameras see (`evaluation.seen`), by the coarse model's depth
    whatever model is measured."""
    cameras = [view.camera for view in coarse.capture.train_views]
    return seen_map(lambda camera: render(coarse.model, camera, depth=True), cameras)


def coarse_of(run: TrainedRun) -> TrainedRun:
    """The run with its coarse model, whichever it was opened with."""
    if run.name == "coarse":
        return run
    return replace(run, model=AnchorModel.load(run.folder.coarse.model).to(run.device), name="coarse")


def true_depth(capture: Capture, views: Sequence[View]) -> Callable[[View], Float[np.ndarray, "h w"]] | None:
    """The true depth of views of a generated capture, in units of the ground frame, inf for sky; None where it was
    written without."""
    if not has_truth(capture.root):
        return None
    truth, units_per_metre = load_truth(capture.root), capture.ground.scale
    if not all(truth.knows_depth(view) for view in views):
        return None
    # The world of a generated capture is in metres, and the ground frame is a similarity of it.
    return lambda view: units_per_metre * truth.depth_map(view)
