"""`vdgs render`: views of a run or a camera path, as PNG files or as a video."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib
import numpy as np
from rich.console import Console
from rich.progress import track

from vdgs.cameras import Camera
from vdgs.errors import VdgsError
from vdgs.evaluation.metrics import to_8bit
from vdgs.evaluation.saving import file_stems, write_png
from vdgs.films import paths as render_paths
from vdgs.films.video import VideoWriter
from vdgs.model.render import render, render_values
from vdgs.runs.opening import TrainedRun, open_run
from vdgs.runs.visibility import visibility_of_run
from vdgs.settings.ranges import refuse
from vdgs.settings.requests import RenderRequest

#: Pace of a film of separate views.
SLIDES_PER_SECOND = 2.0


def render_run(asked: RenderRequest, console: Console) -> None:
    """Render what was asked for, on a device that is chosen already (`vdgs.kernels.devices`).

    Raises VdgsError for an unusable path, codec or output.
    """
    refuse(asked)
    run = open_run(asked.run, asked.model, asked.device)
    named, fps = _cameras(asked, run)
    if asked.width:
        named = [(name, camera.resized(asked.width, _height(camera, asked.width))) for name, camera in named]
    frames = _frames(asked.kind, run, named, console)
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


def _cameras(asked: RenderRequest, run: TrainedRun) -> tuple[list[tuple[str, Camera]], float]:
    """The cameras with their names, and the frames per second for a film of them."""
    capture = run.capture
    if asked.path is None and asked.views in ("test", "train"):
        views = capture.test_views if asked.views == "test" else capture.train_views
        stems = file_stems([view.name for view in views])
        cameras, fps = [view.camera for view in views], asked.fps or SLIDES_PER_SECOND
        return list(zip(stems, cameras, strict=True)), fps
    flown, template = [view.camera for view in capture.train_views], capture.train_views[0].camera
    length, rate = asked.seconds or render_paths.SECONDS, asked.fps or render_paths.FPS
    if asked.path is not None:
        path = render_paths.load_path(asked.path, template, capture.ground, asked.seconds or None, asked.fps or None)
    elif asked.views == "orbit":
        path = render_paths.orbit(capture.points, flown, template, length, rate)
    else:
        path = render_paths.flyover(flown, template, length, rate)
    return [(f"{i:05d}", camera) for i, camera in enumerate(path.cameras)], path.fps


def _height(camera: Camera, width: int) -> int:
    return max(2, 2 * round(camera.height * width / camera.width / 2))


def _frames(
    kind: str, run: TrainedRun, named: list[tuple[str, Camera]], console: Console
) -> Iterator[tuple[str, np.ndarray]]:
    """One uint8 RGB picture per camera, in order."""
    counts = visibility_of_run(run).float() if kind == "visibility" else None
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
