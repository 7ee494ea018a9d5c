"""Positions that cannot be those of one flight: metres of a local system read as degrees, and worlds as large."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.captures import tiny_scene, write_colmap
from vdgs.captures.flight_extent import why_no_flight, why_no_scene
from vdgs.captures.georeference import match_gps
from vdgs.captures.gps_columns import HoldsPoses
from vdgs.captures.loading import load_capture
from vdgs.captures.tables_beside import position_tables
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import geodetic_from_enu

NAMES = [f"{1700000000 + k}.png" for k in range(30)]


def strips(across_m: float, step_m: float, height_m: float, count: int = 30) -> np.ndarray:
    """Places [count, 3] in metres of strips flown back and forth."""
    k = np.arange(count)
    lanes = max(int(across_m / step_m), 1)
    x, lane = k % lanes, k // lanes
    return np.column_stack([(x - lanes / 2) * step_m, (lane - count / lanes / 2) * step_m, np.full(count, height_m)])


def at(places: np.ndarray, latitude: float = 47.0, longitude: float = 8.0) -> np.ndarray:
    return geodetic_from_enu(places, (latitude, longitude, 0.0))


FLIGHTS = {
    "drone": at(strips(60, 10, 120)),
    "few": at(strips(60, 10, 120, 3)),
    "copter at the pole": at(strips(60, 10, 120), 89.9, -179.9),
    "date line": at(strips(60, 10, 120), -17.0, 180.0),
    "power line": at(strips(200_000, 100, 120, 2000)),
    "sparse corridor": at(strips(200_000, 1200, 120, 160)),
    "manned aircraft": at(strips(40_000, 5_000, 10_000)),
    "manned aircraft, altitudes unknown": at(strips(40_000, 5_000, 0)) * [1, 1, 0],
    "sites": np.vstack([at(strips(60, 10, 120)), at(strips(60, 10, 120), 51.0, 0.1), at(strips(60, 10, 120), 40, -70)]),
    "strays": np.vstack([at(strips(60, 10, 120)), [[-33, 151, 20], [1, 2, 3], [0, 0, 0]]]),
    "no satellites": np.vstack([at(strips(60, 10, 120)), np.zeros((200, 3))]),
    "in radians": np.radians(at(strips(60, 10, 120))),
    "one place": np.tile([[47.0, 8.0, 500.0]], (9, 1)),
    "without altitudes": at(strips(60, 10, 120)) * [1, 1, np.nan],
}


@pytest.mark.parametrize("flight", FLIGHTS)
def test_positions_of_flights_are_believed(flight):
    assert not why_no_flight(FLIGHTS[flight])


@pytest.mark.parametrize("far", [0.0, 20.0])
@pytest.mark.parametrize(
    "metres",
    [
        strips(60, 10, 35), strips(8, 1, 2), strips(1, 0.2, 0.7), strips(5, 0.03, 1.5, 900), strips(80, 3, 40, 300),
        strips(60, 10, 0),
    ],
)  # fmt: skip
def test_metres_of_a_local_system_are_no_degrees(metres, far):
    """A flight, a room, a table, a film of a room, and heights that are all 0."""
    assert why_no_flight(metres + np.array([0, far, 0]))


def table_of(folder: Path, rows: np.ndarray, head: str = "", more: str = "") -> Path:
    file = folder / "poses.csv"
    lines = [",".join([name, *(f"{value:.7f}" for value in row)]) + more for name, row in zip(NAMES, rows, strict=True)]
    file.write_text(head + "\n".join(lines) + "\n")
    return file


@pytest.mark.parametrize(
    ("head", "more", "says"),
    [
        ("", "", "no latitudes and longitudes of one flight"),
        ("", ",1,0,0,0", "no latitudes and longitudes of one flight"),
        ("name,lat,lon,alt\n", "", "no latitudes and longitudes of one flight"),
        ("EPSG:4326\n", "", "no latitudes and longitudes of one flight"),
        ("name,x,y,z\n", "", "does not say of which coordinate system"),
        ("name,tx,ty,tz\n", "", "holds positions of a local system"),
        ("local\nname,x,y,z\n", "", "holds positions of a local system"),
        ("ImageFile,POS_X,POS_Y,POS_Z\n", "", "z points down"),
        ("EPSG:32632\nImageFile,POS_X,POS_Y,POS_Z\n", "", "z points down"),
    ],
)
def test_tables_of_local_metres_are_refused_with_the_remedy(tmp_path, head, more, says):
    file = table_of(tmp_path, strips(60, 10, 35), head, more)
    with pytest.raises(CaptureError, match=says) as caught:
        match_gps(NAMES, file)
    assert "transforms.json" in str(caught.value)
    assert "--scale-bar" in str(caught.value)
    assert not [table for table in position_tables([tmp_path], NAMES) if table.photographs]


def test_local_metres_beyond_180_and_beyond_90_are_refused_with_the_remedy(tmp_path):
    for away in (300, 130):
        places = strips(60, 10, 35) + np.array([away, away + 10, 0])
        with pytest.raises(CaptureError, match=r"transforms\.json"):
            match_gps(NAMES, table_of(tmp_path, places))


def test_rows_of_positions_and_quaternions_are_poses_unless_they_are_degrees(tmp_path):
    turns = np.column_stack([np.cos(np.arange(30.0)), np.sin(np.arange(30.0)), np.zeros((30, 2))])
    small = 1e-3 * strips(60, 10, 35)  # of a scale that nobody knows
    for places in (strips(60, 10, 35), small):
        with pytest.raises(HoldsPoses, match="holds poses"):
            match_gps(NAMES, table_of(tmp_path, np.hstack([places, turns])))
    (told,) = position_tables([tmp_path], NAMES, without_system=True)
    assert (told.photographs, bool(told.problem)) == (0, True)
    degrees = np.hstack([at(strips(60, 10, 120)), turns])
    assert len(match_gps(NAMES, table_of(tmp_path, degrees)).images) == len(NAMES)


def test_a_table_of_many_sites_serves_the_photographs_of_one(tmp_path):
    file = table_of(tmp_path, at(strips(60, 10, 120)), "name,lat,lon,alt\n")
    others = "".join(f"other{k}.png,{-40 + 3 * k},{10 + 5 * k},100\n" for k in range(25))
    file.write_text(file.read_text() + others)
    assert len(match_gps(NAMES, file).images) == len(NAMES)


def test_a_capture_that_a_table_makes_as_high_as_no_camera_flies_is_refused(tmp_path):
    scene = tiny_scene()
    write_colmap(tmp_path, scene)
    poses = [camera.camera_from_world for camera in scene.cameras.values()]
    centers = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    step = 19_000 / np.linalg.norm(centers[1] - centers[0])
    rows = at((centers - centers.mean(axis=0)) * [step, step, 0])
    table = "".join(f"{name},{lat:.9f},{lon:.9f}\n" for name, (lat, lon, _) in zip(scene.cameras, rows, strict=True))
    (tmp_path / "gps.csv").write_text("name,lat,lon\n" + table)
    with pytest.raises(CaptureError, match=r"gps\.csv: placed by it, the cameras would .* km"):
        load_capture(tmp_path, CaptureOptions(gps=tmp_path / "gps.csv"))


def test_cameras_as_high_and_as_wide_as_no_scene():
    assert not why_no_scene(strips(200_000, 100, 12_000, 2000), 500.0)
    assert why_no_scene(strips(60, 10, 77_278), 0.0) == "the cameras would be 77 km over the ground"
    assert "under" in why_no_scene(strips(60, 10, -77_278), 0.0)
    assert "5,000 km" in why_no_scene(strips(60, 10, 120) * [1e5, 1, 1], 0.0)


def test_few_positions_of_a_long_flight_are_no_steps_from_one_photograph_to_the_next():
    line = np.column_stack([48 + np.arange(3) * 5 / 111, np.full(3, 11.0), np.full(3, 100.0)])
    assert "km from one to the next" in why_no_flight(line)
    assert not why_no_flight(line, 200)
    assert not why_no_flight(np.vstack([line, np.full((197, 3), np.nan)]))


def test_a_camera_that_was_placed_badly_makes_no_scene_too_wide():
    cameras = strips(60, 10, 120, 60)
    cameras[7] = 2e6, 0, 9e5
    assert not why_no_scene(cameras, 0.0)
