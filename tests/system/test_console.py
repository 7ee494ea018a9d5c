"""Bars say what is left before the word, and notes are printed once."""

from __future__ import annotations

import io

from rich.console import Console

from vdgs.system.console import make_progress_bar, print_once, track


def test_the_time_left_stands_before_the_word() -> None:
    moments = iter(range(0, 1000, 2))
    with make_progress_bar(console := Console(file=io.StringIO(), force_terminal=True, width=100)) as bar:
        bar.get_time = lambda: float(next(moments))
        task = bar.add_task("drawing", total=100)
        assert "left" not in "".join(str(cell) for cell in bar.make_tasks_table(bar.tasks).columns[-1].cells)
        for _ in range(20):
            bar.advance(task)
        shown = str(next(iter(bar.make_tasks_table(bar.tasks).columns[-1].cells)))
    assert shown.endswith(" left")
    assert shown.removesuffix(" left").count(":") == 2
    assert console.is_terminal


def test_all_items_come_with_or_without_a_terminal() -> None:
    for terminal in (True, False):
        console = Console(file=io.StringIO(), force_terminal=terminal)
        assert list(track(range(5), "drawing", 5, console)) == list(range(5))


def test_a_log_gets_a_line_of_progress_every_quarter_of_a_minute() -> None:
    seconds = 0.0
    console = Console(file=io.StringIO(), width=100)
    with make_progress_bar(console) as bar:
        bar.get_time = lambda: seconds
        bar._last_line = seconds
        task = bar.add_task("fitting [colors]", total=40)
        for _ in range(20):
            seconds += 5.0
            bar.advance(task)
    lines = console.file.getvalue().splitlines()
    shares = [line.removeprefix("fitting [colors]  ").split("%")[0] for line in lines]
    assert shares == ["8", "15", "22", "30", "38", "45"]  # of 3, 6, ... of 40
    assert lines[-1].endswith(" left")


def test_a_note_is_printed_once_on_each_console() -> None:
    for _ in range(2):
        console = Console(file=io.StringIO())
        for _ in range(3):
            print_once(console, "LPIPS is null [for want of weights]", "yellow")
        assert console.file.getvalue() == "LPIPS is null [for want of weights]\n"
