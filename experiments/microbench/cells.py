"""Cells of space and Morton order: the native hash and sort beside torch, in one run.

OMP_WAIT_POLICY=PASSIVE python -m experiments.microbench.cells [--points 1000000] [--threads 2]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from types import ModuleType

import torch

from experiments.microbench.hardware_info import describe
from experiments.microbench.timing import medians_ms
from vdgs.kernels.cpu import cells as native
from vdgs.kernels.cpu import extension
from vdgs.kernels.torch_ref import cells as reference

CELL_M = 4.0
FEATURES = 32


def operations(implementation: ModuleType, n: int) -> dict[str, Callable[[], object]]:
    """Each operation on the same random scene."""
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(n, 3, generator=generator) * torch.tensor([800.0, 800.0, 20.0])
    origin = torch.zeros(3)
    keys = reference.cell_keys(positions, CELL_M, origin)
    unique, group = reference.group_cells(keys)
    values = torch.rand(n, FEATURES, generator=generator)
    return {
        "cell_keys": lambda: implementation.cell_keys(positions, CELL_M, origin),
        "group_cells": lambda: implementation.group_cells(keys),
        "contains": lambda: implementation.contains(unique[::2], keys),
        "group_max": lambda: implementation.group_max(values, group, len(unique)),
        "morton_order": lambda: implementation.morton_order(positions),
    }


def main() -> None:
    """Print one line for each operation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int, default=extension.get_num_threads())
    parser.add_argument("--rounds", type=int, default=7)
    arguments = parser.parse_args()
    extension.set_num_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    print(describe())
    print(f"{arguments.points} points, median ms of {arguments.rounds}")
    print(f"{'operation':>14} {'native':>8} {'torch':>8}")
    fast, slow = (operations(implementation, arguments.points) for implementation in (native, reference))
    for name in fast:
        ms = medians_ms({"native": fast[name], "torch": slow[name]}, arguments.rounds)
        print(f"{name:>14} {ms['native']:8.1f} {ms['torch']:8.1f}")


if __name__ == "__main__":
    main()
