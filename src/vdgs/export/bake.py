"""An anchor model as explicit Gaussians that any program can draw.

What anchors spawn depends on where it is seen from: opacity, shape and color. A file of Gaussians holds one opacity
and one shape of each, and colors as spherical harmonics. They are fitted over the training cameras, by how much of
their pictures a Gaussian makes: the derivative of the sum of a picture by its color. What no training view draws is
left out.

Two passes. The first draws every training view and keeps for each of its splats how many pixels it is worth; the second
takes some thousand anchors at a time, decodes them for the cameras that saw them, and fits. Memory: 8 bytes for each
splat of each view, 4 for each Gaussian, and what a part needs (`ANCHORS_PER_PART`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from vdgs.export.parallel import index_range, map_views, parallel_map, sort_segments
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.decode_world import decode_world, gaussian_means
from vdgs.model.gaussians import Gaussians
from vdgs.model.local_exposure import apply_departures
from vdgs.model.renderer import decode_view

#: A splat that makes less of a view than so many pixels did not show there.
MIN_PIXELS = 1e-3
#: Anchors that a thread fits at once.
ANCHORS_PER_PART = 4096
#: Pull of spherical harmonics towards one color for all directions (choice): where cameras look from few directions,
#: the others must not swing. Chosen on validation views (docs/export.md).
RIDGE_WEIGHT = 1e-3
#: Opacities are kept away from 0 and 1, where their logits have no end.
OPACITY_MARGIN = 1e-4
#: A decoder may flatten a Gaussian so much that its scale is 0 in float32, which has no logarithm. No picture shows how
#: thin it is below this, in units of the scene.
LEAST_SCALE = 1e-7


@dataclass(frozen=True, eq=False)
class ViewContributions:
    """What one view shows: Gaussians, ascending, by row · k + offset, and how many of its pixels each makes."""

    gaussians: Int32[Tensor, " p"]
    pixels: Float[Tensor, " p"]


@dataclass(frozen=True, eq=False)
class BakeViews:
    """What the cameras see of a model."""

    model: AnchorModel
    cameras: Sequence[Camera]
    contributions: Sequence[ViewContributions]


@dataclass(frozen=True, eq=False)
class BakeContributions(BakeViews):
    """The same, and what comes of it in all."""

    #: Pixels that each of the g = n · k Gaussians makes, over all views.
    pixels: Float[np.ndarray, " g"]


def collect_contributions(
    model: AnchorModel, cameras: Sequence[Camera], after_view: Callable[[], None] = lambda: None
) -> BakeContributions:
    """Draw every view once, on the device of the model; `after_view` is called after each. Raises ValueError without
    cameras."""
    if not cameras:
        raise ValueError("baking needs the training cameras")
    pixels, shown = np.zeros(gaussian_count(model), np.float32), []
    for view in map_views(lambda camera: view_contributions(model, camera), cameras, model.anchors.positions.device):
        pixels[view.gaussians.numpy()] += view.pixels.numpy()
        shown.append(view)
        after_view()
    return BakeContributions(model, cameras, shown, pixels)


@torch.no_grad()
def view_contributions(model: AnchorModel, camera: Camera) -> ViewContributions:
    """Draw one view, on the device of the model: what it shows, of all levels of anchors (a file has no levels)."""
    k = model.anchors.offsets.shape[1]
    rows, splats = decode_view(model.with_all_levels(), camera)
    kernels = get_backend(rows.device)
    pixels = kernels.splat_contributions(splats, splats.means_px.new_zeros(3), camera.width, camera.height).pixels
    source = splats.source.long()
    kept = (pixels >= MIN_PIXELS).nonzero()[:, 0]
    source = source.index_select(0, kept)
    gaussians = rows.index_select(0, source // k) * k + source % k
    return ViewContributions(gaussians.to("cpu", torch.int32), pixels.index_select(0, kept).cpu())


def gaussian_count(model: AnchorModel) -> int:
    """How many Gaussians the anchors of a model spawn."""
    return len(model.anchors) * model.anchors.offsets.shape[1]


def part_count(model: AnchorModel) -> int:
    """Into how many parts the anchors of a model are cut, to be fitted apart from each other."""
    return -(-len(model.anchors) // ANCHORS_PER_PART)


def part_size(model: AnchorModel) -> int:
    """How many Gaussians the anchors of a part spawn."""
    return ANCHORS_PER_PART * model.anchors.offsets.shape[1]


def gaussians_of_part(selected: Int[np.ndarray, " m"], model: AnchorModel, number: int) -> Int[np.ndarray, " p"]:
    """Those of the given Gaussians (ascending) that a part of the anchors spawns."""
    step = part_size(model)
    low, high = np.searchsorted(selected, [number * step, (number + 1) * step])
    return selected[low:high]


def bake(
    views: BakeViews,
    selected: Int[np.ndarray, " m"],
    degree: int,
    after_part: Callable[[int], None] = lambda done: None,
) -> Iterator[Gaussians]:
    """The Gaussians of the given numbers (ascending, each shown by some view), part by part in this order.

    `degree` is that of the spherical harmonics, 0 to 3. `after_part` is told how many Gaussians are done.
    """
    selected = np.ascontiguousarray(selected)
    cut = (gaussians_of_part(selected, views.model, number) for number in range(part_count(views.model)))
    parts = [part for part in cut if len(part)]
    done = 0
    for gaussians in parallel_map(lambda wanted: fit_gaussians(views, wanted, degree), parts):
        yield gaussians
        done += len(gaussians)
        after_part(done)


@dataclass(frozen=True, eq=False, kw_only=True)
class _ViewSamples:
    """p pairs of a Gaussian and a camera that shows it, sorted by Gaussian."""

    #: Where the pairs of each of the m Gaussians begin.
    starts: Int[np.ndarray, " m"]
    pixels: Float[Tensor, " p"]
    directions: Float[Tensor, "p 3"]
    colors: Float[Tensor, "p 3"]
    opacities: Float[Tensor, " p"]
    log_scales: Float[Tensor, "p 3"]
    quaternions: Float[Tensor, "p 4"]


def _gather_samples(views: BakeViews, wanted: Int[np.ndarray, " m"]) -> _ViewSamples:
    """How the cameras see the wanted Gaussians, which lie close together in number."""
    columns: list[tuple[Tensor, ...]] = []
    first, last = int(wanted[0]), int(wanted[-1])
    place_of = torch.full((last - first + 1,), -1, dtype=torch.int32, device="cpu")
    place_of[torch.from_numpy(wanted - first)] = torch.arange(len(wanted), dtype=torch.int32, device="cpu")
    for camera, shown in zip(views.cameras, views.contributions, strict=True):
        low, high = index_range(shown.gaussians, first, last + 1)
        if low == high:
            continue
        gaussians, pixels = shown.gaussians[low:high], shown.pixels[low:high]
        place = place_of.index_select(0, gaussians - first)
        inside = (place >= 0).nonzero()[:, 0]
        if len(inside):
            as_seen = _decode_from(views.model, gaussians.index_select(0, inside).long(), camera)
            columns.append((place.index_select(0, inside), pixels.index_select(0, inside), *as_seen))
    place, *rest = (torch.cat(column) for column in zip(*columns, strict=True))
    order, counts = sort_segments(place, 0, len(wanted))
    starts = (counts.cumsum(0) - counts).numpy()
    pixels, directions, colors, opacities, log_scales, quaternions = (each.index_select(0, order) for each in rest)
    return _ViewSamples(
        starts=starts, pixels=pixels, directions=directions, colors=colors, opacities=opacities,
        log_scales=log_scales, quaternions=quaternions,
    )  # fmt: skip


@torch.no_grad()
def _decode_from(model: AnchorModel, gaussians: Tensor, camera: Camera) -> tuple[Tensor, ...]:
    """Direction, color, opacity, logarithms of the scales and rotation of Gaussians (ascending) from a camera."""
    anchors, k = model.anchors, model.anchors.offsets.shape[1]
    rows, place = torch.unique_consecutive(gaussians // k, return_inverse=True)
    offset = gaussians % k
    rows = rows.to(anchors.positions.device)
    pieces = []
    for first, last, decoder in model.decoder_ranges():
        low, high = torch.searchsorted(rows, rows.new_tensor([first, last])).tolist()
        if low < high:
            piece = decode_world(anchors, rows[low:high], decoder.weights_for_image(None), camera)
            if model.local_exposure is not None:
                departures = model.local_exposure.at(anchors.positions[rows[low:high]])
                anchor = torch.arange((high - low) * k, device=rows.device) // k
                colors = apply_departures(piece.colors.flatten(0, 1), departures, anchor)
                piece = replace(piece, colors=colors.unflatten(0, (-1, k)))
            pieces.append(piece)
    # Rows of all k Gaussians of an anchor, in one column.
    spread = place * k + offset
    opacities, colors, scales, quaternions = (
        torch.cat([getattr(piece, name) for piece in pieces]).flatten(0, 1).cpu().index_select(0, spread)
        for name in ("opacities", "colors", "scales", "quaternions")
    )
    means = gaussian_means(anchors.select(rows)).flatten(0, 1).cpu().index_select(0, spread)
    rays = means - torch.from_numpy(camera.position.astype(np.float32))
    log_scales = scales.clamp_min(LEAST_SCALE).log()
    return torch.nn.functional.normalize(rays, dim=1), colors, opacities, log_scales, quaternions


def fit_gaussians(views: BakeViews, wanted: Int[np.ndarray, " m"], degree: int) -> Gaussians:
    """The Gaussians of the given numbers: ascending, close together, each shown by some view."""
    pairs = _gather_samples(views, wanted)
    anchors, k = views.model.anchors, views.model.anchors.offsets.shape[1]
    kernels, starts = get_backend(pairs.colors.device), torch.from_numpy(pairs.starts)
    coefficients = kernels.fit_harmonics(pairs.directions, pairs.colors, pairs.pixels, starts, degree, RIDGE_WEIGHT)
    log_scales, quaternions = kernels.mean_ellipsoids(pairs.log_scales, pairs.quaternions, pairs.pixels, starts)
    opacities = _weighted_means(pairs.opacities, pairs).clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    rows = torch.from_numpy(wanted // k)
    rows, place = torch.unique_consecutive(rows, return_inverse=True)
    means = gaussian_means(anchors.select(rows.to(anchors.positions.device))).flatten(0, 1).cpu()
    return Gaussians(
        means=means.index_select(0, place * k + torch.from_numpy(wanted % k)),
        log_scales=log_scales,
        quaternions=quaternions,
        opacity_logits=opacities.logit(),
        sh0=coefficients[:, 0].contiguous(),
        shN=coefficients[:, 1:].contiguous(),
    )


def _weighted_means(values: Float[Tensor, " p"], pairs: _ViewSamples) -> Float[Tensor, " m"]:
    """The mean of each Gaussian's values, by its pixels in each view."""
    pixels = pairs.pixels.numpy()
    total = np.add.reduceat(pixels, pairs.starts)
    return torch.from_numpy(np.add.reduceat(pixels * values.numpy(), pairs.starts) / total)
