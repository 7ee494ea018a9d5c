"""What visitors have made, kept for those whose connection drops: to viser they come back as somebody new."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from vdgs.geometry.camera import Camera
from vdgs.viewer.measurement import KnownDistance, MeasuredPoint
from vdgs.viewer.navigation import CameraPose

#: What is kept, for so many seconds, of so many visits at most (choices).
KEPT_SECONDS, MAX_KEPT = 1800.0, 256
#: A visit that ends may have lost its browser so many seconds ago: websockets ask every 20 s, and wait 20 s for an
#: answer.
UNNOTICED_SECONDS = 60.0
#: Visits of one browser that end within so many seconds were lost together: their tabs come back in the same order
#: (a guess; nothing tells tabs apart).
TOGETHER_SECONDS = 5.0


@dataclass(frozen=True, eq=False)
class PathWork:
    """A camera path as it was set."""

    keyframes: tuple[Camera, ...]
    seconds: float
    closed: bool


@dataclass(frozen=True, eq=False)
class MeasureWork:
    """Clicked places, whether clicks measure, and the distances that were said to be known."""

    clicked: tuple[MeasuredPoint, ...]
    known: tuple[KnownDistance, ...]
    is_on: bool


@dataclass(frozen=True, eq=False)
class VisitorWork:
    """All that a visit leaves: where it stood (vertical `fov` in radians), its path and its measures."""

    pose: CameraPose
    fov: float
    path: PathWork
    measures: MeasureWork

    @property
    def is_empty(self) -> bool:
        """Whether nothing was made but a move."""
        return not (self.path.keyframes or self.measures.clicked or self.measures.known)


class KeptWork:
    """The work of visits that ended, by the browser that they came from: each browser gets its own, the newest first
    (of visits that were lost together the first), and each work goes to one visit."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._kept: list[tuple[float, str, VisitorWork]] = []

    def put(self, browser: str | None, work: VisitorWork) -> None:
        """Keep the work of a visit. Nothing is kept of a browser that takes no cookies, and no mere move over what the
        browser has made."""
        if browser is None:
            return
        with self._lock:
            self._forget_old()
            if not (work.is_empty and any(each[1] == browser and not each[2].is_empty for each in self._kept)):
                self._kept = [*self._kept, (self._clock(), browser, work)][-MAX_KEPT:]

    def take(self, browser: str | None) -> VisitorWork | None:
        """The work that a browser's last visit left, once; None where there is none, or it is too old."""
        with self._lock:
            self._forget_old()
            own = [index for index, each in enumerate(self._kept) if each[1] == browser]
            if not own:
                return None
            newest = self._kept[own[-1]][0]
            return self._kept.pop(next(i for i in own if newest - self._kept[i][0] <= TOGETHER_SECONDS))[2]

    def _forget_old(self) -> None:
        oldest = self._clock() - KEPT_SECONDS
        self._kept = [each for each in self._kept if each[0] >= oldest]


class Session(Protocol):
    """What has work and can go on with that of another (`ClientSession`)."""

    client: Any

    def work(self) -> VisitorWork: ...

    def restore(self, work: VisitorWork, moves: bool) -> None: ...


@dataclass(eq=False)
class _Visit:
    browser: str | None
    began: float
    #: None until it was welcomed: before, it has made nothing, and what is kept may still come to it.
    session: Session | None = None
    was_handed_work: bool = False


class Visits:
    """Who is here, by the numbers of their connections, and what those left who are not. One thing at a time: who
    leaves while work is restored to him is looked at when he has all of it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._kept, self._visits = KeptWork(clock), dict[int, _Visit]()

    def begin(self, client: int, browser: str | None) -> None:
        """Somebody has come, of a browser (`AccessControl.browser_of`)."""
        # In one step, without the lock: viser's loop of events must not wait until another's work is restored.
        self._visits[client] = _Visit(browser, self._clock())

    def welcome(self, session: Session) -> None:
        """Let a visitor whose connection was lost go on where he was, unless he is gone again."""
        with self._lock:
            visit = self._visits.get(session.client.client_id)
            if visit is None:
                return
            work = self._kept.take(visit.browser)
            if work is not None:
                try:
                    session.restore(work, moves=True)
                except BaseException:
                    self._kept.put(visit.browser, work)
                    raise
                visit.was_handed_work = not work.is_empty
            visit.session = session

    def end(self, client: int) -> None:
        """Keep what a visit left. Where the same browser has come back before its loss was noticed, and has made
        nothing yet, it is handed over at once."""
        with self._lock:
            visit = self._visits.pop(client, None)
            if visit is None or visit.session is None:
                return
            work = visit.session.work()
            try:
                next_visit = None if work.is_empty else self._next_visit(client, visit)
                if next_visit is not None and next_visit.session is not None:
                    next_visit.session.restore(work, moves=False)
                    next_visit.was_handed_work = True
                    return
            except BaseException:
                self._kept.put(visit.browser, work)
                raise
            self._kept.put(visit.browser, work)

    def _next_visit(self, client: int, visit: _Visit) -> _Visit | None:
        """Where a browser seems to have come back before the end of its visit was noticed."""
        earliest = self._clock() - UNNOTICED_SECONDS
        for number, other in sorted([*self._visits.items()], key=lambda each: each[0]):
            is_later = number > client and other.began >= earliest
            is_same = visit.browser is not None and other.browser == visit.browser
            if not (is_later and is_same) or other.session is None or other.was_handed_work:
                continue
            if other.session.work().is_empty:
                return other
        return None
