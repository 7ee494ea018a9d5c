"""Tables of positions against what the photographs of a finished capture show: mirrored, along a line, over the ground,
in part."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vdgs.captures.formats.source_capture import Intrinsics, SourceCapture, SourceView
from vdgs.captures.ground_estimation import find_ground_frame
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import geodetic_from_enu

ORIGIN = (47.0, 8.0, 300.0)
#: Straight down, the upper side of each photograph to the north.
DOWN = np.diag([1.0, -1, -1])
LENS = Intrinsics("PINHOLE", (100.0, 100.0, 50.0, 50.0), 100, 100)


def flight(rows: int, columns: int, slope_deg: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Camera centers [n, 3] and points [m, 3] of a flight 60 m over ground that rises to the north, all photographs
    straight down with one heading."""
    generator = np.random.default_rng(1)
    x, y = (each.ravel() for each in np.meshgrid(20.0 * np.arange(columns), 20.0 * np.arange(rows)))
    rise = np.tan(np.radians(slope_deg))
    centers = np.column_stack([x, y, 60 + rise * y]) + generator.normal(size=(len(x), 3)) * 0.3
    ground = generator.uniform(-30, 20 * max(rows, columns) + 30, (400, 2))
    return centers, np.column_stack([ground, rise * ground[:, 1] + generator.normal(size=400)])


