"""Which device computes, from `--device` and the hardware; decided before any work begins, without loading torch."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from vdgs.errors import VdgsError


class DeviceUnavailable(VdgsError):
    """The device that was asked for cannot do the work."""


#: Is there where a driver of NVIDIA is loaded; torch, which knows for sure, takes seconds to load.
DRIVER_FOLDER = Path("/proc/driver/nvidia")
#: Windows' cards within its Linux (WSL 2), which has no such folder.
WSL_DEVICE = Path("/dev/dxg")


@dataclass(frozen=True)
class SelectedDevice:
    """A device (`cpu`, `cuda:0`) and why it was chosen."""

    device: str
    reason: str


def select_device(device: str) -> SelectedDevice:
    """The device for `auto` (the first card that can be used, else the processor), `cpu`, `cuda` or `cuda:i`. Raises
    DeviceUnavailable for a GPU that is absent or cannot be used, VdgsError for another value."""
    named = re.fullmatch(r"auto|cpu|cuda(?::(\d+))?", device)
    if named is None:
        raise VdgsError(f"--device {device}: choose auto, cpu, cuda or cuda:0 (the number is that of the card)")
    if device == "cpu":
        return SelectedDevice("cpu", "as asked for")
    if device == "auto" and not (DRIVER_FOLDER.exists() or WSL_DEVICE.exists()):
        return SelectedDevice("cpu", "this machine has no NVIDIA GPU")
    index = int(named.group(1) or 0)
    reason = _no_card(index)
    if not reason:
        why = "there is a card that can be used" if device == "auto" else "as asked for"
        return SelectedDevice(f"cuda:{index}", why)
    if device == "auto":
        return SelectedDevice("cpu", reason)
    raise DeviceUnavailable(f"--device {device}: {reason}. Use --device cpu, which does everything, or leave it out.")


def cards_of(device: str) -> dict[str, int]:
    """The cards that processes of this machine share where one of them computes on this device, with the bytes of each:
    all where it is the first card, that one where it is another, none for the CPU."""
    from vdgs.kernels.cuda.driver import get_cuda_driver

    if not device.startswith("cuda"):
        return {}
    every = {f"cuda:{card.index}": card.memory_bytes for card in get_cuda_driver().list_gpus()}
    return {name: size for name, size in every.items() if device in ("cuda", "cuda:0", name)}


def _no_card(index: int) -> str:
    """Why a card cannot be used, in words; empty if it can."""
    from vdgs.kernels.cuda.driver import get_cuda_driver
    from vdgs.kernels.cuda.nvrtc import CudaUnavailable, get_nvrtc

    try:
        count = len(get_cuda_driver().list_gpus())
        get_nvrtc()
    except CudaUnavailable as error:
        return str(error).rstrip(".")
    import torch

    if not torch.cuda.is_available():
        return f"this torch ({torch.__version__}) is built without CUDA or does not fit the driver"
    return "" if index < count else f"there is no card {index}; the driver knows {count}"
