"""`vdgs eval`: a run's test views, or its training views, rendered, measured and shown."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int64
from rich.console import Console

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture, View
from vdgs.captures.ground_truth import has_ground_truth, load_ground_truth
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.off_path import OFF_PATH_FOLDER
from vdgs.errors import RunError
from vdgs.evaluation.block_seams import BlockInputs
from vdgs.evaluation.evaluate_model import evaluate_model
from vdgs.evaluation.lpips import load_lpips
from vdgs.evaluation.measured_as import EvaluationSplit, evaluation_folder
from vdgs.evaluation.opacity_coverage import MIN_SEEN_BY, coverage_map
from vdgs.evaluation.renderable_model import EvaluatedModel, EvaluationSettings, ReferenceViews, RenderableModel
from vdgs.evaluation.view_exposures import make_exposures
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.anchor_model import AnchorModel, DecoderSpan
from vdgs.model.renderer import background_image, render, render_scalar_map, view_splats
from vdgs.partition.block_regions import split_trainable_anchors
from vdgs.partition.blocks import xy_positions
from vdgs.runs.lod_folder import drawn_scene
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.open_run import OpenedRun, block_lookup, load_run_blocks
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.visibility_store import get_run_visibility

#: Photographs kept decoded during an evaluation, which needs one at a time.
IMAGE_CACHE_BYTES = 256_000_000

#: How views are exposed, where exposures were fitted (`evaluation.view_exposures`).
EXPOSURE_NOTES = {
    "test": "in the exposure that the training photographs taken before and after predict (no pixel of a test view "
    "is used)",
    "training": "in the exposure that was fitted to each",
    "off-path": "",
}

#: Blocks are held assembled among their surroundings up to so many bytes (at least one): views show them in turn.
CACHE_BYTES = 2_000_000_000


def evaluate_run(
    run: OpenedRun,
    coarse: OpenedRun,
    lpips_weights: Path | None,
    bins: int,
    console: Console,
    views: EvaluationSplit = "test",
    lod_error: float | None = None,
) -> None:
    """Measure a model of a run, opened beside its coarse one, and print a table. Writes `evaluation_folder`. With a
    `lod_error` it is drawn through its level-of-detail tree, on the device of the coarse one."""
    check_bins(bins)
    output = evaluation_folder(run.folder, run.name, views, lod_error)
    lpips, note = load_lpips(lpips_weights)
    model, settings = make_renderable_model(run, coarse, views, lod_error), make_evaluation_settings(bins, views)
    with cached_reference_views(select_views(run.capture, views)) as images:
        stage = "evaluation" if run.name == "merged" else "coarse evaluation"
        evaluate_model(
            images, model, output, lpips=lpips, lpips_note=note, console=console, settings=settings,
            on_view=run.folder.begin_step(stage, f"{views} views", "", len(images.views)),
        )  # fmt: skip
    console.print(f"images and metrics: {output}", highlight=False)


def check_bins(bins: int) -> None:
    if bins < 1:
        raise RunError(f"--visibility-bins is {bins}; it must be at least 1")


def make_evaluation_settings(bins: int, views: EvaluationSplit) -> EvaluationSettings:
    off_path = views == "off-path"
    return EvaluationSettings(
        visibility_bins=bins, title=f"{views} views", exposure_note=EXPOSURE_NOTES[views],
        color_correction=not off_path, covered_only=off_path, by_folder=off_path,
    )  # fmt: skip


def select_views(capture: Capture, views: EvaluationSplit) -> list[View]:
    """The views that are measured."""
    of = {"test": capture.test_views, "training": capture.train_views, "off-path": capture.off_path_views}
    return list(of[views])


def make_renderable_model(
    run: OpenedRun, coarse: OpenedRun, views: EvaluationSplit, lod_error: float | None = None
) -> RenderableModel:
    """The opened model as the evaluation sees it, beside the coarse model of its run."""
    scene = drawn_scene(run, lod_error, str(coarse.device))
    exposures, plain = None, scene
    if views != "off-path" and (lod_error is None or run.model.local_exposure is None):  # a tree has the local one
        exposures = make_exposures(run.model, run.capture)
        if exposures is not None and isinstance(scene, AnchorModel):
            plain = scene.without_local_exposure()
    metadata = EvaluatedModel(
        model=run.name,
        n_anchors=len(run.model.anchors),
        model_bytes=run.model_path.stat().st_size,
        train_seconds=run.status.seconds,
        peak_memory_bytes=run.status.peak_memory_bytes,
        model_digest=run.status.model_id,
        key=run.key,
    )
    measured = RenderableModel(
        render=lambda camera: render(plain, camera), visibility_map=make_visibility_map(coarse), metadata=metadata,
        background=run.model.background, background_image=lambda camera: background_image(scene, camera),
        coverage_map=make_coverage_map(coarse),
        true_depth=make_true_depth(run.capture, select_views(run.capture, views)),
        render_depth=lambda camera: render(scene, camera, depth=True), camera_height=camera_height(run.capture),
        decode_splats=lambda camera: view_splats(scene, camera)[1],
        training_cameras=[view.camera for view in run.capture.train_views],
        exposure=exposures, render_neutral=None if plain is scene else lambda camera: render(scene, camera),
    )  # fmt: skip
    return with_off_path_truth(measured, run.capture) if views == "off-path" else measured


@contextmanager
def cached_reference_views(views: Sequence[View]) -> Iterator[ReferenceViews]:
    """The photographs and masks of views, decoded when they are asked for."""
    index = {view.name: i for i, view in enumerate(views)}
    with ImageCache(views, IMAGE_CACHE_BYTES) as images:

        def load_mask(view: View) -> np.ndarray | None:
            mask = images.get(index[view.name]).mask
            return None if mask is None else mask.numpy() > 0

        yield ReferenceViews(views, lambda view: images.get(index[view.name]).image.numpy(), load_mask)


def make_visibility_map(coarse: OpenedRun) -> Callable[[Camera], np.ndarray]:
    """V at each pixel of a view, drawn with the coarse model of a run whatever model is measured.

    So the same pixels are compared between the models of a run.
    """
    visibility = get_run_visibility(coarse, [view.camera for view in coarse.capture.train_views]).float()
    return lambda camera: render_scalar_map(coarse.model, visibility, camera).cpu().numpy()


def make_coverage_map(coarse: OpenedRun) -> Callable[[Camera], Bool[np.ndarray, "h w"]]:
    """Which pixels of a view show what enough training cameras see, by the coarse model's depth whatever model is
    measured."""
    cameras = [view.camera for view in coarse.capture.train_views]
    return coverage_map(lambda camera: render(coarse.model, camera, depth=True), cameras)


def with_off_path_truth(model: RenderableModel, capture: Capture) -> RenderableModel:
    """The model as off-path views measure it: by true V and true depth where they are known."""
    folder, views = capture.root / OFF_PATH_FOLDER, capture.off_path_views
    model = replace(model, true_depth=make_true_depth(capture, views))
    if not has_ground_truth(folder):
        return model
    truth, by_pose = load_ground_truth(folder), {view.camera.camera_from_world.tobytes(): view for view in views}

    def visibility(camera: Camera) -> Float[np.ndarray, "h w"]:
        return truth.visibility_map(by_pose[camera.camera_from_world.tobytes()])

    return replace(model, visibility_map=visibility, coverage_map=lambda camera: visibility(camera) >= MIN_SEEN_BY)


def with_coarse_model(run: OpenedRun) -> OpenedRun:
    """The run with its coarse model, whichever it was opened with."""
    if run.name == "coarse":
        return run
    return replace(run, model=AnchorModel.load(run.folder.coarse.model).to(run.device), name="coarse")


def make_true_depth(capture: Capture, views: Sequence[View]) -> Callable[[View], Float[np.ndarray, "h w"]] | None:
    """The true depth of views of a generated capture, in units of the ground frame, inf for sky; None where it was
    written without."""
    root = capture.root / OFF_PATH_FOLDER if views and views[0] in capture.off_path_views else capture.root
    if not has_ground_truth(root):
        return None
    truth, units_per_metre = load_ground_truth(root), capture.ground.scale
    if not all(truth.has_depth(view) for view in views):
        return None
    # The world of a generated capture is in metres, and the ground frame is a similarity of it.
    return lambda view: units_per_metre * truth.depth_map(view)


def make_block_inputs(opened: OpenedRun, coarse: OpenedRun, images: ReferenceViews) -> BlockInputs:
    """Where the pictures of a run's blocks come from; the merged model is the one that was opened."""
    run, merged = opened.folder, opened.model.without_local_exposure()
    before, blocks = coarse.model.without_local_exposure(), load_run_blocks(run)
    return BlockInputs(
        reference_views=images,
        render_coarse=lambda camera: render(before, camera, depth=True),
        render_merged=lambda camera: render(merged, camera, depth=True),
        render_block=IsolatedBlocks(run, before).render,
        num_blocks=len(blocks),
        block_at=block_lookup(opened, blocks),
        exposure=make_exposures(opened.model, opened.capture),
    )  # fmt: skip


