"""The Python API: what the verbs of the command line do, as functions. docs/python.md is its guide.

Lengths are in units of the ground frame (metres where the capture says so), z up; pixel centers are at 0.5; cameras
look along +z (OpenCV). Torch tensors or numpy arrays go in, and the same comes out. What a caller can mend is raised as
`VdgsError`, which says how. Everything here is loaded when `vdgs.NAME` is first used.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from vdgs.captures.capture import Capture as Capture
from vdgs.config.capture_options import CaptureOptions as CaptureOptions
from vdgs.config.commands import ExportRequest, ViewRequest
from vdgs.config.method import MAX_BLOCKS, AssignmentConfig, MergeConfig, MethodConfig, PartitionConfig, TrainConfig
from vdgs.config.presets import PRESETS, PresetName
from vdgs.config.ranges import MAX_COUNT, Range
from vdgs.config.type_hints import field_hints
from vdgs.config.typed_paths import home_path
from vdgs.config.validation_rules import checked_settings, checked_value
from vdgs.errors import RunError, VdgsError, check_kind
from vdgs.geometry.camera import Camera as Camera
from vdgs.geometry.camera import check_camera, check_cameras
from vdgs.kernels.device_selection import select_device
from vdgs.ops.arrays import Array, as_tensor, check_finite_points, check_image_index, like, without_autocast
from vdgs.ops.scenes import Run as Run
from vdgs.ops.scenes import Scene as Scene
from vdgs.ops.scenes import open_run as open_run
from vdgs.partition.assignment.assign_cameras import Assignment
from vdgs.partition.blocks import Blocks
from vdgs.runs import open_run as runs
from vdgs.runs.run_folder import REMEDY_OF_OTHER_SETTINGS, RunFolder
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.stop_signals import stops_as_python

_COLOR = Annotated[tuple[float, float, float], Range(0, 1)]
#: Options of `vdgs export` that a scene in memory has no use for, and what to do instead.
_NOT_OF_SCENES = {
    "run": "the scene is the first argument",
    "output": "`path` is the file; call it again for another one",
    "model": "it is that of the scene: vdgs.open_run(RUN, model=...)",
    "device": "it is that of the scene: vdgs.open_run(RUN, device=...)",
    "threads": "vdgs.configure_threads sets them",
    "evaluate": "nothing is reported here; `vdgs export` and `vdgs.render` tell what was lost",
}


def load_capture(path: str | Path, **options: Any) -> Capture:
    """Read and check a capture: a folder with files of COLMAP, nerfstudio, Mega-NeRF, MatrixCity, MVSNet or LLFF.

    `options` are those of `CaptureOptions`, as in `vdgs run --help`: images="images_4", downscale=2, test_every=8, ...
    Warns (UserWarning) of what `vdgs run` notes: photographs that are left out, poor points and poses. Pixels are not
    decoded, and those that are damaged not found.
    Raises CaptureError naming the file, the fault and the remedy, also where cameras and points cannot become a scene;
    VdgsError for an option that does not work.
    """
    from vdgs.captures.validation import require_valid

    capture = _read_capture(path, options)
    _warn(dict.fromkeys((*capture.warnings, *require_valid(capture).warnings)))
    return capture


def _read_capture(path: str | Path, options: dict[str, Any]) -> Capture:
    from vdgs.captures.loading import load_capture as load

    return load(home_path(path), checked_settings(CaptureOptions, options, "CaptureOptions"))


def preset(name: PresetName = "laptop") -> MethodConfig:
    """The settings of a preset; change them with `dataclasses.replace`. Raises VdgsError for another name."""
    if name not in PRESETS:
        raise VdgsError(f"there is no preset {name!r}: choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


class Render(NamedTuple):
    """A drawn view."""

    #: [h, w, 3] float32, not clamped, and how opaque the scene is, [h, w].
    rgb: Tensor
    alpha: Tensor
    #: z along the view in units of the ground frame, [h, w]: where a pixel becomes half opaque (NaN where it never
    #: does), and the mean over what is drawn (NaN where nothing is). None without depth.
    depth: Tensor | None
    expected_depth: Tensor | None


def render(
    scene: Scene,
    camera: Camera,
    *,
    mode: Literal["rgb", "rgb+depth"] = "rgb",
    background: Sequence[float] | np.ndarray | Tensor | None = None,
    image_index: int | None = None,
) -> Render:
    """Draw one view of a scene, without gradients.

    `background`, three numbers from 0 to 1, replaces the scene's own, its environment map too; `image_index` selects
    the appearance of a training photograph, where one was trained. Source: Scaffold-GS eqs. 3-8, 3DGS eqs. 2-3.
    """
    from vdgs.model.renderer import render as draw

    _check_scene(scene)
    check_camera("camera", camera)
    if mode not in ("rgb", "rgb+depth"):
        raise VdgsError(f"mode={mode!r}: choose rgb or rgb+depth")
    color = None if background is None else _checked_color("background", background)
    num_images = MAX_COUNT if scene.capture is None else len(scene.capture.train_views)
    index = check_image_index(image_index, (decoder for _, _, decoder in scene.model.decoder_ranges()), num_images)
    with without_autocast(scene.positions.device):
        raster = draw(scene.model, camera, background=color, depth=mode != "rgb", image_index=index)
    if raster.depth is None or raster.median_depth is None:
        return Render(raster.image, raster.alpha, None, None)
    median = raster.median_depth.masked_fill(raster.median_depth == 0, torch.nan)
    return Render(raster.image, raster.alpha, median, raster.depth / raster.alpha)


def _checked_color(name: str, value: Any) -> tuple[float, float, float]:
    """A color that a caller gave as numbers, an array or a tensor."""
    numbers = value.tolist() if isinstance(value, (np.ndarray, Tensor)) else value
    color: tuple[float, float, float] = checked_value(name, numbers, _COLOR)
    return color


def count_visibility(points: Array, cameras: Sequence[Camera]) -> Array:
    """V_i [n] int32: how many cameras hold each point [n, 3] (float32 or float64) in their frustum. Nothing hides.

    Raises TypeError or ValueError for other points, VdgsError for some that are not finite. Source: VDGS section IV-B.
    """
    from vdgs.visibility import visibility_counts

    check_cameras(cameras)
    places = as_tensor("points", points)
    check_finite_points(places)
    return like(points, visibility_counts.count_visibility(places, cameras))


def visibility_ratio(points: Array, cameras: Sequence[Camera]) -> Array:
    """c_k [n] float32: the share of the distinct cameras whose frustum holds each point [n, 3].

    Raises ValueError without cameras, VdgsError for points that are not finite. Source: VDGS eq. 8.
    """
    from vdgs.visibility import visibility_counts

    check_cameras(cameras)
    places = as_tensor("points", points)
    check_finite_points(places)
    return like(points, visibility_counts.visibility_ratio(places, cameras))


def _checked_config(name: str, config: Any, *kinds: type, remedy: str = "") -> Any:
    """Settings that a caller made, as `checked_settings` reads them. Raises TypeError for those of another kind."""
    check_kind(name, config, *kinds, remedy=remedy)
    return checked_settings(type(config), asdict(config), type(config).__name__)


def _check_scene(scene: Any) -> None:
    check_kind("scene", scene, Scene, remedy="vdgs.open_run(RUN).scene and vdgs.train(...) are scenes")


def partition(
    points: Array,
    visibility: Array,
    *,
    num_blocks: int = 4,
    lambda_vis: float = 1.0,
    seed: int = 0,
    balanced: bool = False,
    expansion: float = 0.4,
) -> Blocks:
    """Cut points [n, 3] into blocks on the ground plane, by place and by their visibility V [n].

    `lambda_vis` weighs visibility beside place (0: place alone); a block is widened by `expansion` of its radius.
    Warns (UserWarning) where there are fewer blocks than asked for; raises VdgsError where nothing can be cut and for
    settings out of their range, ValueError for other shapes. `Blocks` has `items` (polygons `core` and `expanded`) and
    `owner(xy)`. Source: VDGS eq. 5.
    """
    from vdgs.partition.partition_scene import partition_scene

    hints = field_hints(PartitionConfig)
    config = PartitionConfig(
        blocks=checked_value("num_blocks", num_blocks, Annotated[int, Range(1, MAX_BLOCKS)]),
        lambda_vis=checked_value("lambda_vis", lambda_vis, hints["lambda_vis"]),
        balanced=checked_value("balanced", balanced, bool),
        expansion=checked_value("expansion", expansion, hints["expansion"]),
    )
    seed = checked_value("seed", seed, field_hints(TrainConfig)["seed"])
    given = as_tensor("points", points)
    places, counts = (each.detach().cpu().numpy() for each in (given, as_tensor("visibility", visibility)))
    if places.ndim != 2 or places.shape[1] != 3 or counts.shape != places.shape[:1]:
        raise ValueError(f"points must be [n, 3] and visibility [n], not {places.shape} and {counts.shape}")
    if not len(places):
        raise VdgsError("points is empty: there is nothing to cut into blocks")
    check_finite_points(given)
    if not (np.isfinite(counts) & (counts >= 0) & (counts <= MAX_COUNT) & (counts == np.floor(counts))).all():
        raise VdgsError("visibility must be whole numbers of cameras, at least 0: vdgs.count_visibility gives them")
    blocks, notes = partition_scene(places, counts.astype(np.int64), config, seed)
    _warn(notes)
    return blocks


def assign_cameras(
    scene: Scene, blocks: Blocks, cameras: Sequence[Camera], config: AssignmentConfig | None = None
) -> Assignment:
    """Which cameras train which block: `.cameras` [c, k] bool, `.reasons` [c, k] int8 (indices of
    `vdgs.partition.assignment.assign_cameras.REASONS`), `.warnings`, which are also warned of.

    The scene is drawn once for each camera and block; `config.mode` says how the pictures are compared. Source: VDGS
    eqs. 6-7.
    """
    from vdgs.partition.assignment import assign_cameras as assignment
    from vdgs.partition.assignment.score_matrix import compute_score_matrix

    _check_scene(scene)
    check_kind("blocks", blocks, Blocks, remedy="vdgs.partition makes them")
    check_cameras(cameras)
    config = _checked_config("config", AssignmentConfig() if config is None else config, AssignmentConfig)
    with without_autocast(scene.positions.device):
        decided = assignment.assign_cameras(compute_score_matrix(scene.model, blocks, cameras, config), config)
    _warn(decided.warnings)
    return decided


def merge(
    scene: Scene,
    block_scenes: Iterable[Scene],
    blocks: Blocks,
    assignment: Assignment,
    *,
    rule: Literal["owner", "max-visibility"] = "owner",
) -> Scene:
    """One scene from trained blocks: every place takes its anchors from exactly one block.

    `scene` is the coarse scene that the blocks were trained from; `blocks` is the cut that they were trained for
    (`.blocks` of the run), and the rows of `assignment` are its training cameras. The merged scene is on its device,
    wherever the blocks are.
    Raises VdgsError for blocks of another coarse scene, of another cut or in another order, and for a rule that would
    lose anchors; ValueError where the numbers do not fit, TypeError for arguments of another kind.
    """
    from vdgs.partition.merging import merge_blocks

    check_kind("block_scenes", block_scenes, Iterable, remedy="give a list of scenes")
    block_scenes = list(block_scenes)
    for each in (scene, *block_scenes):
        _check_scene(each)
    check_kind("blocks", blocks, Blocks, remedy="vdgs.partition makes them")
    check_kind("assignment", assignment, Assignment, remedy="vdgs.assign_cameras makes it")
    settings, cameras = checked_settings(MergeConfig, {"rule": rule}, "merge"), scene.cameras
    if assignment.cameras.shape != (len(cameras), len(blocks)):
        raise ValueError(
            f"the assignment is {list(assignment.cameras.shape)}, not [{len(cameras)} training cameras, "
            f"{len(blocks)} blocks]"
        )
    served = [[cameras[i] for i in np.flatnonzero(of_block)] for of_block in assignment.cameras.T]
    cpu, device = torch.device("cpu"), scene.positions.device
    models = [partial(each.model.to, cpu) for each in block_scenes]  # one block at a time
    return Scene(merge_blocks(scene.model.to(cpu), models, blocks, served, settings)[0].to(device), scene.capture)


def export(scene: Scene | Run, path: str | Path, **options: Any) -> None:
    """Write a scene as Gaussians or points; the ending of `path` says how (.ply, .spz, .splat, .sog, .glb, .html, ...).

    `options` are those of `vdgs export` that say what is in the file: sh_degree=3, max_gaussians=0, crs="EPSG:25832",
    program="supersplat", ... The file is that of `vdgs export`. Needs no screen. Raises VdgsError, before any Gaussian
    is baked, for a name or an option that does not work and for a scene without its capture.
    """
    from vdgs.export.export_run import resolve_request, write_files

    scene, file = scene.scene if isinstance(scene, Run) else scene, home_path(path)
    _check_scene(scene)
    if scene.capture is None:
        raise VdgsError(f"{path}: baking needs the training cameras: give the capture, as in Scene(model, capture)")
    for name in options.keys() & _NOT_OF_SCENES:
        raise VdgsError(f"export has no {name!r}: {_NOT_OF_SCENES[name]}")
    paths = {"run": file.parent, "output": (file,), "evaluate": False}
    request = resolve_request(checked_settings(ExportRequest, options | paths, "export"))
    opened = runs.OpenedRun(
        folder=RunFolder(request.run), model=scene.model, model_path=file, capture=scene.capture, key="",
        name="merged" if scene.model.decoder_spans else "coarse", status=StatusRecord(state="done"), warning="",
    )  # fmt: skip
    with without_autocast(scene.positions.device), stops_as_python():
        write_files(opened, request, _warning_console())


def train(
    capture: str | Path | Capture,
    config: PresetName | MethodConfig | TrainConfig = "laptop",
    *,
    run_dir: str | Path | None = None,
    callbacks: Sequence[Callable[[Any], object]] = (),
    device: str | torch.device = "cpu",
    capture_options: CaptureOptions | None = None,
) -> Scene:
    """Train a scene as `vdgs run` does: global model, V, blocks, cameras, block training, merge; the same bits.

    A `TrainConfig` trains the global model alone. Without `run_dir` all is done in this process and in memory, what
    moves between photographs is not looked for, and after every step each callback is given a `TrainingEvent` (stage,
    iteration, iterations, loss, psnr in dB, anchors); one that returns True ends the stage early. With `run_dir` it is
    a run folder, which the same call continues after a crash; its blocks train in processes of their own, so it takes
    the capture's folder and no callbacks. Ctrl-C is KeyboardInterrupt there too, after what was done is saved.
    Photographs with poses and without points are refused: `vdgs sfm` finds points (`vdgs run` does so by itself).
    `capture_options` say how a folder is read, and go with no `Capture`. Notes of the stages, and doubts about the
    capture, are printed on standard error. Raises CaptureError for a capture that cannot
    become a scene, VdgsError for settings, TrainingDiverged.
    """
    from vdgs.pipeline.train_in_memory import train_in_memory, train_in_run_folder

    named = preset(config) if isinstance(config, str) else config
    method = _checked_config("config", named, MethodConfig, TrainConfig, remedy="presets are named by a text")
    check_kind("callbacks", callbacks, Iterable, remedy="give a list of functions")
    callbacks = tuple(callbacks)
    for callback in callbacks:
        check_kind("each of callbacks", callback, Callable)  # type: ignore[arg-type]
    options = CaptureOptions() if capture_options is None else capture_options
    settings = _checked_config("capture_options", options, CaptureOptions)
    if capture_options is not None and isinstance(capture, Capture):
        raise VdgsError(
            "capture_options say how a folder is read, and this Capture is read already: give the folder, or the "
            "options to vdgs.load_capture"
        )
    where = select_device(device).device
    if run_dir is None:
        if isinstance(method, MethodConfig) and method.block.mask_moving == "on":
            raise VdgsError("mask_moving='on' keeps the masks that it makes in a run folder: name one (run_dir)")
        opened = capture if isinstance(capture, Capture) else _read_capture(capture, vars(settings))
        with without_autocast(where):
            return Scene(train_in_memory(opened, method, callbacks, _warning_console(), where), opened)
    if callbacks or isinstance(capture, Capture):
        given = "callbacks" if callbacks else "Capture"
        raise VdgsError(f"run_dir={str(run_dir)!r} takes no {given}: processes of their own read the capture's folder")
    try:
        with without_autocast(where), stops_as_python():
            train_in_run_folder(home_path(capture), settings, method, home_path(run_dir), _warning_console(), where)
    except RunError as error:  # of the command line, which has --overwrite
        remedy = "Give the old settings to continue, delete the folder to train anew, or name another run_dir."
        raise RunError(str(error).replace(REMEDY_OF_OTHER_SETTINGS, remedy)) from error
    return open_run(run_dir, model="coarse" if isinstance(method, TrainConfig) else "best", device=where).scene


def view(run: Run | str | Path, *, host: str = "127.0.0.1", port: int | None = None) -> None:
    """Show a run in a browser until Ctrl-C, as `vdgs view` does: prints the address. Needs viser (extra `viewer`).

    Raises VdgsError for a run without a model, and for an address that cannot be used.
    """
    from vdgs.viewer.server import view_run

    opened = run if isinstance(run, Run) else open_run(run)
    address = {"host": host, "port": port}
    request = {"run": opened.path, "model": opened.model, "device": opened.device} | address
    view_run(checked_settings(ViewRequest, request, "view"), Console())


def _warn(notes: Iterable[str]) -> None:
    for note in notes:
        warnings.warn(note, stacklevel=3)


def _warning_console() -> Console:
    """Where notes of the stages go that nobody must miss: nothing else is printed."""
    from vdgs.cli.common import make_console

    return make_console(quiet=True)
