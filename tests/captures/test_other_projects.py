"""Projects of OpenSfM, ODM, OpenMVG, Meshroom and Pix4D: a known flight in each, read back to its numbers; and what
holds of all formats, damaged files too. Bundler and VisualSFM alone: test_bundler_visualsfm.py."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest

from support import project_writers as writers
from support.captures import write_ply
from support.known_flight import (
    BentLens,
    EquidistantLens,
    FixedAtOneLens,
    KnownFlight,
    known_flight,
)
from support.project_reading import OPTIONS, check_numbers, check_tie_points, known_points, read
from vdgs.captures.format_dispatch import lacks_points, read_source
from vdgs.captures.formats import las_reader, opensfm
from vdgs.captures.loading import load_capture
from vdgs.captures.project_formats import PROJECTS, read_project
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError


@pytest.fixture
def flight() -> KnownFlight:
    return known_flight()


def test_opensfm_is_read_to_its_numbers(tmp_path: Path, flight: KnownFlight) -> None:
    writers.write_opensfm(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    source = read(tmp_path, "opensfm")
    check_numbers(source, flight)
    assert all(len(view.observations.points) > 20 for view in source.views if view.observations)
    assert sum(view.observations is not None for view in source.views) == len(flight.names)
    assert source.points.shape == flight.points.shape
    assert (source.colors == flight.colors).all()


def test_pixels_of_opensfm_may_be_wider_than_high(tmp_path: Path, flight: KnownFlight) -> None:
    oblong = replace(flight, lens=replace(flight.lens, aspect=1.02))
    writers.write_opensfm(tmp_path, oblong)
    oblong.write_photographs(tmp_path / "images")
    check_numbers(read(tmp_path, "opensfm"), oblong)


@pytest.mark.parametrize("program", ["opensfm", "openmvg", "visualsfm", "pix4d"])
def test_exports_in_utf_16_are_read(tmp_path: Path, flight: KnownFlight, program: str) -> None:
    flight.write_photographs(tmp_path / "images")
    getattr(writers, f"write_{program}")(tmp_path, flight)
    before = read(tmp_path, program)
    texts = [file for file in tmp_path.rglob("*") if file.suffix in (".json", ".nvm", ".txt", ".prj", ".xyz")]
    for file in texts:
        file.write_bytes(file.read_text().encode("utf-16"))
    after = read(tmp_path, program)
    for one, other in zip(before.views, after.views, strict=True):
        assert (one.name, one.camera_from_world.tolist()) == (other.name, other.camera_from_world.tolist())


def test_odm_project_is_read_in_metres_east_and_north(tmp_path: Path, flight: KnownFlight) -> None:
    """ODM writes UTM over reconstruction.json, and keeps what OpenSfM had made of it beside that."""
    project = tmp_path / "project"
    file = writers.write_opensfm(project / "opensfm", flight)
    file.rename(file.with_name("reconstruction.topocentric.json"))
    _write_utm_reconstruction(project, file, flight)
    flight.write_photographs(project / "images")
    check_numbers(read(project, "opensfm"), flight)


def test_odm_project_without_its_topocentric_reconstruction_is_read_in_utm(tmp_path: Path, flight: KnownFlight) -> None:
    """The report tells that the reconstruction was moved."""
    file = writers.write_opensfm(tmp_path / "opensfm", flight)
    writers.write_odm_report(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    _write_utm_reconstruction(tmp_path, file, flight)
    source = read(tmp_path, "opensfm")
    check_numbers(source, flight)
    assert source.georef is not None
    assert "UTM" in source.georef.method


def test_undistorted_folder_of_odm_is_read_in_its_utm(tmp_path: Path, flight: KnownFlight) -> None:
    flight = replace(flight, lens=BentLens(k=(0, 0, 0, 0), p=(0, 0)))
    file = writers.write_opensfm(tmp_path / "opensfm", flight)
    file.rename(file.with_name("reconstruction.topocentric.json"))
    _write_utm_reconstruction(tmp_path, tmp_path / "opensfm" / "undistorted" / "reconstruction.json", flight)
    flight.write_photographs(tmp_path / "opensfm" / "undistorted" / "images")
    check_numbers(read(tmp_path / "opensfm" / "undistorted", "opensfm"), flight)


@pytest.mark.parametrize("in_utm", [True, False])
@pytest.mark.parametrize("told_by", ["shots", "coords"])
def test_gps_tells_whether_an_odm_project_was_moved_to_utm(
    tmp_path: Path, flight: KnownFlight, in_utm: bool, told_by: str
) -> None:
    """Where neither the topocentric reconstruction nor the report is there; GPS is off by metres, one by kilometres."""
    file = writers.write_opensfm(tmp_path / "opensfm", flight)
    flight.write_photographs(tmp_path / "images")
    before = file.read_text()
    _write_utm_reconstruction(tmp_path, file, flight)
    if not in_utm:
        file.write_text(before)
    off = np.random.default_rng(2).normal(0, 3, flight.centers.shape)
    off[0, 2] += 5000.0 if in_utm else -5000.0  # towards the other reading
    if told_by == "shots":
        content = json.loads(file.read_text())
        for shot, place in zip(content[0]["shots"].values(), flight.centers + off, strict=True):
            shot["gps_position"] = place.tolist()
        file.write_text(json.dumps(content))
    else:
        coordinates = tmp_path / "odm_georeferencing" / "coords.txt"
        shift = np.append(np.array(coordinates.read_text().splitlines()[1].split(), float), 0.0)
        gps = writers.utm_flight(flight)[3] - shift + off
        coordinates.write_text(coordinates.read_text() + "".join(f"{x} {y} {z}\n" for x, y, z in gps) + "and words\n")
    source = read(tmp_path, "opensfm")
    check_numbers(source, flight)
    assert not source.warnings


def test_odm_project_that_may_be_in_utm_or_not_is_named(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_opensfm(tmp_path / "opensfm", flight)
    flight.write_photographs(tmp_path / "images")
    _write_utm_reconstruction(tmp_path, file, flight)
    assert any("nothing tells which" in note for note in read(tmp_path, "opensfm").warnings)


def _write_utm_reconstruction(project: Path, file: Path, flight: KnownFlight) -> None:
    code, poses, points, centers = writers.utm_flight(flight)
    offset = np.append(np.floor(centers[:, :2].mean(axis=0)), 0.0)
    moved = np.array(poses)
    moved[:, :3, 3] += np.einsum("nij,j->ni", moved[:, :3, :3], offset)
    file.parent.mkdir(parents=True, exist_ok=True)
    content = writers.opensfm_reconstruction(replace(flight, poses=moved, points=points - offset))
    file.write_text(json.dumps([content]))
    (project / "odm_georeferencing").mkdir()
    (project / "odm_georeferencing" / "coords.txt").write_text(
        f"WGS84 UTM {code[-2:]}S\n{offset[0]:.0f} {offset[1]:.0f}\n"
    )


def test_report_of_odm_is_read_where_its_reconstruction_is_gone(tmp_path: Path, flight: KnownFlight) -> None:
    writers.write_odm_report(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    check_numbers(read(tmp_path, "opensfm"), flight)
    _check_names_of_cameras(tmp_path, flight)
    _check_parts(tmp_path, flight)
    with pytest.raises(CaptureError, match="vdgs sfm"):
        read_project(tmp_path, "opensfm", OPTIONS)
    _check_dense_cloud(tmp_path, flight)
    assert lacks_points(tmp_path / "odm_report" / "shots.geojson", OPTIONS)
    check_numbers(read_source(tmp_path / "odm_report" / "shots.geojson", OPTIONS, needs_points=False), flight)
    (tmp_path / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(CaptureError, match="none of its 12 photographs"):
        lacks_points(tmp_path / "odm_report" / "shots.geojson", OPTIONS)


@pytest.mark.parametrize("zone", [31, 32, 33])
def test_report_of_odm_may_be_in_the_zone_beside_that_of_its_photographs(tmp_path: Path, zone: int) -> None:
    """Of the first photograph, or of the first control point, where a flight crosses a border of zones."""
    lens = {"projection_type": "brown", "width": 400, "height": 300, "focal_x": 0.8, "focal_y": 0.8, "c_x": 0, "c_y": 0}
    (tmp_path / "cameras.json").write_text(json.dumps({"c": lens | dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 0)}))
    change = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{32600 + zone}", always_xy=True)
    shots = []
    for k in range(5):
        place = [(12.0 if zone > 31 else 6.0) + 1e-4 * (k - 1 if zone == 32 else 1 - k), 51.0]
        shot = {"filename": f"{k}.jpg", "camera": "c", "width": 400, "height": 300, "rotation": [3.14159, 0, 0],
                "translation": [*change.transform(*place), 300]}  # fmt: skip
        shots.append({"properties": shot, "geometry": {"coordinates": [*place, 300]}})
    (tmp_path / "odm_report").mkdir()
    file = tmp_path / "odm_report" / "shots.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": shots}))
    project = opensfm.read(file, OPTIONS)
    assert project.place.endswith(f"zone {zone}N")
    assert not project.warnings


def _check_names_of_cameras(project: Path, flight: KnownFlight) -> None:
    """The report calls a camera as OpenSfM does, cameras.json without the prefix; another is as likely by its shape."""
    file, lenses = project / "odm_report" / "shots.geojson", json.loads((project / "cameras.json").read_text())
    [(name, lens)] = lenses.items()
    other = {**lens, "k1": 0.5}
    (project / "cameras.json").write_text(json.dumps({"a": other, name.removeprefix("v2 "): lens}))
    content = json.loads(file.read_text())
    for feature in content["features"]:
        feature["properties"]["camera"] = name
    file.write_text(json.dumps(content))
    check_numbers(read(project, "opensfm"), flight)


def _check_parts(project: Path, flight: KnownFlight) -> None:
    """ODM's divided projects have the lenses beside each part, one camera with another lens in each; put back again."""
    file, whole = project / "cameras.json", (project / "cameras.json").read_text()
    lens = json.loads(whole)["dji fc6310r"]
    for part, content in (("0000", {**lens, "focal_x": 1.01 * lens["focal_x"], "k1": 0.5}), ("0001", lens)):
        (project / f"submodels/submodel_{part}").mkdir(parents=True)
        (project / f"submodels/submodel_{part}/cameras.json").write_text(json.dumps({"dji fc6310r": content}))
    file.unlink()
    check_numbers(read(project, "opensfm"), flight)
    shutil.rmtree(project / "submodels")
    with pytest.raises(CaptureError, match=r"is not above it. Copy it there"):
        read(project, "opensfm")
    file.write_text(whole)


