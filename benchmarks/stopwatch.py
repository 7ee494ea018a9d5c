"""Wall-clock times of functions run side by side, and what machine they ran on."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from vdgs.kernels.native import module


def describe() -> str:
    """The processor, its load, and the versions that matter, in one line."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    load = f"load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "load unknown"
    return (
        f"{names[0] if names else platform.processor()}, {module.cores()} cores, {load}, "
        f"kernels {module.isa()} on {module.threads()} threads, torch {torch.__version__}"
    )


def medians_ms(functions: dict[str, Callable[[], object]], rounds: int = 9) -> dict[str, float]:
    """Median milliseconds of each function, after one call to warm up.

    The functions take turns, so that what else the machine does falls on all of them alike: compare the
    medians of one call with each other.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    for function in functions.values():
        function()
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}
