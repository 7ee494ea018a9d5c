"""How long work takes on an idle machine, found on a busy one by processor time instead of the clock."""

from __future__ import annotations

import time
from dataclasses import dataclass

from vdgs.system.units import rough_duration


@dataclass(frozen=True)
class Cost:
    """Seconds by the clock on idle processors, and of all processors together."""

    seconds: float
    processor_seconds: float

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.seconds + other.seconds, self.processor_seconds + other.processor_seconds)

    def __mul__(self, factor: float) -> Cost:
        return Cost(self.seconds * factor, self.processor_seconds * factor)


NO_COST = Cost(0.0, 0.0)
#: A machine that makes work take so many times as long is busy.
BUSY = 1.5


def describe_cost(cost: Cost, threads: int, slowdown: float) -> str:
    """about 5 min on 2 idle threads (9 min of processor time); 20 min if the machine stays as busy as it is now."""
    plural = "" if threads == 1 else "s"
    idle = f"about {rough_duration(cost.seconds)} on {threads} idle thread{plural}"
    busy = f"; about {rough_duration(cost.seconds * slowdown)} if the machine stays as busy as it is now"
    return f"{idle} ({rough_duration(cost.processor_seconds)} of processor time){busy if slowdown > BUSY else ''}"


@dataclass(frozen=True)
class Moment:
    """The clocks at one moment."""

    clock: float
    thread: float
    process: float

    @staticmethod
    def now() -> Moment:
        return Moment(time.monotonic(), time.thread_time(), time.process_time())

    def cost_since(self, before: Moment, threads: float = 0) -> Cost:
        """What was done between two moments. By the clock it takes as long as the calling thread computed, which waits
        for no processor on an idle machine; or, where `threads` share the work, as long as they take together."""
        processor = self.process - before.process
        return Cost(processor / threads if threads else self.thread - before.thread, processor)

    def slowdown_since(self, before: Moment, threads: float = 0) -> float:
        """How many times as long it took as it would on an idle machine."""
        idle = self.cost_since(before, threads).seconds
        return max(1.0, (self.clock - before.clock) / idle) if idle > 0 else 1.0
