"""The ground frame: z up, whatever world the capture came in, and exactly invertible."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from support.captures import data_folder, moved, tiny_scene, to_source, write_colmap
from vdgs.captures.formats.source_capture import Intrinsics, SourceCapture, SourceView
from vdgs.captures.georeference import LOCAL_FRAME
from vdgs.captures.ground_estimation import NOMINAL_CAMERA_HEIGHT, find_ground_frame, transform_pose
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.export.local_frame import default_crs, make_local_frame
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_from_geodetic, geodetic_from_ecef, geodetic_from_enu
from vdgs.geometry.map_projection import MapProjection
from vdgs.geometry.similarity import fit_similarity, fit_similarity_robust, geometric_median, rotation_to_z

pytestmark = pytest.mark.slow

ORIGIN = (46.8426, -91.994, 159.4)


def random_rotation(generator: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(generator.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def source_of(scene) -> SourceCapture:
    views = tuple(
        SourceView(
            name=name,
            camera_from_world=camera.camera_from_world,
            intrinsics=Intrinsics("PINHOLE", (50.0, 50.0, 32.0, 24.0), 64, 48),
        )
        for name, camera in scene.cameras.items()
    )
    return SourceCapture(source="colmap", images="images", views=views, points=scene.points, colors=scene.colors)


def ground_of(scene, tmp_path, **options):
    return find_ground_frame(source_of(scene), tmp_path, CaptureOptions(**options))


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100))
def test_a_rigid_motion_and_scaling_of_the_world_changes_only_the_yaw(tmp_path_factory, seed, scale):
    scene = tiny_scene(seed=seed % 7)
    folder = tmp_path_factory.mktemp("ground")
    generator = np.random.default_rng(seed)
    other = moved(scene, scale, random_rotation(generator), generator.normal(size=3) * 100)
    first, second = ground_of(scene, folder)[0], ground_of(other, folder)[0]
    a, b = first.to_ground(scene.points), second.to_ground(other.points)
    np.testing.assert_allclose(a[:, 2], b[:, 2], atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1), atol=1e-6)
    turn = fit_similarity(a, b)
    np.testing.assert_allclose(turn.rotation[2], [0, 0, 1], atol=1e-7)
    assert turn.scale == pytest.approx(1, abs=1e-9)


def test_up_that_the_reconstruction_of_a_capture_tells_is_not_estimated(tmp_path):
    """Level at a wall looks like straight down on ground; attitudes told it when the capture was made."""
    scene = moved(tiny_scene(), 0.3, Rotation.from_euler("x", 90, degrees=True).as_matrix(), np.zeros(3))
    assert ground_of(scene, tmp_path)[0].rotation[2, 2] < 0.1
    (tmp_path / "reconstruction.json").write_text(json.dumps({"up": "the recorded attitudes"}))
    frame, _ = ground_of(scene, tmp_path)
    assert frame.rotation == pytest.approx(np.eye(3))
    assert "up by the recorded attitudes" in frame.description
    assert not frame.metric
    assert ground_of(scene, tmp_path, up="y")[0].rotation[2] == pytest.approx([0, 1, 0])


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_the_estimated_up_axis_is_up(tmp_path_factory, seed):
    """The generated world has z up; so has the ground frame, whichever way the input was turned."""
    generator = np.random.default_rng(seed)
    rotation = random_rotation(generator)
    scene = moved(tiny_scene(), 0.3, rotation, np.array([5.0, -3.0, 2.0]))
    frame, warnings = ground_of(scene, tmp_path_factory.mktemp("ground"))
    assert (frame.rotation @ rotation)[2, 2] > np.cos(np.radians(3))
    assert not warnings
    heights = [frame.to_ground(camera.position[None])[0, 2] for camera in scene.cameras.values()]
    assert np.median(heights) == pytest.approx(NOMINAL_CAMERA_HEIGHT)
    assert np.median(frame.to_ground(scene.points)[:, 2]) == pytest.approx(0, abs=1e-9)
    assert not frame.metric


def test_the_frame_is_exactly_invertible_and_keeps_projections(tmp_path):
    scene = moved(tiny_scene(), 250.0, random_rotation(np.random.default_rng(3)), np.array([5e5, 5e6, 300.0]))
    frame, _ = ground_of(scene, tmp_path)
    np.testing.assert_allclose(to_source(frame, frame.to_ground(scene.points)), scene.points, atol=1e-8)
    for camera in scene.cameras.values():
        pose = transform_pose(camera.camera_from_world, frame)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-14)
        local = frame.to_ground(scene.points) @ pose[:3, :3].T + pose[:3, 3]
        before, depth = camera.project(scene.points)
        after = local[:, :2] / local[:, 2:] * camera.fx + [camera.cx, camera.cy]
        front = depth > 1
        np.testing.assert_allclose(after[front], before[front], atol=1e-5)
        np.testing.assert_allclose(local[:, 2], depth * frame.scale, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("up", "vector"), [("x", [1, 0, 0]), ("-y", [0, -1, 0]), ("z", [0, 0, 1]), ("-z", [0, 0, -1])])
def test_up_can_be_said_outright(tmp_path, up, vector):
    frame, _ = ground_of(tiny_scene(), tmp_path, up=up)
    np.testing.assert_allclose(frame.rotation @ vector, [0, 0, 1], atol=1e-12)
    assert np.linalg.det(frame.rotation) == pytest.approx(1)


def test_up_contradicts_a_georeference_that_is_asked_for(tmp_path):
    with pytest.raises(CaptureError, match="--up contradicts"):
        ground_of(tiny_scene(), tmp_path, up="z", gps=tmp_path / "gps.csv")
    with pytest.raises(CaptureError, match="give one"):
        ground_of(tiny_scene(), tmp_path, georef=tmp_path / "georef.json", gps=tmp_path / "gps.csv")


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 1e-3))
@example([0.0, 1e-05, -1.0])
@example([0.0, 1e-6, -1.0])
@example([1e-8, 0.0, -1.0])
@example([0.0, 0.0, -1.0])
@example([1e-170, 0.0, -1.0])
def test_the_smallest_rotation_to_z(vector):
    unit = np.array(vector) / np.linalg.norm(vector)
    rotation = rotation_to_z(unit)
    np.testing.assert_allclose(rotation @ unit, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.trace(rotation) == pytest.approx(1 + 2 * unit[2], abs=1e-12)  # by the angle to z and no more


# ------------------------------------------------------------------------------------- georeferences


def write_gps(file, scene, origin=ORIGIN, noise=0.0, wrong=()):
    generator = np.random.default_rng(1)
    rows = ["name,model,lat,lon,alt"]
    for index, (name, camera) in enumerate(scene.cameras.items()):
        enu = camera.position + generator.normal(0, noise, 3) + (np.array([400.0, 90, 30]) if index in wrong else 0)
        lat, lon, alt = geodetic_from_enu(enu[None], origin)[0]
        rows.append(f"{name.upper().replace('.PNG', '.JPG')},X,{lat!r},{lon!r},{alt!r}")
    file.write_text("\n".join(rows).replace("np.float64(", "").replace(")", ""), encoding="utf-8")
    return file


def at_several_heights():
    """The scene with each camera up to 8 m higher or lower."""
    scene = tiny_scene()
    for k, (name, camera) in enumerate(scene.cameras.items()):
        pose = camera.camera_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ np.array([0.0, 0.0, 4.0 * (k % 5 - 2)])
        scene.cameras[name] = replace(camera, camera_from_world=pose)
    return scene


@pytest.mark.parametrize("wrong", [(), (2, 7)])
def test_gps_gives_meters_and_east_north_up(tmp_path, wrong):
    """Names match across extensions and case; positions that are wrong by 400 m are left out."""
    truth = tiny_scene()
    gps = write_gps(tmp_path / "gps.csv", truth, wrong=wrong)
    rotation = random_rotation(np.random.default_rng(5))
    world = moved(truth, 0.013, rotation, np.array([1.0, 2, 3]))
    frame, warnings = ground_of(world, tmp_path, gps=gps)
    assert frame.metric
    assert len(warnings) == bool(wrong)
    back = frame.to_ground(world.points)
    offset = truth.points - back
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-4)
    assert np.median(back[:, 2]) == pytest.approx(0, abs=1e-9)
    assert frame.origin_geo is not None
    np.testing.assert_allclose(enu_from_geodetic(np.array([frame.origin_geo]), ORIGIN)[0], offset[0], atol=1e-4)


def test_what_a_table_leaves_in_doubt_counts_in_the_place(tmp_path):
    """An ellipsoid alone names no datum."""
    truth = at_several_heights()
    gps = write_gps(tmp_path / "gps.csv", truth, noise=0.02)
    sure, warnings = ground_of(truth, tmp_path, gps=gps)
    assert not warnings
    assert "place ±0.0" in sure.accuracy
    gps.write_text("+proj=longlat +ellps=bessel +no_defs\n" + gps.read_text())
    doubtful, warnings = ground_of(truth, tmp_path, gps=gps)
    assert "no datum: taken as WGS 84" in "".join(warnings)
    assert "place ±300 m" in doubtful.accuracy


def test_gps_without_altitudes_places_in_the_plane(tmp_path):
    truth = tiny_scene()
    rows = [line.rpartition(",")[0] for line in write_gps(tmp_path / "gps.csv", truth).read_text().splitlines()]
    (tmp_path / "gps.csv").write_text("\n".join(rows))
    world = moved(truth, 0.013, Rotation.from_rotvec([0.3, -2, 1]).as_matrix(), np.array([1.0, 2, 3]))
    frame, warnings = ground_of(world, tmp_path, gps=tmp_path / "gps.csv")
    assert frame.metric
    assert frame.scale == pytest.approx(1 / 0.013, rel=0.05)
    assert frame.origin_geo == pytest.approx((*ORIGIN[:2], 0), abs=1e-4)
    assert any("has no altitudes" in warning for warning in warnings)
    offset = truth.points - frame.to_ground(world.points)
    assert np.ptp(offset, axis=0).max() < 1  # turned by less than what the views are off by


def test_altitudes_drift_in_the_order_of_the_photographs_numbers(tmp_path):
    """Captures list photographs by the letters of their names, frame_10 before frame_2: that says nothing of time."""
    cameras = list(tiny_scene(columns=8, rows=5).cameras.values())
    found = []
    for of in ("frame_{}.png", "frame_{:03d}.png"):
        named = {of.format(k + 1): camera for k, camera in enumerate(cameras)}
        drift = dict(zip(named, np.linspace(0, 30, len(named)).tolist(), strict=True))
        scene = replace(tiny_scene(), cameras=named)
        header, *rows = write_gps(tmp_path / "gps.csv", scene, noise=0.02).read_text().splitlines()
        cells = [row.split(",") for row in rows]
        raised = [",".join([*c[:-1], repr(float(c[-1]) + drift[c[0].lower().replace("jpg", "png")])]) for c in cells]
        (tmp_path / "gps.csv").write_text("\n".join([header, *raised]))
        listed = replace(scene, cameras=dict(sorted(named.items())))
        frame, warnings = ground_of(listed, tmp_path, gps=tmp_path / "gps.csv")
        assert any("drift" in warning for warning in warnings)
        assert np.degrees(np.arccos(frame.rotation[2, 2])) < 3
        found.append(frame.accuracy)
    assert found[0] == found[1]


@pytest.mark.parametrize("altitudes", [True, False])
def test_positions_of_a_receiver_without_satellites_are_left_out(tmp_path, altitudes):
    """Also where they are most of all: 0, 0, 0 in a table."""
    truth = at_several_heights()
    header, *rows = write_gps(tmp_path / "gps.csv", truth, noise=0.02).read_text().splitlines()
    cells = [row.split(",") for row in rows]
    lost = len(cells) // 2 + 1
    cells = [[*c[:2], "0", "0", "0"] if 1 < k <= 1 + lost else c for k, c in enumerate(cells)]
    keep = slice(None) if altitudes else slice(4)
    (tmp_path / "gps.csv").write_text("\n".join(",".join(c[keep]) for c in [header.split(","), *cells]))
    frame, warnings = ground_of(truth, tmp_path, gps=tmp_path / "gps.csv")
    assert frame.origin_geo[:2] == pytest.approx(ORIGIN[:2], abs=1e-3)
    assert frame.scale == pytest.approx(1, abs=0.05)
    assert any("the position is 0, 0" in warning for warning in warnings)
    (tmp_path / "gps.csv").write_text("\n".join([header, *(",".join([*c[:2], "0", "0", "0"]) for c in cells)]))
    frame, warnings = ground_of(truth, tmp_path, gps=tmp_path / "gps.csv")
    assert not frame.metric
    assert any("the position is 0, 0" in warning for warning in warnings)


def test_positions_that_do_not_spread_tell_no_scale(tmp_path):
    truth = at_several_heights()
    header, *rows = write_gps(tmp_path / "gps.csv", truth).read_text().splitlines()
    same = [",".join([*row.split(",")[:2], "47.1", "8.1", str(500 + k % 2)]) for k, row in enumerate(rows)]
    (tmp_path / "gps.csv").write_text("\n".join([header, *same]))
    frame, warnings = ground_of(truth, tmp_path, gps=tmp_path / "gps.csv")
    assert not frame.metric
    assert any("within 2 m of each other" in warning for warning in warnings)


def table_of(file, scene, altitude_of):
    """A table of the cameras' positions, with altitudes that are a function of the true ones."""
    header, *rows = write_gps(file, scene).read_text(encoding="utf-8").splitlines()
    cells = [row.split(",") for row in rows]
    file.write_text("\n".join([header, *(",".join([*c[:-1], repr(altitude_of(float(c[-1])))]) for c in cells)]))
    return file


