"""The part of `vdgs doctor` about NVIDIA GPUs: cards, compiler, compiled code, operations, the choice of a device."""

from __future__ import annotations

from vdgs.cli.doctor import SystemCheck
from vdgs.kernels.cuda.compile_cache import CUDA_CACHE_ENV_VAR, cache_folder
from vdgs.kernels.cuda.driver import get_cuda_driver
from vdgs.kernels.cuda.nvrtc import CudaUnavailable, get_nvrtc
from vdgs.kernels.device_selection import select_device
from vdgs.kernels.operations import OPERATION_NAMES, backends_for
from vdgs.system.units import data_size


def cuda_checks() -> list[SystemCheck]:
    """Every line about CUDA. None is essential: the processor does everything."""
    return [*_gpus(), _compiler(), _kernels(), *_operations(), _device()]


def _gpus() -> list[SystemCheck]:
    try:
        driver = get_cuda_driver()
        cards = driver.list_gpus()
        major, minor = driver.version()
    except CudaUnavailable as error:
        return [SystemCheck("CUDA driver", "note", str(error))]
    return [
        SystemCheck(
            f"CUDA card {card.index}", "ok",
            f"{card.name}, {data_size(card.memory_bytes)}, compute capability {card.capability[0]}."
            f"{card.capability[1]}; driver for CUDA {major}.{minor}",
        )
        for card in cards
    ] or [SystemCheck("CUDA driver", "note", f"for CUDA {major}.{minor}, but it knows no card")]  # fmt: skip


def _compiler() -> SystemCheck:
    try:
        nvrtc = get_nvrtc()
    except CudaUnavailable as error:
        return SystemCheck("NVRTC", "note", "not found: CUDA kernels cannot be compiled", str(error))
    (major, minor), library = nvrtc.version, nvrtc.library_info
    return SystemCheck("NVRTC", "ok", f"{major}.{minor}, from {library.origin}: {library.path}")


def _kernels() -> SystemCheck:
    folder = cache_folder()
    count = len(list(folder.glob("*.bin"))) if folder.is_dir() else 0
    return SystemCheck("CUDA kernels", "note", f"compiled code in {folder} ({CUDA_CACHE_ENV_VAR}), {count} entries")


def _operations() -> list[SystemCheck]:
    """Who does which operation: a line for each way."""
    ways: dict[tuple[str, ...], list[str]] = {}
    for name in OPERATION_NAMES:
        ways.setdefault(backends_for(name, "cuda"), []).append(name)
    by_card = [SystemCheck(f"on cuda: {' or '.join(way)}", "note", ", ".join(names)) for way, names in ways.items()]
    return [SystemCheck("on cpu: cpu", "note", f"all {len(OPERATION_NAMES)} operations"), *by_card]


def _device() -> SystemCheck:
    choice = select_device("auto")
    return SystemCheck("--device auto", "ok", f"{choice.device}: {choice.reason}")
