"""What is kept of visits: for the same browser, once, and not for ever; and to whom it goes, whenever they drop."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from support.gaussians import overhead
from vdgs.viewer.navigation import CameraPose
from vdgs.viewer.visitor_work import (
    KEPT_SECONDS,
    MAX_KEPT,
    TOGETHER_SECONDS,
    UNNOTICED_SECONDS,
    KeptWork,
    MeasureWork,
    PathWork,
    VisitorWork,
    Visits,
)


def some_work(keyframes: int = 1) -> VisitorWork:
    pose = CameraPose(np.zeros(3), np.ones(3))
    return VisitorWork(pose, 1.0, PathWork((overhead(),) * keyframes, 5.0, False), MeasureWork((), (), False))


class Visitor:
    """What `Visits` sees of a visitor."""

    def __init__(self, client: int, keyframes: int = 0) -> None:
        self.client, self.has = SimpleNamespace(client_id=client), some_work(keyframes)
        self.restored: list[tuple[VisitorWork, bool]] = []

    def work(self) -> VisitorWork:
        return self.has

    def restore(self, work: VisitorWork, moves: bool) -> None:
        self.has = work
        self.restored.append((work, moves))


class Clock:
    """A time of day that a test sets, and who comes at it."""

    def __init__(self) -> None:
        self.now, self.clients = 0.0, iter(range(100))
        self.visits = Visits(clock=lambda: self.now)

    def come(self, keyframes: int = 0, browser: str | None = "a") -> Visitor:
        visitor = Visitor(next(self.clients), keyframes)
        self.visits.begin(visitor.client.client_id, browser)
        self.visits.welcome(visitor)
        return visitor

    def end(self, visitor: Visitor) -> None:
        self.visits.end(visitor.client.client_id)


def test_work_goes_to_the_browser_that_made_it_once_and_the_newest_first():
    first, second, other, now = some_work(), some_work(), some_work(), [0.0]
    kept = KeptWork(clock=lambda: now[0])
    for browser, work in (("a", first), ("b", other), ("a", second), (None, some_work())):
        kept.put(browser, work)
        now[0] += TOGETHER_SECONDS
    assert kept.take(None) is None
    assert kept.take("c") is None
    assert [kept.take("a") for _ in range(3)] == [second, first, None]
    assert kept.take("b") is other


def test_old_work_and_that_of_too_many_is_forgotten():
    now = [0.0]
    kept = KeptWork(clock=lambda: now[0])
    kept.put("a", some_work())
    now[0] = KEPT_SECONDS + 1
    kept.put("b", some_work())
    assert kept.take("a") is None
    for number in range(MAX_KEPT):
        kept.put(str(number), some_work())
    assert kept.take("b") is None
    assert kept.take("0") is not None


def test_a_mere_move_never_hides_what_was_made():
    kept, made, moved = KeptWork(), some_work(), some_work(keyframes=0)
    kept.put("a", made)
    kept.put("a", moved)
    kept.put("b", moved)
    assert [kept.take("a"), kept.take("a")] == [made, None]
    assert kept.take("b") is moved


def test_who_drops_before_he_was_welcomed_leaves_what_was_kept():
    """What was made, and where a visit stood that made nothing."""
    for keyframes in (3, 0):
        here = Clock()
        first = here.come(keyframes)
        here.end(first)
        hasty = Visitor(next(here.clients))
        here.visits.begin(hasty.client.client_id, "a")
        here.end(hasty)
        here.visits.welcome(hasty)
        assert not hasty.restored
        assert here.come().restored == [(first.has, True)]


def test_who_drops_while_work_is_restored_leaves_all_of_it():
    here = Clock()
    first = here.come(3)
    here.end(first)
    second = Visitor(next(here.clients))
    leaving = threading.Thread(target=here.end, args=(second,))

    def restore(work: VisitorWork, moves: bool) -> None:
        leaving.start()
        leaving.join(timeout=0.1)  # it must wait
        second.has = work

    second.restore = restore
    here.visits.begin(second.client.client_id, "a")
    here.visits.welcome(second)
    leaving.join()
    assert here.come().restored == [(first.has, True)]


def test_work_that_could_not_be_restored_is_kept():
    here = Clock()
    first = here.come(3)
    here.end(first)
    second = Visitor(next(here.clients))

    def restore(work: VisitorWork, moves: bool) -> None:
        second.has = some_work(1)  # not whole
        raise RuntimeError("the client is gone")

    second.restore = restore
    here.visits.begin(second.client.client_id, "a")
    with pytest.raises(RuntimeError):
        here.visits.welcome(second)
    here.end(second)
    assert here.come().restored == [(first.has, True)]


def test_only_who_has_just_come_and_has_nothing_is_handed_what_another_connection_left():
    here = Clock()
    old, tab = here.come(3), here.come()
    stranger, nameless = here.come(browser="b"), here.come(browser=None)
    here.now += UNNOTICED_SECONDS + 1
    busy, back, late = here.come(1), here.come(), here.come()
    here.end(old)
    assert back.restored == [(old.has, False)]
    back.has = some_work(keyframes=0)  # thrown away again
    here.end(busy)
    assert late.restored == [(busy.has, False)]
    for other in (tab, stranger, nameless):
        assert not other.restored
    here.end(late)
    assert len(back.restored) == 1
    assert here.come().restored == [(late.has, True)]


def test_tabs_that_were_lost_together_come_back_in_order():
    here = Clock()
    tabs = [here.come(1), here.come(2)]
    for tab in tabs:
        here.end(tab)
    assert [here.come().restored for _ in tabs] == [[(tab.has, True)] for tab in tabs]
