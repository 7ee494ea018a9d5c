"""PLY files of points, as other programs write them."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support.captures import (
    write_ply,
)
from vdgs.captures.formats.ply_reader import read_point_cloud
from vdgs.errors import CaptureError

FUZZ = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.mark.parametrize("text", [False, True])
def test_point_clouds_are_read_as_written(tmp_path, scene, text):
    write_ply(tmp_path / "a.ply", scene.points, scene.colors, text=text)
    points, colors = read_point_cloud(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, scene.points)
    np.testing.assert_array_equal(colors, scene.colors)


def test_point_clouds_of_other_programs_are_read(tmp_path, scene):
    import trimesh

    cloud = trimesh.PointCloud(scene.points, np.column_stack([scene.colors, np.full(len(scene.points), 255)]))
    for encoding in ("ascii", "binary"):
        (tmp_path / "a.ply").write_bytes(trimesh.exchange.ply.export_ply(cloud, encoding=encoding))
        points, colors = read_point_cloud(tmp_path / "a.ply")
        np.testing.assert_allclose(points, scene.points, atol=1e-5)
        np.testing.assert_array_equal(colors, scene.colors)


@FUZZ
@given(data=st.data(), text=st.booleans())
def test_damaged_point_clouds_end_in_a_message_or_points(tmp_path, data, text):
    file = tmp_path / "a.ply"
    write_ply(file, np.zeros((5, 3)), np.zeros((5, 3), np.uint8), text=text)
    content = bytearray(file.read_bytes())
    content = content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content
    for _ in range(3 if content else 0):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    file.write_bytes(bytes(content))
    with contextlib.suppress(CaptureError):
        points, colors = read_point_cloud(file)
        assert points.shape == colors.shape
