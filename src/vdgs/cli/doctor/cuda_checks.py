"""The part of `vdgs doctor` about NVIDIA GPUs: cards, compiler, compiled code, operations, the choice of a device."""

from __future__ import annotations

from vdgs.cli.doctor.check import Check
from vdgs.kernels.cuda.compile_cache import VARIABLE, cache_folder
from vdgs.kernels.cuda.driver import CudaDriver, cuda_driver
from vdgs.kernels.cuda.nvrtc import CudaUnavailable, Nvrtc, nvrtc
from vdgs.kernels.device_selection import choose
from vdgs.kernels.operations import OPERATIONS, taken
from vdgs.system.units import data_size


def looks() -> list[Check]:
    """Every line about CUDA. None is essential: the processor does everything."""
    return [*_cards(), _compiler(), _kernels(), *_operations(), _device()]


def _cards() -> list[Check]:
    try:
        driver: CudaDriver = cuda_driver()
        cards = driver.cards()
        major, minor = driver.version()
    except CudaUnavailable as error:
        return [Check("CUDA driver", "note", str(error))]
    return [
        Check(
            f"CUDA card {card.index}", "ok",
            f"{card.name}, {data_size(card.memory_bytes)}, compute capability {card.capability[0]}."
            f"{card.capability[1]}; driver for CUDA {major}.{minor}",
        )
        for card in cards
    ] or [Check("CUDA driver", "note", f"for CUDA {major}.{minor}, but it knows no card")]  # fmt: skip


def _compiler() -> Check:
    try:
        found: Nvrtc = nvrtc()
    except CudaUnavailable as error:
        return Check("NVRTC", "note", "not found: CUDA kernels cannot be compiled", str(error))
    version = f"{found.version[0]}.{found.version[1]}"
    return Check("NVRTC", "ok", f"{version}, from {found.found.origin}: {found.found.path}")


def _kernels() -> Check:
    folder = cache_folder()
    kept = len(list(folder.glob("*.bin"))) if folder.is_dir() else 0
    return Check("CUDA kernels", "note", f"compiled code in {folder} ({VARIABLE}), {kept} entries")


def _operations() -> list[Check]:
    """Who does which operation: a line for each way."""
    ways: dict[tuple[str, ...], list[str]] = {}
    for name in OPERATIONS:
        ways.setdefault(taken(name, "cuda"), []).append(name)
    by_card = [Check(f"on cuda: {' or '.join(way)}", "note", ", ".join(names)) for way, names in ways.items()]
    return [Check("on cpu: native", "note", f"all {len(OPERATIONS)} operations"), *by_card]


def _device() -> Check:
    choice = choose("auto")
    return Check("--device auto", "ok", f"{choice.device}: {choice.why}")
