"""What is kept of visits: for the same browser, once, and not for ever."""

from __future__ import annotations

import numpy as np

from vdgs.viewer.navigation import CameraPose
from vdgs.viewer.visitor_work import KEPT_SECONDS, MAX_KEPT, KeptWork, MeasureWork, PathWork, VisitorWork


def some_work() -> VisitorWork:
    pose = CameraPose(np.zeros(3), np.ones(3))
    return VisitorWork(pose, 1.0, PathWork((), 5.0, False), MeasureWork((), (), False))


def test_work_goes_to_the_browser_that_made_it_once_and_the_newest_first():
    kept, first, second, other = KeptWork(), some_work(), some_work(), some_work()
    for browser, work in (("a", first), ("b", other), ("a", second), (None, some_work())):
        kept.put(browser, work)
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
