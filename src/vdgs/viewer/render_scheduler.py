"""One hand that draws for all visitors: small and quick while a camera moves, at full size once it rests.

All kernels run in this one thread; they take the cores themselves. Visitors take turns, a quick picture of anyone
before the next rows of a full one of anyone. A camera that moves on leaves nothing to be finished: what it last asked
for counts, and what was begun for it before is dropped.

The more visitors move, the less each picture may take, so that a round of all of them stays short (`ROUND_SECONDS`). What a
picture takes follows from the anchors that it is drawn from, and from pixels only where those are few: each seat learns
its seconds an anchor, and asks for as many as fit. Two visitors who rest at the same place get the same full picture.
"""

from __future__ import annotations

import gc
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from vdgs.geometry.camera import Camera
from vdgs.kernels.idle_memory import trim_heap
from vdgs.viewer.layers import DisplayOptions

#: A camera that has not moved for so long rests, seconds.
REST_SECONDS = 0.1
#: A quick picture takes so long, and never has fewer pixels nor more than these.
PREVIEW_SECONDS, MIN_PREVIEW_PIXELS, MAX_PREVIEW_PIXELS = 0.045, 240 * 160, 640 * 480
#: A quick picture of each visitor who moves takes so long together, and no picture is given less than this.
ROUND_SECONDS, MIN_PREVIEW_SECONDS = 0.12, 0.008
#: A quick picture is drawn from at most about so many anchors before it is known what they take, never from fewer.
INITIAL_PREVIEW_ANCHORS, MIN_PREVIEW_ANCHORS = 20_000, 2_000
#: Of a new measure of seconds an anchor, this share counts; the rest is what was known.
SPEED_SMOOTHING = 0.4
#: Rows of a full picture are drawn for so long before others have their turn, and from about so many anchors at once:
#: what they decode to is memory.
TURN_SECONDS, ANCHORS_PER_TURN, MAX_TURNS = 0.1, 40_000, 24
#: Full pictures that are kept for others who stand at the same place.
MAX_CACHED_IMAGES = 3
#: With nothing to do for so long (seconds), or after so many have left, memory is given back.
IDLE_SECONDS, MAX_LEFT_BEFORE_CLEANUP = 1.0, 16

_Result = TypeVar("_Result")


@runtime_checkable
class PainterProtocol(Protocol):
    """Draws what one visitor asks for (`layers.Painter`)."""

    #: Anchors that the last picture was drawn from; 0 where that is not known.
    drawn_anchors: int

    def update_depth_range(self, display: DisplayOptions, full_camera: Camera) -> None: ...
    def cache_key(self, display: DisplayOptions) -> Hashable: ...
    def count_visible_anchors(self, display: DisplayOptions, camera: Camera) -> int: ...
    def paint(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None = None
    ) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A picture for a visitor."""

    image: UInt8[np.ndarray, "h w 3"]
    #: Drawn at full size, with the camera at rest.
    is_full: bool
    #: The view that it shows, at full size.
    camera: Camera
    display: DisplayOptions


@dataclass(eq=False, kw_only=True)
class RenderSession:
    """A visitor's place in the studio."""

    painter: PainterProtocol
    on_frame: Callable[[RenderedFrame], None]
    #: Told why a picture could not be drawn.
    on_error: Callable[[Exception], None]
    #: What was asked for last, at full size.
    requested: tuple[Camera, DisplayOptions] | None = None
    preview_due: bool = False
    full_due: bool = False
    #: When the camera last moved.
    moved_at: float = 0.0
    #: A full picture that is being drawn.
    job: Iterator[None] | None = None
    #: Pixels that a quick picture may have, learned from what they take.
    preview_pixels: float = 320 * 240
    #: Seconds that a quick picture takes for each of its anchors; 0 before there was any.
    seconds_per_anchor: float = 0.0
    #: Seconds that a pixel of a full picture took; 0 before there was any.
    seconds_per_pixel: float = 0.0


