"""`vdgs render`: views of a run or a camera path, as PNG files or as a video."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, UInt8
from rich.console import Console

from vdgs.captures.camera_height import pixel_at_camera_height
from vdgs.captures.capture_metadata import check_same_capture
from vdgs.captures.output_guard import check_not_among_folders
from vdgs.config.commands import MAX_RENDER_SIDE_PX, RENDER_BYTES_PER_PIXEL, RenderRequest
from vdgs.config.ranges import check_ranges
from vdgs.errors import VdgsError
from vdgs.evaluation.comparison_images import unique_file_stems, write_png
from vdgs.evaluation.metrics import to_8bit
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.lod_scene import LodScene
from vdgs.model.renderer import Drawable, render, without_aliasing
from vdgs.rendering import camera_paths
from vdgs.rendering.path_io import load_path
from vdgs.rendering.render_folder import begin_render, finish_render
from vdgs.rendering.scalar_maps import ScalarMap, add_colorbar, draw_colorbar, make_scalar_map
from vdgs.rendering.video import VideoWriter, caution, check_own_film, default_encoder
from vdgs.runs.lod_folder import open_lod
from vdgs.runs.open_run import OpenedModel, open_capture, open_model
from vdgs.runs.run_cameras import RunCameras, load_run_cameras, run_cameras_of_capture
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.visibility_store import get_run_visibility, require_some_seen, with_fade
from vdgs.system.atomic_files import write_array
from vdgs.system.console import print_warning, track
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.system.stop_signals import check_stop_requested
from vdgs.system.units import data_size, three_digits
from vdgs.visibility.visibility_counts import FADE_BELOW, NearbyCameras, count_visibility

#: Frames a second of a video of separate views.
STILLS_FPS = 2.0

#: The name of a frame, its image with the colorbar or without, and the values that it shows.
_Frame = tuple[str, UInt8[np.ndarray, "_ w 3"], Float[np.ndarray, "h w"] | None]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Render:
    """What is drawn: the named cameras, of a model of a run."""

    request: RenderRequest
    run: OpenedModel
    scene: Drawable
    #: The number of training cameras below which the scene is faded out; 0: it is not.
    faded_below: int
    run_cameras: RunCameras
    named: list[tuple[str, Camera]]
    console: Console
    #: Frames that show nothing of the scene, as they are drawn.
    empty: list[str] = field(default_factory=list)

    def scalar_map(self) -> ScalarMap | None:
        """The map that all views are drawn as; None for color images."""
        mode, cameras = self.request.mode, [camera for _, camera in self.named]
        return None if mode == "rgb" else make_scalar_map(mode, self.run, self.scene, self.run_cameras, cameras)

    def frames(self, scalar_map: ScalarMap | None) -> Iterator[_Frame]:
        """One frame per camera, in order."""
        shown = self.scene
        if self.request.is_antialiased:
            known = self.run_cameras
            shown = without_aliasing(shown, pixel_at_camera_height(known.camera_height, known.cameras))
        for name, camera in track(self.named, "rendering", len(self.named), self.console):
            check_stop_requested()
            if scalar_map is None:
                drawn = render(shown, camera)
                self._note_empty(name, bool(drawn.alpha.any()))
                yield name, to_8bit(drawn.image.cpu().numpy()), None
                continue
            values = scalar_map.values(camera)
            self._note_empty(name, bool((np.isfinite(values) & (values != 0)).any()))
            image = scalar_map.scale.colorize(values)
            yield name, add_colorbar(image, scalar_map.scale) if self.request.colorbar else image, values

    def _note_empty(self, name: str, shows: bool) -> None:
        if not shows:
            self.empty.append(name)

    def warn_of_empty(self) -> None:
        """Say that frames show nothing: a path in other coordinates looks past the scene."""
        if not self.empty:
            return
        places = np.array([camera.position for camera in self.run_cameras.cameras])
        lowest, highest = places.min(axis=0), places.max(axis=0)
        span = ", ".join(f"{axis} {a:.1f} to {b:.1f}" for axis, a, b in zip("xyz", lowest, highest, strict=True))
        self.console.print(
            f"[yellow]warning[/] {_frame_count_text(len(self.empty))} of {len(self.named):,} (first {self.empty[0]}) "
            f"show nothing of the scene: its cameras are at {span} of the ground frame. Are those of the path in it?",
            highlight=False,
        )


def render_run(request: RenderRequest, console: Console) -> None:
    """Render the views of a request on a device that is chosen already (`vdgs.kernels.device_selection`).

    Raises VdgsError for options that do not go together, an unusable path, codec or output, and for an output among the
    capture's inputs, in a folder that holds anything but an earlier render, or in place of a film of others.
    """
    began = time.monotonic()
    _check(request)
    run, scene = _open(request)
    run_cameras = _load_cameras(request, run)
    check_not_among_folders(request.output, run_cameras.root, run_cameras.input_folders)
    scene, faded_below = _with_fade(request, run, scene, run_cameras.cameras)
    run = replace(run, model=scene) if isinstance(scene, AnchorModel) else run
    print_warning(console, run.warning)
    if faded_below and request.min_visibility is None:
        console.print(
            f"[yellow]note[/] what fewer than {faded_below} training cameras see is faded out, as in pictures of all "
            "paths; --min-visibility 0 draws it as --views test and metrics do",
            highlight=False,
        )
    if request.seconds and request.path is None and request.views in ("test", "train"):
        console.print(f"[yellow]note[/] --seconds is of camera paths; --views {request.views} draws one frame a view")
    named, fps = _named_cameras(request, run_cameras, console)
    if request.width:
        named = [(name, camera.resized(request.width, _height(camera, request.width))) for name, camera in named]
    _check_size(request, [camera for _, camera in named])
    job = _Render(
        request=request, run=run, scene=scene, faded_below=faded_below, run_cameras=run_cameras, named=named,
        console=console,
    )  # fmt: skip
    summary = _write_video(job, fps) if request.output.suffix else _write_images(job)
    job.warn_of_empty()
    seconds = time.monotonic() - began
    console.print(f"{run.summary}: {summary}, drawn in {seconds:.1f} s: {request.output}", highlight=False)


def _open(request: RenderRequest) -> tuple[OpenedModel, Drawable]:
    """The model, and what it is drawn from."""
    if request.lod_error is None:
        run = open_model(RunFolder(request.run), request.model, request.device)
        return run, run.model
    run, tree = open_lod(RunFolder(request.run), request.model, request.device)
    return run, tree.at_error(request.lod_error)


def _with_fade(
    request: RenderRequest, run: OpenedModel, scene: Drawable, cameras: Sequence[Camera]
) -> tuple[Drawable, int]:
    """What is drawn, faded out where fewer of the training cameras see it than was asked for, and that number. Raises
    VdgsError where nothing would be left; the default leaves scenes alone that so few see."""
    photographs = request.path is None and request.views in ("test", "train")
    least = request.min_visibility
    if least is None:
        least = 0 if photographs or request.mode != "rgb" else FADE_BELOW
    if not least:
        return scene, 0
    if isinstance(scene, LodScene):
        visibility = count_visibility(scene.tree.gaussians(0).means, cameras)
    else:
        visibility = get_run_visibility(run, cameras)
    if request.min_visibility is not None:
        require_some_seen(visibility, least)
    elif not bool((visibility >= least).any()):
        return scene, 0
    if isinstance(scene, LodScene):
        nearby = NearbyCameras(cameras)
        return scene.with_fade(lambda places: nearby.fade_factors(places, least), f"V {least}"), least
    return with_fade(run.model, cameras, least), least


def _check(request: RenderRequest) -> None:
    check_ranges(request)
    if request.raw and request.mode == "rgb":
        raise VdgsError("--raw writes the numbers of a map: it needs --mode depth, visibility or alpha.")
    if request.raw and request.output.suffix:
        raise VdgsError(f"{request.output}: a film holds no numbers. Give a folder for --output, or leave out --raw.")
    if request.output.suffix:
        check_own_film(request.output)


def _write_video(job: _Render, fps: float) -> str:
    """Draw the frames of a video; returns a summary."""
    output, count = job.request.output, len(job.named)
    if output.is_dir():
        raise VdgsError(f"{output}: is a folder. Give another name for the film.")
    sizes = {(camera.width, camera.height) for _, camera in job.named}
    if len(sizes) > 1:
        raise VdgsError(
            f"{output}: a film needs frames of one size, and these views have {len(sizes)}, of several cameras. Give a "
            "folder, or a camera path (--path FILE.json)."
        )
    if (said := caution(default_encoder())) is not None:
        job.console.print(f"[yellow]note[/] {said}", highlight=False)
    with VideoWriter(output, fps) as video:
        scalar_map = job.scalar_map()
        for _, image, _ in job.frames(scalar_map):
            video.write(image)
    (width, height), colorbar = sizes.pop(), ""
    if scalar_map is not None and job.request.colorbar:
        rows = len(draw_colorbar(scalar_map.scale, width, height))
        height, colorbar = height + rows, f", the lowest {rows} rows of them the legend"
    size = f"{width // 2 * 2}x{height // 2 * 2} px{colorbar}"
    return f"{_frame_count_text(count)} of {size}, a film of {count / fps:.1f} s at {fps:g} frames a second"


def _write_images(job: _Render) -> str:
    """Draw images into a folder; returns a summary."""
    output, raw = job.request.output, job.request.raw
    names = [name + suffix for name, _ in job.named for suffix in ((".png", ".npy") if raw else (".png",))]
    earlier = begin_render(output, names)
    scalar_map = job.scalar_map()
    for name, image, values in job.frames(scalar_map):
        write_png(output / f"{name}.png", image)
        if raw and values is not None:
            write_array(output / f"{name}.npy", values)
    finish_render(output, earlier, names, _metadata(job, scalar_map))
    sizes = list(dict.fromkeys(f"{camera.width}x{camera.height} px" for _, camera in job.named))
    summary = f"{_frame_count_text(len(job.named))} of {sizes[0] if len(sizes) == 1 else f'{len(sizes)} sizes'}"
    summary += ", each with its numbers as .npy" if raw else ""
    return summary + (f", in place of {len(earlier)} files of an earlier render" if earlier else "")


def _frame_count_text(count: int) -> str:
    return f"{count:,} frame{'' if count == 1 else 's'}"


def _metadata(job: _Render, scalar_map: ScalarMap | None) -> dict[str, object]:
    """What render.json says of the images beside it."""
    request, model = job.request, job.run.name
    views = request.views if request.path is None else str(request.path)
    run = str(request.run.resolve())
    metadata: dict[str, object] = {"run": run, "model": model, "mode": request.mode, "views": views}
    if request.lod_error is not None:
        metadata["lod_error"] = request.lod_error
    if job.faded_below:
        metadata["min_visibility"] = job.faded_below
    if request.is_antialiased and request.mode == "rgb":
        metadata["antialiased"] = True
    if scalar_map is not None:
        limits = [scalar_map.scale.low, scalar_map.scale.high]
        metadata |= {"numbers": scalar_map.description, "colors_between": limits, "legend_below": request.colorbar}
    return metadata


def _load_cameras(request: RenderRequest, run: OpenedModel) -> RunCameras:
    """The cameras of the run: as it keeps them, else of its capture, which is asked too where it is named."""
    expected = run.model.metadata.capture
    saved = load_run_cameras(run.folder, expected) if request.capture is None else None
    if saved is not None:
        return saved
    capture = open_capture(run.folder, request.capture)
    check_same_capture(run.model_path, expected, capture)
    return run_cameras_of_capture(capture)


def _named_cameras(
    request: RenderRequest, run_cameras: RunCameras, console: Console
) -> tuple[list[tuple[str, Camera]], float]:
    """The cameras with their names, and the frames per second for a video of them."""
    if request.path is None and request.views in ("test", "train"):
        views = run_cameras.test if request.views == "test" else run_cameras.train
        if not views:
            raise VdgsError(f"--views {request.views}: the run has no such views. Ask for others, such as orbit.")
        names = unique_file_stems([name for name, _ in views])
        return [(name, camera) for name, (_, camera) in zip(names, views, strict=True)], request.fps or STILLS_FPS
    cameras, ground = run_cameras.cameras, run_cameras.ground
    seconds, fps = request.seconds or camera_paths.DEFAULT_SECONDS, request.fps or camera_paths.DEFAULT_FPS
    if request.path is not None:
        given = request.seconds or None, request.fps or None
        path = load_path(request.path, cameras[0], ground, *given, run_cameras.root)
    elif request.views == "orbit":
        path = camera_paths.orbit(run_cameras.scene_center[None], cameras, cameras[0], seconds, fps)
    else:
        path = camera_paths.flyover(cameras, cameras[0], seconds, fps)
    if path.converged is not None:
        place, away = ", ".join(f"{value:.1f}" for value in path.converged.place), path.converged.distance
        console.print(
            f"[yellow]note[/] the views of the photographs converge on a place, which the frames look at: {place} of "
            f"the ground frame, {three_digits(away)} {ground.unit} from the cameras (median)",
            highlight=False,
        )
    return [(f"{i:05d}", camera) for i, camera in enumerate(path.cameras)], path.fps


def _check_size(request: RenderRequest, cameras: list[Camera]) -> None:
    """Raise VdgsError, before anything is drawn, for pictures that memory does not hold or nothing can show."""
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    size = f"{largest.width}x{largest.height}"
    where = f"{request.path}: " if request.path is not None and not request.width else ""
    need, free = largest.width * largest.height * RENDER_BYTES_PER_PIXEL, available_memory_bytes()
    if max(largest.width, largest.height) > MAX_RENDER_SIDE_PX:
        problem = f"pictures of {size} are too large: at most {MAX_RENDER_SIDE_PX} pixels a side can be drawn"
    elif need > free:
        problem = f"a picture of {size} takes about {data_size(need)} to draw, and {data_size(free)} are free"
    else:
        return
    raise VdgsError(f"{where}{problem}. Give a smaller --width.")


def _height(camera: Camera, width: int) -> int:
    return max(2, 2 * round(camera.height * width / camera.width / 2))
