"""A scene drawn from its level-of-detail tree: as a model is, at a bounded error and in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Splats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decode_world import gaussian_means
from vdgs.model.lod_splats import FadedNode, merged_splats
from vdgs.model.lod_tree import LodCut, LodTree, NodeCache, side_by_side
from vdgs.model.renderer import cull_anchors, view_splats, without_aliasing

#: What a node draws: its merged Gaussians ("nodes"), or the anchors of a leaf ("anchors").
NodeContent = tuple[str, int]
#: Reads, or makes, the places of one of these.
Places = Callable[[], Float[Tensor, "p 3"]]
#: By what opacities are multiplied is kept up to so many bytes: of many more nodes than the nodes themselves are.
FACTOR_CACHE_BYTES = 48 << 20
#: So many of each are kept assembled: those of the last full picture, and those of a preview.
MAX_ASSEMBLED = 2


@dataclass(frozen=True, eq=False)
class LodScene:
    """A model through its tree. `renderer.render` and its kin take it wherever they take a model."""

    tree: LodTree
    #: Its decoders and background; its anchors are not touched.
    model: AnchorModel
    #: Nothing is drawn more pixels off than so many; 0: all from anchors, as the model itself is drawn.
    max_error_px: float = 1.0
    #: The view that pictures are parts of, where they are: the anchors of all of it are then held together.
    view: Camera | None = None
    #: Of the photographs, where anchors are drawn without aliasing (`Antialiased`): merged Gaussians always are.
    pixel: float | None = None
    #: What opacities are multiplied with, by the places of Gaussians; None: nothing.
    fade: Callable[[Float[Tensor, "p 3"]], Float[Tensor, " p"]] | None = None
    #: By which these are kept.
    fade_name: str = ""
    #: Of a leaf only those anchors are put together that a view may show, and they alone are places: most of a leaf is
    #: beside a small part of a view.
    culls_leaves: bool = False
    _anchors: dict[tuple[int, ...], AnchorModel | None] = field(default_factory=dict)
    _nodes: dict[tuple[int, ...], list[FadedNode]] = field(default_factory=dict)
    #: By what opacities are multiplied, for the Gaussians of what was drawn last, however it fades.
    _kept_factors: NodeCache = field(default_factory=lambda: NodeCache(FACTOR_CACHE_BYTES))

    @property
    def background(self) -> tuple[float, float, float]:
        return self.model.background

    @property
    def envmap(self) -> Float[Tensor, "rows columns 3"] | None:
        return self.model.envmap

    @property
    def device(self) -> torch.device:
        return self.model.decoder.weights.opacity.w1.device

    def at_error(self, max_error_px: float) -> LodScene:
        """The same scene at another error; both share what is in memory."""
        return replace(self, max_error_px=max_error_px)

    def within(self, camera: Camera, max_cost: int) -> LodScene:
        """The same scene, coarser where a view would cost more than so many merged Gaussians."""
        return self.at_error(self.tree.error_within(camera, self.max_error_px, max_cost))

    def in_detail(self, tree: LodTree) -> LodScene:
        """The same scene drawn from all anchors, for small parts of views, through its tree with memory of its own
        (`LodTree.with_own_cache`): what this one keeps stays there."""
        return replace(self, tree=tree, max_error_px=0.0, view=None, culls_leaves=True, _anchors={}, _nodes={})

    def for_view(self, view: Camera) -> LodScene:
        """The same scene for pictures of parts of a view, one after another."""
        return replace(self, view=view)

    def without_aliasing(self, pixel: float) -> LodScene:
        """The same scene, its anchors drawn as `renderer.Antialiased` draws them."""
        return replace(self, pixel=pixel)

    def with_fade(self, factors: Callable[[Float[Tensor, "p 3"]], Float[Tensor, " p"]], name: str) -> LodScene:
        """The same scene, opacities multiplied with these, which are kept by `name`. Anchors and nodes that have wholly
        faded out are left out."""
        return replace(self, fade=factors, fade_name=name, _anchors={}, _nodes={})

    def cost(self, camera: Camera) -> int:
        """What a view costs, in merged Gaussians."""
        return self.tree.cost(self.tree.cut(camera, self.max_error_px))

    @torch.no_grad()
    def view_splats(self, camera: Camera, image_index: int | None = None) -> tuple[Int64[Tensor, " m"], Splats]:
        """The splats of a view, and to which of the places of `values` each belongs."""
        cut = self._cut(camera)
        assemble = partial(self._assemble_anchors, camera=camera)
        anchors = assemble(cut.leaves) if self.culls_leaves else _held(self._anchors, cut.leaves, assemble)
        rows, splats, first = torch.zeros(0, dtype=torch.long, device=self.device), None, 0
        if anchors is not None:
            drawn = anchors if self.pixel is None else without_aliasing(anchors, self.pixel)
            rows, splats = view_splats(drawn, camera, image_index)
            first = len(anchors.anchors)
        if nodes := _held(self._nodes, cut.nodes, self._read_nodes):
            splats = merged_splats(nodes, camera, splats)
            places = torch.arange(first, first + len(splats.depths) - len(rows), device=self.device)
            rows = torch.cat([rows, places])
        if splats is None:
            empty = torch.zeros(0, dtype=torch.float32, device=self.device)
            wide = empty.new_zeros(0, 3)
            splats = Splats(empty.new_zeros(0, 2), wide, empty, wide, empty)
        return rows, splats

    def values(self, camera: Camera, of: Callable[[NodeContent, Places], Tensor]) -> Tensor:
        """A value for each of the places that a view is drawn from, anchors and then centers of merged Gaussians:
        `of` gives those of the places of a node, or of the anchors of a leaf, which may have to be read."""
        cut, found = self._cut(camera), list[Tensor]()
        if cut.leaves:
            found.append(self._leaf_values(cut.leaves, camera, of))
        if cut.nodes:
            found += [self._node_values(node, of) for node in cut.nodes if not _are_zero(self._node_factors(node))]
        return torch.cat(found) if found else torch.zeros(0, dtype=torch.float32, device="cpu")

    def _node_values(self, node: int, of: Callable[[NodeContent, Places], Tensor]) -> Tensor:
        """Values of the merged Gaussians of a node."""
        return of(("nodes", node), lambda: self.tree.gaussians(node).means)

    def _node_factors(self, node: int) -> Float[Tensor, " m"] | None:
        """What the opacities of the merged Gaussians of a node are multiplied with; None: nothing."""
        return self._factors(("nodes", node), lambda: self.tree.gaussians(node).means)

    def _leaf_values(
        self, leaves: tuple[int, ...], camera: Camera, of: Callable[[NodeContent, Places], Tensor]
    ) -> Tensor:
        """Values of the anchors of some leaves that are drawn in a view, in the order of the model."""
        rows, found = list[Tensor](), list[Tensor]()
        for leaf in leaves:
            anchors, these = self.tree.anchors(leaf)
            values = of(("anchors", leaf), partial(getattr, anchors, "positions"))
            mask = self._leaf_mask(anchors, self._leaf_factors(leaf, anchors), camera)
            rows.append(these if mask is None else these[mask])
            found.append(values if mask is None else values[mask])
        return torch.cat(found)[torch.cat(rows).argsort()]

    def _leaf_factors(self, leaf: int, anchors: Anchors) -> Float[Tensor, "a k"] | None:
        """What the opacities of the Gaussians of a leaf's anchors are multiplied with; None: no scene that fades."""
        if self.fade is None:
            return None
        found = self._factors(("anchors", leaf), lambda: gaussian_means(anchors).flatten(0, 1))
        shape = anchors.offsets.shape[:2]
        return torch.ones(1, dtype=torch.half, device="cpu").expand(shape) if found is None else found.view(shape)

    def _leaf_mask(self, anchors: Anchors, factors: Tensor | None, camera: Camera) -> Tensor | None:
        """Which anchors of a leaf are put together for a view; None: all."""
        mask = None if factors is None else (factors > 0).any(1)
        if self.culls_leaves:
            seen = torch.zeros(len(anchors), dtype=torch.bool, device="cpu")
            seen[cull_anchors(anchors, replace(camera, photograph_pixel=self.model.photograph_pixel))] = True
            mask = seen if mask is None else mask & seen
        return mask

    def _factors(self, content: NodeContent, places: Places) -> Float[Tensor, " p"] | None:
        """`fade` of the places of a node, None where it is 1 everywhere; what was asked for lately is kept."""
        if (fade := self.fade) is None:
            return None

        def counted() -> Tensor | None:
            factors = fade(places()).half()
            return None if (factors == 1).all() else factors

        key = (f"{content[0]}, {self.fade_name}", content[1])
        return self._kept_factors.get(key, counted, lambda factors: 0 if factors is None else factors.nbytes)

    def _cut(self, camera: Camera) -> LodCut:
        cut = self._cut_of(camera)
        return cut if self.view is None else replace(cut, leaves=self._cut_of(self.view).leaves)

    def _cut_of(self, camera: Camera) -> LodCut:
        seen = replace(camera, photograph_pixel=self.model.photograph_pixel)
        return self.tree.cut(seen, self.max_error_px)

    def _assemble_anchors(self, leaves: tuple[int, ...], camera: Camera) -> AnchorModel | None:
        """The anchors of some leaves that are drawn, in the order of the model, each with its decoder."""
        found = self.tree.anchors_of(leaves, partial(self._drawn_anchors, camera=camera))
        return None if found is None else model_of_rows(self.model, *found).to(self.device)

    def _drawn_anchors(self, leaf: int, camera: Camera) -> tuple[Anchors, Tensor]:
        """The anchors of a leaf that are put together for a view, faded, and their rows in the model."""
        anchors, rows = self.tree.anchors(leaf)
        factors = self._leaf_factors(leaf, anchors)
        mask = self._leaf_mask(anchors, factors, camera)
        if factors is not None:
            anchors = replace(anchors, opacity_factors=factors)
        return (anchors, rows) if mask is None else (anchors.select(mask), rows[mask])

    def _read_nodes(self, nodes: tuple[int, ...]) -> list[FadedNode]:
        """The nodes of which something is drawn."""
        read = side_by_side(self._faded_node, nodes)
        return [node.to(self.device) for node in read if node is not None]

    def _faded_node(self, node: int) -> FadedNode | None:
        factors = self._node_factors(node)
        return None if _are_zero(factors) else FadedNode(self.tree.gaussians(node), factors)


def _are_zero(factors: Tensor | None) -> bool:
    return factors is not None and not factors.any()


_Held = TypeVar("_Held")


def _held(
    held: dict[tuple[int, ...], _Held], nodes: tuple[int, ...], assemble: Callable[[tuple[int, ...]], _Held]
) -> _Held:
    """What some nodes hold together, of which the last few are kept."""
    content = held.pop(nodes, None)
    content = assemble(nodes) if content is None else content
    while len(held) >= MAX_ASSEMBLED:
        held.pop(next(iter(held)), None)
    held[nodes] = content
    return content


def model_of_rows(model: AnchorModel, anchors: Anchors, rows: Int[Tensor, " r"]) -> AnchorModel:
    """The anchors of some rows of a model, ascending, each with its decoder there."""
    spans = model.decoder_spans
    ends = torch.tensor([0, *(span.count for span in spans)], dtype=torch.int64, device="cpu").cumsum(0)
    bounds = torch.searchsorted(rows.long(), ends).tolist()
    parts = (replace(span, count=last - first) for span, first, last in zip(spans, bounds, bounds[1:], strict=False))
    return replace(model, anchors=anchors, decoder_spans=tuple(parts))
