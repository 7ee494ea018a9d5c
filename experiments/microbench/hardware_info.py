"""What a benchmark ran on, in a few lines for the head of its output."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

import numpy as np
import torch

from vdgs.kernels import cpu_count
from vdgs.kernels.cpu.extension import active_isa, supported_isas


def describe() -> str:
    """Processor, cores, instruction sets, load and versions, one per line."""
    lines = [
        f"command      {' '.join([Path(sys.executable).name, *sys.argv])}",
        f"processor    {_processor()}, {cpu_count()} cores for this process",
        f"native       {active_isa()} of {', '.join(supported_isas())}",
        f"memory       {_memory_gib():.0f} GiB",
        f"load         {os.getloadavg()[0]:.1f} over the last minute, before the start",
        f"system       {platform.system()} {platform.release()}, Python {platform.python_version()}",
        f"versions     torch {torch.__version__}, numpy {np.__version__}",
    ]
    return "\n".join(lines)


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


if __name__ == "__main__":
    print(describe())
