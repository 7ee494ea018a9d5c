"""A scene drawn from its level-of-detail tree: as a model is, at a bounded error and in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Splats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.gaussians import Gaussians, project_splats
from vdgs.model.lod_tree import LodCut, LodTree
from vdgs.model.renderer import view_splats

#: What a node draws: its merged Gaussians ("nodes"), or the anchors of a leaf ("anchors").
NodeContent = tuple[str, int]
#: Cuts that are kept assembled: that of the last full picture, and that of a preview.
MAX_ASSEMBLED = 2


@dataclass(frozen=True, eq=False)
class _Assembled:
    """What a cut is drawn from: anchors, in the order of the model, then merged Gaussians."""

    anchors: AnchorModel | None
    gaussians: Gaussians | None


@dataclass(frozen=True, eq=False)
class LodScene:
    """A model through its tree. `renderer.render` and its kin take it wherever they take a model."""

    tree: LodTree
    #: Its decoders and background; its anchors are not touched.
    model: AnchorModel
    #: Nothing is drawn more pixels off than so many; 0: all from anchors, as the model itself is drawn.
    max_error_px: float = 1.0
    #: Which places are drawn, as `values` asks for them; None: all.
    is_drawn: Callable[[NodeContent, Tensor], Tensor] | None = None
    _assembled: dict[LodCut, _Assembled] = field(default_factory=dict)

    @property
    def background(self) -> tuple[float, float, float]:
        return self.model.background

    @property
    def device(self) -> torch.device:
        return self.model.decoder.weights.opacity.w1.device

    def at_error(self, max_error_px: float) -> LodScene:
        """The same scene at another error; both share what is in memory."""
        return replace(self, max_error_px=max_error_px)

    def with_filter(self, is_drawn: Callable[[NodeContent, Tensor], Tensor]) -> LodScene:
        """The same scene without the places for which this is False."""
        return replace(self, is_drawn=is_drawn, _assembled={})

    def within(self, camera: Camera, max_cost: int) -> LodScene:
        """The same scene, coarser where a view would cost more than so many merged Gaussians."""
        return self.at_error(self.tree.error_within(camera, self.max_error_px, max_cost))

    def cost(self, camera: Camera) -> int:
        """What a view costs, in merged Gaussians."""
        return self.tree.cost(self.tree.cut(camera, self.max_error_px))

    @torch.no_grad()
    def view_splats(self, camera: Camera, image_index: int | None = None) -> tuple[Int64[Tensor, " m"], Splats]:
        """The splats of a view, and to which of `places` each belongs."""
        parts = self._parts(camera)
        shown, sources, first = list[Splats](), list[Tensor](), 0
        if parts.anchors is not None:
            rows, splats = view_splats(parts.anchors, camera, image_index)
            sources.append(rows)
            shown.append(splats)
            first = len(parts.anchors.anchors)
        if parts.gaussians is not None:
            splats = project_splats(parts.gaussians, camera, parts.gaussians.sh_degree)
            sources.append(torch.arange(first, first + len(parts.gaussians), device=self.device))
            shown.append(splats)
        if not shown:
            empty = torch.zeros(0, device=self.device)
            wide = empty.new_zeros(0, 3)
            return empty.long(), Splats(empty.new_zeros(0, 2), wide, empty, wide, empty)
        columns = zip(*((s.means_px, s.conics, s.depths, s.colors, s.opacities) for s in shown), strict=True)
        return torch.cat(sources), Splats(*(torch.cat(column) for column in columns))

    def values(self, camera: Camera, of: Callable[[NodeContent, Float[Tensor, "p 3"]], Tensor]) -> Tensor:
        """A value for each of the places that a view is drawn from, anchors and then centers of merged Gaussians:
        `of` gives those of the places of a node, or of the anchors of a leaf."""
        cut = self.tree.cut(camera, self.max_error_px)
        found, drawn = self._values(cut, of), self._drawn(cut)
        return found if drawn is None else found[drawn]

    def _drawn(self, cut: LodCut) -> Tensor | None:
        """Which of the places of a cut are drawn; None: all."""
        return None if self.is_drawn is None else self._values(cut, self.is_drawn).bool()

    def _values(self, cut: LodCut, of: Callable[[NodeContent, Tensor], Tensor]) -> Tensor:
        parts = list[Tensor]()
        if cut.leaves:
            rows, found = list[Tensor](), list[Tensor]()
            for leaf in cut.leaves:
                anchors, these = self.tree.anchors(leaf)
                rows.append(these)
                found.append(of(("anchors", leaf), anchors.positions))
            parts.append(torch.cat(found)[torch.cat(rows).argsort()])
        parts += [of(("nodes", node), self.tree.gaussians(node).means) for node in cut.nodes]
        return torch.cat(parts) if parts else torch.zeros(0)

    def _parts(self, camera: Camera) -> _Assembled:
        cut = self.tree.cut(camera, self.max_error_px)
        held = self._assembled.pop(cut, None)
        if held is None:
            while len(self._assembled) >= MAX_ASSEMBLED:
                self._assembled.pop(next(iter(self._assembled)), None)
            gaussians, drawn = self.tree.gaussians_of(cut.nodes), self._drawn(cut)
            if gaussians is not None and drawn is not None:
                gaussians = gaussians.select(drawn[len(drawn) - len(gaussians) :])
            moved = None if gaussians is None else Gaussians(
                **{name: tensor.to(self.device) for name, tensor in gaussians.tensors().items()}
            )  # fmt: skip
            held = _Assembled(self._anchor_model(cut, drawn), moved)
        self._assembled[cut] = held
        return held

    def _anchor_model(self, cut: LodCut, drawn: Tensor | None) -> AnchorModel | None:
        """The anchors of the leaves of a cut that are drawn, each with its decoder."""
        found = self.tree.anchors_of(cut.leaves)
        if found is None:
            return None
        anchors, rows = found
        if drawn is not None:
            kept = drawn[: len(rows)]
            anchors, rows = anchors.select(kept), rows[kept]
        return model_of_rows(self.model, anchors, rows).to(self.device)


def model_of_rows(model: AnchorModel, anchors: Anchors, rows: Int[Tensor, " r"]) -> AnchorModel:
    """The anchors of some rows of a model, ascending, each with its decoder there."""
    spans = model.decoder_spans
    ends = torch.tensor([0, *(span.count for span in spans)]).cumsum(0)
    bounds = torch.searchsorted(rows.long(), ends).tolist()
    parts = (replace(span, count=last - first) for span, first, last in zip(spans, bounds, bounds[1:], strict=False))
    return replace(model, anchors=anchors, decoder_spans=tuple(parts))
