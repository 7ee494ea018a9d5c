"""How long the steps of a real training take, by what they draw, and what a card does in them.

    python -m experiments.microbench.gpu_training [--profiled 4] [--kernels 12] -- train-coarse CAPTURE --output RUN ...

The arguments after `--` are a command of vdgs that trains in this process. For each kind of step at the full size of
the photographs (plain, with depths compared, with a pseudo view as well) it prints the median of the clock's
milliseconds; a step ends by reading numbers from the card. Of some of the last steps of each kind torch's profiler
tells how long the card worked and how many kernels and copies that were; these steps are not in the medians.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections import Counter, defaultdict
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from vdgs.cli.main import main as vdgs
from vdgs.training import training_loop
from vdgs.training.depth_agreement import is_agreement_due
from vdgs.training.pseudo_views import is_pseudo_view_due
from vdgs.training.schedule import downscale_at
from vdgs.training.training_state import StepReport, TrainingProblem, TrainingState

#: Share of the iterations after which steps are counted: growth is over, and pictures have their full size.
COUNTED_FROM, PROFILED_FROM = 0.7, 0.9


class StepTimes:
    """Times of steps by kind, and what the card did in some of them."""

    def __init__(self, profiled: int):
        self.profiled = profiled if torch.cuda.is_available() else 0
        self.milliseconds: dict[str, list[float]] = defaultdict(list)
        self.all_milliseconds = 0.0
        self.card: dict[str, list[list[Any]]] = defaultdict(list)
        self._step = training_loop.train_step

    def __call__(self, state: TrainingState, stage: TrainingProblem) -> StepReport:
        """`train_step`, timed. A training that begins forgets those before it, which only estimated its time."""
        if state.iteration == 0:
            self.milliseconds.clear()
            self.card.clear()
            self.all_milliseconds = 0.0
        kind, part = kind_of(stage, state.iteration), state.iteration / stage.config.iterations
        if part >= PROFILED_FROM and kind and len(self.card[kind]) < self.profiled:
            with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as seen:
                report = self._step(state, stage)
            self.card[kind].append([event for event in seen.events() if is_of_card(event)])
            return report
        begin = time.perf_counter()
        report = self._step(state, stage)
        passed = 1e3 * (time.perf_counter() - begin)
        self.all_milliseconds += passed
        if part >= COUNTED_FROM and kind:
            self.milliseconds[kind].append(passed)
        return report

    def print(self, kernels: int) -> None:
        """A line for each kind, and the kernels that take most."""
        print(f"steps: {self.all_milliseconds / 1e3:.1f} s in all")
        for kind, values in sorted(self.milliseconds.items()):
            print(f"{kind:28} {statistics.median(values):7.2f} ms, median of {len(values)}")
            if steps := self.card[kind]:
                self._print_card(steps, kernels)

    def _print_card(self, steps: list[list[Any]], kernels: int) -> None:
        each = [sum(event.time_range.elapsed_us() for event in events) / 1e3 for events in steps]
        number = statistics.median(len(events) for events in steps)
        print(f"{'':28} {statistics.median(each):7.2f} ms the card works, {number:.0f} kernels and copies")
        times: Counter[str] = Counter()
        counts: Counter[str] = Counter()
        for events in steps:
            for event in events:
                times[event.name[:80]] += event.time_range.elapsed_us()
                counts[event.name[:80]] += 1
        for name, microseconds in times.most_common(kernels):
            print(f"{'':28} {microseconds / 1e3 / len(steps):7.3f} ms {counts[name] / len(steps):5.1f} x {name}")


def kind_of(stage: TrainingProblem, iteration: int) -> str:
    """What a step at full size draws; empty for the others."""
    if downscale_at(iteration, stage.config) != 1:
        return ""
    if is_pseudo_view_due(stage.config, iteration):
        return "with depths and pseudo view"
    return "with depths" if is_agreement_due(stage.config, iteration) else "plain"


def is_of_card(event: Any) -> bool:
    """Whether an event of the profiler is a kernel or a copy."""
    return event.device_type == torch.autograd.DeviceType.CUDA


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profiled", type=int, default=4, help="steps of each kind that are profiled")
    parser.add_argument("--kernels", type=int, default=12, help="kernels that are printed for each kind")
    parser.add_argument("command", nargs="+", help="of vdgs")
    args = parser.parse_args(arguments)
    times = StepTimes(args.profiled)
    training_loop.train_step, own = times, training_loop.train_step  # type: ignore[assignment]
    try:
        vdgs(args.command)
    except SystemExit as ended:
        if ended.code:
            return int(ended.code)
    finally:
        training_loop.train_step = own
    times.print(args.kernels)
    return 0


if __name__ == "__main__":
    sys.exit(main())
