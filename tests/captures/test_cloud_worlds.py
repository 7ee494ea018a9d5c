"""In which coordinates a cloud beside cameras is: one that is right stays, however few its points are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from support.captures import look_down
from vdgs.captures.formats.cloud_worlds import CloudFrame, Eye, in_world_of
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
