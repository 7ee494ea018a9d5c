"""The numerical operations, in interchangeable implementations, behind one door: `get_backend(device)`.

`native` is C++ for the CPU, `reference` readable torch for any device (and the oracle of the tests). `KernelBackend` in
`operations.py` is the typed set that both offer; "d" marks those that torch can differentiate. `composed` is the set
for NVIDIA GPUs, of `reference`, own kernels (`cuda`) and `gsplat`; a table in `operations.py` says which is which.
Code outside this folder names no implementation.

Names and dimensions, fixed once for all files in this folder:

    n  anchors of the model          v  anchors visible in the view
    k  offsets per anchor            m  splats: Gaussians that survive decoding
    h, w  image height and width in pixels

       cull(positions [n,3], log_scales [n,6], camera) -> int64 [v], ascending
    d  decode(positions [n,3], features [n,32], offsets [n,k,3], log_scales [n,6], weights, camera,
              rows [v]) -> Splats
       decode_to_train(the same) -> Splats, in an order that goes with them, and their mean volume
       decode_backward_adam(positions [n,3], moved, weights, camera, rows [v], gradients, updates [n])
                 -> finite, gradients of the weights; anchors move and their updates are counted, in place
    d  project(means [m,3], scales [m,3], quaternions [m,4], camera) -> Projected
    d  rasterise(means_px [m,2], conics [m,3], colours [m,3], opacities [m], depths [m],
                 background [3], width, height) -> Raster(image [h,w,3], alpha [h,w], depth [h,w], median_depth [h,w])
       rasterise_vjp(the same) -> Raster, and the function that takes gradients of it back to the splats
       shares(the same, wanted [h,w,3]) -> Shares(pixels [m], missing [m,3])
    d  photometric_loss(image [h,w,3], target uint8 [h,w,3], mask) -> Photometric(loss, l1, ssim)
       adam_rows(parameter [n,...], rows [v], gradient [v,...], moments, ...) -> finite; in place
       add_view_statistics(visible [v], inside [v], source [m], opacities [m], gradient_px [m,2], ..., sums)
                 in place
       harmonic_colours(means [m,3], coefficients [n,c], rows [m], eye [3], degree) -> colours [m,3]
       fit_harmonics(directions [p,3], colours [p,3], weights [p], starts [m], degree, ridge) -> coefficients [m,f,3]
       mean_ellipsoids(log_scales [p,3], quaternions [p,4], weights [p], starts [m]) -> the same of the means [m,...]
       count_visibility(points [n,3], cameras) -> int32 [n];  mark_visible(points [n,3], camera) -> bool [n]
       cell_keys, cell_centres, group_cells, group_max, contains, morton_order: the lattice of growth

Constants shared by all implementations live in `constants.py`. Nothing heavy is imported before it is asked for.
"""

from __future__ import annotations

import os
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from vdgs.kernels.operations import KernelBackend

#: Environment variable that takes another set than the device's own: `reference` or `composed`, for tests and doubts.
KERNELS_ENV_VAR = "VDGS_KERNELS"


def get_backend(device: torch.device) -> KernelBackend:
    """The operations for tensors on `device`: C++ on the CPU, the composed set on NVIDIA GPUs, torch elsewhere; on any
    device those that VDGS_KERNELS names, if it does.

    Raises VdgsError for another value of that variable.
    """
    return _implementation(device.type, os.environ.get(KERNELS_ENV_VAR, ""))


@cache
def _implementation(device_type: str, wanted: str) -> KernelBackend:
    if wanted not in ("", "native", "reference", "composed"):
        from vdgs.errors import VdgsError

        raise VdgsError(f"{KERNELS_ENV_VAR} must be native, reference, composed or not set, not {wanted!r}.")
    if wanted == "reference" or (wanted != "composed" and device_type not in ("cpu", "cuda")):
        from vdgs.kernels import torch_ref

        return torch_ref
    if wanted == "composed" or device_type == "cuda":
        from vdgs.kernels import gpu

        return gpu
    from vdgs.kernels import cpu

    return cpu


def get_num_threads() -> int:
    """How many threads the operations use on the CPU."""
    from vdgs.kernels.cpu import extension

    return extension.get_num_threads()


def default_num_threads() -> int:
    """`VDGS_THREADS`, or the number of cores that this process may use; the kernels themselves are not loaded.

    Raises VdgsError for another value of that variable.
    """
    from vdgs.kernels import thread_count

    return thread_count.default_num_threads()


def configure_threads(count: int | None = None) -> None:
    """Set up the threads of this process and, by its environment, of those that it starts.

    Call it before torch is imported: torch's OpenMP threads must block, not spin, beside the kernels' own pool, and
    OMP_WAIT_POLICY is read once, when torch is loaded. A value that is set already stays. Without a count nothing heavy
    is imported; with one, kernels and torch use so many threads, with 0 as many as `default_num_threads` says.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if count is not None:
        set_num_threads(count or default_num_threads())


def set_num_threads(count: int) -> None:
    """Let the operations use up to `count` threads of the CPU, the calling one included; torch's own as well.

    Raises ValueError below 1.
    """
    import torch

    from vdgs.kernels.cpu import extension

    extension.set_num_threads(count)
    torch.set_num_threads(count)
