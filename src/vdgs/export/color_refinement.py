"""Colors fitted again to what pictures lack, once opacities and shapes are fixed.

A model shows some of what changes with the direction by opacity and shape, which a file cannot. Colors can stand in
for them. The baked Gaussians are drawn where the model is, its picture minus theirs is what is missing, and each
Gaussian takes of it the mean over the pixels that it makes, by its part of each: for the colors one step of the
simultaneous iterative reconstruction technique (Gilbert, 1972). Spherical harmonics are fitted to these steps as they
were to the colors.

Cameras between those of the photographs take part: the model knows what is to be seen from there, and without them what
few photographs ask for would be learnt by heart. Memory: 12 bytes for each Gaussian that a view shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float, Float16, Int, Int32
from torch import Tensor

from vdgs.export.bake import MIN_PIXELS, RIDGE_WEIGHT, part_count, part_size
from vdgs.export.formats.gaussian_store import GaussianStore
from vdgs.export.parallel import index_range, map_views, parallel_map, sort_segments
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import Splats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import decode_view, rasterize_splats

#: The largest weight of a view: the largest finite float16. Of a large photograph a Gaussian may make more.
MOST_PIXELS = torch.finfo(torch.float16).max
#: After so many views or parts the pages of the spool are let go.
FLUSH_EVERY = 16


@dataclass(frozen=True, eq=False)
class ColorResidual:
    """What one view lacks: for Gaussians, ascending, the pixels that each makes and the mean color missing there."""

    gaussians: Int32[Tensor, " p"]
    pixels: Float16[Tensor, " p"]
    colors: Float16[Tensor, "p 3"]


class BakedGaussians:
    """Baked Gaussians on the disk, by the anchors that they come from."""

    def __init__(self, model: AnchorModel, kept: Int[np.ndarray, " m"], spool: GaussianStore) -> None:
        self.model, self.spool = model, spool
        k = model.anchors.offsets.shape[1]
        #: Which of all that anchors spawn are baked: a file of a part of the scene is compared with that part.
        self.is_baked = torch.zeros(len(model.anchors) * k, dtype=torch.bool, device="cpu")
        self.is_baked[torch.from_numpy(kept)] = True
        #: Where the Gaussians of each anchor begin.
        self.starts = np.searchsorted(kept, np.arange(len(model.anchors) + 1) * k)

    def rows_of_anchors(self, rows: Int[np.ndarray, " v"]) -> Int[np.ndarray, " p"]:
        """The Gaussians of anchors, both ascending."""
        first, counts = self.starts[rows], self.starts[rows + 1] - self.starts[rows]
        ends = np.cumsum(counts)
        return np.repeat(first - ends + counts, counts) + np.arange(ends[-1] if len(ends) else 0)

    @torch.no_grad()
    def render_target(self, camera: Camera) -> tuple[Float[Tensor, "h w 3"], Int[np.ndarray, " p"]]:
        """What the model shows by what is baked of it, and the Gaussians that may touch this view, ascending."""
        rows, splats = decode_view(self.model.with_all_levels(), camera)
        rows, k = rows.cpu(), self.model.anchors.offsets.shape[1]
        source = splats.source.long().cpu()
        spawned = rows.index_select(0, source // k) * k + source % k
        of_these = self.is_baked.index_select(0, spawned).nonzero()[:, 0].to(splats.means_px.device)
        shown: Splats = splats
        if len(of_these) < len(source):
            shown = Splats(*(getattr(splats, field.name)[of_these] for field in fields(Splats)))
        picture = rasterize_splats(shown, camera, shown.means_px.new_tensor(self.model.background)).image
        return picture.cpu(), self.rows_in_view(rows.numpy(), camera)

    def rows_in_view(self, anchors: Int[np.ndarray, " v"], camera: Camera) -> Int[np.ndarray, " p"]:
        """The Gaussians that may touch a view which shows these anchors, ascending."""
        return self.rows_of_anchors(anchors)


def refine_colors(
    baked: BakedGaussians, cameras: Sequence[Camera], after_view: Callable[[], None] = lambda: None
) -> None:
    """Add to the colors of all Gaussians, on the disk, what the pictures of these cameras lack."""
    views, device = list[ColorResidual](), baked.model.anchors.positions.device
    for view in map_views(lambda camera: view_residual(baked, camera), cameras, device):
        views.append(view)
        if len(views) % FLUSH_EVERY == 0:
            baked.spool.release_pages()
        after_view()
    parts = [rows_of_part(baked, number) for number in range(part_count(baked.model))]
    done = parallel_map(lambda rows: baked.spool.add_sh(*color_updates(baked, cameras, views, rows)), parts)
    for number, _ in enumerate(done):
        if number % FLUSH_EVERY == 0:
            baked.spool.release_pages()


def rows_of_part(baked: BakedGaussians, number: int) -> range:
    """The rows of the spool that a part fits; none of the last parts where few of all Gaussians are baked."""
    step, count = part_size(baked.model), len(baked.spool.means)
    return range(min(number * step, count), min((number + 1) * step, count))


@torch.no_grad()
def view_residual(baked: BakedGaussians, camera: Camera) -> ColorResidual:
    """What the baked Gaussians do not show of the model's picture."""
    wanted, numbers = baked.render_target(camera)
    background = torch.tensor(baked.model.background, dtype=torch.float32, device="cpu")
    found = get_backend(torch.device("cpu")).splat_contributions(
        _splats(baked.spool, numbers, camera), background, camera.width, camera.height, wanted
    )
    shown = (found.pixels >= MIN_PIXELS).nonzero()[:, 0]
    pixels = found.pixels.index_select(0, shown)
    return ColorResidual(
        torch.from_numpy(numbers).index_select(0, shown).int(),
        pixels.clamp(max=MOST_PIXELS).half(),
        (found.residual.index_select(0, shown) / pixels[:, None]).half(),
    )


