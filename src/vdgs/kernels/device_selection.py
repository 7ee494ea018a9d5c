"""Which device computes: what `--device` asks for, and what there is.

Decided before any work begins, and without torch: a device that cannot do all of it is refused at once.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from vdgs.errors import VdgsError
from vdgs.kernels.operations import RUN_ON_A_CARD


class DeviceUnavailable(VdgsError):
    """The device that was asked for cannot do the work."""


@dataclass(frozen=True)
class Choice:
    """A device (`cpu`, `cuda:0`) and why it was chosen."""

    device: str
    why: str


def choose(asked: str) -> Choice:
    """The device to use for `auto`, `cpu`, `cuda` or `cuda:i`.

    `auto` takes a card only once everything has been run on one. Raises DeviceUnavailable for a card that is not there
    or cannot be used, VdgsError for another word.
    """
    named = re.fullmatch(r"auto|cpu|cuda(?::(\d+))?", asked)
    if named is None:
        raise VdgsError(f"--device {asked}: choose auto, cpu, cuda or cuda:0 (the number is that of the card)")
    if asked == "cpu":
        return Choice("cpu", "as asked for")
    if asked == "auto" and not RUN_ON_A_CARD:
        return Choice("cpu", "vdgs has not been run on a GPU yet; --device cuda asks for the card")
    index = int(named.group(1) or 0)
    reason = _no_card(index)
    if not reason:
        return Choice(f"cuda:{index}", "as asked for" if asked != "auto" else "there is a card that can be used")
    if asked == "auto":
        return Choice("cpu", reason)
    raise DeviceUnavailable(f"--device {asked}: {reason}. Use --device cpu, which does everything, or leave it out.")


def _no_card(index: int) -> str:
    """Why a card cannot be used, in words; empty if it can."""
    from vdgs.kernels.cuda.driver import cuda_driver
    from vdgs.kernels.cuda.nvrtc import CudaUnavailable, nvrtc

    try:
        count = len(cuda_driver().cards())
        nvrtc()
    except CudaUnavailable as error:
        return str(error).rstrip(".")
    import torch

    if not torch.cuda.is_available():
        return f"this torch ({torch.__version__}) is built without CUDA or does not fit the driver"
    return "" if index < count else f"there is no card {index}; the driver knows {count}"
