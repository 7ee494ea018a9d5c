"""How far shards are: what their status files say, how fast they are and how long they will take."""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

ShardState = Literal["queued", "running", "done", "failed", "stopped"]
#: Readings of a status file between which the speed is measured.
SPEED_WINDOW = 20
#: No figure is larger, in whatever unit: beyond it the file is damaged.
MAX_VALUE = 1e12


@dataclass(frozen=True, kw_only=True)
class ProgressStats:
    """The figures of a status file; None where one is missing or damaged."""

    iteration: int | None = None
    iterations: int | None = None
    psnr: float | None = None
    anchors: int | None = None
    seconds_left: float | None = None
    memory_bytes: int | None = None


def read_progress_stats(status_file: Path) -> ProgressStats | None:
    """The figures in a status file; None if it is missing or damaged.

    Never raises, unlike `StageFolder.status`: a table is not worth a run.
    """
    try:
        status = json.loads(status_file.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(status, dict):
        return None
    return ProgressStats(
        iteration=_count(status.get("iteration")),
        iterations=_count(status.get("iterations")),
        psnr=_number(status.get("psnr_training")),
        anchors=_count(status.get("anchors")),
        seconds_left=_number(status.get("seconds_left")),
        memory_bytes=_count(status.get("peak_memory_bytes")),
    )


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if 0 <= value <= MAX_VALUE else None


def _count(value: Any) -> int | None:
    number = _number(value)
    return None if number is None else int(number)


class ShardProgress:
    """How far a shard is while the others run."""

    def __init__(self, index: int):
        self.index = index
        self.state: ShardState = "queued"
        self.attempts = 0
        self.stats = ProgressStats()
        self._readings: deque[tuple[float, int]] = deque(maxlen=SPEED_WINDOW)

    def observe(self, stats: ProgressStats | None, now: float) -> None:
        """Take what was read at `now` (seconds of any steady clock); what could not be read changes nothing."""
        if stats is None:
            return
        self.stats = stats
        if stats.iteration is None or self.state != "running":
            return
        if self._readings and stats.iteration < self._readings[-1][1]:
            self._readings.clear()  # a new attempt continues from an earlier state
        if not self._readings or stats.iteration > self._readings[-1][1]:
            self._readings.append((now, stats.iteration))

    def restart(self) -> None:
        """A new attempt begins, with a speed of its own."""
        self.state, self.attempts = "running", self.attempts + 1
        self._readings.clear()

    @property
    def speed(self) -> float | None:
        """Iterations a second over the last readings; None before there are two."""
        if len(self._readings) < 2:
            return None
        (began, first), (ended, last) = self._readings[0], self._readings[-1]
        return (last - first) / (ended - began) if ended > began else None

    @property
    def seconds_left(self) -> float | None:
        """What the shard says itself, else what follows from its speed; None where neither is known."""
        stats, speed = self.stats, self.speed
        if stats.seconds_left is not None:
            return stats.seconds_left
        if stats.iteration is None or stats.iterations is None or not speed:
            return None
        return max(stats.iterations - stats.iteration, 0) / speed


def seconds_left_overall(rows: list[ShardProgress], at_once: int) -> float | None:
    """Estimated time until all shards are done; None before anything is known (complexity: one pass).

    Those that wait are taken to be as fast as those that ran, and as long where they do not say it.
    """
    speeds = [row.speed for row in rows if row.speed]
    lengths = [row.stats.iterations for row in rows if row.stats.iterations]
    speed = sum(speeds) / len(speeds) if speeds else None
    length = sum(lengths) / len(lengths) if lengths else None
    left = []
    for row in rows:
        if row.state not in ("queued", "running"):
            continue
        seconds = row.seconds_left if row.state == "running" else None
        if seconds is None:
            iterations = row.stats.iterations or length
            if speed is None or iterations is None:
                return None
            seconds = max(iterations - (row.stats.iteration or 0), 0) / speed
        left.append(seconds)
    return max(*left, sum(left) / at_once) if left else 0.0