def _check_dense_cloud(project: Path, flight: KnownFlight) -> None:
    """ODM's dense cloud is used where laspy is there, thinned evenly; removed again."""
    laspy = pytest.importorskip("laspy")
    points = writers.utm_flight(flight)[2]
    cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=7))
    cloud.header.scales, cloud.header.offsets = np.full(3, 1e-4), np.floor(points.min(axis=0))
    cloud.x, cloud.y, cloud.z = points.T
    cloud.red, cloud.green, cloud.blue = flight.colors.T.astype(np.uint16) * 256
    (project / "odm_georeferencing").mkdir()
    file = project / "odm_georeferencing" / "odm_georeferenced_model.laz"
    cloud.write(file)
    source = read_project(project, "opensfm", OPTIONS)
    assert source.georef is not None
    assert source.georef.origin is not None
    assert np.abs(source.points - known_points(flight, source.georef.origin)).max() < 1e-3
    assert (source.colors == flight.colors).all()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(las_reader, "MAX_POINTS", 60)
        assert len(read_project(project, "opensfm", OPTIONS).points) == 50
    file.write_bytes(file.read_bytes()[:-300])
    with pytest.raises(CaptureError, match=r"odm_georeferenced_model\.laz"):
        read_project(project, "opensfm", OPTIONS)
    file.unlink()


