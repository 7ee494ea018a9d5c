"""OPF of Pix4D, written by its specification, against the flight that wrote it."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyproj
import pytest

from support import project_writers as writers
from support.known_flight import (
    KnownFlight,
    centers_of,
    known_flight,
    poses_of,
)
from support.project_reading import check_numbers, known_points, read
from vdgs.captures.format_dispatch import read_source
from vdgs.captures.formats import opf
from vdgs.captures.formats.gltf_points import read_gltf_points
from vdgs.captures.formats.lens_projection import ray_pixels
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError


@pytest.fixture
def flight() -> KnownFlight:
    return known_flight()


def test_opf_is_read_to_its_numbers(tmp_path: Path, flight: KnownFlight) -> None:
    writers.write_opf(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    source = read(tmp_path, "opf")
    check_numbers(source, flight)
    assert source.georef is not None
    assert source.georef.origin is not None
    assert np.abs(source.points - known_points(flight, source.georef.origin)).max() < 1e-3
    assert all(len(view.observations.points) > 20 for view in source.views if view.observations)
    assert sum(view.observations is not None for view in source.views) == len(flight.names)
    assert (source.colors == flight.colors).all()


@pytest.mark.parametrize("unit", [1.0, 0.3048])
def test_the_geoid_of_opf_has_the_unit_of_its_heights(tmp_path: Path, flight: KnownFlight, unit: float) -> None:
    writers.write_opf(tmp_path, flight, unit)
    flight.write_photographs(tmp_path / "images")
    frame, heights = tmp_path / "scene-reference-frame.json", []
    content = json.loads(frame.read_text())
    for geoid in (0.0, -100.0):
        content["crs"]["geoid_height"] = geoid
        frame.write_text(json.dumps(content))
        georef = read(tmp_path, "opf").georef
        assert georef is not None
        assert georef.origin is not None
        heights.append(georef.origin[2])
    assert heights[1] - heights[0] == pytest.approx(-100 * unit, abs=1.0)  # origins are whole metres


def test_heights_by_a_geoid_of_opf_are_converted_once(tmp_path: Path, flight: KnownFlight) -> None:
    """The stated height of the geoid stands in the place of a model of it, whether PROJ has its grid or not."""
    writers.write_opf(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    frame = tmp_path / "scene-reference-frame.json"
    content = json.loads(frame.read_text())
    alone = read(tmp_path, "opf").georef
    content["crs"] = {"definition": f"{content['crs']['definition']}+5773", "geoid_height": 40.0}
    frame.write_text(json.dumps(content))
    georef = read(tmp_path, "opf").georef
    assert georef is not None
    assert georef.origin[2] - alone.origin[2] == pytest.approx(40, abs=1)
    assert "heights as they are" not in georef.method


def test_opf_tells_left_handed_systems_by_their_own_axes(tmp_path: Path) -> None:
    """Krovak's are south and west; a processing frame is right-handed, with x and y exchanged."""
    wkt = pyproj.CRS(5513).to_wkt()
    base = np.array([1044002.0, 744005.0, 400.0])
    change = {"shift": (-base[[1, 0, 2]]).tolist(), "scale": [1, 1, 1], "swap_xy": True}
    (tmp_path / "frame.json").write_text(json.dumps({"crs": {"definition": wkt}, "base_to_canonical": change}))
    items = SimpleNamespace(path=lambda what: tmp_path / "frame.json")
    to_earth = opf._system(items)[0]
    place, west, south = to_earth(np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0]]))
    assert place[:2] == pytest.approx([50.0772, 14.4066], abs=1e-3)  # Prague
    assert west[1] < place[1]
    assert south[0] < place[0]


def test_fisheyes_of_opf_are_their_formula(tmp_path: Path, flight: KnownFlight) -> None:
    writers.write_opf(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    file = tmp_path / "calibrated-cameras.json"
    content = json.loads(file.read_text())
    content["sensors"][0]["internals"] = {
        "type": "fisheye", "principal_point_px": [401.0, 299.0], "affine": [600.0, 1.0, -1.0, 601.0],
        "polynomial": [0.0, 1.0, 0.02, -0.03], "is_p0_zero": True, "is_symmetric_affine": False,
    }  # fmt: skip
    for camera, shutter in zip(content["cameras"], ([0, 0, 0], [0.1, 0, 0], [0, 0, 0.02], "linear"), strict=False):
        camera["rolling_shutter"] = shutter
    file.write_text(json.dumps(content))
    assert any("rolling shutter of 2 photographs" in each for each in read(tmp_path, "opf").warnings)
    rays = np.array([[0.5, 0.3], [-0.9, 0.1], [0.0, -1.4]])
    theta = 2 / np.pi * np.arctan(np.hypot(*rays.T))
    bent = rays * ((theta + 0.02 * theta**2 - 0.03 * theta**3) / np.hypot(*rays.T))[:, None]
    expected = bent @ np.array([[600.0, 1.0], [-1.0, 601.0]]).T + (401.0, 299.0)
    assert np.abs(ray_pixels(read(tmp_path, "opf").views[0].intrinsics, rays) - expected).max() < 1e-6
    content["sensors"][0]["internals"]["polynomial"][0] = 0.1
    file.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match=r"12 of its 12 cameras(?s:.)*polynomial"):
        read(tmp_path, "opf")