class RenderScheduler:
    """Draws for whoever has a seat. `step` does one piece of work; `run` does so until it is closed."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seats: list[RenderSession] = []
        self._errands: deque[tuple[Future[Any], Callable[[], None]]] = deque()
        self._full_pictures: OrderedDict[Hashable, np.ndarray] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False
        self._left = 0

    def add_session(
        self, painter: PainterProtocol, deliver: Callable[[RenderedFrame], None], failed: Callable[[Exception], None]
    ) -> RenderSession:
        """A place for a new visitor."""
        seat = RenderSession(painter=painter, on_frame=deliver, on_error=failed)
        with self._changed:
            self._seats.append(seat)
        return seat

    def remove_session(self, seat: RenderSession) -> None:
        """The visitor is gone; nothing more is drawn for them."""
        with self._changed:
            if seat in self._seats:
                self._seats.remove(seat)
                self._left += 1
            seat.job, seat.requested = None, None

    def request_frame(self, seat: RenderSession, camera: Camera, display: DisplayOptions) -> None:
        """What a visitor wants to see now, at full size. Replaces what they wanted before."""
        with self._changed:
            seat.requested, seat.moved_at = (camera, display), self._clock()
            seat.preview_due = seat.full_due = True
            seat.job = None
            self._changed.notify()

    def submit(self, function: Callable[[], _Result]) -> Future[_Result]:
        """Something else that needs the kernels: done next, in the thread that draws; cancelled once the studio closes,
        so that nobody waits for what does not come."""
        future: Future[_Result] = Future()

        def run() -> None:
            try:
                future.set_result(function())
            except BaseException as error:  # raised again in whoever waits
                future.set_exception(error)

        with self._changed:
            if self._closed:
                future.cancel()
            else:
                self._errands.append((future, run))
                self._changed.notify()
        return future

    def close(self) -> None:
        """Let `run` return. Errands that have not begun are cancelled."""
        with self._changed:
            self._closed = True
            for future, _ in self._errands:
                future.cancel()
            self._errands.clear()
            self._changed.notify()

    def run(self) -> None:
        """Work until `close`."""
        while True:
            wait = self.step()
            if self._left >= MAX_LEFT_BEFORE_CLEANUP:
                self._free_memory()
            with self._changed:
                if self._closed:
                    return
                if wait == 0 or self._busy():
                    continue
                told = self._changed.wait(IDLE_SECONDS if wait is None else wait)
                if told or wait is not None or self._busy() or self._closed:
                    continue
            self._free_memory()
            with self._changed:
                self._changed.wait_for(lambda: self._busy() or self._closed)

    def _free_memory(self) -> None:
        """Give back what pictures and visitors took: who left is held by circles of theirs."""
        self._left = 0
        gc.collect()
        trim_heap()

    def _busy(self) -> bool:
        return bool(self._errands) or any(seat.preview_due for seat in self._seats)

    def step(self) -> float | None:
        """Do one piece of work. Returns 0 if there may be more, else seconds until there will be; None: not known."""
        with self._changed:
            errand = self._errands.popleft()[1] if self._errands else None
            now = self._clock()
            seat = None if errand else self._next(now)
            quick = seat is not None and seat.preview_due
            resting = [each.moved_at + REST_SECONDS - now for each in self._seats if each.full_due]
        if errand is not None:
            errand()
            return 0
        if seat is None:
            return max(min(resting), 1e-3) if resting else None
        try:
            self._draw_preview(seat) if quick else self._draw_next_rows(seat)
        except Exception as error:  # one visitor's trouble ends no other's pictures
            with self._changed:
                seat.preview_due, seat.full_due, seat.job = False, False, None
            seat.on_error(error)
        return 0

    def _next(self, now: float) -> RenderSession | None:
        """Whose turn it is; they go to the end of the queue."""
        for wants in (lambda s: s.preview_due, lambda s: s.full_due and now - s.moved >= REST_SECONDS - 1e-6):
            for seat in self._seats:
                if seat.requested is not None and wants(seat):
                    self._seats.remove(seat)
                    self._seats.append(seat)
                    return seat
        return None

    def _draw_preview(self, seat: RenderSession) -> None:
        with self._changed:
            asked, seat.preview_due = seat.requested, False
        if asked is None:
            return
        whole, shown = asked
        small = limit_pixels(whole, seat.preview_pixels)
        if small is whole and not seat.full_due:
            return
        began = self._clock()
        allowed = self._allowed(began)
        anchors = (
            max(int(allowed / seat.seconds_per_anchor), MIN_PREVIEW_ANCHORS)
            if seat.seconds_per_anchor
            else INITIAL_PREVIEW_ANCHORS
        )
        seat.on_frame(RenderedFrame(seat.painter.paint(shown, small, small, anchors), False, whole, shown))
        taken = max(self._clock() - began, 1e-4)
        if seat.painter.drawn_anchors:
            measured = taken / seat.painter.drawn_anchors
            seat.seconds_per_anchor += (SPEED_SMOOTHING if seat.seconds_per_anchor else 1.0) * (
                measured - seat.seconds_per_anchor
            )
        most = max(min(MAX_PREVIEW_PIXELS, whole.width * whole.height), MIN_PREVIEW_PIXELS)
        seat.preview_pixels = float(
            np.clip(seat.preview_pixels * np.clip(allowed / taken, 0.5, 1.5), MIN_PREVIEW_PIXELS, most)
        )

    def _allowed(self, now: float) -> float:
        """Seconds that a quick picture may take: a fair share of a round of all who move."""
        with self._changed:
            moving = sum(now - seat.moved_at < 2 * REST_SECONDS for seat in self._seats)
        return min(PREVIEW_SECONDS, max(ROUND_SECONDS / max(moving, 1), MIN_PREVIEW_SECONDS))

    def _draw_next_rows(self, seat: RenderSession) -> None:
        """The next rows of a full picture."""
        with self._changed:
            asked = seat.requested
            if asked is None:
                return
            if seat.job is None:
                seat.job = self._full(seat, *asked)
            work = seat.job
        done = next(work, self) is self
        with self._changed:
            if done and seat.job is work:
                seat.job, seat.full_due = None, False

    def _full(self, seat: RenderSession, full_camera: Camera, display: DisplayOptions) -> Iterator[None]:
        """Draw a full picture, turn by turn, and deliver it unless something else was asked for meanwhile."""
        seat.painter.update_depth_range(display, full_camera)
        key = (camera_key(full_camera), display, seat.painter.cache_key(display))
        if key in self._full_pictures:
            self._full_pictures.move_to_end(key)
            seat.on_frame(RenderedFrame(self._full_pictures[key], True, full_camera, display))
            return
        turns = round(seat.seconds_per_pixel * full_camera.width * full_camera.height / TURN_SECONDS)
        turns = max(turns, -(-seat.painter.count_visible_anchors(display, full_camera) // ANCHORS_PER_TURN), 1)
        turns = min(turns, MAX_TURNS, full_camera.height)
        edges = np.linspace(0, full_camera.height, turns + 1).round().astype(int).tolist()
        parts, taken = [], 0.0
        for top, bottom in pairwise(edges):
            began = self._clock()
            part = full_camera if turns == 1 else full_camera.cropped(0, top, full_camera.width, bottom)
            parts.append(seat.painter.paint(display, part, full_camera))
            taken += self._clock() - began
            if bottom != full_camera.height:
                yield
        seat.seconds_per_pixel = taken / (full_camera.width * full_camera.height)
        picture = np.concatenate(parts)
        self._full_pictures[key] = picture
        while len(self._full_pictures) > MAX_CACHED_IMAGES:
            self._full_pictures.popitem(last=False)
        if seat.requested == (full_camera, display):
            seat.on_frame(RenderedFrame(picture, True, full_camera, display))


def camera_key(camera: Camera) -> Hashable:
    """What tells a view from others: equal for two cameras that see the same, to the last bit."""
    return (
        camera.camera_from_world.tobytes(), camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height,
    )  # fmt: skip


def limit_pixels(camera: Camera, max_pixels: float) -> Camera:
    """The same view with at most so many pixels; the very camera where it has no more."""
    share = (max_pixels / (camera.width * camera.height)) ** 0.5
    if share >= 1.0:
        return camera
    return camera.resized(max(1, int(camera.width * share)), max(1, int(camera.height * share)))
