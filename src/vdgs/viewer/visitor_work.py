"""What visitors have made, kept for those whose connection drops: to viser they come back as somebody new."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from vdgs.geometry.camera import Camera
from vdgs.viewer.measurement import KnownDistance, MeasuredPoint
from vdgs.viewer.navigation import CameraPose

#: What is kept, for so many seconds, of so many visits at most (choices).
KEPT_SECONDS, MAX_KEPT = 1800.0, 256


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
    """The work of visits that ended, by the browser that they came from: each browser gets its own, the newest first,
    and each work goes to one visit."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._kept: list[tuple[float, str, VisitorWork]] = []

    def put(self, browser: str | None, work: VisitorWork) -> None:
        """Keep the work of a visit; of a browser that takes no cookies nothing is kept."""
        if browser is not None:
            with self._lock:
                self._kept = [*self._kept, (self._clock(), browser, work)][-MAX_KEPT:]

    def take(self, browser: str | None) -> VisitorWork | None:
        """The work that a browser's last visit left, once; None where there is none, or it is too old."""
        with self._lock:
            oldest = self._clock() - KEPT_SECONDS
            self._kept = [each for each in self._kept if each[0] >= oldest]
            for index in reversed(range(len(self._kept))):
                if self._kept[index][1] == browser:
                    return self._kept.pop(index)[2]
        return None
