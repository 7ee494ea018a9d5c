"""What `vdgs render --mode` draws of a model: values, colors that mean the same in every frame, and the colorbar."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Shaped, UInt8
from matplotlib.colors import Normalize
from matplotlib.ticker import MaxNLocator
from PIL import Image, ImageDraw
from torch import Tensor

from vdgs.evaluation.comparison_images import FAINT, INK, PAPER, load_font
from vdgs.geometry.camera import Camera
from vdgs.model.lod_scene import LodScene
from vdgs.model.renderer import Drawable, render, render_scalar_map
from vdgs.runs.open_run import OpenedModel
from vdgs.runs.run_cameras import RunCameras
from vdgs.runs.visibility_store import get_run_visibility
from vdgs.system.figure_style import VISIBILITY_CMAP
from vdgs.visibility.visibility_counts import count_visibility
from vdgs.visibility.visibility_map import visibility_color_norm

ScalarMapMode = Literal["depth", "visibility", "alpha"]

#: Where there is nothing to draw; in none of the color maps but that of alpha, which draws everywhere.
NO_DATA_COLOR = (208, 211, 215)
#: The range of depths is that of so many views at most, spread over all, drawn so small (longer side): one for the
#: whole film, found before its first frame.
_MAX_PREVIEWS, _PREVIEW_PX = 24, 160
#: Type in pixels: a share of the picture's width between these.
_MIN_FONT_PX, _MAX_FONT_PX, _FONT_SHARE = 11, 26, 1 / 46
_NO_DATA_LABEL = "nothing drawn"


@dataclass(frozen=True, eq=False, kw_only=True)
class ColorScale:
    """How numbers become colors: the same for all frames."""

    #: What the numbers are, with their unit: the longest first, for as much room as there is.
    titles: tuple[str, ...]
    #: Where the colors end; numbers beyond take the color of the end.
    low: float
    high: float
    #: Numbers that the legend names, with their words.
    ticks: tuple[tuple[float, str], ...]
    #: Numbers to RGBA in 0 to 1.
    colormap: Callable[[np.ndarray], np.ndarray]
    #: Whether a number may be missing (NaN).
    has_nodata: bool = True

    def colorize(self, values: Shaped[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
        """A map in colors, `NO_DATA_COLOR` where it is NaN."""
        known = np.isfinite(values)
        image = (self.colormap(np.where(known, values, self.low))[..., :3] * 255 + 0.5).astype(np.uint8)
        image[~known] = NO_DATA_COLOR
        return image


@dataclass(frozen=True, eq=False)
class ScalarMap:
    """A kind of map of one run: its values in a view (float32, NaN where there is nothing), their colors and words."""

    values: Callable[[Camera], Float[np.ndarray, "h w"]]
    scale: ColorScale
    #: What the numbers are, in a sentence.
    description: str


def make_scalar_map(
    mode: ScalarMapMode, run: OpenedModel, scene: Drawable, run_cameras: RunCameras, cameras: Sequence[Camera]
) -> ScalarMap:
    """The map of a model, drawn as `scene`, in all of `cameras`; `run_cameras` are those of its run."""
    if mode == "visibility":
        return _visibility(run, scene, run_cameras)
    return _alpha(scene) if mode == "alpha" else _depth(scene, run_cameras, cameras)


def render_depth(model: Drawable, camera: Camera) -> Float[np.ndarray, "h w"]:
    """Median depth of a view; NaN where a pixel is at most half opaque."""
    raster = render(model, camera, depth=True)
    assert raster.median_depth is not None
    depth, alpha = raster.median_depth.cpu().numpy(), raster.alpha.cpu().numpy()
    return np.where(alpha > 0.5, depth, np.nan).astype(np.float32)


def _depth(scene: Drawable, run_cameras: RunCameras, cameras: Sequence[Camera]) -> ScalarMap:
    unit = run_cameras.ground.unit
    meaning = (
        f"Median depth: z along the view, in {unit} of the ground frame, at which a pixel becomes half opaque; NaN "
        "where it never does."
    )
    sampled = np.linspace(0, len(cameras) - 1, min(len(cameras), _MAX_PREVIEWS)).round().astype(int)
    previews = (render_depth(scene, cameras[index].limit_size(_PREVIEW_PX)) for index in sampled)
    scale = depth_scale(depth_range(previews, run_cameras.camera_height), unit)
    return ScalarMap(lambda camera: render_depth(scene, camera), scale, meaning)


def depth_range(depths: Iterable[Float[np.ndarray, "_ _"]], fallback: float) -> tuple[float, float]:
    """Least and greatest depth in these maps, without the outermost 1 % of each: no view may fall out of the colors.

    From 0 to twice `fallback` where nothing is drawn in any.
    """
    ends = [np.nanquantile(depth, (0.01, 0.99)) for depth in depths if np.isfinite(depth).any()]
    return (float(np.min(ends)), float(np.max(ends))) if ends else (0.0, 2.0 * fallback)


def depth_scale(depth_limits: tuple[float, float], unit: str) -> ColorScale:
    """Viridis between round numbers that hold the span."""
    low, high = depth_limits
    if high - low <= 1e-3 * abs(high):  # one plane
        low, high = 0.99 * low, 1.01 * high or 1.0
    ticks = [float(tick) for tick in MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)]
    norm, colors = Normalize(ticks[0], ticks[-1], clip=True), mpl.colormaps["viridis"]
    labels = [f"{number:g}" for number in np.round(ticks, 9)]
    labels[0], labels[-1] = f"≤ {labels[0]}" if ticks[0] > 0 else labels[0], f"≥ {labels[-1]}"
    return ColorScale(
        titles=(f"depth along the view ({unit})", f"depth ({unit})", unit),
        low=ticks[0],
        high=ticks[-1],
        ticks=tuple(zip(ticks, labels, strict=True)),
        colormap=lambda values: np.asarray(colors(norm(values))),
    )


def _visibility(run: OpenedModel, scene: Drawable, run_cameras: RunCameras) -> ScalarMap:
    meaning = (
        "V: how many training cameras see the place, the mean over the anchors that a pixel shows; NaN where alpha is "
        "at most 0.5."
    )

    def count(places: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        return count_visibility(places, run_cameras.cameras).float()

    tree = scene if isinstance(scene, LodScene) else None
    counts = get_run_visibility(run, run_cameras.cameras) if tree is None else count(tree.tree.gaussians(0).means)

    def values(camera: Camera) -> Float[np.ndarray, "h w"]:
        of_view = counts.float() if tree is None else tree.values(camera, lambda _, places: count(places()))
        return render_scalar_map(scene, of_view, camera).cpu().numpy().astype(np.float32)

    return ScalarMap(values, visibility_scale(counts.cpu().numpy()), meaning)


def visibility_scale(counts: Shaped[np.ndarray, " n"]) -> ColorScale:
    """One color for each whole V, those of all other figures of the project; the last holds all above it."""
    top, norm = visibility_color_norm(counts)
    more = bool(counts.max() > top)
    every = max(1, round(top / 10))
    levels = [level for level in range(0, top + 1, every) if level == 0 or top - level >= every] + [top]
    ticks = [(float(level), f"≥ {level}" if more and level == top else str(level)) for level in dict.fromkeys(levels)]
    return ColorScale(
        titles=("training cameras that see the place, V", "training cameras, V", "V"),
        low=-0.5,
        high=top + 0.5,
        ticks=tuple(ticks),
        colormap=lambda values: np.asarray(VISIBILITY_CMAP(norm(np.clip(np.rint(values), 0, top)))),
    )


def _alpha(scene: Drawable) -> ScalarMap:
    def values(camera: Camera) -> Float[np.ndarray, "h w"]:
        return render(scene, camera).alpha.cpu().numpy().astype(np.float32)

    return ScalarMap(values, alpha_scale(), "Alpha: how opaque the scene is, from 0 (nothing) to 1.")


def alpha_scale() -> ColorScale:
    """From black, where the scene is transparent, to white."""
    ticks = tuple((number / 4, f"{number / 4:g}") for number in range(5))
    gray = mpl.colormaps["gray"]
    titles = ("alpha: 0 nothing, 1 opaque", "alpha")
    return ColorScale(
        titles=titles,
        low=0.0,
        high=1.0,
        ticks=ticks,
        colormap=lambda values: np.asarray(gray(values)),
        has_nodata=False,
    )


def add_colorbar(image: UInt8[np.ndarray, "h w 3"], scale: ColorScale) -> UInt8[np.ndarray, "tall w 3"]:
    """The picture with the legend of its colors below it; both together have an even number of rows."""
    return np.concatenate([image, draw_colorbar(scale, image.shape[1], image.shape[0])])


def draw_colorbar(scale: ColorScale, width: int, above: int) -> UInt8[np.ndarray, "rows w 3"]:
    """The strip for a picture of `width` and `above` rows: what is measured, a bar of colors, numbers."""
    size = int(np.clip(round(width * _FONT_SHARE), _MIN_FONT_PX, _MAX_FONT_PX))
    margin, bar = size // 2, size
    top = margin + round(1.35 * size)
    rows = top + bar + round(1.75 * size)
    strip = Image.new("RGB", (width, rows + (above + rows) % 2), PAPER)
    draw = ImageDraw.Draw(strip)
    _heading(draw, scale, width, margin, size)
    draw.line((0, 0, width, 0), FAINT)  # alpha is white where all is well
    left, right = margin, max(width - margin, margin + 1)
    across = np.linspace(scale.low, scale.high, right - left)
    strip.paste(Image.fromarray(scale.colorize(np.broadcast_to(across, (bar, right - left)))), (left, top))
    draw.rectangle((left - 1, top - 1, right, top + bar), outline=FAINT)
    _numbers(draw, scale, (left, right), top + bar, size)
    return np.asarray(strip)


def _heading(draw: ImageDraw.ImageDraw, scale: ColorScale, width: int, margin: int, size: int) -> None:
    """What is measured at the left; at the right, where there is room for it, what no color stands for."""
    face = load_font(size)
    room = float(width - 2 * margin)
    title = next((each for each in scale.titles if face.getlength(each) <= room), "")
    draw.text((margin, margin), title, INK, face)
    patch = size + size // 2
    needed = face.getlength(_NO_DATA_LABEL) + patch
    if scale.has_nodata and room - face.getlength(title) - 2 * size >= needed:
        start = round(width - margin - needed)
        draw.rectangle((start, margin, start + size, margin + size), fill=NO_DATA_COLOR, outline=FAINT)
        draw.text((start + patch, margin), _NO_DATA_LABEL, INK, face)


def _numbers(draw: ImageDraw.ImageDraw, scale: ColorScale, bar: tuple[int, int], top: int, size: int) -> None:
    """The numbers below the bar, (left, right) in pixels: both ends first, then those that overlap no other."""
    face, (left, right) = load_font(size), bar
    taken: list[tuple[float, float]] = []
    for value, words in (scale.ticks[0], scale.ticks[-1], *scale.ticks[1:-1]):
        x = left + (value - scale.low) / (scale.high - scale.low) * (right - 1 - left)
        length = face.getlength(words)
        start = min(max(x - length / 2, left), right - length)
        if start < left or any(start < other[1] + size / 2 and other[0] < start + length + size / 2 for other in taken):
            continue
        taken.append((start, start + length))
        draw.line((round(x), top, round(x), top + size // 4), FAINT)
        draw.text((start, top + size // 3), words, INK, face)