@pytest.mark.parametrize("altitude", [0.0, 120.0])
def test_altitudes_that_are_one_number_say_nothing_of_heights(tmp_path, altitude):
    truth = at_several_heights()
    gps = table_of(tmp_path / "gps.csv", truth, lambda true: altitude)
    frame, warnings = ground_of(truth, tmp_path, gps=gps)
    assert frame.metric
    assert frame.origin_geo[2] == 0
    assert "up" not in frame.accuracy
    assert any("heights count from the median point" in warning for warning in warnings)


@pytest.mark.parametrize(("factor", "unit"), [(1 / 0.3048, "feet"), (0.3048, "metres")])
def test_altitudes_in_feet_are_told_by_the_cameras(tmp_path, factor, unit):
    truth = at_several_heights()
    gps = table_of(tmp_path / "gps.csv", truth, lambda true: factor * true)
    with pytest.raises(CaptureError, match=rf"gps\.csv: its altitudes are in {unit}"):
        ground_of(truth, tmp_path, gps=gps)


def test_moments_of_a_drone_place_a_finished_capture(tmp_path):
    truth = tiny_scene()
    geodetic = geodetic_from_enu(np.array([camera.position for camera in truth.cameras.values()]), ORIGIN)
    line = "{}\t280.1\t[2145]\t 12,N\t 34,E\t -20,V\t{:.9f},Lat\t{:.9f},Lon\t{:.3f},Ellh\t0.01, 0.02, 0.03\t50,Q"
    (tmp_path / "a.MRK").write_text("\n".join(line.format(k, *row) for k, row in enumerate(geodetic.tolist(), 1)))
    renamed = replace(truth, cameras={f"DJI_{k:04d}.png": c for k, c in enumerate(truth.cameras.values(), 1)})
    frame, warnings = ground_of(renamed, tmp_path, gps=tmp_path / "a.MRK")
    assert (frame.metric, warnings) == (True, [])
    assert frame.scale == pytest.approx(1, rel=1e-3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("name,lat,lon\na,1,2\n", "none of its 1 rows"),
        ("name,x,y,alt\na,351400,6292300,2\n", "does not say of which coordinate system"),
        ("a,b,c\n1,x,3\n", "columns name,lat,lon,alt"),
        ("", "is empty"),
        ("name,lat,lon,alt\n", "names its columns but holds no rows"),
        ("name,lat,lon,alt\nother,1,2,3\n", "none of its 1 rows"),
        ("name,lat,lon,alt\nframe_000,x,2,3\n", "not numbers"),
        ("name,lat,lon,alt\nframe_000,91,2,3\n", "no place on Earth"),
        ("name,lat,lon,alt\nframe_000,nan,2,3\n", "none of its 1 rows has a position"),
    ],
)
def test_bad_gps_tables_are_named(tmp_path, content, message):
    file = tmp_path / "gps.csv"
    file.write_text(content)
    with pytest.raises(CaptureError, match=message):
        ground_of(tiny_scene(), tmp_path, gps=file)


