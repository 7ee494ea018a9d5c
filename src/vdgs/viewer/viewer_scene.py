"""What clients look at: the models of a run and what belongs to them, each loaded when it is first needed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.captures.camera_height import camera_height, pixel_at_camera_height
from vdgs.captures.image_cache import ImageCache
from vdgs.errors import VdgsError
from vdgs.evaluation.view_exposures import ViewExposures, make_exposures
from vdgs.geometry.camera import Camera
from vdgs.geometry.map_projection import MapProjection
from vdgs.kernels.kernel_types import Raster
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.lod_scene import LodScene, NodeContent, Places
from vdgs.model.lod_tree import ANCHOR_COST, LodTree
from vdgs.model.renderer import Drawable, render
from vdgs.partition.blocks import Blocks
from vdgs.partition.merging import BlockLookup
from vdgs.partition.plots.block_colors import block_color
from vdgs.runs.lod_folder import find_tree
from vdgs.runs.open_run import OpenedRun, block_lookup, load_run_blocks, open_run
from vdgs.runs.visibility_store import get_run_visibility, with_fade
from vdgs.viewer.lod import LodLevel, LodPyramid
from vdgs.viewer.navigation import CameraPose, overview_pose
from vdgs.visibility.visibility_counts import NearbyCameras, count_visibility

#: Of a tree: pixels that a view at rest and a preview may be off, and what a view at rest may cost, in merged Gaussians
#: (choice: about a second on two cores, reading included).
REST_ERROR_PX, PREVIEW_ERROR_PX, REST_MAX_COST = 0.2, 1.0, 4_250_000
#: A view at rest is then drawn from all anchors, in parts that show about so many: a part takes about 50 ms on two
#: cores (measured). Leaves take so much memory meanwhile.
PART_MAX_ANCHORS, PART_CACHE_BYTES = 20_000, 128 << 20
#: Visitors may let a scene fade out at different V: of so many, what has faded is kept (choice).
_MAX_FADED = 3
#: Photographs kept in memory, decoded (choice).
_IMAGE_CACHE_BYTES = 128 << 20
#: What a camera meters is drawn from at most about so many anchors (choice): fitting its law takes up to two hundred
#: images, and all clients wait meanwhile.
_METERING_MAX_ANCHORS = 10_000

_Key = TypeVar("_Key")
_Kept = TypeVar("_Kept")


class ViewerScene:
    """One run, opened for viewing. Used from one thread, the one that draws."""

    def __init__(self, run: OpenedRun, open_other: Callable[[str], OpenedRun] | None = None) -> None:
        self.run = run
        self.capture = run.capture
        self._open = open_other or (lambda name: open_run(run.folder.path, name, run.device))  # type: ignore[arg-type]
        self._runs: dict[str, OpenedRun] = {run.name: run}
        self._visibility: dict[str, Tensor] = {}
        self._block_tints: dict[str, Tensor] = {}
        self._block_lookups: dict[str, BlockLookup] = {}
        #: By model, and by how many cameras must see an anchor; of each model the last few such numbers.
        self._levels: dict[str, dict[int, LodPyramid]] = {}
        self._trees: dict[str, LodScene | None] = {}
        #: By the same two, the last few that were asked for.
        self._faded_trees: dict[tuple[str, int], LodScene] = {}
        #: By model, for pictures from all anchors.
        self._detailed_trees: dict[str, LodTree] = {}
        self._values: dict[tuple[str, NodeContent], Tensor] = {}
        self._exposures: dict[str, ViewExposures | None] = {}
        #: Grows with every newer model.
        self.generation = 0

    @property
    def names(self) -> Sequence[str]:
        """The models that can be shown, the best first."""
        return ("merged", "coarse") if self.run.name == "merged" else (self.run.name,)

    def shown_name(self, name: str) -> str:
        """The name itself where the run has such a model, else that of the best one."""
        return name if name in self.names else self.names[0]

    def get_run(self, name: str) -> OpenedRun:
        """A model of the run; the one opened first where that has no such model."""
        if name not in self.names:
            name = self.run.name
        if name not in self._runs:
            self._runs[name] = replace(self._open(name), capture=self.capture)  # one capture in memory
        return self._runs[name]

    def model(self, name: str) -> AnchorModel:
        return self.get_run(name).model

    def tree(self, name: str) -> LodScene | None:
        """A model through its level-of-detail tree; None where it has none."""
        if name not in self._trees:
            self._trees[name] = find_tree(self.get_run(name))
        return self._trees[name]

    def shown(self, name: str, view: Camera | None = None, *, min_visibility: int = 0) -> Drawable:
        """What single pixels are drawn from: the tree at its finest but for the anchors far away; and what all of a
        view is compared by: as finely as at rest. Faded out as pictures are (`get_level`): what cannot be seen there
        is not to be met."""
        tree = self._faded_tree(name, min_visibility)
        if tree is None:
            return self._pyramid(name, min_visibility).model
        finest = tree.at_error(REST_ERROR_PX)
        return finest if view is None else finest.within(view, REST_MAX_COST)

    def get_level(
        self, name: str, camera: Camera, max_anchors: int | None = None, *, full_camera: Camera | None = None,
        full_detail: bool = False, min_visibility: int = 0,
    ) -> tuple[LodLevel, int]:  # fmt: skip
        """The level of detail to draw, with at most so many anchors in view, and how many those are; faded out where
        fewer than `min_visibility` training cameras see. Of a tree, merged Gaussians count as anchors by their cost.
        `camera` may be a part of `full_camera`."""
        tree = self._faded_tree(name, min_visibility)
        if tree is None:
            return self._pyramid(name, min_visibility).of(camera, max_anchors)
        if full_detail:
            tree = tree.in_detail(self._detailed_tree(name, tree.tree))
        else:
            least = REST_ERROR_PX if max_anchors is None else PREVIEW_ERROR_PX
            cost = REST_MAX_COST if max_anchors is None else max_anchors * ANCHOR_COST
            view = full_camera or camera
            tree = tree.at_error(least).within(view, cost).for_view(view)
        return LodLevel(tree), max(1, tree.cost(camera) // ANCHOR_COST)

    def parts_in_detail(self, name: str, camera: Camera, min_visibility: int = 0) -> list[Camera]:
        """The parts of a view that make it whole where `get_level` draws it coarser than the model is, from its middle
        on; none for a model without a tree."""
        tree = self._faded_tree(name, min_visibility)
        return [] if tree is None else tree.tree.parts_in_detail(camera, PART_MAX_ANCHORS)

    def _detailed_tree(self, name: str, tree: LodTree) -> LodTree:
        """The tree of a model with memory for pictures from all anchors, whatever fades out."""
        if name not in self._detailed_trees:
            self._detailed_trees[name] = tree.with_own_cache(PART_CACHE_BYTES)
        return self._detailed_trees[name]

    def _faded_tree(self, name: str, min_visibility: int) -> LodScene | None:
        """The tree of a model that fades out where fewer than so many training cameras see; None where it has none."""
        tree = self.tree(name)
        if tree is None or not min_visibility:
            return tree

        def fade_out() -> LodScene:
            least = min(min_visibility, int(self.visibility_sample(name).max()))
            return tree.with_fade(lambda places: self._nearby.fade_factors(places, least), f"V {least}")

        return _keep_last(self._faded_trees, (name, min_visibility), fade_out)

    def _pyramid(self, name: str, min_visibility: int) -> LodPyramid:
        """The levels of a model without a tree."""
        pyramids = self._levels.setdefault(name, {})
        return _keep_last(pyramids, min_visibility, lambda: LodPyramid(self._faded(name, min_visibility)))

    def _faded(self, name: str, min_visibility: int) -> AnchorModel:
        """A model that fades out where fewer than so many training cameras see, or fewer than see any of it."""
        model = self.model(name)
        if not min_visibility or not len(model.anchors):
            return model
        return with_fade(model, self._cameras, min(min_visibility, int(self.visibility(name).max())))

    @property
    def _cameras(self) -> list[Camera]:
        return [view.camera for view in self.capture.train_views]

    @cached_property
    def _nearby(self) -> NearbyCameras:
        return NearbyCameras(self._cameras)

    def level_visibility(self, name: str, level: LodLevel, camera: Camera) -> Tensor:
        """V of what a level draws in a view."""
        if isinstance(level.model, LodScene):
            return level.model.values(camera, partial(self._node_values, f"{name} V", self._count_visibility))
        return level.of(self.visibility(name))

    def level_tint(self, name: str, level: LodLevel, camera: Camera) -> Tensor:
        """The colors of the blocks of what a level draws in a view."""
        if isinstance(level.model, LodScene):
            return level.model.values(camera, partial(self._node_values, f"{name} blocks", partial(self._tint, name)))
        return level.of(self.block_tint(name))

    def visibility_sample(self, name: str) -> Float[Tensor, " n"]:
        """V all over a model: of every anchor, or of the root of its tree."""
        tree = self.tree(name)
        if tree is None:
            return self.visibility(name)
        return self._node_values(
            f"{name} V", self._count_visibility, ("nodes", 0), lambda: tree.tree.gaussians(0).means
        )

    def _node_values(self, what: str, of: Callable[[Tensor], Tensor], content: NodeContent, places: Places) -> Tensor:
        """Values of the places of a node, each found once."""
        if (what, content) not in self._values:
            self._values[what, content] = of(places())
        return self._values[what, content]

    def _count_visibility(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        return count_visibility(places, self._nearby.of(places)).float()

    def replace_run(self, run: OpenedRun) -> None:
        """Put a newer model in place of the one of its name."""
        self.run = run
        self._runs = {run.name: run}
        self._visibility, self._block_tints, self._levels, self._exposures = {}, {}, {}, {}
        self._block_lookups = {}
        self._trees, self._faded_trees, self._detailed_trees, self._values = {}, {}, {}, {}
        self.generation += 1
        self.__dict__.pop("blocks", None)

    def visibility(self, name: str) -> Float[Tensor, " n"]:
        """V of every anchor of a model."""
        if name not in self._visibility:
            self._visibility[name] = get_run_visibility(self.get_run(name), self._cameras).float()
        return self._visibility[name]

    def exposures(self, name: str) -> ViewExposures | None:
        """The exposures that views are compared in with a model, as `vdgs eval` has them but for what is metered of
        decimated models; None where training fitted none, and for a tree in the local exposure."""

        def render_decimated(camera: Camera) -> Raster:
            level = self.get_level(name, camera, _METERING_MAX_ANCHORS)[0].model
            return render(level.without_local_exposure() if isinstance(level, AnchorModel) else level, camera)

        if name not in self._exposures:
            model = self.model(name)
            has_none = model.local_exposure is not None and self.tree(name) is not None
            self._exposures[name] = None if has_none else make_exposures(model, self.capture, render_decimated)
        return self._exposures[name]

    @cached_property
    def blocks(self) -> Blocks | None:
        """The cut of the run; None before it is cut."""
        try:
            return load_run_blocks(self.run.folder)
        except VdgsError:
            return None

    def block_tint(self, name: str) -> Float[Tensor, "n 3"]:
        """The color of the block that each anchor is from, RGB in 0 to 1; gray where the scene is not cut."""
        if name not in self._block_tints:
            self._block_tints[name] = self._tint(name, self.model(name).anchors.positions)
        return self._block_tints[name]

    def block_lookup(self, name: str) -> BlockLookup | None:
        """Which block a model has its anchors from at a point; None before the run is cut, and where that cannot be
        read."""
        if self.blocks is None:
            return None
        if name not in self._block_lookups:
            try:
                self._block_lookups[name] = block_lookup(self.get_run(name), self.blocks)
            except VdgsError:
                return None
        return self._block_lookups[name]

    def _tint(self, name: str, places: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        block_at = self.block_lookup(name)
        if self.blocks is None or block_at is None:
            colors = np.full((len(places), 3), 0.6)
        else:
            palette = np.stack([block_rgb(index) for index in range(len(self.blocks))])
            colors = palette[block_at(places)] / 255.0
        return torch.as_tensor(colors, dtype=torch.float32, device=places.device)

    @cached_property
    def camera_height(self) -> float:
        """How high the photographs were taken (`captures.camera_height`): it takes all sparse points to tell."""
        return camera_height(self.capture)

    @cached_property
    def first_view(self) -> CameraPose:
        """Where a visitor stands first, in a wide window."""
        return overview_pose(self.capture)

    @cached_property
    def view_rays(self) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"]]:
        """From where, and in which direction (unit), each of `capture.views` looks."""
        cameras = [view.camera for view in self.capture.views]
        return np.array([each.position for each in cameras]), np.array([each.forward for each in cameras])

    @cached_property
    def pixel_at_camera_height(self) -> float:
        """What a pixel of the photographs shows from their height, in units of the ground frame."""
        return pixel_at_camera_height(self.camera_height, (view.camera for view in self.capture.train_views))

    @cached_property
    def images(self) -> ImageCache:
        """The photographs of all views, by their number in `capture.views`."""
        return ImageCache(self.capture.views, _IMAGE_CACHE_BYTES)

    @cached_property
    def map_projections(self) -> tuple[MapProjection, ...]:
        """The map coordinates that a point is given in beside those of the ground frame, if any."""
        with contextlib.suppress(VdgsError):  # pyproj is not installed
            if self.capture.ground.origin_geo is not None or self.capture.ground.is_moved_site:
                return (MapProjection.of(self.capture.ground),)
        return ()

    def close(self) -> None:
        if "images" in self.__dict__:
            self.images.close()


def _keep_last(kept: dict[_Key, _Kept], key: _Key, make: Callable[[], _Kept]) -> _Kept:
    """What is kept by a key, or is made: of the last `_MAX_FADED` keys."""
    found = kept.pop(key) if key in kept else make()
    while len(kept) >= _MAX_FADED:
        del kept[next(iter(kept))]
    kept[key] = found
    return found


def block_rgb(block: int) -> tuple[int, int, int]:
    """The color of a block in all figures, 0 to 255."""
    red, green, blue = bytes.fromhex(block_color(block).lstrip("#"))
    return red, green, blue
