"""In which coordinates a cloud beside cameras is: one that is right stays, however few its points are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from support.captures import look_down
from vdgs.captures.formats.cloud_worlds import CloudFrame, Eye, best_frame, in_world_of
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.errors import CaptureError

LENS = Intrinsics("PINHOLE", (900.0, 900.0, 500.0, 375.0), 1000, 750)
SHRUNK: CloudFrame = ("shrunk", lambda points: points * 0.1)
TURNED: CloudFrame = ("turned", lambda points: points[:, [0, 2, 1]] * [1, -1, 1])


def eyes(step: float, count: int = 6, altitude: float = 80.0) -> list[Eye]:
    """Cameras of a flight in a grid that look down."""
    places = [np.array([step * i, step * j, altitude]) for i in range(count) for j in range(count)]
    return [Eye(look_down(place, 3.0, 70.0 * k), LENS) for k, place in enumerate(places)]


def placed(points: np.ndarray, cameras: Sequence[Eye], others: Sequence[CloudFrame], notes: list[str]) -> np.ndarray:
    return in_world_of(points, Path("cloud.ply"), cameras, others, notes, "Mend it.")


@pytest.mark.parametrize("count", [1, 5, 20])
def test_few_points_stay(count: int) -> None:
    for seed in range(20):
        generator, notes = np.random.default_rng(seed), list[str]()
        points = np.column_stack([generator.uniform(-10, 135, (count, 2)), generator.normal(0, 3, count)])
        assert placed(points, eyes(25.0), [TURNED, SHRUNK], notes) is points
        assert notes == []


@pytest.mark.parametrize("step", [0.0, 0.05])
def test_cameras_that_hardly_moved_see_what_is_far(step: float) -> None:
    generator, notes = np.random.default_rng(0), list[str]()
    points = np.column_stack([generator.uniform(-40, 40, (500, 2)), generator.normal(0, 3, 500)])
    for others in ([], [SHRUNK]):
        assert placed(points, eyes(step), others, notes) is points
    assert notes == []
    with pytest.raises(CaptureError, match=r"where the cameras look .*Mend it"):
        placed(points + np.array([5e3, 0, 0]), eyes(step), [], notes)


def ground(count: int, width: float = 160.0) -> np.ndarray:
    """Points under the flight of `eyes(25.0)`, of which one in a hundred lies beyond it."""
    generator = np.random.default_rng(1)
    points = np.column_stack([generator.uniform(-0.5, 0.5, (count, 2)) * width + 62, generator.normal(0, 3, count)])
    points[: count // 100, :2] += [400, 0]
    return points


@pytest.mark.parametrize("count", [60, 400, 20_000])
@pytest.mark.parametrize("scale", [0.1, 0.5, 3.0, 40.0])
@pytest.mark.parametrize("order", [1, -1])
def test_neither_a_shrunk_nor_a_blown_up_cloud_wins(count: int, scale: float, order: int) -> None:
    """Shrunk all of it is seen; blown up, if it is dense, it fills all photographs."""
    middle = np.array([62.0, 62, 0])
    frames: list[CloudFrame] = [
        ("right", lambda points: points),
        ("wrong", lambda points: (points - middle) * scale + middle),
    ]
    (name, _), seen = best_frame(ground(count), eyes(25.0), frames[::order])
    assert name == "right"
    assert seen > 0.9


def test_of_coordinates_that_fit_alike_the_first_are_taken() -> None:
    frames: list[CloudFrame] = [
        ("usual", lambda points: points),
        ("nearly", lambda points: points + np.array([0.2, 0, 0])),
    ]
    for order in (1, -1):
        assert best_frame(ground(2000), eyes(25.0), frames[::order])[0] is frames[::order][0]


def test_coordinates_that_refuse_a_cloud_are_passed_over() -> None:
    def refuse(_: np.ndarray) -> np.ndarray:
        raise CaptureError("they look like degrees.")

    frames: list[CloudFrame] = [("refusing", refuse), ("right", lambda points: points)]
    assert best_frame(ground(200), eyes(25.0), frames)[0] is frames[1]
    assert best_frame(ground(200), eyes(25.0), frames[:1])[1] == 0


@pytest.mark.parametrize("relief", [0.0, 15.0])
def test_a_cloud_at_one_spot_is_seen_by_nobody(relief: float) -> None:
    """Degrees as metres: a cloud of millimetres, but for its heights."""
    cloud = ground(500) * [1e-5, 1e-5, relief / 3] + [60, 60, 0]
    frames: list[CloudFrame] = [("as they are", lambda points: points)]
    assert best_frame(cloud, eyes(25.0), frames)[1] == 0
    one_building = ground(500, width=12.0)
    assert best_frame(one_building, eyes(25.0), frames)[1] > 0.9
    wires = ground(500) * [1, 0.02, 0.1] + [0, 60, 0]
    assert best_frame(wires, eyes(25.0), frames)[1] > 0.9