def georef(file, **changes):
    content = {
        "frame": "ENU, metres",
        "origin_lat_deg": ORIGIN[0],
        "origin_lon_deg": ORIGIN[1],
        "origin_alt_m": ORIGIN[2],
    }
    file.write_text(json.dumps(content | changes), encoding="utf-8")


def test_a_georeferenced_world_keeps_its_axes_and_meters(tmp_path):
    georef(tmp_path / "georef.json")
    frame, _ = ground_of(tiny_scene(), tmp_path)
    np.testing.assert_array_equal(frame.rotation, np.eye(3))
    np.testing.assert_array_equal(frame.translation, 0)
    assert (frame.scale, frame.metric, frame.origin_geo) == (1.0, True, ORIGIN)


def test_a_georeference_that_contradicts_the_cameras_is_a_warning(tmp_path):
    georef(tmp_path / "georef.json")
    sideways = moved(tiny_scene(), 1.0, np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.zeros(3))
    _, warnings = ground_of(sideways, tmp_path)
    assert any("90 degrees away" in warning for warning in warnings)


@pytest.mark.parametrize("near", [True, False])
def test_a_far_origin_is_moved_so_that_float32_is_safe(tmp_path, near):
    """Coordinates of UTM are no ENU about any origin: metres hold, a place on Earth would be made up."""
    georef(tmp_path / "georef.json")
    shift = np.array([4_321.4, -5_187.7, 20.0]) if near else np.array([432_100.4, -5_187_300.7, 20.0])
    scene = moved(tiny_scene(), 1.0, np.eye(3), shift)
    frame, warnings = ground_of(scene, tmp_path)
    ground = frame.to_ground(scene.points)
    assert np.abs(ground).max() < 100
    np.testing.assert_allclose(ground.astype(np.float32), ground, atol=1e-5)
    np.testing.assert_allclose(to_source(frame, ground), scene.points, rtol=1e-15)
    assert (frame.origin_geo is not None) == near
    assert any("projected coordinates (UTM)" in warning for warning in warnings) == (not near)


