"""`vdgs render`: views of a run or a camera path, as PNG files or as a video."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from rich.console import Console
from rich.progress import track

from vdgs.captures.capture_metadata import refuse_another_capture
from vdgs.captures.output_guard import refuse_among_folders, refuse_in_a_capture
from vdgs.config.commands import BYTES_PER_PIXEL, LARGEST_SIDE_PX, RenderRequest
from vdgs.config.ranges import refuse
from vdgs.errors import VdgsError
from vdgs.evaluation.image_io import file_stems, write_png
from vdgs.evaluation.metrics import to_8bit
from vdgs.geometry.camera import Camera
from vdgs.model.renderer import render
from vdgs.rendering import camera_paths, render_folder
from vdgs.rendering.colorbar import legend, with_legend
from vdgs.rendering.path_io import load_path
from vdgs.rendering.scalar_maps import Map, map_of
from vdgs.rendering.video import VideoWriter
from vdgs.runs.open_run import OpenedModel, open_capture, open_model
from vdgs.runs.run_cameras import Flight, flight_of, kept_flight
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import write_array
from vdgs.system.memory.process_memory import available_bytes
from vdgs.system.stop_signals import stop_if_asked
from vdgs.system.units import data_size

#: Pace of a film of separate views.
SLIDES_PER_SECOND = 2.0


@dataclass(frozen=True, eq=False)
class _Frame:
    """One picture, with its legend or without, its name, and the numbers that it shows."""

    name: str
    picture: UInt8[np.ndarray, "_ w 3"]
    values: Float[np.ndarray, "h w"] | None


def render_run(asked: RenderRequest, console: Console) -> None:
    """Render what was asked for, on a device that is chosen already (`vdgs.kernels.device_selection`).

    Raises VdgsError for options that do not go together, an unusable path, codec or output, and for an output among the
    capture's inputs or in a folder that holds anything but an earlier render.
    """
    began = time.monotonic()
    _check(asked)
    refuse_in_a_capture(asked.output)
    run = open_model(RunFolder(asked.run), asked.model, asked.device)
    flight = _flight(asked, run)
    refuse_among_folders(asked.output, flight.root, flight.inputs)
    if run.caution:
        console.print(f"[yellow]warning[/] {run.caution}", highlight=False)
    named, fps = _cameras(asked, flight)
    if asked.width:
        named = [(name, camera.resized(asked.width, _height(camera, asked.width))) for name, camera in named]
    _refuse_large(asked, [camera for _, camera in named])
    if asked.output.suffix:
        said = _write_film(asked, run, flight, named, fps, console)
    else:
        said = _write_pictures(asked, run, flight, named, console)
    console.print(f"{run.line}: {said}, drawn in {time.monotonic() - began:.1f} s: {asked.output}", highlight=False)


def _check(asked: RenderRequest) -> None:
    refuse(asked)
    if asked.raw and asked.kind == "image":
        raise VdgsError("--raw writes the numbers of a map: it needs --kind depth, visibility or alpha.")
    if asked.raw and asked.output.suffix:
        raise VdgsError(f"{asked.output}: a film holds no numbers. Give a folder for --output, or leave out --raw.")


def _write_film(
    asked: RenderRequest,
    run: OpenedModel,
    flight: Flight,
    named: list[tuple[str, Camera]],
    fps: float,
    console: Console,
) -> str:
    """Draw the frames of a film; returns what to say of it."""
    if asked.output.is_dir():
        raise VdgsError(f"{asked.output}: is a folder. Give another name for the film.")
    sizes = {(camera.width, camera.height) for _, camera in named}
    if len(sizes) > 1:
        raise VdgsError(
            f"{asked.output}: a film needs frames of one size, and these views have {len(sizes)}. Give a folder."
        )
    with VideoWriter(asked.output, fps) as film:
        drawn = _map(asked, run, flight, named)
        for frame in _frames(asked, run, named, drawn, console):
            film.write(frame.picture)
    (width, height), strip = sizes.pop(), ""
    if drawn is not None and asked.legend:
        rows = len(legend(drawn.scale, width, height))
        height, strip = height + rows, f", the lowest {rows} rows of them the legend"
    return (
        f"{_frames_of(len(named))} of {width // 2 * 2}x{height // 2 * 2} px{strip}, a film of {len(named) / fps:.1f} s "
        f"at {fps:g} frames a second"
    )


def _write_pictures(
    asked: RenderRequest, run: OpenedModel, flight: Flight, named: list[tuple[str, Camera]], console: Console
) -> str:
    """Draw pictures into a folder; returns what to say of them."""
    kinds = (".png", ".npy") if asked.raw else (".png",)
    names = [name + kind for name, _ in named for kind in kinds]
    earlier = render_folder.begin(asked.output, names)
    drawn = _map(asked, run, flight, named)
    for frame in _frames(asked, run, named, drawn, console):
        write_png(asked.output / f"{frame.name}.png", frame.picture)
        if asked.raw and frame.values is not None:
            write_array(asked.output / f"{frame.name}.npy", frame.values)
    render_folder.finish(asked.output, earlier, names, _facts(asked, run, drawn))
    sizes = list(dict.fromkeys(f"{camera.width}x{camera.height} px" for _, camera in named))
    said = f"{_frames_of(len(named))} of {sizes[0] if len(sizes) == 1 else f'{len(sizes)} sizes'}"
    said += ", each with its numbers as .npy" if asked.raw else ""
    return said + (f", in place of {len(earlier)} files of an earlier render" if earlier else "")


def _frames_of(count: int) -> str:
    return f"{count:,} frame{'' if count == 1 else 's'}"


def _map(asked: RenderRequest, run: OpenedModel, flight: Flight, named: list[tuple[str, Camera]]) -> Map | None:
    """The map that all views are drawn as; None for plain pictures."""
    return None if asked.kind == "image" else map_of(asked.kind, run, flight, [camera for _, camera in named])


def _facts(asked: RenderRequest, run: OpenedModel, drawn: Map | None) -> dict[str, object]:
    """What render.json says of the pictures beside it."""
    facts: dict[str, object] = {
        "run": str(asked.run.resolve()), "model": run.name, "kind": asked.kind,
        "views": str(asked.path) if asked.path is not None else asked.views,
    }  # fmt: skip
    if drawn is not None:
        facts |= {"numbers": drawn.meaning, "colours_between": [drawn.scale.low, drawn.scale.high],
                  "legend_below": asked.legend}  # fmt: skip
    return facts


def _flight(asked: RenderRequest, run: OpenedModel) -> Flight:
    """The cameras of the run: as it keeps them, else of its capture, which is asked too where it is named."""
    described = run.model.metadata.capture
    kept = kept_flight(run.folder, described) if asked.capture is None else None
    if kept is not None:
        return kept
    capture = open_capture(run.folder, asked.capture)
    refuse_another_capture(run.model_path, described, capture)
    return flight_of(capture)


def _cameras(asked: RenderRequest, flight: Flight) -> tuple[list[tuple[str, Camera]], float]:
    """The cameras with their names, and the frames per second for a film of them."""
    if asked.path is None and asked.views in ("test", "train"):
        names, cameras = zip(*(flight.test if asked.views == "test" else flight.train), strict=True)
        return list(zip(file_stems(list(names)), cameras, strict=True)), asked.fps or SLIDES_PER_SECOND
    template = flight.cameras[0]
    length, rate = asked.seconds or camera_paths.SECONDS, asked.fps or camera_paths.FPS
    if asked.path is not None:
        path = load_path(asked.path, template, flight.ground, asked.seconds or None, asked.fps or None, flight.root)
    elif asked.views == "orbit":
        path = camera_paths.orbit(flight.middle[None], flight.cameras, template, length, rate)
    else:
        path = camera_paths.flyover(flight.cameras, template, length, rate)
    return [(f"{i:05d}", camera) for i, camera in enumerate(path.cameras)], path.fps


def _refuse_large(asked: RenderRequest, cameras: list[Camera]) -> None:
    """Raise VdgsError, before anything is drawn, for pictures that memory does not hold or nothing can show."""
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    size = f"{largest.width}x{largest.height}"
    where = f"{asked.path}: " if asked.path is not None and not asked.width else ""
    if max(largest.width, largest.height) > LARGEST_SIDE_PX:
        raise VdgsError(
            f"{where}pictures of {size} are too large: at most {LARGEST_SIDE_PX} pixels a side can be drawn. "
            "Give a smaller --width."
        )
    need, free = largest.width * largest.height * BYTES_PER_PIXEL, available_bytes()
    if need > free:
        raise VdgsError(
            f"{where}a picture of {size} takes about {data_size(need)} to draw, and {data_size(free)} are free. "
            "Give a smaller --width."
        )


def _height(camera: Camera, width: int) -> int:
    return max(2, 2 * round(camera.height * width / camera.width / 2))


def _frames(
    asked: RenderRequest, run: OpenedModel, named: list[tuple[str, Camera]], drawn: Map | None, console: Console
) -> Iterator[_Frame]:
    """One picture per camera, in order."""
    for name, camera in track(named, "rendering", console=console, disable=not console.is_terminal):
        stop_if_asked()
        if drawn is None:
            yield _Frame(name, to_8bit(render(run.model, camera).image.cpu().numpy()), None)
            continue
        values = drawn.values(camera)
        picture = drawn.scale.coloured(values)
        yield _Frame(name, with_legend(picture, drawn.scale) if asked.legend else picture, values)
