"""Where the figures of a run are from: the day, the machine and the version, in words for people."""

from __future__ import annotations

import platform
from datetime import date
from pathlib import Path

from vdgs import __version__
from vdgs.distributed.node_check import cpu_instruction_set
from vdgs.runs.config_file import git_commit

_CPUINFO_FILE = Path("/proc/cpuinfo")


def describe_provenance(threads: int, device: str = "cpu") -> str:
    """This day and machine, and the commit (outside a checkout: the version) of this package."""
    of = sha[:7] if (sha := git_commit()) else __version__
    cores = f"{threads} thread{'s' * (threads > 1)}"
    card = "" if device == "cpu" else f"{_card(device)}, "
    return f"{date.today().isoformat()}, {card}{cores} of {_processor()} ({cpu_instruction_set()}), {of}"


def _card(device: str) -> str:
    import torch

    return torch.cuda.get_device_name(device)


def _processor() -> str:
    try:
        named = [line for line in _CPUINFO_FILE.read_text().splitlines() if line.startswith("model name")]
    except OSError:
        named = []
    return named[0].partition(":")[2].strip() if named else platform.processor() or platform.machine()