def test_the_grid_of_a_site_is_moved_for_float32_and_given_back(tmp_path):
    """Metres without a place on Earth: maps and files stand where the site's own coordinates say."""
    (tmp_path / "georef.json").write_text(json.dumps({"frame": LOCAL_FRAME}))
    frame, warnings = ground_of(tiny_scene(), tmp_path)
    assert MapProjection.of(frame).crs == "local"
    scene = moved(tiny_scene(), 1.0, np.eye(3), np.array([512_345.4, 5_678_901.7, 20.0]))
    frame, warnings = ground_of(scene, tmp_path)
    assert not warnings
    assert frame.origin_geo is None
    assert frame.metric
    ground = frame.to_ground(scene.points)
    assert np.abs(ground).max() < 100
    np.testing.assert_allclose(MapProjection.of(frame).project(ground), scene.points, rtol=1e-15)
    for name in ("a.ply", "a.laz", "a.spz"):
        local = make_local_frame(frame, default_crs(frame, Path(name)), np.median(ground, axis=0))
        np.testing.assert_allclose(local.apply(ground) + local.facts.origin, scene.points, atol=1e-6)
        assert np.abs(local.apply(ground)).max() < 1000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame": "EPSG:32615"}, "no ENU frame"),
        ({"origin_lat_deg": "north"}, "must give numbers"),
        ({"origin_lat_deg": 200}, "no place"),
    ],
)
def test_bad_georeferences_are_named(tmp_path, changes, message):
    georef(tmp_path / "georef.json", **changes)
    with pytest.raises(CaptureError, match=message):
        ground_of(tiny_scene(), tmp_path)


