"""Adam on the rows that a view has touched: the native kernel beside torch, in one run.

OMP_WAIT_POLICY=PASSIVE python -m experiments.microbench.adam [--anchors 100000] [--visible 20000] [--threads 2]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from types import ModuleType

import torch

from experiments.microbench.hardware_info import describe
from experiments.microbench.timing import medians_ms
from vdgs.kernels.cpu import adam as native
from vdgs.kernels.cpu import extension
from vdgs.kernels.kernel_types import AdamState
from vdgs.kernels.torch_ref import adam as reference

#: The trained arrays of an anchor.
WIDTHS = {"log_scales": 6, "offsets": 30, "features": 32}


def step(implementation: ModuleType, anchors: int, visible: int, width: int) -> Callable[[], object]:
    """One step on random rows."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randperm(anchors, generator=generator)[:visible].sort().values
    gradient = torch.randn(visible, width, generator=generator)
    parameter, first, second = (torch.zeros(anchors, width) for _ in range(3))

    def run() -> object:
        return implementation.adam_rows(AdamState(parameter, first, second, 1e-3), rows, gradient, 10)

    return run


def torch_step(anchors: int, width: int) -> Callable[[], object]:
    """torch.optim.Adam, which updates every row."""
    parameter = torch.zeros(anchors, width, requires_grad=True)
    parameter.grad = torch.randn(anchors, width)
    return torch.optim.Adam([parameter], lr=1e-3, fused=True).step


def main() -> None:
    """Print one line for each array of the anchors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--anchors", type=int, default=100_000)
    parser.add_argument("--visible", type=int, default=20_000)
    parser.add_argument("--threads", type=int, default=extension.get_num_threads())
    parser.add_argument("--rounds", type=int, default=15)
    arguments = parser.parse_args()
    extension.set_num_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    print(describe())
    print(f"{arguments.visible} of {arguments.anchors} rows, median ms of {arguments.rounds}")
    print(f"{'array':>10} {'native':>8} {'twin':>8} {'torch fused, all rows':>22}")
    for name, width in WIDTHS.items():
        ms = medians_ms(
            {
                "native": step(native, arguments.anchors, arguments.visible, width),
                "twin": step(reference, arguments.anchors, arguments.visible, width),
                "torch": torch_step(arguments.anchors, width),
            },
            arguments.rounds,
        )
        print(f"{name:>10} {ms['native']:8.2f} {ms['twin']:8.2f} {ms['torch']:22.2f}")


if __name__ == "__main__":
    main()
