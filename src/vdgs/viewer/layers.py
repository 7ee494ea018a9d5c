"""The layers of a view: color, depth, V, alpha, blocks, errors; maps in the colors of `vdgs render`."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from vdgs.evaluation.metrics import to_8bit
from vdgs.geometry.camera import Camera
from vdgs.model.renderer import (
    Drawable,
    rasterize_splats,
    render,
    render_scalar_map,
    view_splats,
    without_aliasing,
)
from vdgs.viewer.image_comparison import ImageComparison, warp_image
from vdgs.viewer.lod import LodLevel
from vdgs.viewer.viewer_scene import ViewerScene
from vdgs.visibility.visibility_counts import FADE_BELOW

if TYPE_CHECKING:
    from vdgs.rendering.scalar_maps import ColorScale

Layer = Literal["color", "depth", "visibility", "alpha", "blocks", "error"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
#: Errors from here on have the color of the end, as a share of full brightness (choice).
_MAX_ERROR = 0.25
#: How much of the color is that of the block, or of a mark.
_TINT_STRENGTH = 0.6
#: What is marked where trust ends: places that fewer than two training cameras see, and two, RGB (choice).
TRUST_MARKS = ((0.85, 0.05, 0.25), (1.0, 0.72, 0.0))
#: The range of depths is found in an image so wide.
_PREVIEW_PX = 160
#: Of the line between two images.
_DIVIDER_COLOR = (255, 255, 255)


@dataclass(frozen=True)
class DisplayOptions:
    """What a client has chosen to see."""

    layer: Layer = "color"
    #: "merged", "coarse", or "both" beside each other, the coarse one left of `split` (share of the width).
    model: str = "merged"
    split: float = 0.5
    #: A photograph, by its number, laid over the image left of `image_split`; None: no photograph.
    image_index: int | None = None
    image_split: float = 0.5
    #: The scene fades out where fewer training cameras see it.
    min_visibility: int = FADE_BELOW
    #: In the layer `color`: mark what fewer than three training cameras see.
    mark_trust: bool = False


class Painter:
    """Draws for one client. Depth keeps its color range until `update_depth_range`, else colors flicker in motion."""

    def __init__(self, scene: ViewerScene) -> None:
        self._scene = scene
        self._comparison = ImageComparison(scene)
        self._depth: ColorScale | None = None
        #: Anchors that the last image was drawn from: the scheduler learns speed from them.
        self.drawn_anchors = 0

    def cache_key(self, display: DisplayOptions) -> Hashable:
        """What an image depends on beside the camera and the display options."""
        depth = self._depth if display.layer == "depth" else None
        return self._scene.generation, None if depth is None else (depth.low, depth.high)

    def update_depth_range(self, display: DisplayOptions, full_camera: Camera) -> None:
        """Set the range of depths to that of a view at rest."""
        if display.layer == "depth":
            from vdgs.rendering import scalar_maps

            small = full_camera.limit_size(_PREVIEW_PX)
            name = self._scene.shown_name(display.model)
            shown = self._scene.shown(name, small, min_visibility=display.min_visibility)
            depth = scalar_maps.render_depth(shown, small)
            depth_range = scalar_maps.depth_range([depth], self._scene.camera_height)
            self._depth = scalar_maps.depth_scale(depth_range, self._scene.capture.ground.unit)

    def scale(self, display: DisplayOptions) -> ColorScale | None:
        """What the colors mean; None for images that need no legend."""
        from vdgs.rendering import scalar_maps

        if display.layer == "depth":
            return self._depth
        if display.layer == "visibility":
            name = self._scene.shown_name(display.model)
            return scalar_maps.visibility_scale(self._scene.visibility_sample(name).cpu().numpy())
        if display.layer == "alpha":
            return scalar_maps.alpha_scale()
        if display.layer == "color" and display.mark_trust:
            return trust_scale()
        return error_scale() if display.layer == "error" else None

    def count_visible_anchors(self, display: DisplayOptions, camera: Camera) -> int:
        """How many anchors a full image is drawn from."""
        return sum(
            self._scene.get_level(name, camera, min_visibility=display.min_visibility)[1]
            for name in self._shown_names(display)
        )

    def parts_in_detail(self, display: DisplayOptions, camera: Camera) -> list[Camera]:
        """The parts of a full image that `paint` draws better in full detail; none where it is whole."""
        if display.layer == "error":  # drawn at the error of a view at rest
            return []
        parts = (
            self._scene.parts_in_detail(name, camera, display.min_visibility) for name in self._shown_names(display)
        )
        return max(parts, key=len)

    def paint(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None = None,
        *, full_detail: bool = False,
    ) -> UInt8[np.ndarray, "h w 3"]:  # fmt: skip
        """An image, or a part of it: `camera` is `full_camera` or cropped from it. With at most so many anchors, or in
        full detail from all of them; else as at first when a camera rests."""
        self.drawn_anchors = 0
        draw = partial(
            self._render_model, display=display, full_camera=full_camera, max_anchors=max_anchors,
            full_detail=full_detail,
        )  # fmt: skip
        if self._shows_both(display):
            image = self._side_by_side(display, camera, full_camera, draw)
        else:
            image = draw(self._scene.shown_name(display.model), camera=camera)
        return image if display.image_index is None else self._with_image(display, camera, full_camera, image)

    def _shown_names(self, display: DisplayOptions) -> Sequence[str]:
        return self._scene.names if self._shows_both(display) else [self._scene.shown_name(display.model)]

    def _shows_both(self, display: DisplayOptions) -> bool:
        return display.model == "both" and len(self._scene.names) > 1

    def _render_model(
        self, name: str, *, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None,
        full_detail: bool,
    ) -> UInt8[np.ndarray, "h w 3"]:  # fmt: skip
        level, count = self._scene.get_level(
            name, camera, max_anchors, full_camera=full_camera, full_detail=full_detail,
            min_visibility=display.min_visibility,
        )  # fmt: skip
        self.drawn_anchors += count
        if display.layer == "color":
            shown = without_aliasing(level.model, self._scene.pixel_at_camera_height)
            image = render(shown, camera).image
            if display.mark_trust:
                image = _with_trust_marks(image, shown, self._scene.level_visibility(name, level, camera), camera)
            return to_8bit(image.cpu().numpy())
        if display.layer == "blocks":
            return _render_block_tints(level.model, self._scene.level_tint(name, level, camera), camera)
        if display.layer == "depth" and self._depth is None:
            self.update_depth_range(display, full_camera)
        scale = self.scale(display)
        assert scale is not None
        return scale.colorize(self._values(name, level, display, camera, full_camera))

    def _values(
        self, name: str, level: LodLevel, display: DisplayOptions, camera: Camera, full_camera: Camera
    ) -> np.ndarray:
        if display.layer == "depth":
            from vdgs.rendering.scalar_maps import render_depth

            return render_depth(level.model, camera)
        if display.layer == "visibility":
            return (
                render_scalar_map(level.model, self._scene.level_visibility(name, level, camera), camera).cpu().numpy()
            )
        if display.layer == "alpha":
            return render(level.model, camera).alpha.cpu().numpy()
        return self._comparison.error_map(name, camera, full_camera, display.min_visibility)

    def _side_by_side(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, draw: Callable[..., np.ndarray]
    ) -> UInt8[np.ndarray, "h w 3"]:
        edge = split_column(display.split, camera, full_camera)
        middle = min(max(edge, 0), camera.width)
        parts = []
        for name, left, right in (("coarse", 0, middle), ("merged", middle, camera.width)):
            if left < right:
                parts.append(draw(name, camera=camera.cropped(left, 0, right, camera.height)))
        return _draw_divider(np.concatenate(parts, axis=1), edge)

    def _with_image(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, rendered: np.ndarray
    ) -> UInt8[np.ndarray, "h w 3"]:
        assert display.image_index is not None
        edge = split_column(display.image_split, camera, full_camera)
        photograph, covered = warp_image(self._scene, display.image_index, camera)
        covered[:, max(edge, 0) :] = False
        return _draw_divider(np.where(covered[..., None], photograph, rendered), edge)


def split_column(split: float, camera: Camera, full_camera: Camera) -> int:
    """The column of a part of an image at which all of it is split, also beyond the part; more than its width where
    nothing is right of the split."""
    column = round(min(max(split, 0.0), 1.0) * full_camera.width)
    return column + (column == full_camera.width) - round(full_camera.cx - camera.cx)


def _draw_divider(image: np.ndarray, edge: int) -> UInt8[np.ndarray, "h w 3"]:
    """With a line where two images meet."""
    if 0 < edge <= image.shape[1]:
        image = image.copy()
        image[:, edge - 1 : edge] = _DIVIDER_COLOR
    return image


@torch.no_grad()
def _render_block_tints(model: Drawable, tints: Tensor, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The scene with the colors of the blocks that its anchors are from."""
    rows, splats = view_splats(model, camera)
    tint = tints.to(rows.device)[rows]
    colors = (1 - _TINT_STRENGTH) * splats.colors.mean(dim=1, keepdim=True) + _TINT_STRENGTH * tint
    background = splats.means_px.new_tensor(model.background)
    raster = rasterize_splats(replace(splats, colors=colors.contiguous()), camera, background)
    return to_8bit(raster.image.cpu().numpy())