@pytest.mark.parametrize("nested", [False, True])
def test_openmvg_is_read_to_its_numbers(tmp_path: Path, flight: KnownFlight, nested: bool) -> None:
    file = writers.write_openmvg(tmp_path, flight, nested=nested)
    flight.write_photographs(tmp_path / "images")
    listing = json.loads((tmp_path / "sfm_data.json").read_text())
    for view, center in zip(listing["views"], flight.centers.tolist(), strict=True):  # as SfMInit_ImageListing -P does
        view["value"]["ptr_wrapper"]["data"] |= {"use_pose_center_prior": True, "center": center}
    (tmp_path / "sfm_data.json").write_text(json.dumps(listing, indent=4))
    check_tie_points(read(tmp_path, "openmvg"), replace(flight, colors=np.full_like(flight.colors, 128)))
    file.unlink()
    with pytest.raises(CaptureError, match="not a capture"):
        read_source(tmp_path, OPTIONS)
    with pytest.raises(CaptureError, match="no camera of it has a pose"):
        read_source(tmp_path / "sfm_data.json", OPTIONS)


@pytest.mark.parametrize("version", [(1, 0, 0), (1, 2, 6), (1, 2, 8)])
def test_meshroom_is_read_to_its_numbers(tmp_path: Path, flight: KnownFlight, version: tuple[int, int, int]) -> None:
    writers.write_alicevision(tmp_path, flight, version)
    flight.write_photographs(tmp_path / "images")
    check_tie_points(read(tmp_path, "alicevision"), flight)