# ------------------------------------------------------------------------------------------ numerics


@given(
    st.floats(-89.9, 89.9),
    st.floats(-179.9, 179.9),
    st.floats(-400, 9000),
    st.tuples(*[st.floats(-5e4, 5e4)] * 3),
)
def test_geodesy_is_invertible(latitude, longitude, altitude, enu):
    place = np.array([[latitude, longitude, altitude]])
    np.testing.assert_allclose(geodetic_from_ecef(ecef_from_geodetic(place)), place, atol=1e-6, rtol=1e-11)
    origin = (latitude, longitude, altitude)
    there = geodetic_from_enu(np.array([enu]), origin)
    np.testing.assert_allclose(enu_from_geodetic(there, origin)[0], enu, atol=1e-6)


def test_geodesy_agrees_with_pycolmap():
    import pycolmap

    places = np.array([[46.84, -91.99, 159.0], [-33.9, 18.4, 12.0], [78.2, 15.6, 400.0]])
    transform = (
        pycolmap.GPSTransform(pycolmap.GPSTransfromEllipsoid.WGS84)
        if hasattr(pycolmap, "GPSTransfromEllipsoid")
        else pycolmap.GPSTransform()
    )
    np.testing.assert_allclose(np.asarray(transform.ellipsoid_to_ecef(places)), ecef_from_geodetic(places), atol=1e-5)


