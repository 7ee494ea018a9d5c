"""Draws for all clients in one thread: small previews while a camera moves, the full image once it rests.

The kernels use all cores themselves. Clients take turns, previews before the next rows of full images, and these before
parts of full images that are drawn again in full detail. A new request of a client replaces its last one, and work
begun for that is dropped.

The more cameras move, the less time each preview gets, so that a round of all stays short (`ROUND_SECONDS`). The time
follows from the anchors drawn, and from pixels only where anchors are few: each session learns its seconds per anchor
and draws as many anchors as fit. Clients with equal views at rest get the same full image.
"""

from __future__ import annotations

import gc
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Hashable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from vdgs.geometry.camera import Camera
from vdgs.kernels.idle_memory import trim_heap
from vdgs.viewer.layers import DisplayOptions
from vdgs.viewer.navigation import limit_resolution

#: A camera that has not moved for so long rests, seconds.
REST_SECONDS = 0.1
#: Time of a preview, and its fewest and most pixels.
PREVIEW_SECONDS, MIN_PREVIEW_PIXELS, MAX_PREVIEW_PIXELS = 0.045, 240 * 160, 640 * 480
#: Time of a round of previews for all clients that move, and the least time of one preview.
ROUND_SECONDS, MIN_PREVIEW_SECONDS = 0.12, 0.008
#: Anchors of a preview before their time is known, and at least.
INITIAL_PREVIEW_ANCHORS, MIN_PREVIEW_ANCHORS = 20_000, 2_000
#: Weight of a new measurement of seconds per anchor in their running mean.
SPEED_SMOOTHING = 0.4
#: Rows of a full image are drawn for so long before others have their turn, and from about so many anchors at once,
#: for decoded anchors take memory.
TURN_SECONDS, ANCHORS_PER_TURN, MAX_TURNS = 0.1, 40_000, 24
#: A full image that becomes better is sent so often.
DETAIL_SECONDS = 1.0
#: Full images that are cached for other clients with the same view.
MAX_CACHED_IMAGES = 3
#: Memory is given back after so many idle seconds, or when so many clients have left.
IDLE_SECONDS, MAX_LEFT_BEFORE_CLEANUP = 1.0, 16

_Result = TypeVar("_Result")


@runtime_checkable
class PainterProtocol(Protocol):
    """Draws for one client (`layers.Painter`)."""

    #: Anchors that the last image was drawn from; 0 where that is not known.
    drawn_anchors: int

    def update_depth_range(self, display: DisplayOptions, full_camera: Camera) -> None: ...
    def cache_key(self, display: DisplayOptions) -> Hashable: ...
    def count_visible_anchors(self, display: DisplayOptions, camera: Camera) -> int: ...
    def parts_in_detail(self, display: DisplayOptions, camera: Camera) -> list[Camera]: ...
    def paint(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None = None,
        *, full_detail: bool = False,
    ) -> np.ndarray: ...  # fmt: skip


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """An image for a client."""

    image: UInt8[np.ndarray, "h w 3"]
    #: Drawn at full size, with the camera at rest.
    is_full: bool
    #: The view that it shows, at full size.
    camera: Camera
    display: DisplayOptions


@dataclass(eq=False)
class FullImage:
    """A full image that is cached, and the parts of it that are still to be drawn in full detail."""

    image: UInt8[np.ndarray, "h w 3"]
    parts: deque[Camera]


@dataclass(eq=False, kw_only=True)
class RenderSession:
    """A client of the scheduler."""

    painter: PainterProtocol
    on_frame: Callable[[RenderedFrame], None]
    #: Called with the reason where an image could not be drawn.
    on_error: Callable[[Exception], None]
    #: The last request, at full size.
    requested: tuple[Camera, DisplayOptions] | None = None
    preview_due: bool = False
    full_due: bool = False
    #: When the camera last moved.
    moved_at: float = 0.0
    #: A full image that is being drawn.
    job: Iterator[None] | None = None
    #: The full image is there, and becomes better.
    adds_detail: bool = False
    #: Pixels that a preview may have, learned from the time of previews.
    preview_pixels: float = 320 * 240
    #: Seconds of a preview for each of its anchors; 0 before there was any.
    seconds_per_anchor: float = 0.0
    #: Seconds of a full image for each of its pixels; 0 before there was any.
    seconds_per_pixel: float = 0.0


