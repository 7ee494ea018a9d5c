"""What a person sees of shards that run side by side: a live table on a terminal, lines elsewhere."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table

from vdgs.distributed.job_labels import BLOCK_LABELS, JobLabels
from vdgs.distributed.shard_progress import ShardProgress, ShardState, seconds_left_overall
from vdgs.system.units import ABSENT, clock, data_size

#: Seconds between two summary lines where there is no terminal to redraw.
LOG_INTERVAL_SECONDS = 15.0
#: Lines of the table that are not rows of shards: head, rules, totals, and one to spare for the prompt.
TABLE_FRAME_LINES = 7
#: Columns that only training has.
TRAINING_COLUMNS = ("PSNR", "anchors")
#: The styles of states, in the order in which states are counted, and the order in which rows are shown if not all fit.
STATE_STYLES: dict[ShardState, str] = {
    "queued": "dim",
    "running": "cyan",
    "done": "green",
    "failed": "red",
    "stopped": "yellow",
}
URGENCY: tuple[ShardState, ...] = ("running", "failed", "stopped", "queued", "done")


class ProgressTable:
    """Shows rows until it is closed. Everything printed meanwhile goes through it, above the table."""

    def __init__(self, console: Console, rows: list[ShardProgress], at_once: int, labels: JobLabels = BLOCK_LABELS):
        self._console, self._rows, self._at_once, self._labels = console, rows, at_once, labels
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._last_line = time.monotonic()

    def __enter__(self) -> ProgressTable:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self.show()
            self._live.stop()

    def print_line(self, text: str, style: str = "") -> None:
        """Print a line that stays."""
        self._console.print(text, style=style, highlight=False, markup=False)

    def note(self, text: str) -> None:
        """Print what the live table shows anyway: only where there is none."""
        if self._live is None:
            self.print_line(text)

    def show(self) -> None:
        """Redraw the table, or print the summary line if it is time."""
        if self._live is not None:
            room = self._console.height - TABLE_FRAME_LINES
            self._live.update(build_progress_table(self._rows, self._at_once, room, self._labels), refresh=True)
            return
        is_open = any(row.state in ("queued", "running") for row in self._rows)
        if is_open and time.monotonic() - self._last_line >= LOG_INTERVAL_SECONDS:
            self._last_line = time.monotonic()
            self.print_line(progress_line(self._rows, self._at_once, self._labels))


def build_progress_table(
    rows: list[ShardProgress], at_once: int, max_rows: int, labels: JobLabels = BLOCK_LABELS
) -> Table:
    """One row for each shard and one with totals; of more than `max_rows`, those that wait or are done are counted."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0), caption_justify="left")  # 80 columns
    unit, rate = labels.step_unit, labels.rate_unit
    columns = (labels.singular, "state", unit, *TRAINING_COLUMNS, rate, "left", "memory", "tries")
    chosen = [
        index for index, column in enumerate(columns) if labels.shows_training_stats or column not in TRAINING_COLUMNS
    ]
    for index in chosen:
        table.add_column(columns[index], justify="left" if columns[index] == "state" else "right", no_wrap=True)
    shown = sorted(rows, key=lambda row: URGENCY.index(row.state))[: max(max_rows, 1)]
    for row in rows:
        if row in shown:
            cells = _cells(row)
            table.add_row(*(cells[index] for index in chosen), style=STATE_STYLES[row.state])
    if len(shown) < len(rows):
        table.caption = f"and {_states([row for row in rows if row not in shown])}"
    table.add_section()
    totals = _totals(rows, at_once)
    table.add_row(*(totals[index] for index in chosen), style="bold")
    return table


def progress_line(rows: list[ShardProgress], at_once: int, labels: JobLabels = BLOCK_LABELS) -> str:
    """The table in one line: counts, the shards that run, the time left."""
    parts = [f"{labels.plural}: {_states(rows)}"]
    for row in rows:
        if row.state == "running":
            psnr = f" {row.stats.psnr:.2f} dB" if row.stats.psnr is not None else ""
            parts.append(f"{row.index:02d}: {_iteration(row)}{psnr}")
    left = seconds_left_overall(rows, at_once)
    return " · ".join(parts if left is None else [*parts, f"about {clock(left)} left"])


def _states(rows: Sequence[ShardProgress]) -> str:
    count = Counter(row.state for row in rows)
    return ", ".join(f"{count[state]} {state}" for state in STATE_STYLES if count[state])


def _iteration(row: ShardProgress) -> str:
    stats = row.stats
    if stats.iteration is None:
        return "starting" if row.state == "running" else ABSENT
    return f"{stats.iteration:,}" + (f"/{stats.iterations:,}" if stats.iterations is not None else "")


def _cells(row: ShardProgress) -> list[str]:
    stats, running = row.stats, row.state == "running"
    return [
        f"{row.index:02d}",
        row.state,
        _iteration(row),
        _number_text(stats.psnr, "{:.2f}"),
        _number_text(stats.anchors, "{:,}"),
        _number_text(row.speed if running else None, "{:.1f}"),
        _clock_text(row.seconds_left if running else None),
        data_size(stats.memory_bytes, decimals=1),
        str(row.attempts) if row.attempts else ABSENT,
    ]


def _totals(rows: list[ShardProgress], at_once: int) -> list[str]:
    running = [row for row in rows if row.state == "running"]
    done = sum(row.state == "done" for row in rows)
    speeds = [row.speed for row in running if row.speed is not None]
    memory = [row.stats.memory_bytes for row in running if row.stats.memory_bytes is not None]
    anchors = [row.stats.anchors for row in rows if row.stats.anchors is not None]
    return [
        "all",
        f"{done}/{len(rows)} done",
        f"{100 * sum(map(_done_share, rows)) / len(rows):.0f} %" if rows else ABSENT,
        "",
        _number_text(sum(anchors) if anchors else None, "{:,}"),
        _number_text(sum(speeds) if speeds else None, "{:.1f}"),
        _clock_text(seconds_left_overall(rows, at_once)),
        data_size(sum(memory) if memory else None, decimals=1),
        "",
    ]


def _done_share(row: ShardProgress) -> float:
    """Share of its work that is done; 0 where it does not say."""
    iteration, iterations = row.stats.iteration, row.stats.iterations
    return 1.0 if row.state == "done" else min((iteration or 0) / iterations, 1.0) if iterations else 0.0


def _number_text(value: float | None, form: str) -> str:
    return ABSENT if value is None else form.format(value)


def _clock_text(seconds: float | None) -> str:
    return ABSENT if seconds is None else clock(seconds)
