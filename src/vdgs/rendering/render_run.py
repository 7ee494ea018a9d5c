"""`vdgs render`: views of a run or a camera path, as PNG files or as a video."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from rich.console import Console
from rich.progress import track

from vdgs.captures.capture_metadata import check_same_capture
from vdgs.captures.output_guard import check_not_among_folders, check_not_in_capture
from vdgs.config.commands import MAX_RENDER_SIDE_PX, RENDER_BYTES_PER_PIXEL, RenderRequest
from vdgs.config.ranges import check_ranges
from vdgs.errors import VdgsError
from vdgs.evaluation.image_io import unique_file_stems, write_png
from vdgs.evaluation.metrics import to_8bit
from vdgs.geometry.camera import Camera
from vdgs.model.renderer import render
from vdgs.rendering import camera_paths, render_folder
from vdgs.rendering.colorbar import add_colorbar, draw_colorbar
from vdgs.rendering.path_io import load_path
from vdgs.rendering.scalar_maps import ScalarMap, make_scalar_map
from vdgs.rendering.video import VideoWriter, caution, default_encoder
from vdgs.runs.open_run import OpenedModel, open_capture, open_model
from vdgs.runs.run_cameras import RunCameras, load_run_cameras, run_cameras_of_capture
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import write_array
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.system.stop_signals import check_stop_requested
from vdgs.system.units import data_size

#: Pace of a film of separate views.
STILLS_FPS = 2.0


@dataclass(frozen=True, eq=False)
class _NamedImage:
    """One picture, with its legend or without, its name, and the numbers that it shows."""

    name: str
    picture: UInt8[np.ndarray, "_ w 3"]
    values: Float[np.ndarray, "h w"] | None


def render_run(request: RenderRequest, console: Console) -> None:
    """Render what was asked for, on a device that is chosen already (`vdgs.kernels.device_selection`).

    Raises VdgsError for options that do not go together, an unusable path, codec or output, and for an output among the
    capture's inputs or in a folder that holds anything but an earlier render.
    """
    began = time.monotonic()
    _check(request)
    check_not_in_capture(request.output)
    run = open_model(RunFolder(request.run), request.model, request.device)
    flight = _load_cameras(request, run)
    check_not_among_folders(request.output, flight.root, flight.input_folders)
    if run.warning:
        console.print(f"[yellow]warning[/] {run.warning}", highlight=False)
    named, fps = _cameras(request, flight)
    if request.width:
        named = [(name, camera.resized(request.width, _height(camera, request.width))) for name, camera in named]
    _check_size(request, [camera for _, camera in named])
    if request.output.suffix:
        said = _write_video(request, run, flight, named, fps, console)
    else:
        said = _write_images(request, run, flight, named, console)
    console.print(
        f"{run.summary}: {said}, drawn in {time.monotonic() - began:.1f} s: {request.output}", highlight=False
    )


def _check(request: RenderRequest) -> None:
    check_ranges(request)
    if request.raw and request.mode == "rgb":
        raise VdgsError("--raw writes the numbers of a map: it needs --mode depth, visibility or alpha.")
    if request.raw and request.output.suffix:
        raise VdgsError(f"{request.output}: a film holds no numbers. Give a folder for --output, or leave out --raw.")


def _write_video(
    request: RenderRequest,
    run: OpenedModel,
    flight: RunCameras,
    named: list[tuple[str, Camera]],
    fps: float,
    console: Console,
) -> str:
    """Draw the frames of a film; returns what to say of it."""
    if request.output.is_dir():
        raise VdgsError(f"{request.output}: is a folder. Give another name for the film.")
    sizes = {(camera.width, camera.height) for _, camera in named}
    if len(sizes) > 1:
        raise VdgsError(
            f"{request.output}: a film needs frames of one size, and these views have {len(sizes)}. Give a folder."
        )
    if (said := caution(default_encoder())) is not None:
        console.print(f"[yellow]note[/] {said}", highlight=False)
    with VideoWriter(request.output, fps) as film:
        drawn = _scalar_map(request, run, flight, named)
        for frame in _frames(request, run, named, drawn, console):
            film.write(frame.picture)
    (width, height), strip = sizes.pop(), ""
    if drawn is not None and request.colorbar:
        rows = len(draw_colorbar(drawn.scale, width, height))
        height, strip = height + rows, f", the lowest {rows} rows of them the legend"
    return (
        f"{_frame_count_text(len(named))} of {width // 2 * 2}x{height // 2 * 2} px{strip}, a film of {len(named) / fps:.1f} s "
        f"at {fps:g} frames a second"
    )


def _write_images(
    request: RenderRequest, run: OpenedModel, flight: RunCameras, named: list[tuple[str, Camera]], console: Console
) -> str:
    """Draw pictures into a folder; returns what to say of them."""
    kinds = (".png", ".npy") if request.raw else (".png",)
    names = [name + kind for name, _ in named for kind in kinds]
    earlier = render_folder.begin_render(request.output, names)
    drawn = _scalar_map(request, run, flight, named)
    for frame in _frames(request, run, named, drawn, console):
        write_png(request.output / f"{frame.name}.png", frame.picture)
        if request.raw and frame.values is not None:
            write_array(request.output / f"{frame.name}.npy", frame.values)
    render_folder.finish_render(request.output, earlier, names, _metadata(request, run, drawn))
    sizes = list(dict.fromkeys(f"{camera.width}x{camera.height} px" for _, camera in named))
    said = f"{_frame_count_text(len(named))} of {sizes[0] if len(sizes) == 1 else f'{len(sizes)} sizes'}"
    said += ", each with its numbers as .npy" if request.raw else ""
    return said + (f", in place of {len(earlier)} files of an earlier render" if earlier else "")


def _frame_count_text(count: int) -> str:
    return f"{count:,} frame{'' if count == 1 else 's'}"


def _scalar_map(
    request: RenderRequest, run: OpenedModel, flight: RunCameras, named: list[tuple[str, Camera]]
) -> ScalarMap | None:
    """The map that all views are drawn as; None for plain pictures."""
    return (
        None if request.mode == "rgb" else make_scalar_map(request.mode, run, flight, [camera for _, camera in named])
    )


def _metadata(request: RenderRequest, run: OpenedModel, drawn: ScalarMap | None) -> dict[str, object]:
    """What render.json says of the pictures beside it."""
    facts: dict[str, object] = {
        "run": str(request.run.resolve()), "model": run.name, "kind": request.mode,
        "views": str(request.path) if request.path is not None else request.views,
    }  # fmt: skip
    if drawn is not None:
        facts |= {"numbers": drawn.description, "colors_between": [drawn.scale.low, drawn.scale.high],
                  "legend_below": request.colorbar}  # fmt: skip
    return facts


def _load_cameras(request: RenderRequest, run: OpenedModel) -> RunCameras:
    """The cameras of the run: as it keeps them, else of its capture, which is asked too where it is named."""
    described = run.model.metadata.capture
    kept = load_run_cameras(run.folder, described) if request.capture is None else None
    if kept is not None:
        return kept
    capture = open_capture(run.folder, request.capture)
    check_same_capture(run.model_path, described, capture)
    return run_cameras_of_capture(capture)


def _cameras(request: RenderRequest, flight: RunCameras) -> tuple[list[tuple[str, Camera]], float]:
    """The cameras with their names, and the frames per second for a film of them."""
    if request.path is None and request.views in ("test", "train"):
        names, cameras = zip(*(flight.test if request.views == "test" else flight.train), strict=True)
        return list(zip(unique_file_stems(list(names)), cameras, strict=True)), request.fps or STILLS_FPS
    template = flight.cameras[0]
    length, rate = request.seconds or camera_paths.DEFAULT_SECONDS, request.fps or camera_paths.DEFAULT_FPS
    if request.path is not None:
        path = load_path(
            request.path, template, flight.ground, request.seconds or None, request.fps or None, flight.root
        )
    elif request.views == "orbit":
        path = camera_paths.orbit(flight.scene_center[None], flight.cameras, template, length, rate)
    else:
        path = camera_paths.flyover(flight.cameras, template, length, rate)
    return [(f"{i:05d}", camera) for i, camera in enumerate(path.cameras)], path.fps


def _check_size(request: RenderRequest, cameras: list[Camera]) -> None:
    """Raise VdgsError, before anything is drawn, for pictures that memory does not hold or nothing can show."""
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    size = f"{largest.width}x{largest.height}"
    where = f"{request.path}: " if request.path is not None and not request.width else ""
    if max(largest.width, largest.height) > MAX_RENDER_SIDE_PX:
        raise VdgsError(
            f"{where}pictures of {size} are too large: at most {MAX_RENDER_SIDE_PX} pixels a side can be drawn. "
            "Give a smaller --width."
        )
    need, free = largest.width * largest.height * RENDER_BYTES_PER_PIXEL, available_memory_bytes()
    if need > free:
        raise VdgsError(
            f"{where}a picture of {size} takes about {data_size(need)} to draw, and {data_size(free)} are free. "
            "Give a smaller --width."
        )


def _height(camera: Camera, width: int) -> int:
    return max(2, 2 * round(camera.height * width / camera.width / 2))


def _frames(
    request: RenderRequest, run: OpenedModel, named: list[tuple[str, Camera]], drawn: ScalarMap | None, console: Console
) -> Iterator[_NamedImage]:
    """One picture per camera, in order."""
    for name, camera in track(named, "rendering", console=console, disable=not console.is_terminal):
        check_stop_requested()
        if drawn is None:
            yield _NamedImage(name, to_8bit(render(run.model, camera).image.cpu().numpy()), None)
            continue
        values = drawn.values(camera)
        picture = drawn.scale.colorize(values)
        yield _NamedImage(name, add_colorbar(picture, drawn.scale) if request.colorbar else picture, values)
