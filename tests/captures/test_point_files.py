"""PLY files of points, as other programs write them."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support.captures import write_ply
from support.dataset_layouts import write_transforms
from vdgs.captures.formats import las_reader
from vdgs.captures.formats.ply_reader import GRAY, read_point_cloud
from vdgs.captures.loading import load_capture
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


# ---------------------------------------------------------------------------------------------- colors

COLORS = np.random.default_rng(5).integers(0, 256, (50, 3))


def cloud(file: Path, names: tuple[str, ...], kind: str, values: np.ndarray, form: str) -> Path:
    codes = {"uchar": "B", "ushort": "H", "int": "i", "float": "f", "double": "d"}
    header = f"ply\nformat {form} 1.0\nelement vertex {len(values)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property {kind} {name}\n" for name in names) + "end_header\n"
    cast = float if kind in ("float", "double") else int
    if form == "ascii":
        body = "".join(f"1 2 3 {' '.join(str(cast(v)) for v in row)}\n" for row in values).encode()
    else:
        code = f"{'<' if 'little' in form else '>'}3f{values.shape[1]}{codes[kind]}"
        body = b"".join(struct.pack(code, 1, 2, 3, *map(cast, row)) for row in values)
    file.write_bytes(header.encode() + body)
    return file


@pytest.mark.parametrize(
    "names",
    [
        ("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"),
        ("Red", "Green", "Blue"), ("alpha", "R", "G", "B"),
    ],
)  # fmt: skip
@pytest.mark.parametrize(
    ("kind", "factor"),
    [
        ("uchar", 1), ("ushort", 257), ("ushort", 1), ("int", 257), ("int", 1), ("float", 1 / 255), ("float", 1),
        ("double", 257),
    ],
)  # fmt: skip
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_colors_of_clouds_are_read_by_every_name_and_scale(tmp_path, names, kind, factor, form):
    values = COLORS * factor
    if len(names) == 4:
        values = np.c_[values[:, :1], values]
    points, found = read_point_cloud(cloud(tmp_path / "a.ply", names, kind, values, form))
    assert (points == [1, 2, 3]).all()
    assert np.abs(found.astype(int) - COLORS).max() <= 1


@pytest.mark.parametrize(
    ("kind", "factor", "beyond"),
    [
        ("float", 1 / 255, 1.004), ("double", 1 / 255, 3.7), ("float", 1.02 / 255, 1.02), ("float", 1 / 255, 255.0),
        ("float", 1, 255.6), ("float", 1, 300.0), ("float", 1, 65535.0), ("ushort", 1, 256), ("ushort", 257, 65535),
    ],
)  # fmt: skip
def test_a_few_colors_beyond_the_scale_are_clipped(tmp_path, kind, factor, beyond):
    values = COLORS * factor
    values[0] = beyond
    found = read_point_cloud(cloud(tmp_path / "a.ply", ("red", "green", "blue"), kind, values, "ascii"))[1].astype(int)
    assert np.abs(found[1:] - COLORS[1:]).max() <= 5  # two in a hundred where all are by that much too bright
    assert (found[0] == 255).all()


@pytest.mark.parametrize(
    ("values", "expected"), [([[0.0, 1.0, 1.0]], [0, 255, 255]), ([[0.0, 1.0, 2.0]], [0, 1, 2]), ([[0, 0, 0]], [0] * 3)]
)
def test_whole_numbers_above_one_are_no_shares(tmp_path, values, expected):
    file = cloud(tmp_path / "a.ply", ("red", "green", "blue"), "float", np.array(values * 9), "binary_little_endian")
    assert (read_point_cloud(file)[1] == expected).all()


@pytest.mark.parametrize(("kind", "factor"), [("ushort", 257), ("float", 1 / 255), ("double", 0.997)])
def test_points_without_a_color_say_nothing_of_the_scale(tmp_path, kind, factor):
    """As scanners write them: black, and most of all."""
    values = np.concatenate([COLORS * factor, np.zeros((40 * len(COLORS), 3))])
    found = read_point_cloud(cloud(tmp_path / "a.ply", ("red", "green", "blue"), kind, values, "ascii"))[1].astype(int)
    assert np.abs(found[: len(COLORS)] - COLORS).max() <= 1
    assert (found[len(COLORS) :] == 0).all()


def test_points_that_are_black_are_remarked(tmp_path, scene):
    write_transforms(tmp_path, scene)
    assert not any("black" in note for note in load_capture(tmp_path).warnings)
    write_ply(tmp_path / "sparse_pc.ply", scene.points, np.minimum(scene.colors, 7))
    assert any("points are all but black" in note for note in load_capture(tmp_path).warnings)


def test_colors_of_splats_and_none_at_all(tmp_path):
    coefficients = (COLORS / 255 - 0.5) / 0.28209479177387814
    file = cloud(tmp_path / "a.ply", ("f_dc_0", "f_dc_1", "f_dc_2"), "float", coefficients, "binary_big_endian")
    assert np.abs(read_point_cloud(file)[1].astype(int) - COLORS).max() <= 1
    gray = cloud(tmp_path / "b.ply", ("u", "v"), "float", COLORS[:, :2], "binary_little_endian")
    assert (read_point_cloud(gray)[1] == GRAY).all()


def test_a_comment_ends_no_header(tmp_path):
    file = cloud(tmp_path / "a.ply", ("red", "green", "blue"), "uchar", COLORS, "binary_big_endian")
    file.write_bytes(file.read_bytes().replace(b"1.0\n", b"1.0\ncomment end_header is below\nobj_info 1\n", 1))
    assert (read_point_cloud(file)[1] == COLORS).all()


def test_points_without_colors_are_remarked(tmp_path, scene):
    write_transforms(tmp_path, scene)
    assert load_capture(tmp_path).warnings == ()
    cloud(tmp_path / "sparse_pc.ply", ("u",), "float", COLORS[:, :1], "ascii")
    text = (tmp_path / "sparse_pc.ply").read_text()
    for k in range(len(COLORS)):
        text = text.replace("\n1 2 3 ", f"\n{k % 7} {k % 5} {k / 100} ", 1)
    (tmp_path / "sparse_pc.ply").write_text(text)
    assert any("bring no colors" in warning for warning in load_capture(tmp_path).warnings)


def test_colors_of_sixteen_bits_are_those_of_eight_exactly(tmp_path):
    levels = np.arange(256)[:, None].repeat(3, axis=1)
    file = cloud(tmp_path / "a.ply", ("red", "green", "blue"), "ushort", 257 * levels, "binary_little_endian")
    np.testing.assert_array_equal(read_point_cloud(file)[1], levels)


@pytest.mark.parametrize("chunk", [7, 25, 1000])
def test_clouds_are_thinned_evenly_however_they_are_read(tmp_path, monkeypatch, chunk):
    laspy = pytest.importorskip("laspy")
    written = laspy.LasData(laspy.LasHeader(version="1.4", point_format=7))
    written.header.scales = np.full(3, 0.01)
    written.x, written.y, written.z = np.arange(100) * np.array([[1.0], [0.0], [0.0]])
    written.write(tmp_path / "a.las")
    monkeypatch.setattr(las_reader, "MAX_POINTS", 20)
    monkeypatch.setattr(las_reader, "_CHUNK", chunk)
    points, _ = las_reader.read_las_points(tmp_path / "a.las")
    np.testing.assert_allclose(points[:, 0], np.arange(0, 100, 5))
