"""Which device computes, from `--device` and the hardware; decided before any work begins, without loading torch."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vdgs.errors import VdgsError

if TYPE_CHECKING:
    from vdgs.kernels.cuda.driver import GpuInfo


class DeviceUnavailable(VdgsError):
    """The device that was asked for cannot do the work."""


#: Is there where a driver of NVIDIA is loaded; torch, which knows for sure, takes seconds to load.
DRIVER_FOLDER = Path("/proc/driver/nvidia")
#: Windows' cards within its Linux (WSL 2), which has no such folder.
WSL_DEVICE = Path("/dev/dxg")


class AnyCard(str):
    """The name of the first card of those that may be used, where nobody asked for one by its number."""

    __slots__ = ()


@dataclass(frozen=True)
class SelectedDevice:
    """A device (`cpu`, `cuda:0`) and why it was chosen."""

    device: str
    reason: str


def select_device(device: object) -> SelectedDevice:
    """The device for `auto` (the first card that can be used, else the processor), `cpu`, `cuda` or `cuda:i`, or a
    torch.device. Raises DeviceUnavailable for a GPU that is absent or cannot be used, VdgsError for another value."""
    if not isinstance(device, str):  # a torch.device, whose module need not be loaded for it
        device = "cpu" if getattr(device, "type", "") == "cpu" else str(device)
    named = re.fullmatch(r"auto|cpu|cuda(?::(\d+))?", device)
    if named is None:
        raise VdgsError(f"--device {device}: choose auto, cpu, cuda or cuda:0 (the number is that of the card)")
    if device == "cpu":
        return SelectedDevice("cpu", "as asked for")
    if device == "auto" and not (DRIVER_FOLDER.exists() or WSL_DEVICE.exists()):
        return SelectedDevice("cpu", "this machine has no NVIDIA GPU")
    index = int(named.group(1) or 0)
    reason = _no_card(index)
    if reason and not named.group(1):
        index = next((card.index for card, why in _cards() if not why), index)
        reason = _no_card(index) if index else reason
    if not reason:
        why = "there is a card that can be used" if device == "auto" else "as asked for"
        return SelectedDevice(f"cuda:{index}" if named.group(1) else AnyCard(f"cuda:{index}"), why)
    if device == "auto":
        return SelectedDevice("cpu", reason)
    raise DeviceUnavailable(f"--device {device}: {reason}. Use --device cpu, which does everything, or leave it out.")


def cards_of(device: str) -> dict[str, int]:
    """The cards that processes of this machine share where one of them computes on this device, with the bytes of each:
    all that torch can use where nobody asked for one by its number, that one elsewhere, none for the CPU."""
    if not device.startswith("cuda"):
        return {}
    every = {f"cuda:{card.index}": card.memory_bytes for card, why in _cards() if not why}
    return {name: size for name, size in every.items() if isinstance(device, AnyCard) or name == device}


def cards_left_out(device: str) -> list[str]:
    """What to say of the cards that are not used because torch cannot."""
    if not isinstance(device, AnyCard):
        return []
    return [f"note: card {card.index} ({card.name}) is not used: {why}" for card, why in _cards() if why]


def _cards() -> list[tuple[GpuInfo, str]]:
    """All cards that the driver shows, each with why torch cannot use it; empty if it can."""
    from vdgs.kernels.cuda.driver import get_cuda_driver
    from vdgs.kernels.cuda.nvrtc import CudaUnavailable

    try:
        return [(card, _unfit(card.index, card.capability)) for card in get_cuda_driver().list_gpus()]
    except CudaUnavailable:
        return []


def _unfit(index: int, capability: tuple[int, int]) -> str:
    import torch

    count, archs = torch.cuda.device_count(), torch.cuda.get_arch_list()
    if 0 < count <= index:
        return f"torch sees {count} card{'s' if count > 1 else ''} only"
    found = [re.fullmatch(r"(sm|compute)_(\d+)(\d)\w?", arch) for arch in archs]
    built = [(each[1], (int(each[2]), int(each[3]))) for each in found if each]
    # Machine code serves cards of its generation from its own on, PTX all later ones.
    fits = any(arch <= capability and (kind == "compute" or arch[0] == capability[0]) for kind, arch in built)
    have = ".".join(map(str, capability))
    return "" if fits or not built else f"this torch ({torch.__version__}) is not built for its capability, {have}"


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
    if index >= count:
        return f"there is no card {index}; the driver knows {count}"
    return next((why for card, why in _cards() if card.index == index), "")
