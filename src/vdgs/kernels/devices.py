"""Which device computes: what `--device` asks for, and what there is.

Decided before any work begins, and without torch: a device that cannot do all of it is refused at once.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from vdgs.errors import VdgsError
from vdgs.kernels.operations import CUDA_OPERATIONS, OPERATIONS, missing_on_cuda


class DeviceUnavailable(VdgsError):
    """The device that was asked for cannot do the work."""


@dataclass(frozen=True)
class Choice:
    """A device (`cpu`, `cuda:0`) and why it was chosen."""

    device: str
    why: str


def choose(asked: str) -> Choice:
    """The device to use for `auto`, `cpu`, `cuda` or `cuda:i`.

    `auto` takes a card only where every operation runs on it. Raises DeviceUnavailable for a card that is not there
    or on which operations are missing, VdgsError for another word.
    """
    named = re.fullmatch(r"auto|cpu|cuda(?::(\d+))?", asked)
    if named is None:
        raise VdgsError(f"--device {asked}: choose auto, cpu, cuda or cuda:0 (the number is that of the card)")
    if asked == "cpu":
        return Choice("cpu", "as asked for")
    index = int(named.group(1) or 0)
    missing = missing_on_cuda()
    reason = (
        f"{len(CUDA_OPERATIONS)} of {len(OPERATIONS)} operations run on GPUs so far" if missing else _no_card(index)
    )
    if not reason:
        return Choice(f"cuda:{index}", "every operation runs on it")
    if asked == "auto":
        return Choice("cpu", reason)
    if missing:
        reason = (
            "vdgs cannot train, draw or measure on GPUs yet. Of its operations, "
            f"{', '.join(CUDA_OPERATIONS)} is there; {', '.join(missing)} are not"
        )
    raise DeviceUnavailable(f"--device {asked}: {reason}. Use --device cpu, which does everything, or leave it out.")


def _no_card(index: int) -> str:
    """Why a card cannot be used, in words; empty if it can."""
    from vdgs.kernels.cuda.driver import cuda_driver
    from vdgs.kernels.cuda.nvrtc import CudaUnavailable, nvrtc

    try:
        count = len(cuda_driver().cards())
        nvrtc()
    except CudaUnavailable as error:
        return str(error)
    import torch

    if not torch.cuda.is_available():
        return f"this torch ({torch.__version__}) is built without CUDA or does not fit the driver"
    return "" if index < count else f"there is no card {index}; the driver knows {count}"