def _splats(spool: GaussianStore, numbers: Int[np.ndarray, " p"], camera: Camera) -> Splats:
    kernels, (means, log_scales, quaternions, logits) = get_backend(torch.device("cpu")), spool.ellipsoids(numbers)
    seen = kernels.project(means, log_scales.exp(), quaternions, camera)
    colors = kernels.harmonic_colors(
        means, spool.coefficients, torch.from_numpy(numbers), _camera_center(camera), spool.degree
    )
    opacities = torch.where(seen.valid, logits.sigmoid(), 0.0)
    return Splats(seen.means_px, seen.conics, seen.depths, colors, opacities)


def _camera_center(camera: Camera) -> Float[Tensor, "3"]:
    return torch.from_numpy(camera.position.astype(np.float32))


def color_updates(
    baked: BakedGaussians, cameras: Sequence[Camera], residuals: Sequence[ColorResidual], rows: range
) -> tuple[Int[np.ndarray, " c"], Float[Tensor, "c f 3"]]:
    """What is to be added to the colors of the Gaussians of some rows: of which, ascending, and how much."""
    means, columns = torch.from_numpy(baked.spool.means), list[tuple[Tensor, ...]]()
    for camera, view in zip(cameras, residuals, strict=True):
        low, high = index_range(view.gaussians, rows.start, rows.stop)
        if low < high:
            here = view.gaussians[low:high]
            # index_select, not an index: torch is five times as fast at it.
            directions = torch.nn.functional.normalize(means.index_select(0, here) - _camera_center(camera), dim=1)
            columns.append((here, directions, view.colors[low:high].float(), view.pixels[low:high].float()))
    if not columns:
        return np.zeros(0, np.int64), torch.zeros(
            0, (baked.spool.degree + 1) ** 2, 3, dtype=torch.float32, device="cpu"
        )
    numbers, *rest = (torch.cat(column) for column in zip(*columns, strict=True))
    order, counts = sort_segments(numbers, rows.start, len(rows))
    directions, colors, pixels = (column.index_select(0, order) for column in rest)
    changed = counts.nonzero()[:, 0]
    runs = (counts.cumsum(0) - counts)[changed]
    found = get_backend(colors.device).fit_harmonics(
        directions, colors + 0.5, pixels, runs, baked.spool.degree, RIDGE_WEIGHT
    )
    return changed.numpy() + rows.start, found
