"""`vdgs render`: views of a run or a camera path, as PNG files or as a video."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from rich.console import Console
from rich.progress import track
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.errors import VdgsError
from vdgs.evaluation.of_run import TrainedRun, open_run
from vdgs.files import write_atomically
from vdgs.render import render, render_values
from vdgs.verbs import RenderArguments


def render_run(asked: RenderArguments, console: Console) -> None:
    """Render what was asked for. Raises VdgsError for an unusable path, codec or output."""
    run = open_run(asked.run)
    named = _cameras(asked, run)
    if asked.width:
        named = [(name, camera.resized(asked.width, _height(camera, asked.width))) for name, camera in named]
    frames = _frames(asked.kind, run, named, console)
    if asked.output.suffix == ".mp4":
        from vdgs.video import write_video

        write_video(asked.output, (frame for _, frame in frames), asked.fps)
    elif asked.output.suffix:
        raise VdgsError(f"{asked.output}: give a folder (for PNG files) or a file that ends in .mp4")
    else:
        for name, frame in frames:
            write_png(asked.output / f"{name}.png", frame)
    console.print(f"{len(named)} views: {asked.output}", highlight=False)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write uint8 RGB [h, w, 3] atomically."""
    encoded = cv2.imencode(".png", image[..., ::-1])[1]
    write_atomically(path, lambda temporary: temporary.write_bytes(encoded.tobytes()) and None)


def _cameras(asked: RenderArguments, run: TrainedRun) -> list[tuple[str, Camera]]:
    from vdgs import render_paths

    count = max(2, round(asked.seconds * asked.fps))
    if asked.path is not None:
        cameras = render_paths.load_path(asked.path, count)
    elif asked.views == "orbit":
        cameras = render_paths.orbit(run.capture, count)
    elif asked.views == "flyover":
        cameras = render_paths.flyover(run.capture, count)
    else:
        views = run.capture.test_views if asked.views == "test" else run.capture.train_views
        return [(str(Path(view.name).with_suffix("")), view.camera) for view in views]
    return [(f"{i:05d}", camera) for i, camera in enumerate(cameras)]


def _height(camera: Camera, width: int) -> int:
    return max(2, 2 * round(camera.height * width / camera.width / 2))


def _frames(
    kind: str, run: TrainedRun, named: list[tuple[str, Camera]], console: Console
) -> Iterator[tuple[str, np.ndarray]]:
    """One uint8 RGB picture per camera, in order."""
    counts = run.views_of_anchors().float() if kind == "visibility" else None
    span: tuple[float, float] | None = None if counts is None else (0.0, float(counts.max()))
    for name, camera in track(named, "rendering", console=console, disable=not console.is_terminal):
        if kind == "image":
            yield name, to_uint8(render(run.model, camera).image)
            continue
        if counts is not None:
            values = render_values(run.model, counts, camera).numpy()
        else:
            raster = render(run.model, camera, depth=True)
            assert raster.depth is not None
            alpha = raster.alpha.numpy()
            values = np.where(alpha > 0.5, raster.depth.numpy() / np.maximum(alpha, 1e-6), np.nan)
            span = span or _span(values)
        yield name, coloured(values, span or (0.0, 1.0))


def _span(values: np.ndarray) -> tuple[float, float]:
    """The 1 to 99 % range of the first frame, used for all, so that colours do not flicker."""
    seen = values[np.isfinite(values)]
    return (float(np.quantile(seen, 0.01)), float(np.quantile(seen, 0.99))) if seen.size else (0.0, 1.0)


def to_uint8(image: Tensor) -> np.ndarray:
    """[h, w, 3] in [0, 1] to 8 bits, rounded."""
    return (image.clamp(0, 1) * 255 + 0.5).byte().numpy()


def coloured(values: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """A map [h, w] in viridis, black where it is NaN."""
    scaled = (values - span[0]) / max(span[1] - span[0], 1e-9)
    picture = matplotlib.colormaps["viridis"](np.nan_to_num(scaled).clip(0, 1))[..., :3]
    picture[~np.isfinite(values)] = 0.0
    return (picture * 255 + 0.5).astype(np.uint8)
