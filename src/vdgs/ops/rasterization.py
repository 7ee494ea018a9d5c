"""`rasterization`, with the signature of gsplat 1.5, by the kernels of vdgs."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, NamedTuple

import torch
from torch import Tensor

from vdgs.config.ranges import MAX_COUNT, MAX_FLOAT, Range
from vdgs.config.validation_rules import checked_value
from vdgs.errors import UnsupportedOption
from vdgs.geometry.camera import NEAR_PLANE, Camera, is_rigid_motion
from vdgs.kernels import KERNELS_ENV_VAR, get_backend
from vdgs.kernels.constants import ALPHA_MIN, DILATION_PX2
from vdgs.kernels.gaussian_projection import GaussianShapes, project_gaussians, variances_px2
from vdgs.kernels.kernel_types import ProjectedGaussians, Splats
from vdgs.kernels.spherical_harmonics import MAX_SH_DEGREE, eval_sh_colors, num_sh_bases
from vdgs.ops.arrays import Array, like, to_torch

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]

#: Beyond so many standard deviations no Gaussian is drawn (gsplat): alpha is below 1/255 there.
MAX_EXTENT = 3.33
#: How far from a rotation a pose may be for the kernels, which take -Rᵀ t for the camera's center.
RIGID_TOLERANCE = 1e-5
#: What gsplat's keyword arguments must be here, and what to do instead.
UNSUPPORTED: Mapping[str, tuple[tuple[Any, ...], str]] = {
    "sparse_grad": ((False,), "gradients are dense; use `sparse_adam_` with the rows of meta['gaussian_ids']"),
    "absgrad": ((False,), "the kernels sum signed gradients only; leave it out, and lower grow_grad2d"),
    "distributed": ((False,), "a process draws all Gaussians; draw other cameras in other processes"),
    "camera_model": (("pinhole", "ortho"), "undistort the photographs first (`vdgs run --undistort`)"),
    "with_ut": ((False,), "Gaussians are projected by their linearization (EWA)"),
    "with_eval3d": ((False,), "Gaussians are evaluated on the image plane"),
    "radial_coeffs": ((None,), "undistort the photographs first"),
    "tangential_coeffs": ((None,), "undistort the photographs first"),
    "thin_prism_coeffs": ((None,), "undistort the photographs first"),
    "ftheta_coeffs": ((None,), "undistort the photographs first"),
    "viewmats_rs": ((None,), "cameras have a global shutter"),
    "rasterize_mode": (("classic", "antialiased"), "choose one of them"),
    "render_mode": (("RGB", "D", "ED", "RGB+D", "RGB+ED"), "choose one of them"),
}
#: What its other numbers may be: planes that bound depths (infinite ones bound none), px, and px² of variance.
_NUMBERS: Mapping[str, Range] = {
    "near_plane": Range(-math.inf, math.inf), "far_plane": Range(-math.inf, math.inf),
    "radius_clip": Range(0, math.inf), "eps2d": Range(0, MAX_FLOAT),
}  # fmt: skip


def rasterization(
    means: Array,
    quats: Array | None,
    scales: Array | None,
    opacities: Array,
    colors: Array,
    viewmats: Array,
    Ks: Array,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Array | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye", "ftheta"] = "pinhole",
    segmented: bool = False,
    covars: Array | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Array | None = None,
    tangential_coeffs: Array | None = None,
    thin_prism_coeffs: Array | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Array | None = None,
) -> tuple[Array, Array, dict[str, Any]]:
    """Draw N Gaussians in C cameras: `gsplat.rasterization` 1.5 on a CPU, differentiable, with the kernels of vdgs.

    Differentiable once in means, quats, scales, covars, opacities, colors, backgrounds and viewmats, not in Ks; any
    number of leading batch dimensions `...`. Shapes and units (world units; pixels from the image's upper left corner):

    - means [..., N, 3], quats [..., N, 4] (wxyz, any length), scales [..., N, 3] (standard deviations) or, instead of
      the two, covars [..., N, 3, 3]; opacities [..., N] in [0, 1];
    - colors [..., (C,) N, D], any D; with `sh_degree` (0 to 3) coefficients [..., (C,) N, K, 3], drawn as
      max(0, 1/2 + Σ c Y);
    - viewmats [..., C, 4, 4] (camera from world; slower with a scale), Ks [..., C, 3, 3] (no skew); backgrounds
      [..., C, D].

    Returns the picture [..., C, height, width, X], alpha [..., C, height, width, 1] and `meta`. X is D for `RGB`, 1 for
    `D` (Σ w z) and `ED` (Σ w z / Σ w, 0 where nothing is drawn), D + 1 for `RGB+D` and `RGB+ED`. Gaussians
    with a number that is not finite are left out. `meta` has gsplat's keys but those of its tiles
    (`tiles_per_gauss`, `isect_ids`, `flatten_ids`, `isect_offsets`): batch_ids, camera_ids, gaussian_ids, radii (px),
    means2d (px), depths, conics, opacities, width, height, tile_size, tile_width, tile_height, n_batches, n_cameras;
    their rows are those drawn (`packed`), or they are [..., C, N, ...]. `means2d.retain_grad()` gives densification its
    gradients. `tile_size`, `channel_chunk` and `segmented` change nothing: those of the kernels are their own.

    One difference: J is clamped at 1.3 half-angles on either side of the axis (3DGS), in gsplat of the image's center,
    which tells where the principal point is not its center: on Gaussians beside the image, and beyond 15 % of the
    image's side off its center, as in crops, also within it.

    Raises ValueError for shapes that do not fit, for viewmats and Ks with a number that is not finite (of one camera of
    several too) or with their translation in the last row, TypeError for what is no tensor or array of float32,
    VdgsError for a size or a degree that is no whole number, a plane, a radius or an eps2d that is no number, and a
    radius or an eps2d below 0, RuntimeError on the way back with `create_graph=True`, UnsupportedOption for absgrad,
    sparse_grad, distributed, fisheye and ftheta cameras, distortion, skew, rolling shutter, `with_ut` and
    `with_eval3d`. Source: Kerbl et al. 2023 (eqs. 2-6); Ye et al. 2025 for the interface.
    """
    given = locals()
    _refuse_unsupported(given)
    width, height, tile_size = (
        checked_value(name, given[name], Annotated[int, Range(1, MAX_COUNT)])
        for name in ("width", "height", "tile_size")
    )
    if sh_degree is not None:
        sh_degree = checked_value("sh_degree", sh_degree, Annotated[int, Range(0, MAX_COUNT)])
    near, far, radius_clip, eps2d = (
        checked_value(name, given[name], Annotated[float, bounds]) for name, bounds in _NUMBERS.items()
    )
    gaussians: _Gaussians = _check_gaussians(sh_degree, _tensors(given))
    settings = _Settings(
        width=width, height=height, near=near, far=far, radius_clip=radius_clip, eps2d=eps2d,
        antialiased=rasterize_mode == "antialiased", orthographic=camera_model == "ortho",
    )  # fmt: skip
    with torch.autocast(gaussians.means.device.type, enabled=False):  # the kernels compute in float32
        meta, images = _projected(gaussians, settings, packed)
        drawn = [_draw_image(gaussians, settings, image, render_mode, sh_degree) for image in images]
    meta |= {
        "tile_width": -(-width // tile_size), "tile_height": -(-height // tile_size), "width": width, "height": height,
        "tile_size": tile_size, "n_batches": gaussians.num_batches, "n_cameras": gaussians.num_cameras,
    }  # fmt: skip
    channels = (0 if render_mode in ("D", "ED") else gaussians.colors.shape[-1]) + (render_mode != "RGB")
    shape = (*gaussians.batch, gaussians.num_cameras, height, width)
    picture, alpha = _joined(drawn, gaussians.means.new_zeros(0, height, width, channels))
    picture, alpha = picture.reshape(*shape, channels), alpha.reshape(*shape, 1)
    return like(means, (picture, alpha, meta))


def _joined(drawn: Sequence[tuple[Tensor, Tensor]], none: Tensor) -> tuple[Tensor, Tensor]:
    """The pictures [n, h, w, x] and alphas [n, h, w] of the images; where there are none, those of `none`."""
    if not drawn:
        return none, none.sum(-1)
    pictures, alphas = zip(*drawn, strict=True)
    return torch.stack(pictures), torch.stack(alphas)


def _tensors(given: Mapping[str, Any]) -> dict[str, Tensor]:
    """The arguments that are tensors, by name. Raises TypeError for those of another kind or dtype."""
    optional = ("quats", "scales", "covars", "backgrounds")
    names = [name for name in _Gaussians.names() if name not in optional or given[name] is not None]
    if given["render_mode"] in ("D", "ED"):  # as in gsplat, behind depths there is nothing
        names = [name for name in names if name != "backgrounds"]
    tensors = {name: to_torch(name, given[name]) for name in names}
    allowed = [torch.float32] + [torch.float64] * (os.environ.get(KERNELS_ENV_VAR) == "torch_ref")
    for name, tensor in tensors.items():
        if tensor.dtype not in allowed or tensor.dtype != tensors["means"].dtype:
            remedy = ".float()" if isinstance(given[name], Tensor) else ".astype(np.float32)"
            raise TypeError(f"{name} must be float32, not {tensor.dtype}: convert it with {remedy}")
    return tensors


def _refuse_unsupported(given: Mapping[str, Any]) -> None:
    """Raise UnsupportedOption for an argument that gsplat has and `rasterization` has not."""
    shutter = getattr(given["rolling_shutter"], "name", given["rolling_shutter"])
    if shutter not in (None, "GLOBAL"):
        raise UnsupportedOption(f"rolling_shutter={shutter}: cameras have a global shutter")
    for name, (allowed, remedy) in UNSUPPORTED.items():
        value = given[name]
        if not any(value is each or (isinstance(value, (str, bool)) and value == each) for each in allowed):
            choices = " or ".join(repr(each) for each in allowed)
            raise UnsupportedOption(f"{name}={value!r}: vdgs.ops.rasterization has only {choices}; {remedy}")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Settings:
    width: int
    height: int
    near: float
    far: float
    radius_clip: float
    eps2d: float
    antialiased: bool
    orthographic: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class _Gaussians:
    """The arguments of `rasterization` with one batch dimension b."""

    batch: tuple[int, ...]
    means: Tensor
    opacities: Tensor
    #: [b, 1, ...] where all cameras share them, else [b, c, ...].
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    quats: Tensor | None = None
    scales: Tensor | None = None
    covars: Tensor | None = None
    backgrounds: Tensor | None = None

    @staticmethod
    def names() -> tuple[str, ...]:
        return tuple(each.name for each in fields(_Gaussians) if each.name != "batch")

    @property
    def num_batches(self) -> int:
        return len(self.means)

    @property
    def num_cameras(self) -> int:
        return self.viewmats.shape[1]


def _check_gaussians(sh_degree: int | None, tensors: dict[str, Tensor]) -> _Gaussians:
    """From tensors with any batch dimensions. Raises what `rasterization` raises."""
    means, colors = tensors["means"], tensors["colors"]
    if means.ndim < 2 or tensors["viewmats"].ndim < 3:
        given = f"{list(means.shape)} and {list(tensors['viewmats'].shape)}"
        raise ValueError(f"means must be [..., N, 3] and viewmats [..., C, 4, 4], not {given}")
    batch, n, c = tuple(means.shape[:-2]), means.shape[-2], tensors["viewmats"].shape[-3]
    if "covars" in tensors:
        tensors = {name: each for name, each in tensors.items() if name not in ("quats", "scales")}
    elif not {"quats", "scales"} <= tensors.keys():
        raise ValueError("give quats and scales, or covars")
    if sh_degree is not None and colors.ndim < len(batch) + 3:
        raise ValueError(f"colors must be [..., N, K, 3] with sh_degree={sh_degree}, not {list(colors.shape)}")
    own = colors.ndim == len(batch) + (3 if sh_degree is None else 4)
    tail = (colors.shape[-1],) if sh_degree is None else (*colors.shape[-2:-1], 3)
    wanted = {
        "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "covars": (n, 3, 3), "opacities": (n,),
        "viewmats": (c, 4, 4), "Ks": (c, 3, 3), "colors": (*([c] if own else []), n, *tail),
        "backgrounds": (c, tail[-1]),
    }  # fmt: skip
    for name, tensor in tensors.items():
        if tuple(tensor.shape) != (*batch, *wanted[name]):
            raise ValueError(f"{name} must be {[*batch, *wanted[name]]}, not {list(tensor.shape)}")
    if sh_degree is not None and sh_degree > MAX_SH_DEGREE:
        raise UnsupportedOption(f"sh_degree={sh_degree}: spherical harmonics go to degree {MAX_SH_DEGREE} here")
    if sh_degree is not None and num_sh_bases(sh_degree) > colors.shape[-2]:
        raise ValueError(f"sh_degree={sh_degree} needs {num_sh_bases(sh_degree)} bases, not {colors.shape[-2]}")
    _check_cameras(tensors["viewmats"], tensors["Ks"])
    flat = {name: tensor.reshape(math.prod(batch), *tensor.shape[len(batch) :]) for name, tensor in tensors.items()}
    return _Gaussians(batch=batch, **(flat | {"colors": flat["colors"] if own else flat["colors"][:, None]}))


def _check_cameras(viewmats: Tensor, Ks: Tensor) -> None:
    """Raise for matrices without numbers, for transposed ones, and for lenses that are not drawn."""
    for name, matrices in (("viewmats", viewmats), ("Ks", Ks)):
        if not bool(matrices.isfinite().all()):
            raise ValueError(f"{name} hold what is no finite number")
        below, aside = (matrices[..., -1, :-1] != 0).any(-1), (matrices[..., :-1, -1] != 0).any(-1)
        if bool((below & ~aside).any()):
            raise ValueError(f"{name} have their translation in the last row: transpose them")
    if bool((Ks[..., 0, 1] != 0).any() or (Ks[..., 1, 0] != 0).any()):
        raise UnsupportedOption("Ks: a camera has skew, which vdgs.ops.rasterization has not")


class _Image(NamedTuple):
    """The Gaussians of one image that are drawn: their rows, and what they are on the image plane."""

    batch: int
    camera: int
    rows: Tensor
    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor


def _projected(gaussians: _Gaussians, settings: _Settings, packed: bool) -> tuple[dict[str, Any], list[_Image]]:
    """What `meta` says of the Gaussians, and each image's own, taken from there: gradients pass through `meta`."""
    places = [(b, c) for b in range(gaussians.num_batches) for c in range(gaussians.num_cameras)]
    views = [_project_image(gaussians, settings, b, c) for b, c in places]
    rows = [(radii > 0).all(-1).nonzero()[:, 0] for radii, *_ in views]
    means = gaussians.means
    none = {  # to begin with, where there are no images
        "radii": means.new_zeros(0, 2, dtype=torch.int32), "means2d": means.new_zeros(0, 2),
        "depths": means.new_zeros(0), "conics": means.new_zeros(0, 3), "opacities": means.new_zeros(0),
    }  # fmt: skip
    columns = [[view[place] for view in views] for place in range(len(none))]
    meta: dict[str, Any] = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    if packed:
        counts = torch.tensor([len(each) for each in rows], dtype=torch.int64, device=means.device)
        for name, at in (("batch_ids", 0), ("camera_ids", 1)):
            meta[name] = counts.new_tensor([place[at] for place in places]).repeat_interleave(counts)
        meta["gaussian_ids"] = torch.cat([counts[:0], *rows])
        for (name, first), column in zip(none.items(), columns, strict=True):
            meta[name] = torch.cat([first, *(each[chosen] for each, chosen in zip(column, rows, strict=True))])
        parts = [meta[name].split(counts.tolist())[: len(rows)] for name in none]
    else:
        shape, n = (*gaussians.batch, gaussians.num_cameras), means.shape[1]
        for (name, first), column in zip(none.items(), columns, strict=True):
            meta[name] = torch.cat([first, *column]).reshape(*shape, n, *first.shape[1:])
        flat = [meta[name].reshape(len(places), n, *none[name].shape[1:]) for name in none]
        parts = [[each[i][chosen] for i, chosen in enumerate(rows)] for each in flat]
    images = [
        _Image(place[0], place[1], chosen, means2d, conics, depths, opacities)
        for place, chosen, _, means2d, depths, conics, opacities in zip(places, rows, *parts, strict=True)
    ]
    return meta, images


def _project_image(gaussians: _Gaussians, settings: _Settings, batch: int, index: int) -> tuple[Tensor, ...]:
    """Radii (0: not drawn), means, depths, conics and opacities of all Gaussians in one image."""
    means, opacities, pose = gaussians.means[batch], gaussians.opacities[batch], gaussians.viewmats[batch, index]
    camera = _camera(pose, gaussians.Ks[batch, index], settings)
    scales, quats, covars = (
        None if each is None else each[batch] for each in (gaussians.scales, gaussians.quats, gaussians.covars)
    )
    moved = pose.requires_grad and torch.is_grad_enabled()
    plain = settings.eps2d == DILATION_PX2 and settings.near >= NEAR_PLANE and not settings.antialiased
    plain = plain and not moved and is_rigid_motion(camera.camera_from_world, RIGID_TOLERANCE)
    if scales is not None and quats is not None and plain:
        projected = get_backend(means.device).project(means, scales, quats, camera)
    else:
        limits = (settings.near, settings.far)
        shapes = GaussianShapes(scales, quats, None if covars is None else _symmetric(covars))
        projected, _, compensation = project_gaussians(
            means, shapes, camera, pose, dilation_px2=settings.eps2d, depths=limits
        )
        if settings.antialiased:
            opacities = opacities * compensation
    with torch.no_grad():
        radii = _radii(projected, opacities, settings)
    return radii, projected.means_px, projected.depths, projected.conics, opacities


def _camera(pose: Tensor, K: Tensor, settings: _Settings) -> Camera:
    intrinsics = K.detach().double().cpu()
    return Camera(
        camera_from_world=pose.detach().double().cpu().numpy(),
        fx=float(intrinsics[0, 0]), fy=float(intrinsics[1, 1]), cx=float(intrinsics[0, 2]), cy=float(intrinsics[1, 2]),
        width=settings.width, height=settings.height, model="orthographic" if settings.orthographic else "pinhole",
    )  # fmt: skip


def _symmetric(covars: Tensor) -> Tensor:
    """From the upper triangle, the part that gsplat reads."""
    return covars.triu() + covars.triu(1).mT


def _radii(projected: ProjectedGaussians, opacities: Tensor, settings: _Settings) -> Tensor:
    """How far a Gaussian is drawn from its center, [n, 2] int32 px: 0 for one that no pixel shows, as in gsplat."""
    extent = (2 * (opacities / ALPHA_MIN).clamp(min=1).log()).sqrt().clamp(max=MAX_EXTENT)
    radii = (extent[:, None] * variances_px2(projected.conics).sqrt()).ceil().nan_to_num()
    low, high = projected.means_px + radii, projected.means_px - radii
    size = radii.new_tensor([settings.width, settings.height])
    shown = projected.valid & (opacities >= ALPHA_MIN) & (radii > settings.radius_clip).any(-1)
    shown &= (low > 0).all(-1) & (high < size).all(-1)
    shown &= (projected.depths > settings.near) & (projected.depths < settings.far)
    return torch.where(shown[:, None], radii.clamp(max=2.0**30), 0.0).to(torch.int32)


def _draw_image(
    gaussians: _Gaussians, settings: _Settings, image: _Image, mode: RenderMode, sh_degree: int | None
) -> tuple[Tensor, Tensor]:
    """The picture [h, w, x] and alpha [h, w] of one image: three channels at a time."""
    means2d, wants_depth = image.means2d, mode != "RGB"
    colors, background = means2d.new_zeros(len(means2d), 0), means2d.new_zeros(0)
    if mode not in ("D", "ED"):
        colors = _colors(gaussians, image, sh_degree)
        background = colors.new_zeros(colors.shape[1])
        if gaussians.backgrounds is not None:
            background = gaussians.backgrounds[image.batch, image.camera]
    kernels, channels, parts = get_backend(means2d.device), colors.shape[1], []
    alpha = depth = None
    for first in range(0, max(channels, 1), 3):
        count = min(3, channels - first)
        pad = (0, 3 - count)
        some, behind = (torch.nn.functional.pad(x[..., first : first + count], pad) for x in (colors, background))
        splats = Splats(means2d, image.conics, image.depths, some, image.opacities)
        raster = kernels.rasterize(splats, behind, settings.width, settings.height, depth=wants_depth and first == 0)
        parts.append(raster.image[..., :count])
        if first == 0:
            alpha, depth = raster.alpha, raster.depth
    assert alpha is not None
    if depth is not None:
        parts.append((depth / alpha.clamp(min=1e-10) if mode.endswith("ED") else depth)[..., None])
    return torch.cat(parts, -1), alpha


def _colors(gaussians: _Gaussians, image: _Image, sh_degree: int | None) -> Tensor:
    """The colors [v, d] that the drawn Gaussians show to a camera."""
    of_camera = image.camera if gaussians.colors.shape[1] > 1 else 0
    colors = gaussians.colors[image.batch, of_camera][image.rows]
    if sh_degree is None:
        return colors
    eye = torch.linalg.inv(gaussians.viewmats[image.batch, image.camera])[:3, 3]
    directions = torch.nn.functional.normalize(gaussians.means[image.batch][image.rows] - eye, dim=-1)
    return eval_sh_colors(colors[:, 0], colors[:, 1:], directions, sh_degree)
