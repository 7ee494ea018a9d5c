"""`vdgs render`: views of a run or a camera path, as PNG files or as a video."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib
import numpy as np
from rich.console import Console
from rich.progress import track

from vdgs.cameras import Camera
from vdgs.captures.facts import refuse_another_capture
from vdgs.errors import VdgsError
from vdgs.evaluation.metrics import to_8bit
from vdgs.evaluation.saving import file_stems, write_png
from vdgs.films import paths as render_paths
from vdgs.films.path_files import load_path
from vdgs.films.video import VideoWriter
from vdgs.memory.process import available_bytes
from vdgs.model.render import render, render_values
from vdgs.runs.flight import Flight, flight_of, kept_flight
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import OpenedModel, open_capture, open_model
from vdgs.runs.visibility import visibility_of_run
from vdgs.settings.ranges import refuse
from vdgs.settings.requests import LARGEST_SIDE_PX, RenderRequest

#: Pace of a film of separate views.
SLIDES_PER_SECOND = 2.0
#: What drawing takes at most of memory for each pixel: the raster, its depth, pictures made of it.
BYTES_PER_PIXEL = 100


def render_run(asked: RenderRequest, console: Console) -> None:
    """Render what was asked for, on a device that is chosen already (`vdgs.kernels.devices`).

    Raises VdgsError for an unusable path, codec or output.
    """
    refuse(asked)
    folder = RunFolder(asked.run)
    run = open_model(folder, asked.model, asked.device)
    flight = _flight(asked, run)
    named, fps = _cameras(asked, flight)
    if asked.width:
        named = [(name, camera.resized(asked.width, _height(camera, asked.width))) for name, camera in named]
    _refuse_large(asked, [camera for _, camera in named])
    frames = _frames(asked.kind, run, flight, named, console)
    if asked.output.suffix:
        sizes = {(camera.width, camera.height) for _, camera in named}
        if len(sizes) > 1:
            raise VdgsError(
                f"{asked.output}: a film needs frames of one size, and these views have {len(sizes)}. Give a folder."
            )
        with VideoWriter(asked.output, fps) as film:
            for _, frame in frames:
                film.write(frame)
    else:
        for name, frame in frames:
            write_png(asked.output / f"{name}.png", frame)
    console.print(f"{len(named)} views: {asked.output}", highlight=False)


def _flight(asked: RenderRequest, run: OpenedModel) -> Flight:
    """The cameras of the run: as it keeps them, else of its capture, which is asked too where it is named."""
    facts = run.model.facts.get("capture", {})
    kept = kept_flight(run.folder, facts) if asked.capture is None else None
    if kept is not None:
        return kept
    capture = open_capture(run.folder, asked.capture)
    refuse_another_capture(run.model_path, facts, capture)
    return flight_of(capture)


def _cameras(asked: RenderRequest, flight: Flight) -> tuple[list[tuple[str, Camera]], float]:
    """The cameras with their names, and the frames per second for a film of them."""
    if asked.path is None and asked.views in ("test", "train"):
        names, cameras = zip(*(flight.test if asked.views == "test" else flight.train), strict=True)
        return list(zip(file_stems(list(names)), cameras, strict=True)), asked.fps or SLIDES_PER_SECOND
    template = flight.cameras[0]
    length, rate = asked.seconds or render_paths.SECONDS, asked.fps or render_paths.FPS
    if asked.path is not None:
        path = load_path(asked.path, template, flight.ground, asked.seconds or None, asked.fps or None)
    elif asked.views == "orbit":
        path = render_paths.orbit(flight.middle[None], flight.cameras, template, length, rate)
    else:
        path = render_paths.flyover(flight.cameras, template, length, rate)
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
            f"{where}a picture of {size} takes about {need / 1e9:.1f} GB to draw, and {free / 1e9:.1f} GB are free. "
            "Give a smaller --width."
        )


def _height(camera: Camera, width: int) -> int:
    return max(2, 2 * round(camera.height * width / camera.width / 2))


def _frames(
    kind: str, run: OpenedModel, flight: Flight, named: list[tuple[str, Camera]], console: Console
) -> Iterator[tuple[str, np.ndarray]]:
    """One uint8 RGB picture per camera, in order."""
    counts = visibility_of_run(run, flight.cameras).float() if kind == "visibility" else None
    span: tuple[float, float] | None = None if counts is None else (0.0, float(counts.max()))
    for name, camera in track(named, "rendering", console=console, disable=not console.is_terminal):
        if kind == "image":
            yield name, to_8bit(render(run.model, camera).image.cpu().numpy())
            continue
        if counts is not None:
            values = render_values(run.model, counts, camera).cpu().numpy()
        else:
            raster = render(run.model, camera, depth=True)
            assert raster.median_depth is not None
            values = np.where(raster.alpha.cpu().numpy() > 0.5, raster.median_depth.cpu().numpy(), np.nan)
            span = span or _span(values)
        yield name, coloured(values, span or (0.0, 1.0))


def _span(values: np.ndarray) -> tuple[float, float]:
    """The 1 to 99 % range of the first frame, used for all, so that colours do not flicker."""
    seen = values[np.isfinite(values)]
    return (float(np.quantile(seen, 0.01)), float(np.quantile(seen, 0.99))) if seen.size else (0.0, 1.0)


def coloured(values: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """A map [h, w] in viridis, black where it is NaN."""
    scaled = (values - span[0]) / max(span[1] - span[0], 1e-9)
    picture = matplotlib.colormaps["viridis"](np.nan_to_num(scaled).clip(0, 1))[..., :3]
    picture[~np.isfinite(values)] = 0.0
    return (picture * 255 + 0.5).astype(np.uint8)
