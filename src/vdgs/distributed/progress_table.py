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
#: Columns of what trains.
TRAINING_COLUMNS = ("PSNR", "anchors")
STATE_STYLES: dict[ShardState, str] = {
    "queued": "dim",
    "running": "cyan",
    "done": "green",
    "failed": "red",
    "stopped": "yellow",
}


class ProgressTable:
    """Shows rows until it is closed. Everything printed meanwhile goes through it, above the table."""

    def __init__(self, console: Console, rows: list[ShardProgress], at_once: int, labels: JobLabels = BLOCK_LABELS):
        self._console, self._rows, self._at_once, self._kind = console, rows, at_once, labels
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
        """A line that stays."""
        self._console.print(text, style=style, highlight=False, markup=False)

    def note(self, text: str) -> None:
        """A line about what the live table shows anyway: only where there is none."""
        if self._live is None:
            self.print_line(text)

    def show(self) -> None:
        """Redraw the table, or print the summary line if it is time."""
        if self._live is not None:
            table = build_progress_table(
                self._rows, self._at_once, self._console.height - TABLE_FRAME_LINES, self._kind
            )
            self._live.update(table, refresh=True)
        elif self._open and time.monotonic() - self._last_line >= LOG_INTERVAL_SECONDS:
            self._last_line = time.monotonic()
            self.print_line(progress_line(self._rows, self._at_once, self._kind))

    @property
    def _open(self) -> bool:
        return any(row.state in ("queued", "running") for row in self._rows)


def build_progress_table(
    rows: list[ShardProgress], at_once: int, max_rows: int, labels: JobLabels = BLOCK_LABELS
) -> Table:
    """One row for each shard and one with totals; of more than `most`, those that wait or are done are counted."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0), caption_justify="left")  # 80 columns
    columns = (
        labels.singular,
        "state",
        labels.step_unit,
        *TRAINING_COLUMNS,
        labels.rate_unit,
        "left",
        "memory",
        "tries",
    )
    chosen = [
        place for place, column in enumerate(columns) if labels.shows_training_stats or column not in TRAINING_COLUMNS
    ]
    for column in (columns[place] for place in chosen):
        table.add_column(column, justify="left" if column == "state" else "right", no_wrap=True)
    shown = _visible_rows(rows, max(max_rows, 1))
    for row in shown:
        cells = _cells(row)
        table.add_row(*(cells[place] for place in chosen), style=STATE_STYLES[row.state])
    if len(shown) < len(rows):
        hidden = [row for row in rows if row not in shown]
        table.caption = f"and {_states(hidden)}"
    table.add_section()
    totals = _totals(rows, at_once)
    table.add_row(*(totals[place] for place in chosen), style="bold")
    return table


def progress_line(rows: list[ShardProgress], at_once: int, labels: JobLabels = BLOCK_LABELS) -> str:
    """The table in one line: counts, the shards that run, the time left."""
    running = [
        f"{row.index:02d}: {_iteration(row)}" + (f" {row.stats.psnr:.2f} dB" if row.stats.psnr is not None else "")
        for row in rows
        if row.state == "running"
    ]
    left = seconds_left_overall(rows, at_once)
    parts = [f"{labels.plural}: {_states(rows)}", *running] + (
        [f"about {clock(left)} left"] if left is not None else []
    )
    return " · ".join(parts)


def _visible_rows(rows: list[ShardProgress], max_rows: int) -> list[ShardProgress]:
    if len(rows) <= max_rows:
        return rows
    urgency = {"running": 0, "failed": 1, "stopped": 2, "queued": 3, "done": 4}
    urgent = sorted(rows, key=lambda row: urgency[row.state])[:max_rows]
    return [row for row in rows if row in urgent]


def _states(rows: Sequence[ShardProgress]) -> str:
    count = Counter(row.state for row in rows)
    return ", ".join(f"{count[state]} {state}" for state in STATE_STYLES if count[state])


def _iteration(row: ShardProgress) -> str:
    figures = row.stats
    if figures.iteration is None:
        return "starting" if row.state == "running" else ABSENT
    return f"{figures.iteration:,}" + (f"/{figures.iterations:,}" if figures.iterations is not None else "")


def _cells(row: ShardProgress) -> list[str]:
    figures, running = row.stats, row.state == "running"
    return [
        f"{row.index:02d}",
        row.state,
        _iteration(row),
        _shown(figures.psnr, "{:.2f}"),
        _shown(figures.anchors, "{:,}"),
        _shown(row.speed if running else None, "{:.1f}"),
        _shown(row.seconds_left if running else None),
        data_size(figures.memory_bytes, decimals=1),
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
        _percent(rows),
        "",
        _shown(sum(anchors) if anchors else None, "{:,}"),
        _shown(sum(speeds) if speeds else None, "{:.1f}"),
        _shown(seconds_left_overall(rows, at_once)),
        data_size(sum(memory) if memory else None, decimals=1),
        "",
    ]


def _percent(rows: list[ShardProgress]) -> str:
    """Share of the work done, a shard that says nothing counting as one that has not begun."""
    shares = []
    for row in rows:
        iteration, iterations = row.stats.iteration, row.stats.iterations
        share = min((iteration or 0) / iterations, 1.0) if iterations else 0.0
        shares.append(1.0 if row.state == "done" else share)
    return f"{100 * sum(shares) / len(shares):.0f} %" if shares else ABSENT


def _shown(value: float | None, form: str | None = None) -> str:
    if value is None:
        return ABSENT
    return form.format(value) if form else clock(value)