class IsolatedBlocks:
    """Blocks as they were trained, before the merge: their own anchors among frozen coarse ones."""

    def __init__(self, run: RunFolder, coarse: AnchorModel):
        self._run, self._coarse = run, coarse
        self._blocks, self._config, self._key = load_run_blocks(run), run.method().block, run.keys().blocks
        self._done = [run.block(index).is_done(self._key) for index in range(len(self._blocks))]
        self._held: OrderedDict[int, AnchorModel] = OrderedDict()

    @cached_property
    def _owner(self) -> Int64[np.ndarray, " n"]:
        """The block of each coarse anchor: of millions it takes seconds, for all blocks alike."""
        return self._blocks.owner(xy_positions(self._coarse.anchors.positions))

    def render(self, index: int, camera: Camera) -> Raster | None:
        """The block's own picture; None if it was not trained (merged with --allow-missing-blocks)."""
        if not self._done[index]:
            return None
        if index not in self._held:
            self._held[index] = self.assemble(index)
            while len(self._held) > 1 and sum(_bytes(model) for model in self._held.values()) > CACHE_BYTES:
                self._held.popitem(last=False)
        self._held.move_to_end(index)
        return render(self._held[index], camera)

    def assemble(self, index: int) -> AnchorModel:
        """A block's own anchors and what stood around them in its training, each with its decoder."""
        own = load_verified(self._run.block(index), self._key, index).to(self._coarse.anchors.positions.device)
        coarse = self._coarse.anchors
        around = coarse.select(split_trainable_anchors(coarse, self._blocks, index, self._config, self._owner)[1])
        parts = DecoderSpan(len(own.anchors), own.decoder), DecoderSpan(len(around), self._coarse.decoder)
        return replace(own.without_local_exposure(), anchors=own.anchors.concat(around), decoder_spans=parts)


def _bytes(model: AnchorModel) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in model.anchors.tensors().values())
