"""Check a GPU in a few minutes: whether it computes what the processor computes, and how long that takes.

    python -m experiments.microbench.gpu [--minutes 8] [--town PLACE] [--capture PLACE] [--small]

In this order: what the kernels take of the card, parity of every operation with the processor, a generated town trained
and measured on both, milliseconds and bytes of a training step by each rasterizer, and a capture of one's own if it is
named. What there is no time left for is named. Exit codes: 0 all agrees, 1 something does not, 2 there is no GPU here
that can be used.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from experiments.microbench import gpu_parity, step
from experiments.microbench.cuda_resources import resources_of
from experiments.microbench.hardware_info import describe
from vdgs.cli.main import main as vdgs
from vdgs.kernels.cuda.driver import CudaUnavailable, get_cuda_driver
from vdgs.kernels.cuda.nvrtc import CompileTarget, get_nvrtc
from vdgs.kernels.gpu import rasterizer
from vdgs.kernels.gsplat import GsplatUnavailable

#: Sources and the headers that they include.
SOURCES = {
    "adam.cu": (), "cull.cu": ("gaussian_math.h", "image_formation.h"),
    "decode.cu": ("gaussian_math.h", "image_formation.h"), "loss.cu": (), "rasterize.cu": ("image_formation.h",),
    "statistics.cu": (), "visibility.cu": (),
}  # fmt: skip
#: How many dB the town may come out better or worse than on the processor: two trainings differ by rounding.
TOWN_DB = 0.5


@dataclass(frozen=True)
class GpuDevice:
    """A device, and and the functions that the measurements need of it. Tests replace the card by another."""

    device: torch.device
    synchronize: Callable[[], None]
    reset_peak: Callable[[], None]
    peak_bytes: Callable[[], int]
    capability: tuple[int, int]


@dataclass(frozen=True)
class Sizes:
    """How much is computed."""

    parity: tuple[int, int, int]  # anchors, width, height
    #: Visible anchors, width, height of the steps that are timed.
    steps: tuple[tuple[int, int, int], ...]
    rounds: int
    #: Anchors by which the peak of memory is raised.
    memory: int
    town: tuple[str, ...]
    iterations: int


FULL = Sizes(
    (20_000, 800, 600), ((20_000, 400, 300), (20_000, 800, 600), (200_000, 1600, 1200)), 15, 200_000,
    ("--size", "village"), 1500,
)  # fmt: skip
SMALL = Sizes(
    (60, 40, 32), ((60, 40, 32),), 1, 60, ("--size", "toy", "--num-images", "6", "--width", "48", "--height", "36"), 8
)


@dataclass
class Report:
    """Errors, and sections that were skipped for want of time."""

    seconds: float
    began: float = field(default_factory=time.monotonic)
    errors: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    @contextmanager
    def section(self, title: str) -> Iterator[bool]:
        """Gives whether there is time for it; an error in one section is printed, and the next one follows."""
        if time.monotonic() - self.began > self.seconds:
            self.skipped.append(title)
            yield False
            return
        print(f"\n{title}", flush=True)
        try:
            yield True
        except Exception as error:
            traceback.print_exc()
            self.errors.append(f"{title}: {type(error).__name__}: {error}")


def find_card() -> GpuDevice | str:
    """The first card, or why none can be used."""
    try:
        driver = get_cuda_driver()
        compiler = get_nvrtc()
        cards = driver.list_gpus()
    except CudaUnavailable as error:
        return str(error)
    if not torch.cuda.is_available():
        return f"this torch ({torch.__version__}) is built without CUDA or does not fit the driver"
    for card in cards:
        major, minor = card.capability
        print(f"card         {card.name}, {card.memory_bytes / 1e9:.1f} GB, compute capability {major}.{minor}")
    print(f"NVRTC        {compiler.version[0]}.{compiler.version[1]}, from {compiler.library_info.origin}")
    return GpuDevice(
        torch.device("cuda"), torch.cuda.synchronize, torch.cuda.reset_peak_memory_stats,
        torch.cuda.max_memory_allocated, cards[0].capability,
    )  # fmt: skip


def print_resources(gpu: GpuDevice) -> None:
    target: CompileTarget = get_nvrtc().target_for(gpu.capability)
    if target.is_ptx:
        print(f"this NVRTC is older than the card: {target.name}, which the driver compiles on")
        return
    for source, headers in SOURCES.items():
        for kernel in resources_of(source, target, headers):
            print(
                f"{kernel.kernel:22} {kernel.registers:4} registers {kernel.shared_bytes:6} B shared "
                f"{kernel.spilled_bytes:4} B spilled"
            )


def print_parity(gpu: GpuDevice, sizes: Sizes, report: Report) -> None:
    for difference in gpu_parity.differences(gpu.device, *sizes.parity):
        name = f"{difference.operation}{f' by {difference.backend}' if difference.backend else ''}: {difference.result}"
        print(f"{name:56} {difference.size:9.1e} {'' if difference.agrees else 'TOO FAR'}", flush=True)
        if not difference.agrees:
            report.errors.append(f"{name} differs by {difference.size:.1e}")


def train_town(sizes: Sizes, report: Report, town: Path | None) -> None:
    with tempfile.TemporaryDirectory() as folder:
        capture = town or Path(folder) / "capture"
        if town is None:
            run_command("synth", str(capture), *sizes.town)
        # Both at the size that the town has: one chosen for each device would be another for each.
        same = ("--seed", "1", "--images", "images", "--preset", "laptop")
        results = {
            device: train_and_measure(capture, Path(folder) / device, device, sizes.iterations, *same)
            for device in ("cpu", "cuda")
        }
    for device, (psnr, seconds) in results.items():
        print(
            f"{device:6} {psnr:6.2f} dB after {sizes.iterations} iterations, {seconds:6.1f} s with all that is around"
        )
    difference = abs(results["cpu"][0] - results["cuda"][0])
    if not difference <= TOWN_DB:
        report.errors.append(f"the town differs by {difference:.2f} dB")


def train_and_measure(capture: Path, run: Path, device: str, iterations: int, *options: str) -> tuple[float, float]:
    """PSNR of the test views after a coarse stage, and its seconds."""
    begin = time.monotonic()
    run_command(
        "train-coarse", str(capture), "--output", str(run), "--iterations", str(iterations), "--device", device,
        *options,
    )  # fmt: skip
    seconds = time.monotonic() - begin
    run_command("eval", str(run), "--model", "coarse", "--device", device)
    return json.loads((run / "coarse" / "evaluation" / "metrics.json").read_text())["psnr"], seconds


def run_command(*arguments: str) -> None:
    """A verb of vdgs in this process. Raises RuntimeError where it fails."""
    try:
        vdgs(list(arguments))
    except SystemExit as ended:
        if ended.code:
            raise RuntimeError(f"vdgs {' '.join(arguments)} ended with {ended.code}") from ended


def time_steps(gpu: GpuDevice, sizes: Sizes) -> None:
    for name in rasterizers():
        os.environ[rasterizer.RASTERIZER_ENV_VAR] = name
        for visible, width, height in sizes.steps:
            state, camera, target = step.prepare(visible, width, height, device=gpu.device)
            times: dict[str, list[float]] = {phase: [] for phase in step.PHASES}
            for number in range(1, sizes.rounds + 4):
                seen, splats = step.one_step(state, camera, target, number, times, gpu.synchronize)
            medians = {phase: statistics.median(values[3:]) for phase, values in times.items()}
            parts = "  ".join(f"{phase} {value:.2f}" for phase, value in medians.items())
            print(
                f"{name:7} {width}x{height}, {seen} visible anchors, {splats} splats: {sum(medians.values()):.2f} ms "
                f"({parts})", flush=True,
            )  # fmt: skip
    os.environ.pop(rasterizer.RASTERIZER_ENV_VAR, None)


def rasterizers() -> list[str]:
    """Those that can be used."""
    try:
        rasterizer.select_rasterizer("gsplat")
    except GsplatUnavailable as error:
        print(f"without gsplat: {error}")
        return ["cuda"]
    return ["gsplat", "cuda"]


def print_memory(gpu: GpuDevice, sizes: Sizes) -> None:
    """Slopes of the peak over the number of anchors, in view and out of view, with the smallest pictures."""
    _, width, height = sizes.steps[0]

    def peak(visible: int, hidden: int) -> int:
        gpu.reset_peak()
        state, camera, target = step.prepare(visible, width, height, hidden, device=gpu.device)
        for number in range(1, 4):
            step.one_step(state, camera, target, number, {phase: [] for phase in step.PHASES}, gpu.synchronize)
        return gpu.peak_bytes()

    count = sizes.memory
    base = peak(count, 0)
    in_view, out_of_view = peak(2 * count, 0) - base, peak(count, 2 * count) - base
    print(f"{in_view / count:.0f} B for each anchor in view, {out_of_view / (2 * count):.0f} B for each out of view")


def train_capture(capture: Path, iterations: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        psnr, seconds = train_and_measure(capture, Path(folder) / "run", "cuda", iterations)
    print(f"{capture.name}: {psnr:.2f} dB after {iterations} iterations, {seconds:.1f} s, reading included")


def main(arguments: list[str] | None = None, gpu: GpuDevice | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=8.0, help="no section begins after so long (default 8)")
    parser.add_argument(
        "--town", type=Path, help="what `vdgs synth PLACE --size village` has made (default: made anew)"
    )
    parser.add_argument("--capture", type=Path, help="also train on this capture")
    parser.add_argument("--iterations", type=int, default=1500, help="of that training (default 1500)")
    parser.add_argument("--small", action="store_true", help="as little of everything as tries all of it")
    args = parser.parse_args(arguments)
    device = gpu or find_card()
    if isinstance(device, str):
        print(f"No GPU to measure: {device}", file=sys.stderr)
        return 2
    print(describe())
    sizes, report = SMALL if args.small else FULL, Report(60 * args.minutes)
    sections: dict[str, Callable[[], None]] = {
        "what the kernels take": lambda: print_resources(device),
        "parity with the processor": lambda: print_parity(device, sizes, report),
        "a generated town": lambda: train_town(sizes, report, args.town),
        "a training step": lambda: time_steps(device, sizes),
        "memory": lambda: print_memory(device, sizes),
    }
    if args.capture is not None:
        sections["a capture"] = lambda: train_capture(args.capture, args.iterations)
    for title, work in sections.items():
        with report.section(title) as has_time:
            if has_time:
                work()
    for title in report.skipped:
        print(f"no time was left for: {title}")
    for line in report.errors:
        print(line, file=sys.stderr)
    return 1 if report.errors else 0


if __name__ == "__main__":
    sys.exit(main())