class RenderScheduler:
    """Draws for all sessions. `step` does one unit of work; `run` does so until `close`."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._sessions: list[RenderSession] = []
        self._tasks: deque[tuple[Future[Any], Callable[[], None]]] = deque()
        self._full_images: OrderedDict[Hashable, FullImage] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False
        self._left = 0

    def add_session(
        self, painter: PainterProtocol, on_frame: Callable[[RenderedFrame], None], on_error: Callable[[Exception], None]
    ) -> RenderSession:
        session = RenderSession(painter=painter, on_frame=on_frame, on_error=on_error)
        with self._changed:
            self._sessions.append(session)
        return session

    def remove_session(self, session: RenderSession) -> None:
        """Draw nothing more for a client that is gone."""
        with self._changed:
            if session in self._sessions:
                self._sessions.remove(session)
                self._left += 1
            session.job, session.requested = None, None

    def request_frame(self, session: RenderSession, camera: Camera, display: DisplayOptions) -> None:
        """Draw a view, given at full size, in place of the client's last request."""
        with self._changed:
            session.requested, session.moved_at = (camera, display), self._clock()
            session.preview_due = session.full_due = True
            session.job, session.adds_detail = None, False
            self._changed.notify()

    def submit(self, function: Callable[[], _Result]) -> Future[_Result]:
        """Run a function next, in the thread that draws; its future is cancelled once the scheduler closes."""
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
                self._tasks.append((future, run))
                self._changed.notify()
        return future

    def close(self) -> None:
        """Let `run` return; cancel the tasks that have not begun."""
        with self._changed:
            self._closed = True
            for future, _ in self._tasks:
                future.cancel()
            self._tasks.clear()
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
                notified = self._changed.wait(IDLE_SECONDS if wait is None else wait)
                if notified or wait is not None or self._busy() or self._closed:
                    continue
            self._free_memory()
            with self._changed:
                self._changed.wait_for(lambda: self._busy() or self._closed)

    def _free_memory(self) -> None:
        """Give back the memory of images and of clients that left: reference cycles hold these."""
        self._left = 0
        gc.collect()
        trim_heap()

    def _busy(self) -> bool:
        return bool(self._tasks) or any(session.preview_due for session in self._sessions)

    def step(self) -> float | None:
        """Do one unit of work. Returns 0 if there may be more, else seconds until there will be; None: not known."""
        with self._changed:
            task = self._tasks.popleft()[1] if self._tasks else None
            now = self._clock()
            session = None if task else self._next(now)
            is_preview = session is not None and session.preview_due
            requested = None if session is None else session.requested
            resting = [each.moved_at + REST_SECONDS - now for each in self._sessions if each.full_due]
        if task is not None:
            task()
            return 0
        if session is None:
            return max(min(resting), 1e-3) if resting else None
        try:
            self._draw_preview(session) if is_preview else self._draw_next_rows(session)
        except Exception as error:  # an error of one client does not end the images of others
            with self._changed:
                if session.requested is requested:  # what the client asked for meanwhile stays due
                    session.preview_due, session.full_due, session.job = False, False, None
            session.on_error(error)
        return 0

    def _next(self, now: float) -> RenderSession | None:
        """The session whose turn it is; it goes to the end of the queue."""
        rest = [each for each in self._sessions if each.full_due and now - each.moved_at >= REST_SECONDS - 1e-6]
        for is_due in (
            lambda s: s.preview_due, lambda s: s in rest and not s.adds_detail, lambda s: s in rest
        ):  # fmt: skip
            for session in self._sessions:
                if session.requested is not None and is_due(session):
                    self._sessions.remove(session)
                    self._sessions.append(session)
                    return session
        return None

    def _draw_preview(self, session: RenderSession) -> None:
        with self._changed:
            requested, session.preview_due = session.requested, False
        if requested is None:
            return
        camera, display = requested
        small = limit_resolution(camera, session.preview_pixels)
        if small is camera and not session.full_due:
            return
        began, speed = self._clock(), session.seconds_per_anchor
        allowed = self._allowed_seconds(began)
        anchors = max(int(allowed / speed), MIN_PREVIEW_ANCHORS) if speed else INITIAL_PREVIEW_ANCHORS
        session.on_frame(RenderedFrame(session.painter.paint(display, small, small, anchors), False, camera, display))
        seconds = max(self._clock() - began, 1e-4)
        if drawn := session.painter.drawn_anchors:
            session.seconds_per_anchor += (SPEED_SMOOTHING if speed else 1.0) * (seconds / drawn - speed)
        max_pixels = max(min(MAX_PREVIEW_PIXELS, camera.width * camera.height), MIN_PREVIEW_PIXELS)
        pixels = session.preview_pixels * np.clip(allowed / seconds, 0.5, 1.5)
        session.preview_pixels = float(np.clip(pixels, MIN_PREVIEW_PIXELS, max_pixels))

    def _allowed_seconds(self, now: float) -> float:
        """How long a preview may take: a fair share of a round of all that move."""
        with self._changed:
            moving = sum(now - session.moved_at < 2 * REST_SECONDS for session in self._sessions)
        return min(PREVIEW_SECONDS, max(ROUND_SECONDS / max(moving, 1), MIN_PREVIEW_SECONDS))

    def _draw_next_rows(self, session: RenderSession) -> None:
        """The next rows of a full image, or the next part of it in full detail."""
        with self._changed:
            if session.requested is None:
                return
            job = session.job = session.job or self._draw_full(session, *session.requested)
        done = next(job, self) is self
        with self._changed:
            if done and session.job is job:
                session.job, session.full_due = None, False

    def _draw_full(self, session: RenderSession, full_camera: Camera, display: DisplayOptions) -> Iterator[None]:
        """Draw a full image, turn by turn, and deliver it unless there is a newer request by then; then the same in
        full detail."""
        session.painter.update_depth_range(display, full_camera)
        key = (camera_key(full_camera), display, session.painter.cache_key(display))
        full = self._full_images.pop(key, None)
        if full is None:
            image = yield from self._draw_rows(session, full_camera, display)
            full = FullImage(image, deque(session.painter.parts_in_detail(display, full_camera)))
        self._full_images[key] = full
        while len(self._full_images) > MAX_CACHED_IMAGES:
            self._full_images.popitem(last=False)
        with self._changed:
            if session.requested != (full_camera, display):
                return
            session.adds_detail = True
        image = full.image.copy() if full.parts else full.image
        session.on_frame(RenderedFrame(image, True, full_camera, display))
        yield from self._add_detail(session, full, full_camera, display)

    def _draw_rows(
        self, session: RenderSession, full_camera: Camera, display: DisplayOptions
    ) -> Generator[None, None, np.ndarray]:
        """Draw a full image, some rows in each turn."""
        turns = round(session.seconds_per_pixel * full_camera.width * full_camera.height / TURN_SECONDS)
        turns = max(turns, -(-session.painter.count_visible_anchors(display, full_camera) // ANCHORS_PER_TURN), 1)
        turns = min(turns, MAX_TURNS, full_camera.height)
        edges = np.linspace(0, full_camera.height, turns + 1).round().astype(int).tolist()
        parts, seconds = [], 0.0
        for top, bottom in pairwise(edges):
            began = self._clock()
            part = full_camera if turns == 1 else full_camera.cropped(0, top, full_camera.width, bottom)
            parts.append(session.painter.paint(display, part, full_camera))
            seconds += self._clock() - began
            if bottom != full_camera.height:
                yield
        session.seconds_per_pixel = seconds / (full_camera.width * full_camera.height)
        return np.concatenate(parts)

    def _add_detail(
        self, session: RenderSession, full: FullImage, full_camera: Camera, display: DisplayOptions
    ) -> Iterator[None]:
        """Draw a full image again in full detail, a part in each turn, and deliver what has come of it every second and
        at last. Clients with equal views share the parts."""
        sent_at, left = self._clock(), len(full.parts)
        while full.parts or left:
            yield
            if full.parts:
                part = full.parts[0]
                x, y = round(full_camera.cx - part.cx), round(full_camera.cy - part.cy)
                drawn = session.painter.paint(display, part, full_camera, full_detail=True)
                full.image[y : y + part.height, x : x + part.width] = drawn
                full.parts.popleft()  # only now: one that could not be drawn stays due
            if session.requested != (full_camera, display):
                return
            if not full.parts or self._clock() - sent_at >= DETAIL_SECONDS:
                session.on_frame(RenderedFrame(full.image.copy(), True, full_camera, display))
                sent_at, left = self._clock(), len(full.parts)


def camera_key(camera: Camera) -> Hashable:
    """Equal for two cameras that see the same, to the last bit."""
    return (
        camera.camera_from_world.tobytes(), camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height,
    )  # fmt: skip
