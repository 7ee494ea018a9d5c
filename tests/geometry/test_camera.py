"""Cameras: smaller pictures of the same view."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vdgs.geometry.camera import Camera

sides = st.integers(1, 9000)


@given(sides, sides, sides)
def test_a_smaller_picture_has_the_shape_of_the_whole_to_half_a_pixel(width: int, height: int, limit: int) -> None:
    camera = Camera(
        camera_from_world=np.eye(4), fx=2.0 * width, fy=2.0 * height, cx=width / 2, cy=height / 3, width=width,
        height=height,
    )  # fmt: skip
    small, scale = camera.limit_size(limit), min(1.0, limit / max(width, height))
    assert max(small.width, small.height) == min(limit, max(width, height))
    for side, whole in ((small.width, width), (small.height, height)):
        assert side >= 1
        assert abs(side - scale * whole) <= 0.5 + 1e-9 or side == 1
    # The same view: its lens as shares of the picture is the same.
    shares = (small.fx / small.width, small.fy / small.height, small.cx / small.width, small.cy / small.height)
    np.testing.assert_allclose(shares, (2.0, 2.0, 1 / 2, 1 / 3))