@pytest.mark.parametrize(
    ("version", "told"),
    [
        ((1, 2, 0), {"pxFocalLength": ["700", "707"]}),
        ((1, 2, 1), {"pxFocalLength": ["700", "707"]}),
        ((1, 2, 4), {"focalLength": "31.5", "pixelRatio": str(1 / 1.01)}),
        ((1, 2, 5), {"focalLength": "31.5", "pixelRatio": "1.01"}),
    ],
)
def test_each_version_of_meshroom_counts_focal_lengths_and_principal_points_its_own_way(
    tmp_path: Path, flight: KnownFlight, version: tuple[int, int, int], told: dict[str, str | list[str]]
) -> None:
    """Before 1.2.1 the principal point is from the corner, before 1.2.2 the focal length in pixels; `pixelRatio` is
    that of the pixels, before 1.2.5 of the focal lengths."""
    file = writers.write_alicevision(tmp_path, flight, version)
    flight.write_photographs(tmp_path / "images")
    content = json.loads(file.read_text())
    content["intrinsics"][0] |= told
    file.write_text(json.dumps(content))
    lens = read(tmp_path, "alicevision").views[0].intrinsics
    assert lens.focal == pytest.approx((700.0, 707.0))
    assert lens.principal_point == pytest.approx(flight.lens.center)


