"""Single kernels: culling, decoding, projection, the loss, and Adam on rows."""

from __future__ import annotations

from numbers import Integral
from typing import Annotated, Generic, NamedTuple

from torch import Tensor

from vdgs.config.ranges import FRACTION, MAX_FLOAT, Range
from vdgs.config.validation_rules import checked_value
from vdgs.errors import check_kind
from vdgs.geometry.camera import Camera, check_camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import AdamState, AnchorSplats, IsFinite, PhotometricLoss
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.renderer import cull_anchors
from vdgs.model.renderer import decode_anchors as decode_rows
from vdgs.ops.arrays import Array, check_image_index, in_place, like, to_torch, without_autocast

_AT_LEAST_0 = Annotated[float, Range(0, MAX_FLOAT)]


def cull(positions: Array, log_scales: Array, camera: Camera) -> Array:
    """Rows, ascending int64, of the anchors that may touch a view.

    positions [n, 3] in world units, log_scales [n, 6] (of the offsets' unit and of the Gaussians), float32. Raises
    ValueError for other shapes. Source: Scaffold-GS, section 3.2; the test is `kernels.torch_ref.cull`.
    """
    check_camera("camera", camera)
    at = to_torch("positions", positions)
    return like(positions, get_backend(at.device).cull(at, to_torch("log_scales", log_scales), camera))


def decode_anchors(
    anchors: Anchors, decoder: Decoder, camera: Camera, rows: Tensor | None = None, image_index: int | None = None
) -> AnchorSplats:
    """The splats that anchors become in a view: means_px, conics, depths, colors, opacities, volumes, source.

    `rows` are ascending (None: those that `cull` keeps); `image_index` selects the appearance of a training photograph
    (None: the mean). Differentiable in the anchors' tensors but positions, and in the decoder's. Source: Scaffold-GS
    eqs. 3-8.
    """
    check_kind("anchors", anchors, Anchors)
    check_kind("decoder", decoder, Decoder)
    check_camera("camera", camera)
    rows = cull_anchors(anchors, camera) if rows is None else to_torch("rows", rows)
    weights = decoder.weights_for_image(check_image_index(image_index, [decoder]))
    with without_autocast(anchors.positions.device):
        return decode_rows(anchors, rows, weights, camera)


class Projection(NamedTuple, Generic[Array]):
    """Gaussians on the image plane: see `project`."""

    means_px: Array
    conics: Array
    depths: Array
    valid: Array


def project(means: Array, quats: Array, scales: Array, camera: Camera) -> Projection[Array]:
    """Gaussians on the image plane: means_px [m, 2], conics [m, 3] (xx, xy, yy of the inverse of the covariance with
    0.3 px² on its diagonal, 1/px²), depths [m] (z, world units), valid [m]; all 0 where not valid.

    means [m, 3], quats [m, 4] (wxyz, any length), scales [m, 3], float32; differentiable in all three. Raises
    ValueError for other shapes. Source: 3DGS eq. 5 (EWA).
    """
    check_camera("camera", camera)
    at = to_torch("means", means)
    found = get_backend(at.device).project(at, to_torch("scales", scales), to_torch("quats", quats), camera)
    return like(means, Projection(found.means_px, found.conics, found.depths, found.valid))


def photometric_loss(
    image: Array, target: Array, mask: Array | None = None, *, ssim_weight: float = 0.2
) -> PhotometricLoss:
    """(1 - w) L1 + w (1 - SSIM) of an image [h, w, 3] float32 in [0, 1] and a target [h, w, 3] uint8, with L1 and SSIM.

    Pixels where `mask` [h, w] uint8 is 0 do not count. Only `loss` carries a gradient, by the image, computed with it.
    Raises TypeError for other dtypes, ValueError for other shapes, VdgsError for a weight w = `ssim_weight` that is not
    from 0 to 1. Source: 3DGS eq. 7; Wang et al. 2004.
    """
    ssim_weight = checked_value("ssim_weight", ssim_weight, Annotated[float, FRACTION])
    given, counted = to_torch("image", image), None if mask is None else to_torch("mask", mask)
    kernels, wanted = get_backend(given.device), to_torch("target", target)
    return like(image, kernels.photometric_loss(given, wanted, counted, ssim_weight=ssim_weight))


def sparse_adam_(
    parameter: Array,
    first: Array,
    second: Array,
    gradient: Array,
    rows: Array | None,
    step: int | Array,
    *,
    lr: float,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
) -> IsFinite:
    """One step of Adam in place on the given rows [v] int64 (ascending; None: all) of a parameter [n, ...] and its
    moments, all float32, contiguous and writable; the others keep their values.

    `gradient` [v, ...] has a row for each of `rows`; `step` counts from 1, for all or [v] int32. Returns whether all
    gradients were finite; if not, nothing changed. Raises TypeError, ValueError or, for a rate that is no number at
    least 0, betas that are not from 0 to below 1 and an eps below 0, VdgsError before any change. Source: Kingma and Ba
    2015, algorithm 1; rows as in Taming-3DGS.
    """
    lr, eps = (checked_value(name, value, _AT_LEAST_0) for name, value in (("lr", lr), ("eps", eps)))
    betas = checked_value("betas", betas, Annotated[tuple[float, float], Range(0, 1, exclusive_max=True)])
    moments = in_place("first", first), in_place("second", second)
    state = AdamState(in_place("parameter", parameter), *moments, lr)
    chosen = None if rows is None else to_torch("rows", rows)
    number = int(step) if isinstance(step, Integral) else to_torch("step", step)
    kernels, along = get_backend(state.parameter.device), to_torch("gradient", gradient)
    return kernels.adam_rows(state, chosen, along, number, beta1=betas[0], beta2=betas[1], epsilon=eps)
