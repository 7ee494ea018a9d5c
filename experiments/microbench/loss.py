"""Photometric loss with its gradient: the native kernel beside torch, in one run.

OMP_WAIT_POLICY=PASSIVE python -m experiments.microbench.loss [--threads 2] [--rounds 5]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from types import ModuleType

import torch

from experiments.microbench.hardware_info import describe
from experiments.microbench.timing import medians_ms
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu import loss as native
from vdgs.kernels.torch_ref import loss as reference

SIZES = [(400, 300), (800, 600), (1600, 1200)]


def step(implementation: ModuleType, width: int, height: int, masked: bool) -> Callable[[], object]:
    """Loss and gradient of one random image."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(height, width, 3, generator=generator).requires_grad_()
    target = torch.randint(256, (height, width, 3), generator=generator, dtype=torch.uint8)
    mask = (torch.rand(height, width, generator=generator) < 0.9).byte() if masked else None

    def run() -> object:
        return torch.autograd.grad(implementation.photometric_loss(image, target, mask).loss, image)

    return run


def main() -> None:
    """Print one line for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=extension.get_num_threads())
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    extension.set_num_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    print(describe())
    print(f"loss + gradient, median ms of {arguments.rounds}")
    print(f"{'size':>10} {'native':>8} {'masked':>8} {'torch':>8} {'torch / native':>15}")
    for width, height in SIZES:
        ms = medians_ms(
            {
                "native": step(native, width, height, masked=False),
                "masked": step(native, width, height, masked=True),
                "torch": step(reference, width, height, masked=False),
            },
            arguments.rounds,
        )
        print(
            f"{width:>5}x{height:<4} {ms['native']:8.2f} {ms['masked']:8.2f} {ms['torch']:8.1f}"
            f" {ms['torch'] / ms['native']:15.0f}"
        )


if __name__ == "__main__":
    main()