def test_a_similarity_survives_gross_outliers():
    generator = np.random.default_rng(0)
    source = generator.normal(size=(40, 3))
    rotation = random_rotation(generator)
    target = 3.0 * source @ rotation.T + [1.0, 2.0, 3.0]
    target[:12] += generator.normal(0, 50, (12, 3))
    similarity, inliers = fit_similarity_robust(source, target)
    assert not inliers[:12].any()
    np.testing.assert_allclose(similarity.apply(source[12:]), target[12:], atol=1e-9)


@pytest.mark.parametrize("count", [6, 7, 8])
@pytest.mark.parametrize(("wrong", "up"), [(0, 0.06), (1, 0.06), (0, 0.12)])
def test_of_few_points_a_similarity_leaves_out_wrong_ones_and_hardly_ever_good_ones(count, wrong, up):
    """Heights may be far worse than places: a model may be bent."""
    generator = np.random.default_rng(count)
    surveys, lost, found = 60, 0, 0
    for _ in range(surveys):
        target = generator.uniform(-100, 100, (count, 3)) * [1, 1, 0.05]
        source = target + generator.normal(size=(count, 3)) * [0.03, 0.03, up]
        source[:wrong] += [2.0, -1.0, 1.0]
        _, inliers = fit_similarity_robust(source, target)
        found += not inliers[:wrong].any()
        lost += not inliers[wrong:].all()
    assert lost <= 0.05 * surveys
    assert found >= 0.9 * surveys


def test_the_geometric_median_turns_with_its_points():
    generator = np.random.default_rng(2)
    points = generator.exponential(size=(500, 3))
    rotation = random_rotation(generator)
    np.testing.assert_allclose(
        geometric_median(points @ rotation.T + 5), rotation @ geometric_median(points) + 5, atol=1e-8
    )


@pytest.mark.capture
@pytest.mark.parametrize(("name", "degrees"), [("brighton", 2.0), ("copr", 5.0), ("seneca", 1.0)])
def test_on_real_flights_the_estimate_agrees_with_the_georeference(name, degrees):
    """The real captures are in ENU; the estimate, told nothing, must find z (nadir flights included)."""
    folder = data_folder(name, "images_4", "georef.json")
    capture = load_capture(folder, CaptureOptions(images="images_4"))
    assert capture.ground.metric
    source = SourceCapture(
        source="colmap",
        images="images_4",
        views=tuple(
            SourceView(
                name=v.name,
                camera_from_world=v.camera.camera_from_world,
                intrinsics=Intrinsics("PINHOLE", (1.0,) * 4, 1, 1),
            )
            for v in capture.views
        ),
        points=capture.points,
        colors=capture.point_colors,
    )
    frame, _ = find_ground_frame(source, folder / "sparse", CaptureOptions())
    assert np.degrees(np.arccos(frame.rotation[2, 2])) < degrees


@pytest.mark.capture
def test_real_gps_agrees_with_the_georeference():
    folder = data_folder("seneca", "images_4", "georef.json", "gps.csv")
    capture = load_capture(folder, CaptureOptions(images="images_4"))
    by_gps = load_capture(folder, CaptureOptions(images="images_4", gps=folder / "gps.csv"))
    assert by_gps.ground.scale == pytest.approx(1, abs=1e-3)
    # georef.json comes of the same positions, which are good to some metres, by another fit: the two may lean against
    # each other by no more than the height error that the frame itself states makes at the edge of the flight.
    (stated,) = re.findall(r"±([\d.]+) m up", by_gps.ground.description)
    centers = np.array([view.camera.position for view in by_gps.views])
    edge = np.linalg.norm(centers[:, :2] - np.median(centers[:, :2], axis=0), axis=1).max()
    lean = np.arccos(by_gps.ground.rotation[2, 2])
    assert np.degrees(lean) < 0.5
    assert edge * np.sin(lean) < float(stated)
    assert by_gps.ground.origin_geo is not None
    assert capture.ground.origin_geo is not None
    assert by_gps.ground.origin_geo[:2] == pytest.approx(capture.ground.origin_geo[:2], abs=1e-3)


def test_loading_puts_cameras_and_points_into_the_frame(tmp_path):
    truth = tiny_scene()
    world = moved(truth, 2.0, random_rotation(np.random.default_rng(9)), np.array([3.0, 4, 5]))
    write_colmap(tmp_path, world, shown=truth)
    capture = load_capture(tmp_path, CaptureOptions())
    for view in capture.views:
        camera = world.cameras[view.name]
        expected, depth = camera.project(world.points)
        front = depth > 1
        found, _ = view.camera.project(capture.points)
        np.testing.assert_allclose(found[front], expected[front], atol=1e-6)
