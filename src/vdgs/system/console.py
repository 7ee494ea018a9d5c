"""What long work shows on a console: bars with the time left, and notes that are printed once."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TaskProgressColumn,
    TextColumn,
)
from rich.text import Text

from vdgs.system.stop_signals import check_stop_requested
from vdgs.system.units import clock

Item = TypeVar("Item")
#: Between two lines of work whose console is no terminal.
LINE_INTERVAL_SECONDS = 15.0

#: Brackets that rich would take for styles, but for those that lines of ours have.
_NOT_OURS = re.compile(
    r"(?<!\\)\[(?!/?(yellow|red|green|cyan|magenta|blue|bold|dim)( \w+)?\]|/\])(?=[a-z#/@])", re.IGNORECASE
)
#: What each console has printed already.
_PRINTED = WeakKeyDictionary[Console, set[str]]()


class TimeLeftColumn(ProgressColumn):
    """`0:01:11 left`; nothing before a pace is known and once all is done."""

    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        left = None if task.finished or task.total is None else task.time_remaining
        return Text("" if left is None else f"{clock(left)} left", style="progress.remaining")


class _LineProgress(Progress):
    """Prints a line now and then instead of a bar: what a log can hold."""

    def __init__(self, console: Console) -> None:
        super().__init__(console=console, disable=True)
        self._last_line = self.get_time()

    def update(self, task_id: TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        self._print_line(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._print_line(task_id)

    def _print_line(self, task_id: TaskID) -> None:
        now = self.get_time()
        if now - self._last_line < LINE_INTERVAL_SECONDS:
            return
        self._last_line, task = now, self._tasks[task_id]
        share = "" if task.total is None else f"  {task.percentage:.0f}%"
        left = TimeLeftColumn().render(task).plain
        self.console.print(f"{task.description}{share}  {left}".rstrip(), highlight=False, markup=False)


def make_progress_bar(console: Console, counts: bool = False, transient: bool = True) -> Progress:
    """A bar of the progress of work, to be used as a context; where the console is no terminal, a line every
    `LINE_INTERVAL_SECONDS`. With `counts` the bar says how many items are done, else what share."""
    if not console.is_terminal:
        return _LineProgress(console)
    done = MofNCompleteColumn() if counts else TaskProgressColumn()
    columns = (TextColumn("{task.description}"), BarColumn(), done, TimeLeftColumn())
    return Progress(*columns, console=console, transient=transient)


def track(items: Iterable[Item], description: str, total: int, console: Console) -> Iterator[Item]:
    """The items, with a bar for them."""
    with make_progress_bar(console, transient=False) as bar:
        yield from bar.track(items, total, description=description)


@contextmanager
def show_share(console: Console, description: str) -> Iterator[Callable[[int, int], None]]:
    """A bar while the context lasts; yields a function that takes how many are done and how many there are, and raises
    Interrupted where a person asked to stop."""
    with make_progress_bar(console) as bar:
        task = bar.add_task(description, total=None)

        def on_progress(done: int, total: int) -> None:
            check_stop_requested()
            bar.update(task, completed=done, total=total)

        yield on_progress


def escape_names(text: str) -> str:
    """The text of a line with styles, in which brackets that are none of ours are names: `run[2][new]`."""
    return _NOT_OURS.sub(r"\\\g<0>", text)


def print_warning(console: Console, warning: str) -> None:
    """Print a warning; nothing where it is empty."""
    if warning:
        console.print(f"[yellow]warning[/] {warning}", highlight=False)


def print_once(console: Console, text: str, style: str) -> None:
    """Print a line, unless this console has it already."""
    printed = _PRINTED.setdefault(console, set())
    if text not in printed:
        printed.add(text)
        console.print(Text(text, style=style))
