"""News of tasks that run side by side, one line each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from vdgs.distributed.executor import Listener, Task

#: Prints a line in a style of rich; the text is no markup.
Say = Callable[[str, str], None]


class Lines(Listener):
    """Says what a person must know in any case: who waits, who crashed, who was asked to stop."""

    def __init__(self, say: Say):
        self.say = say

    def waits(self, task: Task) -> None:
        self.say(f"{task.name}: waiting for another process that works on it", "yellow")

    def paused(self, task: Task, why: str) -> None:
        self.say(f"{task.name}: saved and waits for another turn" + (f" ({why})" if why else ""), "yellow")

    def crashed(self, task: Task, how: str, attempts_left: int) -> None:
        text = f"{task.name}: crashed by {how}; continues from its last checkpoint, attempts left: {attempts_left}"
        self.say(text, "yellow")

    def stopping(self, tasks: Sequence[Task]) -> None:
        names = ", ".join(task.name for task in tasks)
        self.say(f"stopping: {names} will save and end (Ctrl-C again kills)", "yellow")
