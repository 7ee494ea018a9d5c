"""What can be seen of a scene from a camera: colour, depth, V, alpha, blocks, errors. Numbers in the colours and with
the legends of `vdgs render`."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from vdgs.captures.camera_height import camera_height
from vdgs.evaluation.metrics import to_8bit
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import decode_view, rasterize_splats, render, render_scalar_map
from vdgs.viewer.image_comparison import ImageComparison, warp_image
from vdgs.viewer.lod import LodLevel
from vdgs.viewer.viewer_scene import ViewerScene

if TYPE_CHECKING:
    from vdgs.rendering.scalar_maps import ColorScale

Layer = Literal["color", "depth", "visibility", "alpha", "blocks", "error"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
#: Errors from here on have the colour of the end, as a share of full brightness (choice).
_MAX_ERROR = 0.25
#: How much of the colour is that of the block.
_TINT_STRENGTH = 0.6
#: The range of depths is found in a picture so wide.
_PREVIEW_PX = 160
#: Of the line between two pictures.
_DIVIDER_COLOR = (255, 255, 255)


@dataclass(frozen=True)
class DisplayOptions:
    """What a visitor has chosen to see."""

    layer: Layer = "color"
    #: "merged", "coarse", or "both" beside each other, the coarse one left of `split` (share of the width).
    model: str = "merged"
    split: float = 0.5
    #: A photograph, by its number, laid over the picture left of `photograph_split`; None: no photograph.
    image_index: int | None = None
    image_split: float = 0.5


class Painter:
    """Draws for one visitor. Depth keeps its colours until `settle`: they would flicker while the camera moves."""

    def __init__(self, scene: ViewerScene) -> None:
        self._scene = scene
        self._comparison = ImageComparison(scene)
        self._depth: ColorScale | None = None
        #: Anchors that the last picture was drawn from: what its time is learned from.
        self.drawn_anchors = 0

    def cache_key(self, display: DisplayOptions) -> Hashable:
        """What a picture depends on beside the camera and what is shown: pictures of equal keys are equal."""
        depth = self._depth if display.layer == "depth" else None
        return self._scene.generation, None if depth is None else (depth.low, depth.high)

    def update_depth_range(self, display: DisplayOptions, full_camera: Camera) -> None:
        """The camera has come to rest: the range of depths becomes that of what it sees."""
        if display.layer == "depth":
            from vdgs.rendering.scalar_maps import depth_range, depth_scale

            depth = _depth(self._scene.model(self._model(display)), full_camera.limit_size(_PREVIEW_PX))
            capture = self._scene.capture
            self._depth = depth_scale(depth_range([depth], camera_height(capture)), capture.ground.unit)

    def scale(self, display: DisplayOptions) -> ColorScale | None:
        """What the colours mean; None for pictures that need no legend."""
        from vdgs.rendering import scalar_maps

        if display.layer == "depth":
            return self._depth
        if display.layer == "visibility":
            return scalar_maps.visibility_scale(self._scene.visibility(self._model(display)).cpu().numpy())
        if display.layer == "alpha":
            return scalar_maps.alpha_scale()
        return error_scale() if display.layer == "error" else None

    def count_visible_anchors(self, display: DisplayOptions, camera: Camera) -> int:
        """How many anchors a full picture is drawn from."""
        both = display.model == "both" and len(self._scene.names) > 1
        return sum(
            self._scene.get_level(name, camera)[1] for name in (self._scene.names if both else [self._model(display)])
        )

    def paint(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None = None
    ) -> UInt8[np.ndarray, "h w 3"]:
        """A picture, or rows of it: `camera` is `whole` or cropped from it, all columns. `most`: drawn from at most so
        many anchors."""
        self.drawn_anchors = 0
        if display.model == "both" and len(self._scene.names) > 1:
            picture = self._side_by_side(display, camera, full_camera, max_anchors)
        else:
            picture = self._render_model(self._model(display), display, camera, full_camera, max_anchors)
        if display.image_index is not None:
            picture = self._with_image(display, camera, picture)
        return picture

    def _model(self, display: DisplayOptions) -> str:
        return display.model if display.model in self._scene.names else self._scene.names[0]

    def _render_model(
        self, name: str, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None
    ) -> UInt8[np.ndarray, "h w 3"]:
        level, count = self._scene.get_level(name, camera, max_anchors)
        self.drawn_anchors += count
        if display.layer == "color":
            return to_8bit(render(level.model, camera).image.cpu().numpy())
        if display.layer == "blocks":
            return _render_block_tints(level.model, level.of(self._scene.block_tint(name)), camera)
        if display.layer == "depth" and self._depth is None:
            self.update_depth_range(display, full_camera)
        scale = self.scale(display)
        assert scale is not None
        return scale.colorize(self._values(name, level, display, camera, full_camera))

    def _values(
        self, name: str, level: LodLevel, display: DisplayOptions, camera: Camera, full_camera: Camera
    ) -> np.ndarray:
        if display.layer == "depth":
            return _depth(level.model, camera)
        if display.layer == "visibility":
            return render_scalar_map(level.model, level.of(self._scene.visibility(name)), camera).cpu().numpy()
        if display.layer == "alpha":
            return render(level.model, camera).alpha.cpu().numpy()
        return self._comparison.error_map(name, camera, full_camera)

    def _side_by_side(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None
    ) -> UInt8[np.ndarray, "h w 3"]:
        edge = split_column(display.split, camera.width)
        parts = []
        for name, left, right in (("coarse", 0, edge), ("merged", edge, camera.width)):
            if left < right:
                parts.append(
                    self._render_model(
                        name, display, camera.cropped(left, 0, right, camera.height), full_camera, max_anchors
                    )
                )
        return _draw_divider(np.concatenate(parts, axis=1), edge)

    def _with_image(self, display: DisplayOptions, camera: Camera, picture: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
        assert display.image_index is not None
        edge = split_column(display.image_split, camera.width)
        photograph, there = warp_image(self._scene, display.image_index, camera)
        there[:, edge:] = False
        return _draw_divider(np.where(there[..., None], photograph, picture), edge)


def split_column(split: float, width: int) -> int:
    """The column at which a picture is split."""
    return round(min(max(split, 0.0), 1.0) * width)


def _draw_divider(picture: np.ndarray, edge: int) -> UInt8[np.ndarray, "h w 3"]:
    """With a line where two pictures meet."""
    if 0 < edge < picture.shape[1]:
        picture = picture.copy()
        picture[:, edge - 1 : edge] = _DIVIDER_COLOR
    return picture


def _depth(model: AnchorModel, camera: Camera) -> np.ndarray:
    raster = render(model, camera, depth=True)
    assert raster.median_depth is not None
    depth, alpha = raster.median_depth.cpu().numpy(), raster.alpha.cpu().numpy()
    return np.where(alpha > 0.5, depth, np.nan).astype(np.float32)


@torch.no_grad()
def _render_block_tints(model: AnchorModel, tints: Tensor, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The scene with the colours of the blocks that own its anchors."""
    rows, splats = decode_view(model, camera)
    k = model.anchors.offsets.shape[1]
    tint = tints[rows][splats.source.long() // k]
    colors = (1 - _TINT_STRENGTH) * splats.colors.mean(dim=1, keepdim=True) + _TINT_STRENGTH * tint
    background = splats.means_px.new_tensor(model.background)
    raster = rasterize_splats(replace(splats, colors=colors.contiguous()), camera, background)
    return to_8bit(raster.image.cpu().numpy())


def error_scale() -> ColorScale:
    """From dark, where the model is right, to bright."""
    import matplotlib as mpl

    from vdgs.rendering.scalar_maps import ColorScale

    colors = mpl.colormaps["inferno"]
    numbers = (0.0, 0.05, 0.1, 0.15, 0.2, _MAX_ERROR)
    ticks = tuple((value, f"≥ {value:.0%}" if value == _MAX_ERROR else f"{value:.0%}") for value in numbers)
    titles = ("difference from the nearest photograph", "error of the photograph", "error")
    paint: Callable[[np.ndarray], np.ndarray] = lambda values: np.asarray(colors(values / _MAX_ERROR))  # noqa: E731
    return ColorScale(titles=titles, low=0.0, high=_MAX_ERROR, ticks=ticks, colormap=paint)