def capture_of(
    centers: np.ndarray, points: np.ndarray, turned: np.ndarray | None = None, view: np.ndarray | None = None
) -> SourceCapture:
    """In a world that is `turned`; `view` [3, 3] or [n, 3, 3] turns cameras from looking straight down."""
    turned = np.eye(3) if turned is None else turned
    all_looking = np.broadcast_to(DOWN if view is None else view @ DOWN, (len(centers), 3, 3))
    views = []
    for k, (center, looking) in enumerate(zip(centers, all_looking, strict=True)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = looking @ turned.T, -looking @ center
        views.append(SourceView(name=f"{k:03d}.jpg", camera_from_world=pose, intrinsics=LENS))
    colors = np.zeros((len(points), 3), np.uint8)
    return SourceCapture(source="colmap", images="images", views=tuple(views), points=points @ turned.T, colors=colors)


def positions_of(centers: np.ndarray, noise=(0.5, 0.5, 1.0)) -> np.ndarray:
    return geodetic_from_enu(centers + np.random.default_rng(2).normal(size=centers.shape) * noise, ORIGIN)


def write_table(file: Path, geodetic: np.ndarray) -> Path:
    rows = [
        f"{k:03d}.jpg,{a:.9f},{b:.9f},{'' if np.isnan(c) else round(c, 3)}\n" for k, (a, b, c) in enumerate(geodetic)
    ]
    file.write_text("name,lat,lon,alt\n" + "".join(rows))
    return file


def placed(tmp_path, scene, geodetic):
    return find_ground_frame(
        capture_of(*scene), tmp_path, CaptureOptions(gps=write_table(tmp_path / "t.csv", geodetic))
    )


@pytest.mark.parametrize("signs", [(1, -1, 1), (-1, 1, 1), "exchanged"])
def test_a_mirrored_table_is_refused_where_all_photographs_look_one_way(tmp_path, signs):
    """From below a level flight is its own mirror image, and photographs straight down with one heading do not say for
    sure what is up: they are as those of a wall."""
    scene = flight(5, 6)
    right = positions_of(scene[0])
    frame, _ = placed(tmp_path, scene, right)
    assert frame.rotation[2, 2] > 0.99
    wrong = right[:, [1, 0, 2]] if signs == "exchanged" else right * signs
    with pytest.raises(CaptureError, match="mirror image"):
        placed(tmp_path, scene, wrong)


def test_a_world_upside_down_is_told_whatever_else_is_in_doubt(tmp_path):
    """Ground or wall is a doubt of 90 degrees."""
    origin = dict(zip(("origin_lat_deg", "origin_lon_deg", "origin_alt_m"), ORIGIN, strict=True))
    (tmp_path / "georef.json").write_text(json.dumps(origin))
    north_east_down = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    for turned, said in ((np.eye(3), []), (north_east_down, ["up is 180 degrees away"])):
        _, warnings = find_ground_frame(capture_of(*flight(5, 6), turned), tmp_path, CaptureOptions())
        assert [warning[: len("up is 180 degrees away")] for warning in warnings] == said


def test_positions_along_one_line_give_meters_and_say_how_level_is_known(tmp_path):
    scene = flight(1, 20)
    frame, warnings = placed(tmp_path, scene, positions_of(scene[0]))
    assert frame.metric
    assert frame.scale == pytest.approx(1, abs=0.01)
    assert frame.rotation[2, 2] > np.cos(np.radians(10))
    assert "20 photographs along one line" in frame.method
    assert any("what is level across it is by the views" in warning for warning in warnings)
    frame, warnings = placed(tmp_path, scene, positions_of(scene[0])[:2])
    assert not frame.metric
    assert any("2 photographs with GPS tell no scale" in warning for warning in warnings)


def test_photographs_from_one_place_give_no_meters(tmp_path):
    centers, points = flight(1, 20)
    frame, warnings = placed(tmp_path, (np.tile(centers[:1], (20, 1)), points), positions_of(centers))
    assert not frame.metric
    assert any("20 photographs with GPS tell no scale" in warning for warning in warnings)


def test_heights_over_a_slope_are_seen_where_all_photographs_look_one_way(tmp_path):
    """The plane tells the slope better there than the views, which lie between the ground and down."""
    scene = flight(7, 7, slope_deg=20)
    geodetic = positions_of(scene[0], noise=1.0)
    geodetic[:, 2] = 360 + 0.3 * np.sin(np.arange(len(geodetic)))
    frame, warnings = placed(tmp_path, scene, geodetic)
    assert frame.rotation[2, 2] > np.cos(np.radians(4))
    assert any("its altitudes are all about 360" in warning for warning in warnings)


@pytest.mark.parametrize("share", [-0.01, 0.01])
def test_a_stretched_model_is_no_slope(tmp_path, share):
    """Altitudes that are good to centimetres and nearly one for all are those of a level flight."""
    centers, points = flight(10, 10)
    centers[:, 2] = 60 + 0.3 * np.random.default_rng(0).normal(size=len(centers))
    there_and_back = Rotation.from_euler("z", 180.0 * (np.arange(len(centers)) // 10 % 2)[:, None], degrees=True)
    stretched = [1 + share, 1, 1]
    table = write_table(tmp_path / "t.csv", positions_of(centers, noise=0.02))
    seen = capture_of(centers * stretched, points * stretched, view=there_and_back.as_matrix())
    frame, warnings = find_ground_frame(seen, tmp_path, CaptureOptions(gps=table))
    assert frame.rotation[2, 2] > np.cos(np.radians(1))
    assert not any("its altitudes are all about" in warning for warning in warnings)


@pytest.mark.parametrize("pitch_deg", [-50, -65])
@pytest.mark.parametrize("knows_altitudes", [True, False])
def test_a_line_of_oblique_views_is_level_as_its_ground_is(tmp_path, pitch_deg, knows_altitudes):
    """The mean view is far from down there, and positions along a line do not tell by how much it is rolled."""
    centers, points = flight(20, 1)
    geodetic = positions_of(centers, noise=1.0)
    geodetic[:, 2] = geodetic[:, 2] if knows_altitudes else np.nan
    seen = capture_of(centers, points, view=Rotation.from_euler("x", -90 - pitch_deg, degrees=True).as_matrix())
    frame, warnings = find_ground_frame(seen, tmp_path, CaptureOptions(gps=write_table(tmp_path / "t.csv", geodetic)))
    assert frame.metric
    assert frame.scale == pytest.approx(1, abs=0.01)
    assert frame.rotation[2, 2] > np.cos(np.radians(5))
    assert any("what is level across it is by flat ground" in warning for warning in warnings)


def test_rows_that_are_not_used_are_told(tmp_path):
    centers, points = flight(4, 5)
    geodetic = positions_of(centers)
    geodetic[:3, 2] = np.nan
    _, warnings = placed(tmp_path, (centers[:16], points), geodetic)
    assert any("4 rows are of photographs that are not there" in warning for warning in warnings)
    assert any("000.jpg, 001.jpg, 002.jpg: the position has no altitude; not used" in warning for warning in warnings)
    geodetic[:12, 2] = np.nan
    _, warnings = placed(tmp_path, (centers[:16], points), geodetic)
    assert any("most positions have no altitude; those of 4 are not used" in warning for warning in warnings)


def test_the_error_of_a_scale_is_never_said_to_be_zero(tmp_path):
    centers, points = flight(5, 6)
    frame, _ = placed(tmp_path, (centers * [50, 50, 1], points), positions_of(centers * [50, 50, 1], 0.01))
    assert "scale ±0.01%" in frame.accuracy
