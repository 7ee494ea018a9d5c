"""Which frames of a film become photographs: by how far the picture moved, of those around each step the sharpest."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8

#: How far the picture moves between two frames that are taken, as a share of its width (choice: neighbors overlap by
#: seven eighths).
STEP = 0.125
#: Width in pixels of the pictures in which motion is followed, and of those whose sharpness is measured.
MOTION_WIDTH, SHARPNESS_WIDTH = 320, 1280
#: Motion that is less than this is that of a drone that hovers: it counts only once it adds up to this.
HOVER = 0.03
#: Corners that are followed, and fewer than these say nothing.
MAX_CORNERS, MIN_CORNERS = 150, 12
#: Where at once fewer than this share can be followed the film was cut, or moves too fast (noise looks alike anywhere).
CUT_SHARE = 0.4
#: A corner is followed truly where following it back leads to where it was (pixels).
SAME_CORNER_PX = 1.0
#: New corners are sought where fewer of them than this share are left.
KEPT_CORNERS = 0.5
#: A film in which nothing can be followed moves by one step in this time (seconds).
BLIND_SECONDS = 1.0
#: What the sharpness of a frame half a step beside the mark counts.
EDGE_WEIGHT = 0.2

Frame = TypeVar("Frame")


def sharpness(gray: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian: comparable between pictures that show about the same."""
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


class MotionTracker:
    """How far the picture has moved since the first frame, in widths, along its way: the median of followed corners."""

    def __init__(self) -> None:
        self._before: np.ndarray | None = None
        self._seconds = 0.0
        self._start: np.ndarray = np.zeros((0, 1, 2), np.float32)
        self._now: np.ndarray = self._start
        self._base = self._way = 0.0
        self._found = 0

    def travel(self, gray: UInt8[np.ndarray, "h w"], seconds: float) -> float:
        """Take the next frame, `MOTION_WIDTH` wide, and the moment of it."""
        before, self._before = self._before, gray
        passed, self._seconds = seconds - self._seconds, seconds
        if before is None:
            self._seek(gray)
            return 0.0
        if self._found < MIN_CORNERS:  # water, fog, a wall
            self._base += STEP * min(1.0, max(0.0, passed) / BLIND_SECONDS)
            self._seek(gray)
        else:
            self._follow(before, gray)
        self._way = max(self._way, self._base + self._moved(gray))
        return self._way

    def _follow(self, before: np.ndarray, gray: np.ndarray) -> None:
        now, back = _flow(before, gray, self._now), self._now
        high, wide = gray.shape
        inside = ((now >= 0) & (now <= [wide - 1, high - 1])).all(axis=(1, 2))
        kept = inside & (np.linalg.norm(_flow(gray, before, now) - back, axis=2)[:, 0] < SAME_CORNER_PX)
        if kept.sum() < max(MIN_CORNERS, CUT_SHARE * len(kept)):  # a cut, or too fast to follow
            self._base = self._way + STEP
            self._seek(gray)
            return
        self._start, self._now = self._start[kept], now[kept]
        moved = self._moved(gray)
        if moved >= HOVER or kept.sum() < KEPT_CORNERS * self._found:
            self._base += moved
            self._seek(gray)

    def _moved(self, gray: np.ndarray) -> float:
        if not len(self._now):
            return 0.0
        return float(np.median(np.linalg.norm(self._now - self._start, axis=2))) / gray.shape[1]

    def _seek(self, gray: np.ndarray) -> None:
        corners = cv2.goodFeaturesToTrack(gray, MAX_CORNERS, 0.01, 8)
        self._start = self._now = np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners)
        self._found = len(self._now)


def _flow(before: np.ndarray, after: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Where corners are in another picture; NaN for those that are lost."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, winSize=(21, 21), maxLevel=3)  # type: ignore[call-overload]
    return np.where(found[:, :, None] == 1, moved, np.nan).astype(np.float32)


class FrameChooser(Generic[Frame]):
    """Takes the sharpest frame around each step of the way and hands it to `keep`, whose answer names it to `drop`.

    Where a film has more than twice `most` of them the step is doubled and every other one dropped; `finish` leaves
    `most`, spread over the way.
    """

    def __init__(self, most: int, keep: Callable[[Frame], Path], drop: Callable[[Path], object]) -> None:
        self._most, self._keep, self._drop = most, keep, drop
        self._step, self._mark = STEP, 0
        self._best: tuple[float, Frame] | None = None
        self._kept: list[tuple[int, Path]] = []

    def offer(self, travel: float, sharp: float, frame: Frame) -> None:
        """The next frame, with how far the picture has moved and how sharp it is."""
        mark = round(travel / self._step)
        if mark != self._mark:
            self._close()
            self._mark = mark = round(travel / self._step)  # the step may have grown
        if self._kept and mark == self._kept[-1][0]:  # and with it the reach of a mark whose frame is taken
            return
        beside = min(1.0, 2 * abs(travel / self._step - mark))
        score = sharp * (1 - (1 - EDGE_WEIGHT) * beside**2)
        if self._best is None or score > self._best[0]:
            self._best = score, frame

    def finish(self) -> list[Path]:
        """What `keep` said of the frames that are taken, in order."""
        self._close()
        count = len(self._kept)
        left = set(range(count))
        if count > self._most:
            left = set(np.linspace(0, count - 1, self._most).round().astype(int).tolist())
            for place in set(range(count)) - left:
                self._drop(self._kept[place][1])
        return [self._kept[place][1] for place in sorted(left)]

    def _close(self) -> None:
        if self._best is None:
            return
        _, frame = self._best
        self._best = None
        self._kept.append((self._mark, self._keep(frame)))
        if len(self._kept) > 2 * self._most:
            for place, dropped in self._kept:
                if place % 2:
                    self._drop(dropped)
            self._kept = [(place // 2, each) for place, each in self._kept if place % 2 == 0]
            self._step *= 2
