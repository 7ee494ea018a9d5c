"""Whose turn it is in a viewer, and how much is drawn in it: visitors, moving and at rest, in a time that tests set."""

from __future__ import annotations

from concurrent.futures import CancelledError

import numpy as np
import pytest

from support.captures import camera_at
from vdgs.geometry.camera import Camera
from vdgs.viewer.layers import DisplayOptions
from vdgs.viewer.navigation import limit_resolution
from vdgs.viewer.render_scheduler import (
    ANCHORS_PER_TURN,
    MIN_PREVIEW_PIXELS,
    REST_SECONDS,
    ROUND_SECONDS,
    RenderedFrame,
    RenderScheduler,
)


class Clock:
    """Time that passes only where a test says so."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


class Slow:
    """A painter that takes so long for each pixel."""

    def __init__(self, clock: Clock, per_px: float = 0.0) -> None:
        self.clock, self.per_px, self.settled, self.drawn_anchors = clock, per_px, 0, 0

    def cache_key(self, display: DisplayOptions) -> object:
        return id(self)

    def count_visible_anchors(self, display: DisplayOptions, camera: Camera) -> int:
        return 0

    def update_depth_range(self, display: DisplayOptions, full_camera: Camera) -> None:
        self.settled += 1

    def parts_in_detail(self, display: DisplayOptions, camera: Camera) -> list[Camera]:
        return []

    def paint(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None = None,
        *, full_detail: bool = False,
    ) -> np.ndarray:  # fmt: skip
        self.clock.now += self.per_px * camera.width * camera.height
        return np.full((camera.height, camera.width, 3), full_detail, np.uint8)


@pytest.fixture
def studio():
    clock = Clock()
    return RenderScheduler(clock), clock


def sit(studio: RenderScheduler, painter: Slow) -> tuple[object, list[RenderedFrame], list[Exception]]:
    frames, errors = list[RenderedFrame](), list[Exception]()
    return studio.add_session(painter, frames.append, errors.append), frames, errors


def test_small_while_moving_and_full_at_rest(studio):
    studio, clock = studio
    seat, frames, _ = sit(studio, Slow(clock, 1e-6))
    for x in range(5):
        studio.request_frame(seat, camera_at(x, 0, width=1280), DisplayOptions())
        assert studio.step() == 0
        wait = studio.step()
        assert wait is not None
        assert 0 < wait <= REST_SECONDS  # nothing to do until it rests
    assert [frame.is_full for frame in frames] == [False] * 5
    assert all(frame.image.shape[1] <= 640 for frame in frames)
    clock.now += REST_SECONDS
    while studio.step() == 0:
        pass
    assert [frame.is_full for frame in frames] == [False] * 5 + [True]
    assert frames[-1].image.shape == (960, 1280, 3)
    assert frames[-1].camera.position[0] == pytest.approx(4.0)
    assert studio.step() is None


def test_a_camera_that_moves_on_leaves_nothing_to_be_finished(studio):
    studio, clock = studio
    seat, frames, _ = sit(studio, Slow(clock, 1e-6))
    for x in range(2):  # the second picture is drawn in turns: the first one told how long they take
        studio.request_frame(seat, camera_at(x, 0, width=1280), DisplayOptions())
        studio.step()
        clock.now += REST_SECONDS
        studio.step()
    count = len(frames)
    assert seat.job is not None
    studio.request_frame(seat, camera_at(9, 0, width=1280), DisplayOptions())
    studio.step()
    assert not frames[-1].is_full
    assert frames[-1].camera.position[0] == pytest.approx(9.0)
    clock.now += REST_SECONDS
    while studio.step() == 0:
        pass
    assert [frame.is_full for frame in frames[count:]] == [False, True]
    assert all(frame.camera.position[0] == pytest.approx(9.0) for frame in frames[count:])


def test_quick_pictures_are_as_large_as_time_allows(studio):
    studio, clock = studio
    for per_px, least, most in (
        (1e-3, MIN_PREVIEW_PIXELS * 0.9, MIN_PREVIEW_PIXELS),
        (1e-9, 640 * 480 * 0.98, 640 * 480),
    ):
        seat, frames, _ = sit(studio, Slow(clock, per_px))
        for x in range(20):
            studio.request_frame(seat, camera_at(x, 0, width=1600), DisplayOptions())
            studio.step()
        height, width = frames[-1].image.shape[:2]
        assert least <= width * height <= most
        studio.remove_session(seat)


class Decoding(Slow):
    """A painter of 100 000 anchors in view that takes so long for each one that it draws."""

    def __init__(self, clock: Clock, per_anchor: float) -> None:
        super().__init__(clock)
        self.per_anchor, self.times = per_anchor, [1, 5, 15, 45]

    def paint(
        self, display: DisplayOptions, camera: Camera, full_camera: Camera, max_anchors: int | None = None,
        *, full_detail: bool = False,
    ) -> np.ndarray:  # fmt: skip
        counts = [100_000 // times for times in self.times]
        self.drawn_anchors = (
            counts[0] if max_anchors is None else next((c for c in counts if c <= max_anchors), counts[-1])
        )
        self.clock.now += self.per_anchor * self.drawn_anchors
        return super().paint(display, camera, full_camera, max_anchors)


@pytest.mark.parametrize(("moving", "drawn"), [(1, 20_000), (2, 20_000), (8, 6_666)])
def test_a_round_of_all_who_move_stays_short(studio, moving, drawn):
    studio, clock = studio
    painters = [Decoding(clock, 2e-6) for _ in range(moving)]
    seats = [sit(studio, painter)[0] for painter in painters]
    for x in range(8):
        began = clock.now
        for seat in seats:
            studio.request_frame(seat, camera_at(x, 0, width=1280), DisplayOptions())
        for _ in seats:
            assert studio.step() == 0
        taken = clock.now - began
    assert [painter.drawn_anchors for painter in painters] == [drawn] * moving
    assert taken <= ROUND_SECONDS * 1.05


def test_who_is_alone_on_a_fast_machine_sees_the_model_itself_while_moving(studio):
    studio, clock = studio
    painter = Decoding(clock, 1e-7)
    seat, _, _ = sit(studio, painter)
    for x in range(3):
        studio.request_frame(seat, camera_at(x, 0, width=1280), DisplayOptions())
        studio.step()
    assert painter.drawn_anchors == 100_000


def test_two_who_rest_at_the_same_place_share_a_picture(studio):
    studio, clock = studio

    class Alike(Slow):
        def cache_key(self, display: DisplayOptions) -> object:
            return "one scene"

    one, other, elsewhere = (sit(studio, Alike(clock, 1e-7)) for _ in range(3))
    for (seat, _, _), x in ((one, 0), (other, 0), (elsewhere, 1)):
        studio.request_frame(seat, camera_at(x, 0, width=640), DisplayOptions())
    for _ in range(3):
        studio.step()
    clock.now += REST_SECONDS
    while studio.step() == 0:
        pass
    full = [frames[-1] for _, frames, _ in (one, other, elsewhere)]
    assert all(frame.is_full for frame in full)
    assert full[0].image is full[1].image
    assert full[0].image is not full[2].image


def test_a_full_picture_of_much_is_drawn_in_parts(studio):
    studio, clock = studio
    painter = Slow(clock)
    painter.count_visible_anchors = lambda display, camera: 5 * ANCHORS_PER_TURN  # type: ignore[method-assign]
    seat, frames, _ = sit(studio, painter)
    studio.request_frame(seat, camera_at(0, 0, width=1280), DisplayOptions())
    studio.step()
    clock.now += REST_SECONDS
    steps = 0
    while studio.step() == 0:
        steps += 1
    assert steps == 5
    assert frames[-1].image.shape == (960, 1280, 3)


class Detailed(Slow):
    """A painter whose pictures become better in eight parts."""

    def cache_key(self, display: DisplayOptions) -> object:
        return "one scene"

    def parts_in_detail(self, display: DisplayOptions, camera: Camera) -> list[Camera]:
        return [camera.cropped(160 * x, 0, 160 * (x + 1), camera.height) for x in range(8)]


def test_who_rests_gets_full_detail_part_by_part_until_a_move(studio):
    studio, clock = studio
    one, other, mover = (sit(studio, Detailed(clock, 2e-6)) for _ in range(3))
    for seat, x in ((one[0], 0), (other[0], 0), (mover[0], 1)):
        studio.request_frame(seat, camera_at(x, 0, width=1280), DisplayOptions())
    clock.now += REST_SECONDS
    while not all(frames and frames[-1].is_full for _, frames, _ in (one, other, mover)):
        studio.step()
    assert not any(frames[-1].image.any() for _, frames, _ in (one, other, mover))  # nobody waits for others' detail
    while not one[1][-1].image.any():
        assert studio.step() == 0
    assert 0 < one[1][-1].image.mean() < 1  # a part of it, after a second
    before = len(mover[1])
    studio.request_frame(mover[0], camera_at(2, 0, width=1280), DisplayOptions())
    assert studio.step() == 0
    assert len(mover[1]) == before + 1  # the next step is that of the camera that moves
    studio.remove_session(mover[0])
    while studio.step() == 0:
        pass
    for _, frames, errors in (one, other):
        shares = [frame.image.mean() for frame in frames if frame.is_full]
        assert shares == sorted(shares)
        assert shares[-1] == 1
        assert not errors
    again = sit(studio, Detailed(clock, 2e-6))
    studio.request_frame(again[0], camera_at(0, 0, width=1280), DisplayOptions())
    clock.now += REST_SECONDS
    while studio.step() == 0:
        pass
    assert [frame.image.mean() for frame in again[1] if frame.is_full] == [1]  # what others waited for is there


def test_a_part_that_could_not_be_drawn_is_drawn_for_the_next(studio):
    studio, clock = studio

    class Fails(Detailed):
        def paint(self, *args, full_detail=False, **named):
            if full_detail:
                raise RuntimeError("no part")
            return super().paint(*args, **named)

    for painter, share, said in ((Fails(clock, 2e-6), 0, ["no part"]), (Detailed(clock, 2e-6), 1, [])):
        seat, frames, errors = sit(studio, painter)
        studio.request_frame(seat, camera_at(0, 0, width=1280), DisplayOptions())
        clock.now += REST_SECONDS
        while studio.step() == 0:
            pass
        assert frames[-1].image.mean() == share
        assert [str(error) for error in errors] == said


def test_visitors_take_turns_and_moving_ones_go_first(studio):
    studio, clock = studio
    order: list[int] = []
    seats = []
    for number in range(3):
        seat = studio.add_session(Slow(clock, 1e-7), lambda frame, n=number: order.append(n), pytest.fail)
        seats.append(seat)
    for _ in range(4):
        for seat in seats:
            studio.request_frame(seat, camera_at(0, 0, width=1280), DisplayOptions())
        for _ in seats:
            studio.step()
    assert sorted(order[:3]) == [0, 1, 2]
    assert all(order.count(number) == 4 for number in range(3))
    clock.now += REST_SECONDS
    studio.request_frame(
        seats[1], camera_at(1, 0, width=1280), DisplayOptions()
    )  # the others rest and wait for full pictures
    studio.step()
    assert order[-1] == 1


def test_who_left_is_drawn_for_no_more(studio):
    studio, clock = studio
    seat, frames, _ = sit(studio, Slow(clock))
    studio.request_frame(seat, camera_at(0, 0), DisplayOptions())
    studio.remove_session(seat)
    assert studio.step() is None
    assert not frames


@pytest.mark.parametrize("failing_width", [320, 640])
def test_what_is_asked_for_while_a_picture_fails_is_drawn(studio, failing_width):
    """Of a small picture and of a full one: the visitor chooses another layer, for example."""
    studio, clock = studio
    broken, chosen = DisplayOptions(layer="error"), DisplayOptions()

    class Fails(Slow):
        def paint(self, display, camera, full_camera, max_anchors=None):
            if display == broken and camera.width == failing_width:
                studio.request_frame(seat, full_camera, chosen)
                raise RuntimeError("no picture")
            return super().paint(display, camera, full_camera, max_anchors)

    seat, frames, errors = sit(studio, Fails(clock))
    studio.request_frame(seat, camera_at(0, 0, width=640), broken)
    while (wait := studio.step()) is not None:
        clock.now += wait
    assert [str(error) for error in errors] == ["no picture"]
    assert [(frame.display, frame.is_full) for frame in frames[-2:]] == [(chosen, False), (chosen, True)]


def test_one_visitors_trouble_is_theirs_alone(studio):
    studio, clock = studio

    class Broken(Slow):
        def paint(self, display, camera, full_camera, max_anchors=None):
            raise RuntimeError("no picture")

    broken, _, errors = sit(studio, Broken(clock))
    other, frames, _ = sit(studio, Slow(clock))
    for seat in (broken, other):
        studio.request_frame(seat, camera_at(0, 0, width=640), DisplayOptions())
    assert (studio.step(), studio.step()) == (0, 0)
    assert [str(error) for error in errors] == ["no picture"]
    assert len(frames) == 1
    assert studio.submit(lambda: 3).done() is False
    future = studio.submit(lambda: 1 // 0)
    studio.step()
    studio.step()
    with pytest.raises(ZeroDivisionError):
        future.result()


def test_nobody_waits_for_errands_of_a_studio_that_closes(studio):
    studio, _ = studio
    before = studio.submit(lambda: 3)
    studio.close()
    after = studio.submit(lambda: 4)
    for future in (before, after):
        with pytest.raises(CancelledError):
            future.result(timeout=0)


def test_a_small_canvas_is_drawn_once(studio):
    studio, clock = studio
    seat, frames, _ = sit(studio, Slow(clock))
    camera = camera_at(0, 0, width=160)
    assert limit_resolution(camera, 1e6) is camera
    studio.request_frame(seat, camera, DisplayOptions())
    studio.step()
    clock.now += REST_SECONDS
    while studio.step() == 0:
        pass
    assert [frame.image.shape for frame in frames] == [(120, 160, 3)] * len(frames)
