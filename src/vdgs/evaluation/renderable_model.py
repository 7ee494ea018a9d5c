"""A model as the evaluation sees it, and what is to be measured of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vdgs.captures.capture import View
from vdgs.evaluation import comparison_images
from vdgs.evaluation.by_visibility import DEFAULT_BINS
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster, Splats


class RenderedView(Protocol):
    """What a renderer returns; `alpha` [h, w] may come with it, as in `Raster`."""

    @property
    def image(self) -> Float[Tensor, "h w 3"]: ...


@dataclass(frozen=True, kw_only=True)
class EvaluatedModel:
    """What the evaluation reports of the model but cannot measure itself; None is unknown."""

    #: "coarse" or "merged".
    model: str | None = None
    n_anchors: int | None = None
    model_bytes: int | None = None
    train_seconds: float | None = None
    peak_memory_bytes: int | None = None
    #: What tells the model from any other, and the settings that it was made with (`runs.stage_keys`).
    model_digest: str | None = None
    key: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderableModel:
    """A model as the evaluation sees it. Whatever is None is not known, and so are the figures that need it."""

    #: Timed: the plain picture, with alpha if the renderer has it.
    render: Callable[[Camera], RenderedView]
    #: V per pixel [h, w], NaN where the model shows nothing; without it there are no figures by visibility.
    visibility_map: Callable[[Camera], Float[np.ndarray, "h w"]] | None = None
    metadata: EvaluatedModel = EvaluatedModel()
    #: Whether the time that `render` takes says anything.
    is_timed: bool = True
    #: What is behind the model in a render, RGB in [0, 1]: one color, or an image where this is given and returns one.
    background: tuple[float, float, float] | None = None
    background_image: Callable[[Camera], Float[Tensor, "h w 3"] | None] | None = None
    #: Pixels that show what enough training cameras see (`opacity_coverage.coverage_map`); solidity and depth are
    #: measured on them.
    coverage_map: Callable[[Camera], Bool[np.ndarray, "h w"]] | None = None
    #: Depth along the axis of a view's camera, inf for sky; then these two are needed as well: the model's own depth
    #: (not timed), and how high cameras are above ground. All in the units of the model.
    true_depth: Callable[[View], Float[np.ndarray, "h w"]] | None = None
    render_depth: Callable[[Camera], Raster] | None = None
    camera_height: float | None = None
    #: The splats that a view is drawn from.
    decode_splats: Callable[[Camera], Splats] | None = None
    #: Against whose views the angle of each pixel is measured; none: there are no figures by angle.
    training_cameras: Sequence[Camera] = ()
    #: The color model of a view (`model.exposure`), in which its picture is measured; None: neutral colors.
    exposure: Callable[[View], Float[Tensor, "3 4"]] | None = None
    #: The picture in neutral colors, where it is not that which exposures are applied to.
    render_neutral: Callable[[Camera], RenderedView] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for a true depth without what it is compared with."""
        if self.true_depth is not None and (self.render_depth is None or not self.camera_height):
            raise ValueError("true_depth needs render_depth and a camera_height above 0")


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """What to measure and draw."""

    #: Also report every figure after color correction (fitted on the test image itself).
    color_correction: bool = True
    #: Bins by visibility, of about equal size.
    visibility_bins: int = DEFAULT_BINS
    #: Write photograph | render | error for every view.
    comparisons: bool = True
    #: Measure only pixels that show what enough training cameras see (`RenderableModel.coverage_map`).
    covered_only: bool = False
    #: Also report the figures of the views of each folder, by their names.
    by_folder: bool = False
    #: What the contact sheet calls the views, and, with _ between its words, metrics.json their number.
    title: str = "test views"
    #: How pictures are exposed, if the model says how: what metrics.json notes of them.
    exposure_note: str = "in the exposure of each photograph"
    #: Views on the contact sheet at most, chosen evenly.
    contact_sheet_views: int = 40
    #: Error at the bright end of the color map, where white is 1.
    error_limit: float = comparison_images.ERROR_LIMIT


@dataclass(frozen=True, eq=False)
class ReferenceViews:
    """Test views, and how to load their photographs and masks (true = keep; None: all of it counts)."""

    views: Sequence[View]
    load_image: Callable[[View], UInt8[np.ndarray, "h w 3"]]
    load_mask: Callable[[View], Bool[np.ndarray, "h w"] | None]