@torch.no_grad()
def _with_trust_marks(image: Tensor, model: Drawable, visibility: Tensor, camera: Camera) -> Tensor:
    """A picture [h, w, 3] of a model, colored by as much as what few training cameras see makes of each pixel."""
    rows, splats = view_splats(model, camera)
    seen, marks = visibility[rows][:, None], image.new_tensor(TRUST_MARKS)
    is_marked = torch.cat([seen < 2, seen == 2, torch.zeros_like(seen, dtype=torch.bool)], dim=1).to(image.dtype)
    parts = rasterize_splats(replace(splats, colors=is_marked), camera, image.new_zeros(3)).image[..., :2]
    parts = _TINT_STRENGTH * parts
    return image * (1 - parts.sum(dim=-1, keepdim=True)) + parts @ marks


def trust_scale() -> ColorScale:
    """What the marks mean, by V."""
    from vdgs.rendering.scalar_maps import ColorScale

    colors = np.array([*TRUST_MARKS, (1.0, 1.0, 1.0)])
    ticks = tuple((float(seen), f"≥ {seen}, as it is" if seen == 3 else str(seen)) for seen in range(4))
    titles = ("training cameras that see the place, V", "training cameras, V", "V")
    return ColorScale(
        titles=titles, low=-0.5, high=3.5, ticks=ticks, has_nodata=False,
        colormap=lambda values: colors[np.clip(np.rint(values).astype(int) - 1, 0, 2)],
    )  # fmt: skip


def error_scale() -> ColorScale:
    """From dark, where the model is right, to bright."""
    import matplotlib as mpl

    from vdgs.rendering.scalar_maps import ColorScale

    colors = mpl.colormaps["inferno"]
    values = (0.0, 0.05, 0.1, 0.15, 0.2, _MAX_ERROR)
    ticks = tuple((value, f"≥ {value:.0%}" if value == _MAX_ERROR else f"{value:.0%}") for value in values)
    titles = ("difference from the nearest photograph", "error of the photograph", "error")

    def colorize(errors: np.ndarray) -> np.ndarray:
        return np.asarray(colors(errors / _MAX_ERROR))

    return ColorScale(titles=titles, low=0.0, high=_MAX_ERROR, ticks=ticks, colormap=colorize)