def test_photographs_of_a_rig_of_meshroom_have_its_pose_and_then_their_cameras(
    tmp_path: Path, flight: KnownFlight
) -> None:
    """Pairs of photographs share a pose; of the last pair the second camera's place in the rig is not known, and of the
    first both are independent."""
    from scipy.spatial.transform import Rotation

    inside = np.eye(4)
    inside[:3, :3] = Rotation.from_euler("yx", (20, 5), degrees=True).as_matrix()
    inside[:3, 3] = -inside[:3, :3] @ (0.3, 0.05, -0.1)
    poses = flight.poses.copy()
    poses[3::2] = inside @ poses[2::2]
    flight = replace(flight, poses=poses)
    file = writers.write_alicevision(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    content = json.loads(file.read_text())
    for index, view in enumerate(content["views"]):
        view.update(rigId="5", subPoseId=str(index % 2), isPoseIndependant="1" if index < 2 else "0")
        view["poseId"] = str(index if index < 2 else index // 2 * 2)
    content["views"][-1]["subPoseId"] = "2"
    for view in content["views"][:1]:
        del view["isPoseIndependant"]
    content["rigs"] = [{"rigId": "5", "subPoses": [
        {"status": status, "pose": {"rotation": [str(each) for each in pose[:3, :3].T.ravel()],
                                    "center": [str(each) for each in -pose[:3, :3].T @ pose[:3, 3]]}}
        for status, pose in (("constant", np.eye(4)), ("estimated", inside), ("uninitialized", np.eye(4)))
    ]}]  # fmt: skip
    file.write_text(json.dumps(content))
    source = read(tmp_path, "alicevision")
    assert any("1 photographs" in note and flight.names[-1] in note for note in source.warnings)
    check_tie_points(source, replace(flight, names=flight.names[:-1], poses=poses[:-1]))


@pytest.mark.parametrize(
    ("lens", "told"),
    [
        (EquidistantLens(k=(0.0,) * 4, sensor=(36.0, 27.0), circle=300.0), {"type": "equidistant"}),
        (EquidistantLens(k=(0.0,) * 4), {"type": "equidistant", "fisheyeCircleRadius": "280", "sensorHeight": "25"}),
        (EquidistantLens(), {"type": "equidistant_r3", "fisheyeCircleRadius": "280", "sensorHeight": "25"}),
        (EquidistantLens(sensor=(36.0, 27.0), circle=300.0), {"type": "equidistant", "distortionType": "radialk3pt"}),
        (FixedAtOneLens(), {"type": "pinhole", "distortionType": "radialk3pt"}),
    ],
)
def test_lenses_of_meshroom_are_read_to_their_numbers(tmp_path: Path, lens: BentLens, told: dict[str, str]) -> None:
    flight = known_flight(lens)
    writers.write_alicevision(tmp_path, flight, **told)
    flight.write_photographs(tmp_path / "images")
    check_tie_points(read(tmp_path, "alicevision"), flight)


def test_a_lens_of_meshroom_that_is_not_read_is_named(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_alicevision(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    file.write_text(file.read_text().replace('"brown"', '"3deanamorphic4"'))
    with pytest.raises(CaptureError, match="lens 7 is '3deanamorphic4'; read are pinhole"):
        read(tmp_path, "alicevision")
    undone = '"undistortionType": "3deanamorphic4", "undistortionParams": ["0", "0.02"], "type": "pinhole"'
    file.write_text(file.read_text().replace('"type": "3deanamorphic4"', undone))
    with pytest.raises(CaptureError, match="lens 7 is 'pinhole 3deanamorphic4'; read are pinhole"):
        read(tmp_path, "alicevision")


def test_a_lens_of_meshroom_with_more_terms_than_its_model_is_refused(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_alicevision(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    content = json.loads(file.read_text())
    terms = content["intrinsics"][0]["distortionParams"]
    terms += ["0"] * (6 - len(terms))
    file.write_text(json.dumps(content))
    read(tmp_path, "alicevision")
    terms[-1] = "0.1"
    file.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match=r"lens 7 has 6 terms of distortion, more than its model"):
        read(tmp_path, "alicevision")


@pytest.mark.parametrize("program", ["pix4d", "opf"])
def test_heights_of_pix4d_have_the_unit_of_its_system(tmp_path: Path, flight: KnownFlight, program: str) -> None:
    """The system has no heights; x, y and z of a camera model have one unit."""
    flight.write_photographs(tmp_path / "images")
    getattr(writers, f"write_{program}")(tmp_path, flight, unit=1200 / 3937)
    source = read(tmp_path, program)
    check_numbers(source, flight)
    assert source.georef is not None
    assert "x, y and heights in feet" in source.georef.method


def test_a_dense_cloud_of_pix4dmapper_is_found_where_it_writes_it(tmp_path: Path, flight: KnownFlight) -> None:
    writers.write_pix4d(tmp_path / "flight", flight)
    flight.write_photographs(tmp_path / "images")
    _, _, points, _ = writers.utm_flight(flight, 1.0)
    dense = tmp_path / "flight" / "2_densification" / "point_cloud"
    dense.mkdir(parents=True)
    write_ply(dense / "flight_group1_densified_point_cloud.ply", points, flight.colors)
    source = read_source(tmp_path, CaptureOptions())
    assert len(source.points) == len(flight.points)
    assert any("densified_point_cloud.ply are used" in note for note in source.warnings)


def test_parameters_of_pix4dmapper_are_read_to_their_numbers(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_pix4d(tmp_path / "flight", flight)
    flight.write_photographs(tmp_path / "images")
    check_numbers(read(tmp_path, "pix4d"), flight)
    check_numbers(read_source(file, CaptureOptions(images=str(tmp_path / "images")), needs_points=False), flight)
    whole = file.read_text()
    file.write_text(whole[:-200])
    with pytest.raises(CaptureError, match="10 lines"):
        read(tmp_path, "pix4d")
    file.write_text(whole)
    offset = file.with_name("flight_offset.xyz")
    kept = offset.read_text()
    offset.unlink()
    lost = read(tmp_path, "pix4d")
    assert lost.georef is None or lost.georef.origin is None
    assert any("flight_offset.xyz is missing" in each for each in lost.warnings)
    offset.write_text(kept)
    for wkt in ('LOCAL_CS["site",UNIT["metre",1]]', "Site grid 7"):
        file.with_name("flight_wkt.prj").write_text(wkt)
        source = read(tmp_path, "pix4d")
        assert source.georef is not None
        assert source.georef.origin is None
    assert any("'Site grid 7' is not known" in each for each in source.warnings)


def test_projects_that_are_not_read_say_what_is(tmp_path: Path) -> None:
    for name, says in (("a.psx", "Export Cameras"), ("B.RCPROJ", "camera parameters"), ("c.rsproj", "CSV"),
                       ("d.p4d", "1_initial/params"), ("e.p4m", "OPF"), ("f.ccm", "BlocksExchange")):  # fmt: skip
        (tmp_path / name).write_bytes(b"x" * 50)
        with pytest.raises(CaptureError, match=f"{name}: is a project of .*{says}"):
            load_capture(tmp_path / name, OPTIONS)


def test_biggest_of_several_reconstructions_is_read_and_the_others_named(tmp_path: Path, flight: KnownFlight) -> None:
    parts = [writers.opensfm_reconstruction(flight, names) for names in (flight.names[:3], flight.names[3:])]
    (tmp_path / "reconstruction.json").write_text(json.dumps(parts))
    flight.write_photographs(tmp_path / "images")
    source = read(tmp_path, "opensfm")
    assert [view.name for view in source.views] == flight.names[3:]
    assert any("2 reconstructions" in note and flight.names[0] in note for note in source.warnings)


@pytest.mark.parametrize(
    ("kind", "keys", "model"),
    [
        ("perspective", {"focal": 0.875, "k1": -0.1, "k2": 0.01}, "RADIAL"),
        ("fisheye", {"focal": 0.875, "k1": -0.1, "k2": 0.01}, "RADIAL_FISHEYE"),
        ("fisheye_opencv", {"focal_x": 0.875, "focal_y": 0.875, "c_x": 0.01, "k1": 0.1, "k4": 0.01}, "OPENCV_FISHEYE"),
        ("radial", {"focal_x": 0.875, "focal_y": 0.9, "c_x": 0.01, "c_y": 0, "k1": 0.1, "k2": 0.01}, "OPENCV"),
    ],
)  # fmt: skip
def test_projections_of_opensfm_become_the_models_that_are_the_same(
    tmp_path: Path, flight: KnownFlight, kind: str, keys: dict[str, float], model: str
) -> None:
    content = writers.opensfm_reconstruction(flight)
    [camera] = content["cameras"]
    content["cameras"][camera] = {"projection_type": kind, "width": 800, "height": 600, **keys}
    (tmp_path / "reconstruction.json").write_text(json.dumps([content]))
    flight.write_photographs(tmp_path / "images")
    lens = read(tmp_path, "opensfm").views[0].intrinsics
    assert lens.model == model
    assert lens.focal[0] == pytest.approx(700)
    assert lens.principal_point[0] == pytest.approx(400 + 800 * keys.get("c_x", 0))


def test_panoramas_are_named_and_refused(tmp_path: Path, flight: KnownFlight) -> None:
    content = writers.opensfm_reconstruction(flight)
    content["cameras"]["ball"] = {"projection_type": "spherical", "width": 800, "height": 400}
    for name in flight.names[:2]:
        content["shots"][name]["camera"] = "ball"
    (tmp_path / "reconstruction.json").write_text(json.dumps([content]))
    flight.write_photographs(tmp_path / "images")
    source = read(tmp_path, "opensfm")
    assert len(source.views) == len(flight.names) - 2
    assert any("spherical" in note and flight.names[0] in note for note in source.warnings)
    for shot in content["shots"].values():
        shot["camera"] = "ball"
    (tmp_path / "reconstruction.json").write_text(json.dumps([content]))
    with pytest.raises(CaptureError, match="spherical"):
        read(tmp_path, "opensfm")


def _all_formats(root: Path, flight: KnownFlight) -> list[tuple[str, Path]]:
    flight.write_photographs(root / "images")
    writers.write_realityscan_xmp(root / "images", flight)
    return [
        ("opensfm", writers.write_opensfm(root, flight)), ("opensfm", writers.write_odm_report(root, flight)),
        ("bundler", writers.write_bundler(root, flight)), ("opf", writers.write_opf(root, flight)),
        ("opf", root / "calibrated-cameras.json"), ("opf", root / "scene-reference-frame.json"),
        ("opf", root / "camera-list.json"), ("opf", root / "point_cloud" / "sparse.gltf"),
        ("realityscan", writers.write_realityscan_csv(root / "cameras.csv", flight)),
        ("realityscan", writers.write_realityscan_opencv_csv(root / "opencv.csv", flight)),
        ("pix4d", writers.write_pix4d(root / "flight", flight)),
        ("realityscan", (root / "images" / flight.names[0]).with_suffix(".xmp")),
        ("visualsfm", writers.write_visualsfm(root, flight)), ("openmvg", writers.write_openmvg(root, flight)),
        ("alicevision", writers.write_alicevision(root, flight)),
    ]  # fmt: skip


@pytest.mark.parametrize("number", range(15))
def test_damaged_files_are_refused_by_name_or_read(tmp_path: Path, flight: KnownFlight, number: int) -> None:
    """Cut off, overwritten and hostile files: a CaptureError, never anything else."""
    name, file = _all_formats(tmp_path, flight)[number]
    start = tmp_path / "project.opf" if name == "opf" else file
    whole = file.read_bytes()
    assert len(PROJECTS[name].read(start, OPTIONS).views) == len(flight.names)
    rng = np.random.default_rng(number)
    damaged = [whole[: int(share * len(whole))] for share in (0.0, 0.01, 0.3, 0.7, 0.97)]
    for _ in range(12):
        bad, at = bytearray(whole), rng.integers(0, len(whole), 4)
        bad[int(at[0])] = int(rng.integers(0, 256))
        bad[int(at[1]) : int(at[1]) + 8] = rng.choice([b"NaN", b"1e999", b"null", b"[[[[", b"-1", b"\xff\xfe", b"{}"])
        damaged.append(bytes(bad))
    damaged += [
        whole.replace(b"[", b"[" * 3000, 1),
        whole.replace(b"800", b"-5"),
        whole.replace(b"600", b"99999999999"),
        whole.replace(b"0.", b"0.x"),
    ]
    refusals = list[str]()
    for content in damaged:
        file.write_bytes(content)
        try:
            views = PROJECTS[name].read(start, OPTIONS).views
        except CaptureError as error:
            refusals.append(str(error))
            continue
        assert all(np.isfinite(view.camera_from_world).all() for view in views)
    assert len(refusals) >= 3
    assert all(str(tmp_path) in refusal for refusal in refusals)


def test_names_that_leave_the_folder_are_not_followed(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_opf(tmp_path / "project", flight)
    flight.write_photographs(tmp_path / "project" / "images")
    (tmp_path / "secret.json").write_text("{}")
    content = json.loads(file.read_text())
    content["items"][0]["resources"][0]["uri"] = "../secret.json"
    file.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="not a path inside"):
        read(tmp_path / "project", "opf")


def test_capture_of_a_project_is_loaded_whole(tmp_path: Path, flight: KnownFlight) -> None:
    """From the folder to cameras in metres over the ground, photographs undistorted."""
    writers.write_opensfm(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    capture = load_capture(tmp_path, OPTIONS)
    assert capture.source == "opensfm"
    assert capture.ground.metric
    assert capture.ground.origin_geo is not None
    assert len(capture.views) == len(flight.names)
    assert {view.image_path.parent.name for view in capture.views} == {"images"}
    assert all("undistorted" in view.image_path.parts for view in capture.views)
