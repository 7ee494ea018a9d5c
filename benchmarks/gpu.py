"""What runs on an NVIDIA GPU, against the same on the processor: first whether it agrees, then how long it takes.

    python benchmarks/gpu.py [--rounds 20]

Prints a table of the operations that have a CUDA implementation and names those that have none. Exit codes: 0 all
agree, 1 one does not, 2 there is no GPU here that can be used.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from machine import describe
from stopwatch import medians_ms
from vdgs.kernels import native
from vdgs.kernels.cuda import photometric_loss as loss_on_card
from vdgs.kernels.cuda.driver import CudaUnavailable, cuda_driver
from vdgs.kernels.cuda.nvrtc import nvrtc
from vdgs.kernels.gsplat import rasterise as rasterise_by_gsplat
from vdgs.kernels.operations import missing_on_cuda
from vdgs.kernels.types import Splats

SIZES = [(400, 300), (800, 600), (1600, 1200)]
#: Largest difference that counts as agreement, in the norm over that of the processor's result: sums are added in
#: another order, and a pixel at a threshold may go either way.
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Row:
    """An operation at a size: relative difference, milliseconds on the card and on the processor."""

    operation: str
    size: str
    difference: float
    card_ms: float
    native_ms: float


def why_none() -> str:
    """Why no GPU can be measured here; empty if one can."""
    try:
        driver = cuda_driver()
        compiler = nvrtc()
        cards = driver.cards()
    except CudaUnavailable as error:
        return str(error)
    if not torch.cuda.is_available():
        return f"this torch ({torch.__version__}) is built without CUDA or does not fit the driver"
    for card in cards:
        major, minor = card.capability
        print(f"card         {card.name}, {card.memory_bytes / 1e9:.1f} GB, compute capability {major}.{minor}")
    print(f"NVRTC        {compiler.version[0]}.{compiler.version[1]}, from {compiler.found.origin}")
    return ""


def card_ms(run: Callable[[], object], rounds: int) -> float:
    """Median milliseconds of `run` on the card, once all that it queued is done."""
    run()
    times = []
    for _ in range(rounds):
        torch.cuda.synchronize()
        start = time.perf_counter()
        run()
        torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def compare(name: str, size: str, card: Callable[[], tuple], processor: Callable[[], tuple], rounds: int) -> Row:
    """Both results, number by number, and both times."""
    worst = 0.0
    for ours, theirs in zip(card(), processor(), strict=True):
        error = (ours.detach().cpu() - theirs.detach()).double().norm()
        worst = max(worst, float(error / (theirs.detach().double().norm() + 1e-12)))
    return Row(name, size, worst, card_ms(card, rounds), medians_ms({"native": processor}, rounds)["native"])


def loss(width: int, height: int, rounds: int) -> Row:
    g = torch.Generator().manual_seed(0)
    image = torch.rand(height, width, 3, generator=g)
    target = torch.randint(256, (height, width, 3), generator=g, dtype=torch.uint8)
    mask = (torch.rand(height, width, generator=g) < 0.9).byte()

    def step(operation: Callable, device: str) -> Callable[[], tuple]:
        leaf, goal, kept = image.to(device).requires_grad_(), target.to(device), mask.to(device)

        def run() -> tuple:
            result = operation(leaf, goal, kept)
            return (*result, *torch.autograd.grad(result.loss, leaf))

        return run

    run_card, run_native = step(loss_on_card, "cuda"), step(native.photometric_loss, "cpu")
    return compare("SSIM + L1 with gradient", f"{width}x{height}", run_card, run_native, rounds)


def raster(width: int, height: int, rounds: int, splats: int = 200_000) -> Row:
    """gsplat's rasteriser, forward: not an own kernel, a second opinion."""
    g = torch.Generator().manual_seed(0)
    spread = 0.3 + 3 * torch.rand(splats, generator=g)
    conics = torch.stack([1 / spread, torch.zeros(splats), 1 / spread], dim=1)
    here = Splats(
        torch.rand(splats, 2, generator=g) * torch.tensor([float(width), float(height)]), conics,
        1 + torch.rand(splats, generator=g), torch.rand(splats, 3, generator=g), torch.rand(splats, generator=g),
    )  # fmt: skip
    there = Splats(**{name: tensor.cuda() for name, tensor in vars(here).items()})
    return compare(
        "gsplat: rasterise", f"{width}x{height}",
        lambda: rasterise_by_gsplat(there, torch.zeros(3).cuda(), width, height)[:2],
        lambda: native.rasterise(here, torch.zeros(3), width, height)[:2],
        rounds,
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args()
    if reason := why_none():
        print(f"No GPU to measure: {reason}", file=sys.stderr)
        return 2
    print(describe())
    rows = [loss(*size, arguments.rounds) for size in SIZES]
    if importlib.util.find_spec("gsplat"):
        rows += [raster(*size, arguments.rounds) for size in SIZES]
    print(f"{'operation':26} {'size':>10} {'difference':>11} {'card ms':>9} {'native ms':>10}")
    for row in rows:
        print(f"{row.operation:26} {row.size:>10} {row.difference:11.1e} {row.card_ms:9.3f} {row.native_ms:10.2f}")
    print(f"no CUDA implementation: {', '.join(missing_on_cuda())}")
    wrong = [row for row in rows if not row.difference < TOLERANCE]
    for row in wrong:
        print(f"{row.operation} at {row.size} differs by {row.difference:.1e}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