@pytest.mark.parametrize(
    ("bands", "used", "said"),
    [
        ((["Red", "Green", "Blue"], ["LWIR"]), 8, "4 cameras show other bands (LWIR) than the rest"),
        ((None, ["Red edge"]), 8, "4 cameras show other bands (Red edge)"),
        ((["NIR"], ["Red"]), 8, "4 cameras show other bands (Red)"),
        ((["LWIR"], ["LWIR"]), 12, ""),
        ((["R", "G", "B"], None), 12, ""),
    ],
)
def test_cameras_of_opf_of_other_bands_are_named_and_left_out(tmp_path, flight, bands, used, said):
    """Eight photographs of one sensor, four of another, whose lens is none that is read."""
    writers.write_opf(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    sensors, calibrated = tmp_path / "input-cameras.json", tmp_path / "calibrated-cameras.json"
    content, cameras = json.loads(sensors.read_text()), json.loads(calibrated.read_text())
    for number, shown in zip((77, 88), bands, strict=True):
        named = {} if shown is None else {"bands": [{"name": name, "weight": 1.0} for name in shown]}
        content["sensors"].append({**content["sensors"][0], "id": number, **named})
    internals = cameras["sensors"][0]["internals"]
    cameras["sensors"].append({"id": 88, "internals": {**internals, "type": "spherical" if said else "perspective"}})
    for camera in cameras["cameras"][8:]:
        camera["sensor_id"] = 88
    sensors.write_text(json.dumps(content))
    calibrated.write_text(json.dumps(cameras))
    source = read(tmp_path, "opf")
    assert [view.name for view in source.views] == flight.names[:used]
    assert [note.startswith(said) for note in source.warnings] == ([True] if said else [])


def test_opf_of_a_site_is_metres_without_a_place(tmp_path: Path, flight: KnownFlight) -> None:
    writers.write_opf(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    frame = tmp_path / "scene-reference-frame.json"
    content = json.loads(frame.read_text())
    content["crs"]["definition"] = "Site grid 7"
    frame.write_text(json.dumps(content))
    assert any("'Site grid 7' is not known" in each for each in read(tmp_path, "opf").warnings)
    content["crs"]["definition"] = (
        'ENGINEERINGCRS["Site",ENGINEERINGDATUM["Corner"],CS[Cartesian,3],LENGTHUNIT["metre",1.0]]'
    )
    frame.write_text(json.dumps(content))
    source = read(tmp_path, "opf")
    assert source.georef is not None
    assert source.georef.origin is None
    source = read_source(tmp_path, CaptureOptions(format="opf"), needs_points=False)
    apart = np.linalg.norm(np.diff(centers_of(poses_of(source, flight)), axis=0), axis=1)
    true = np.linalg.norm(np.diff(flight.centers, axis=0), axis=1)
    assert np.abs(apart / true - 1).max() < 1e-3  # UTM's scale


def test_opf_without_calibration_and_with_missing_files_says_so(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_opf(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    content = json.loads(file.read_text())
    (tmp_path / "point_cloud" / "positions.bin").write_bytes(b"short")
    with pytest.raises(CaptureError, match=r"positions\.bin: has 5 bytes"):
        read(tmp_path, "opf")
    (tmp_path / "point_cloud" / "positions.bin").unlink()
    with pytest.raises(CaptureError, match=r"positions\.bin"):
        read(tmp_path, "opf")
    content["items"] = [item for item in content["items"] if item["type"] != "calibration"]
    file.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="not calibrated"):
        read(tmp_path, "opf")


@pytest.mark.parametrize(("component", "dtype", "most"), [(5121, "u1", 255), (5123, "<u2", 65535), (5126, "<f4", 1.0)])
def test_colors_of_points_are_the_same_in_every_kind_of_number(tmp_path: Path, component: int, dtype: str, most: float):
    """Of glTF all run from black, 0, to white: the largest integer, or 1."""
    levels = np.array([[0, 1, 127], [128, 254, 255]])
    scaled = levels * (most / 255)
    buffers = {"places": np.zeros((2, 3), "<f4"), "colors": (scaled if most == 1 else np.rint(scaled)).astype(dtype)}
    for name, values in buffers.items():
        (tmp_path / f"{name}.bin").write_bytes(values.tobytes())
    content = {
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}}]}],
        "accessors": [{"bufferView": k, "componentType": kind, "count": 2, "type": "VEC3"}
                      for k, kind in enumerate((5126, component))],
        "bufferViews": [{"buffer": k} for k in range(2)], "buffers": [{"uri": f"{name}.bin"} for name in buffers],
    }  # fmt: skip
    (tmp_path / "points.gltf").write_text(json.dumps(content))
    np.testing.assert_array_equal(read_gltf_points(tmp_path / "points.gltf").colors, levels)


def test_points_whose_sightings_begin_beyond_four_bytes_say_so(tmp_path: Path, flight: KnownFlight) -> None:
    """A beginning has five bytes, of which the last is no part of the length."""
    writers.write_opf(tmp_path, flight)
    ranges = tmp_path / "point_cloud" / "ranges.bin"
    held = bytearray(ranges.read_bytes())
    held[4] = 1
    ranges.write_bytes(held)
    with pytest.raises(CaptureError, match="is no point cloud of OPF"):
        read_gltf_points(tmp_path / "point_cloud" / "sparse.gltf")
