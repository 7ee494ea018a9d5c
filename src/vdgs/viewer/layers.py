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
from vdgs.model.renderer import decode_view, draw, render, render_values
from vdgs.viewer.image_comparison import Comparison, laid_over
from vdgs.viewer.lod import Level
from vdgs.viewer.viewer_scene import Scene

if TYPE_CHECKING:
    from vdgs.rendering.scalar_maps import Scale

Layer = Literal["colour", "depth", "visibility", "alpha", "blocks", "error"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
#: Errors from here on have the colour of the end, as a share of full brightness (choice).
_WORST = 0.25
#: How much of the colour is that of the block.
_TINTED = 0.6
#: The range of depths is found in a picture so wide.
_PREVIEW_PX = 160
#: Of the line between two pictures.
_LINE = (255, 255, 255)


@dataclass(frozen=True)
class Shown:
    """What a visitor has chosen to see."""

    layer: Layer = "colour"
    #: "merged", "coarse", or "both" beside each other, the coarse one left of `split` (share of the width).
    model: str = "merged"
    split: float = 0.5
    #: A photograph, by its number, laid over the picture left of `photograph_split`; None: no photograph.
    photograph: int | None = None
    photograph_split: float = 0.5


class Painter:
    """Draws for one visitor. Depth keeps its colours until `settle`: they would flicker while the camera moves."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._comparison = Comparison(scene)
        self._depth: Scale | None = None
        #: Anchors that the last picture was drawn from: what its time is learned from.
        self.drawn = 0

    def key(self, shown: Shown) -> Hashable:
        """What a picture depends on beside the camera and what is shown: pictures of equal keys are equal."""
        depth = self._depth if shown.layer == "depth" else None
        return self._scene.generation, None if depth is None else (depth.low, depth.high)

    def settle(self, shown: Shown, whole: Camera) -> None:
        """The camera has come to rest: the range of depths becomes that of what it sees."""
        if shown.layer == "depth":
            from vdgs.rendering.scalar_maps import depth_scale, depth_span

            depth = _depth(self._scene.model(self._model(shown)), whole.within(_PREVIEW_PX))
            capture = self._scene.capture
            self._depth = depth_scale(depth_span([depth], camera_height(capture)), capture.ground.unit)

    def scale(self, shown: Shown) -> Scale | None:
        """What the colours mean; None for pictures that need no legend."""
        from vdgs.rendering import scalar_maps

        if shown.layer == "depth":
            return self._depth
        if shown.layer == "visibility":
            return scalar_maps.seen_scale(self._scene.seen(self._model(shown)).cpu().numpy())
        if shown.layer == "alpha":
            return scalar_maps.alpha_scale()
        return error_scale() if shown.layer == "error" else None

    def in_view(self, shown: Shown, camera: Camera) -> int:
        """How many anchors a full picture is drawn from."""
        both = shown.model == "both" and len(self._scene.names) > 1
        return sum(self._scene.level(name, camera)[1] for name in (self._scene.names if both else [self._model(shown)]))

    def paint(self, shown: Shown, camera: Camera, whole: Camera, most: int | None = None) -> UInt8[np.ndarray, "h w 3"]:
        """A picture, or rows of it: `camera` is `whole` or cropped from it, all columns. `most`: drawn from at most so
        many anchors."""
        self.drawn = 0
        if shown.model == "both" and len(self._scene.names) > 1:
            picture = self._side_by_side(shown, camera, whole, most)
        else:
            picture = self._of(self._model(shown), shown, camera, whole, most)
        if shown.photograph is not None:
            picture = self._with_photograph(shown, camera, picture)
        return picture

    def _model(self, shown: Shown) -> str:
        return shown.model if shown.model in self._scene.names else self._scene.names[0]

    def _of(
        self, name: str, shown: Shown, camera: Camera, whole: Camera, most: int | None
    ) -> UInt8[np.ndarray, "h w 3"]:
        level, count = self._scene.level(name, camera, most)
        self.drawn += count
        if shown.layer == "colour":
            return to_8bit(render(level.model, camera).image.cpu().numpy())
        if shown.layer == "blocks":
            return _tinted(level.model, level.of(self._scene.tint(name)), camera)
        if shown.layer == "depth" and self._depth is None:
            self.settle(shown, whole)
        scale = self.scale(shown)
        assert scale is not None
        return scale.coloured(self._values(name, level, shown, camera, whole))

    def _values(self, name: str, level: Level, shown: Shown, camera: Camera, whole: Camera) -> np.ndarray:
        if shown.layer == "depth":
            return _depth(level.model, camera)
        if shown.layer == "visibility":
            return render_values(level.model, level.of(self._scene.seen(name)), camera).cpu().numpy()
        if shown.layer == "alpha":
            return render(level.model, camera).alpha.cpu().numpy()
        return self._comparison.error_in(name, camera, whole)

    def _side_by_side(
        self, shown: Shown, camera: Camera, whole: Camera, most: int | None
    ) -> UInt8[np.ndarray, "h w 3"]:
        edge = column(shown.split, camera.width)
        parts = []
        for name, left, right in (("coarse", 0, edge), ("merged", edge, camera.width)):
            if left < right:
                parts.append(self._of(name, shown, camera.cropped(left, 0, right, camera.height), whole, most))
        return _lined(np.concatenate(parts, axis=1), edge)

    def _with_photograph(self, shown: Shown, camera: Camera, picture: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
        assert shown.photograph is not None
        edge = column(shown.photograph_split, camera.width)
        photograph, there = laid_over(self._scene, shown.photograph, camera)
        there[:, edge:] = False
        return _lined(np.where(there[..., None], photograph, picture), edge)


def column(split: float, width: int) -> int:
    """The column at which a picture is split."""
    return round(min(max(split, 0.0), 1.0) * width)


def _lined(picture: np.ndarray, edge: int) -> UInt8[np.ndarray, "h w 3"]:
    """With a line where two pictures meet."""
    if 0 < edge < picture.shape[1]:
        picture = picture.copy()
        picture[:, edge - 1 : edge] = _LINE
    return picture


def _depth(model: AnchorModel, camera: Camera) -> np.ndarray:
    raster = render(model, camera, depth=True)
    assert raster.median_depth is not None
    depth, alpha = raster.median_depth.cpu().numpy(), raster.alpha.cpu().numpy()
    return np.where(alpha > 0.5, depth, np.nan).astype(np.float32)


@torch.no_grad()
def _tinted(model: AnchorModel, tints: Tensor, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The scene with the colours of the blocks that own its anchors."""
    rows, splats = decode_view(model, camera)
    k = model.anchors.offsets.shape[1]
    tint = tints[rows][splats.source.long() // k]
    colours = (1 - _TINTED) * splats.colours.mean(dim=1, keepdim=True) + _TINTED * tint
    background = splats.means_px.new_tensor(model.background)
    raster = draw(replace(splats, colours=colours.contiguous()), camera, background)
    return to_8bit(raster.image.cpu().numpy())


def error_scale() -> Scale:
    """From dark, where the model is right, to bright."""
    import matplotlib as mpl

    from vdgs.rendering.scalar_maps import Scale

    colours = mpl.colormaps["inferno"]
    numbers = (0.0, 0.05, 0.1, 0.15, 0.2, _WORST)
    ticks = tuple((value, f"≥ {value:.0%}" if value == _WORST else f"{value:.0%}") for value in numbers)
    titles = ("difference from the nearest photograph", "error of the photograph", "error")
    paint: Callable[[np.ndarray], np.ndarray] = lambda values: np.asarray(colours(values / _WORST))  # noqa: E731
    return Scale(titles=titles, low=0.0, high=_WORST, ticks=ticks, paint=paint)
