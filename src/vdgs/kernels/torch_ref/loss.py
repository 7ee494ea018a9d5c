"""Photometric loss: L1 and structural similarity (3DGS eq. 7; SSIM of Wang et al. 2004).

    loss = (1 - λ) · L1 + λ · (1 - SSIM),        λ = 0.2

SSIM has an 11×11 Gaussian window of σ = 1.5 px, zero padding, C1 = 0.01², C2 = 0.03², data range 1.
Both terms are means over the pixels that count and the three channels.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import conv2d

from vdgs.kernels.constants import SSIM_WINDOW_PX
from vdgs.kernels.kernel_types import PhotometricLoss

#: Standard deviation of the SSIM window in pixels.
SIGMA_PX = 1.5
C1 = 0.01**2
C2 = 0.03**2


def photometric_loss(
    image: Float[Tensor, "h w 3"],
    target: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"] | None = None,
    *,
    ssim_weight: float = 0.2,
) -> PhotometricLoss:
    """(1 - ssim_weight) · L1 + ssim_weight · (1 - SSIM) between `image` (in [0, 1]) and `target` / 255.

    Pixels where `mask` is zero do not count: the image is replaced by the target there, and means run over the other
    pixels (choice: what is drawn under the mask cannot change the loss). With no pixel left, loss and L1 are 0, SSIM is
    1 and the gradient is zero. Raises TypeError for other dtypes, ValueError for shapes that do not match.
    """
    check_images(image, target, mask)
    goal = target.to(image.dtype) / 255
    if mask is None:
        kept = torch.ones_like(image[..., :1])
    else:
        keep = (mask != 0)[..., None]
        kept = keep.to(image.dtype)
        image = torch.where(keep, image, goal)
    # With nothing kept both sums are zero, whatever they are divided by.
    count = (kept.sum() * 3).clamp(min=1)
    l1 = ((image - goal).abs() * kept).sum() / count
    dissimilarity = ((1 - _ssim_map(image, goal)) * kept).sum() / count
    loss = (1 - ssim_weight) * l1 + ssim_weight * dissimilarity
    return PhotometricLoss(loss, l1.detach(), 1 - dissimilarity.detach())


def photometric_loss_vjp(
    image: Float[Tensor, "h w 3"],
    target: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"] | None = None,
    *,
    ssim_weight: float = 0.2,
) -> tuple[PhotometricLoss, Float[Tensor, "h w 3"]]:
    """`photometric_loss` without autograd around it: its values, and its gradient by the image. Errors as there."""
    with torch.enable_grad():
        leaf = image.detach().requires_grad_(True)
        found = photometric_loss(leaf, target, mask, ssim_weight=ssim_weight)
        (gradient,) = torch.autograd.grad(found.loss, leaf)
    return found._replace(loss=found.loss.detach()), gradient


def ssim_map(
    image: Float[Tensor, "h w c"] | UInt8[Tensor, "h w c"], target: Float[Tensor, "h w c"] | UInt8[Tensor, "h w c"]
) -> Float[Tensor, "h w c"]:
    """SSIM of every pixel and channel in float64, for evaluation. uint8 images are divided by 255."""
    if image.shape != target.shape or image.ndim != 3:
        raise ValueError(f"expected two images [h, w, c], got {tuple(image.shape)} and {tuple(target.shape)}")
    return _ssim_map(_unit_range(image), _unit_range(target))


def gaussian_window(dtype: torch.dtype = torch.float64) -> Float[Tensor, "taps"]:
    """The separable Gaussian window, of sum 1."""
    offset = torch.arange(SSIM_WINDOW_PX, dtype=torch.float64, device="cpu") - SSIM_WINDOW_PX // 2
    weight = torch.exp(-(offset**2) / (2 * SIGMA_PX**2))
    return (weight / weight.sum()).to(dtype)


def check_float32_images(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    """As `check_images`, for kernels that compute in float32."""
    check_images(image, target, mask)
    if image.dtype != torch.float32:
        raise TypeError(f"image must be float32, not {image.dtype}")


def check_images(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    """Raise a clear error unless the three fit together."""
    if image.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"image must be float32 or float64, not {image.dtype}")
    if target.dtype != torch.uint8:
        raise TypeError(f"target must be uint8, not {target.dtype}")
    if image.ndim != 3 or image.shape[2] != 3 or image.numel() == 0:
        raise ValueError(f"image must be [h, w, 3] with at least one pixel, not {list(image.shape)}")
    if target.shape != image.shape:
        raise ValueError(f"target is {list(target.shape)} but the image {list(image.shape)}")
    if mask is None:
        return
    if mask.dtype != torch.uint8:
        raise TypeError(f"mask must be uint8, not {mask.dtype}")
    if mask.shape != image.shape[:2]:
        raise ValueError(f"mask is {list(mask.shape)} but the image {list(image.shape)}")


def _unit_range(image: Tensor) -> Float[Tensor, "h w c"]:
    scaled = image.to(torch.float64)
    return scaled / 255 if image.dtype == torch.uint8 else scaled


def _blur(planes: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    weight, half = gaussian_window(planes.dtype).to(planes.device), SSIM_WINDOW_PX // 2
    rows = conv2d(planes[:, None], weight[None, None, None, :], padding=(0, half))
    return conv2d(rows, weight[None, None, :, None], padding=(half, 0))[:, 0]


def _ssim_map(image: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_x, mean_y = _blur(x), _blur(y)
    variance_x = _blur(x * x) - mean_x**2
    variance_y = _blur(y * y) - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    denominator = (mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2)
    return (numerator / denominator).permute(1, 2, 0)
