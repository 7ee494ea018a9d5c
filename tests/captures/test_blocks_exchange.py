"""BlocksExchange XML of ContextCapture and DJI Terra: a known flight in each system, and what else their files hold."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support.blocks_files import ORIENTATIONS, PLAIN, blocks_xml, in_system
from support.captures import write_ply
from support.true_flight import ORIGIN, SIZE, TrueFlight, assert_read_or_refused, assert_true, true_flight
from vdgs.captures.formats import blocks_exchange
from vdgs.captures.formats.block_rotations import TwoWays, told_by_points
from vdgs.captures.formats.lens_projection import ray_pixels
from vdgs.captures.formats.source_capture import Intrinsics, SourceCapture
from vdgs.captures.loading import read_files
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu

OPTIONS = CaptureOptions()


@pytest.fixture(scope="module")
def flight() -> TrueFlight:
    return true_flight(count=6, lens=PLAIN)


def read(root: Path, xml: str, flight: TrueFlight, name: str = "block.xml") -> SourceCapture:
    flight.touch(root)
    (root / name).write_text(xml, encoding="utf-8")
    return read_files(root, OPTIONS)


def assert_points(source: SourceCapture, flight: TrueFlight) -> None:
    """Tie points are the flight's within a millimetre, and where photographs say that they show them."""
    points = flight.points
    if source.georef.origin is not None:
        points = enu_from_geodetic(geodetic_from_enu(points, ORIGIN), source.georef.origin)
    np.testing.assert_allclose(source.points, points, atol=1e-3)
    np.testing.assert_array_equal(source.colors[0], [255, 128, 0])
    for view in source.views:
        seen = view.observations.points @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
        assert np.abs(seen[:, :2] / seen[:, 2:] - view.observations.rays).max() * PLAIN.f < 0.01


@pytest.mark.parametrize("system", ["EPSG:32632", "EPSG:25833", "EPSG:4326", "ENU:48.1,11.9,540", None])
def test_systems_are_read_exactly(tmp_path, flight, system):
    """Projected (near and far from the middle of the zone), degrees, and metres about a place."""
    pytest.importorskip("pyproj")
    source = read(tmp_path, blocks_xml(flight, system), flight)
    assert_true(source, flight)
    assert_points(source, flight)
    assert (source.georef.origin is None) == (system is None)


@pytest.mark.parametrize(("unit", "said"), [(1.0, "taken as metres"), (1200 / 3937, "x, y and heights in feet")])
def test_tie_points_tell_the_unit_of_heights_of_a_system_in_feet(tmp_path, flight, unit, said):
    pytest.importorskip("pyproj")
    feet = "+proj=utm +zone=32 +datum=WGS84 +units=us-ft +type=crs"
    source = read(tmp_path, blocks_xml(flight, feet, height_unit=unit), flight)
    assert_true(source, flight)
    assert_points(source, flight)
    assert said in source.georef.method


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("angles", [False, True])
def test_rotations_and_axes(tmp_path, flight, orientation, angles):
    xml = blocks_xml(flight, None, orientation=orientation, angles=angles, in_millimeters=True, tie_points=False)
    write_ply(tmp_path / "points.ply", flight.points, np.zeros((900, 3), np.uint8))
    source = read(tmp_path, xml, flight)
    assert_true(source, flight)


def test_yaw_and_pitch_are_read_where_nothing_rolls_and_refused_where_it_does(tmp_path, flight):
    """Yaw clockwise about z, pitch about x; (0, 0, 0) looks along y with z up (Bentley's camera models)."""
    level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    yaw, pitch = np.radians(37.0), np.radians(-60.0)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    lift = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    xml = blocks_xml(flight, None)
    start, end = xml.index("<Rotation>"), xml.index("</Rotation>")
    angles = "<Yaw>37</Yaw><Pitch>-60</Pitch><Roll>0</Roll>"
    source = read(tmp_path, xml[:start] + "<Rotation>" + angles + xml[end:], flight)
    np.testing.assert_allclose(source.views[0].camera_from_world[:3, :3], level @ (turn @ lift).T, atol=1e-9)
    assert source.views[0].camera_from_world[2, :3] @ [np.sin(yaw), np.cos(yaw), 0] > 0  # looks to 37° and down
    assert source.views[0].camera_from_world[2, 2] < 0
    rolled = xml[:start] + "<Rotation>" + angles.replace(">0<", ">5<") + xml[end:]
    [said] = [each for each in read(tmp_path, rolled, flight).warnings if "Omega, Phi, Kappa" in each]
    assert "1 of 6 cameras" in said
    assert "with its tie points" in said


@pytest.mark.parametrize("direction", ["clockwise", "counter-clockwise"])
def test_tie_points_tell_which_way_a_roll_turns(tmp_path, flight, direction):
    source = read(tmp_path, blocks_xml(flight, None, angles="roll", rolls=direction), flight)
    assert_true(source, flight)
    assert any(f"turn cameras {direction}, seen from behind" in each for each in source.warnings)


def test_groups_whose_poses_or_lens_are_left_to_the_program_are_not_taken_for_aligned(tmp_path, flight):
    whole = blocks_xml(flight, None)
    start, end = whole.index("<Photogroup>"), whole.index("</Photogroups>")
    again = whole[start:end].replace("\\flights\\", "\\other\\").replace("<Id>", "<Id>9")
    more = "".join(
        again.replace("<Name>", f"<{tag}>false</{tag}><Name>", 1).replace("<Id>", f"<Id>{tag}")
        for tag in ("ManualPose", "ManualOpticalParams")
    )
    bulk = "<BulkPhotos><Photo><ImagePath>bulk.JPG</ImagePath></Photo></BulkPhotos><ControlPoints>"
    xml = blocks_xml(flight, None, more=more).replace("<ControlPoints>", bulk)
    flight.touch(tmp_path)
    (tmp_path / "block.xml").write_text(xml)
    project = blocks_exchange.read(tmp_path / "block.xml", OPTIONS)
    assert len(project.views) == len(flight.names)
    said, counted = project.warnings
    assert "control point" in counted
    assert "not used" in counted
    assert f"{len(flight.names) + 1} photographs are not oriented" in said
    assert "bulk.JPG" in said
    [(why, names)] = project.refused.items()
    assert "ManualOpticalParams" in why
    assert len(names) == len(flight.names)


def test_thermal_photogroups_are_named_and_left_out(tmp_path, flight):
    whole = blocks_xml(flight, None)
    start, end = whole.index("<Photogroup>"), whole.index("</Photogroups>")
    group = whole[start:end].replace("<Name>", "<CameraModelBand>Thermal</CameraModelBand><Name>", 1)
    thermal = group.replace("\\flights\\", "\\thermal\\").replace("<Id>", "<Id>9")
    source = read(tmp_path, blocks_xml(flight, None, more=thermal), flight)
    assert len(source.views) == len(flight.names)
    assert any("6 cameras show other bands (Thermal) than the rest" in each for each in source.warnings)
    alone = read(tmp_path, whole[:start] + group + whole[end:], flight)
    assert_true(alone, flight)
    assert not any("bands" in each for each in alone.warnings)


def test_photographs_without_pose_are_named_and_left_out(tmp_path, flight):
    more = (
        "<Photogroup><Name>late</Name><Photo><Id>90</Id><ImagePath>late_1.JPG</ImagePath></Photo><Photo><Id>91</Id>"
        "<ImagePath>late_2.JPG</ImagePath><Pose><Center><x>1</x><y>2</y><z>3</z></Center></Pose></Photo>"
    )
    guess = (
        "<Rotation><Omega>1</Omega><Phi>2</Phi><Kappa>3</Kappa>{}</Rotation><Center><x>1</x><y>2</y><z>3</z></Center>"
    )
    more += (
        "<Photo><Id>92</Id><ImagePath>late_3.JPG</ImagePath><Component>0</Component><Pose>"
        f"{guess.format('')}</Pose></Photo><Photo><Id>93</Id><ImagePath>late_4.JPG</ImagePath><Pose>"
        f"{guess.format('<Accurate>false</Accurate>')}</Pose></Photo></Photogroup>"
    )
    source = read(tmp_path, blocks_xml(flight, None, more=more), flight)
    assert_true(source, flight)
    assert any(
        "4 photographs are not oriented and are left out (late_1.JPG, late_2.JPG, late_3.JPG, late_4.JPG)" in each
        for each in source.warnings
    )


@pytest.mark.parametrize("encoding", ["utf-16", "gb18030"])
def test_exports_in_other_encodings_are_read(tmp_path, flight, encoding):
    xml = blocks_xml(flight, "EPSG:32632").replace("utf-8", encoding).replace("UTF-8", encoding)
    flight.touch(tmp_path)
    (tmp_path / "block.xml").write_bytes(xml.encode(encoding))
    assert_points(read_files(tmp_path, OPTIONS), flight)


def test_zipped_files_and_tie_points_in_a_file_of_their_own(tmp_path, flight):
    whole = blocks_xml(flight)
    start, end = whole.index("<TiePoint>"), whole.index("</TiePoints>")
    flight.touch(tmp_path)
    points = '<?xml version="1.0" encoding="utf-8"?>\n' + whole[start:end]
    (tmp_path / "block - Tiepoints.xml").write_text(points)
    parts = whole[:start] + "<Path>C:\\out\\block - Tiepoints.xml</Path>" + whole[end:]
    with zipfile.ZipFile(tmp_path / "block.xmlz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("Orientations.xml", parts)
    source = read_files(tmp_path, OPTIONS)
    assert_true(source, flight)
    assert_points(source, flight)
    (tmp_path / "block - Tiepoints.xml").write_text(points[:-20])
    with pytest.raises(CaptureError, match=r"Tiepoints\.xml: is no whole XML file"):
        read_files(tmp_path, OPTIONS)
    whole_zip = (tmp_path / "block.xmlz").read_bytes()
    (tmp_path / "block.xmlz").write_bytes(whole_zip[:-30])
    with pytest.raises(CaptureError, match=r"not a capture"):
        read_files(tmp_path, OPTIONS)


def test_heights_above_a_geoid_without_its_grid_are_said(tmp_path, flight):
    source = read(tmp_path, blocks_xml(flight).replace("EPSG:32632<", "EPSG:32632+5773<"), flight)
    assert_true(source, flight)
    assert "heights as they are" in source.georef.method


@pytest.mark.parametrize("in_pixels", [True, False])
def test_fisheyes_are_bentleys(tmp_path, flight, in_pixels):
    """A focal matrix for angles in quarter turns, or a focal length for radians, and a polynomial of the former."""
    xml = blocks_xml(flight, None, tie_points=False).replace(">Perspective<", ">Fisheye<")
    write_ply(tmp_path / "points.ply", flight.points, np.zeros((900, 3), np.uint8))
    matrix = np.array([[5000.0, 2.0], [-1.0, 4990.0]]) if in_pixels else np.diag([3656.4, 3656.4]) * np.pi / 2
    if in_pixels:
        tags = [f"M_{row}{column}" for row in range(2) for column in range(2)]
        inner = "".join(f"<{tag}>{value}</{tag}>" for tag, value in zip(tags, matrix.ravel(), strict=True))
        xml = xml.replace("<FocalLengthPixels>3656.4</FocalLengthPixels>", "")
        xml = xml.replace("<Distortion>", f"<FisheyeFocalMatrix>{inner}</FisheyeFocalMatrix><Distortion>")
    powers = "<FisheyeDistortion><P0>0</P0><P1>1</P1><P2>0.02</P2><P3>-0.03</P3></FisheyeDistortion>"
    xml = xml.replace("<Distortion>", f"{powers}<Distortion>")
    source = read(tmp_path, xml, flight)
    rays = np.array([[0.5, 0.3], [-0.9, 0.1], [0.0, -1.4]])
    theta = 2 / np.pi * np.arctan(np.hypot(*rays.T))
    bent = rays * ((theta + 0.02 * theta**2 - 0.03 * theta**3) / np.hypot(*rays.T))[:, None]
    center = np.array([flight.lens.cx + SIZE[0] / 2, flight.lens.cy + SIZE[1] / 2])
    assert np.abs(ray_pixels(source.views[0].intrinsics, rays) - bent @ matrix.T - center).max() < 0.01


def test_distortion_that_is_not_known_is_refused_by_its_name(tmp_path, flight):
    xml = blocks_xml(flight, None).replace("<Distortion>", "<Distortion><K4>0.1</K4>")
    with pytest.raises(CaptureError, match=r"distortion that is not known \(K4\)"):
        read(tmp_path, xml, flight)
    zero = read(tmp_path, xml.replace("<K4>0.1<", "<K4>0<"), flight)
    assert zero.views[0].intrinsics.is_distorted


def test_a_photogroup_that_cannot_be_used_is_named_and_the_others_are_used(tmp_path, flight):
    turned = "<Rotation><Omega>1</Omega><Phi>2</Phi><Kappa>3</Kappa></Rotation>"
    pose = f"<Pose>{turned}<Center><x>1</x><y>2</y><z>3</z></Center></Pose>"
    more = (
        "<Photogroup><Name>ball</Name><CameraModelType>Spherical</CameraModelType><Photo><Id>90</Id><ImagePath>b_1.JPG"
        f"</ImagePath>{pose}</Photo><Photo><Id>91</Id><ImagePath>b_2.JPG</ImagePath>{pose}</Photo></Photogroup>"
    )
    xml = blocks_xml(flight, None, more=more)
    source = read(tmp_path, xml, flight)
    assert_true(source, flight)
    assert any("photogroup 'ball' is 'Spherical'" in each and "(b_1.JPG, b_2.JPG)" in each for each in source.warnings)
    with pytest.raises(CaptureError, match=r"(?s)2 of its 8 cameras.*--strict.*b_1.JPG, b_2.JPG"):
        read_files(tmp_path, CaptureOptions(strict=True))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (">Perspective<", ">Spherical<", "photogroup 'UCX' is 'Spherical'"),
        (
            ">Perspective<",
            ">Fisheye</CameraModelType><FisheyeDistortion><P0>1</P0></FisheyeDistortion><CameraModelType><",
            "fisheye with P0 = 1",
        ),
        ("<Width>5472</Width>", "", "has no Width"),
        ("<FocalLengthPixels>3656.4</FocalLengthPixels>", "", "neither FocalLengthPixels"),
        (">XRightYDown<", ">XRightYRight<", "CameraOrientation"),
        ("<SRSId>7</SRSId>", "<SRSId>8</SRSId>", "system 8 is not defined"),
        ("<TiePoints>", "<TiePoints><SRSId>3</SRSId>", "mixes the coordinate systems 3, 7"),
        ("<Id>11</Id>", "<Id>10</Id>", "two photographs have the number 10"),
        ("</Block>", "</Block><Block/>", "holds 2 blocks"),
        ("</M_00>", "e3</M_00>", "not orthonormal"),
    ],
)
def test_what_is_not_read_is_named(tmp_path, flight, old, new, says):
    xml = blocks_xml(flight)
    assert old in xml
    with pytest.raises(CaptureError, match=f"block.xml.*(?s:.)*{says}"):
        read(tmp_path, xml.replace(old, new, 1), flight)


def test_a_system_that_nobody_knows_is_named_and_strict_refuses(tmp_path, flight):
    xml = blocks_xml(flight, None).replace("<Block>", "<Block><SRSId>7</SRSId>")
    site = "<SpatialReferenceSystems><SRS><Id>7</Id><Definition>Site grid 7</Definition></SRS>"
    xml = xml.replace("<SpatialReferenceSystems>", site)
    source = read(tmp_path, xml, flight)
    assert_true(source, flight)
    assert source.georef.origin is None
    assert any("'Site grid 7' is not known" in each and "--gps" in each for each in source.warnings)
    with pytest.raises(CaptureError, match=r"'Site grid 7' is not known.*--strict"):
        read_files(tmp_path, CaptureOptions(strict=True))
    degrees = blocks_xml(flight, "EPSG:4326").replace("<Definition>EPSG:4326<", "<Definition>Site grid 7<")
    with pytest.raises(CaptureError, match="its SRS must name"):
        read(tmp_path, degrees, flight)


def test_damaged_files_end_in_a_message(tmp_path, flight):
    whole = blocks_xml(replace(flight, points=flight.points[:40]), None).encode()
    flight.touch(tmp_path)
    assert_read_or_refused(tmp_path / "block.xml", whole, lambda: read_files(tmp_path, OPTIONS), seed=1)


# ------------------------------------------------------------------------------------------------ DJI Terra


def terra_project(root: Path, flight: TrueFlight) -> TrueFlight:
    """A project as Terra lays it out, photographs by its own names in the list; returns the flight with these names."""
    called = [f"{index:08x}-aa.jpg" for index in range(len(flight.names))]
    listed = [
        {"id": Path(new).stem, "origin_path": f"D:/Card/{old}"} for new, old in zip(called, flight.names, strict=True)
    ]
    (root / "images" / "survey").mkdir(parents=True)
    (root / "images" / "survey" / "image_list.json").write_text(json.dumps(listed))
    (root / "AT").mkdir()
    (root / "AT" / "sfm_geo_desc.json").write_text("{}")
    temporary = [f"C:\\DJI\\.temp/ImageCorrection/undistort\\{name}" for name in called]
    for name, points in (("", True), ("_WithoutTiePoints", False)):
        xml = blocks_xml(flight, "EPSG:4326", angles=True, paths=temporary, tie_points=points)
        (root / "AT" / f"BlocksExchangeUndistortAT{name}.xml").write_text(xml)
    return replace(flight, names=[f"survey/{name}" for name in called])


def test_terra_by_its_own_names_and_by_those_of_the_card(tmp_path):
    flight = true_flight(count=6, lens=replace(PLAIN, k=(0, 0, 0, 0), p=(0, 0)))
    mine, card = tmp_path / "terra", tmp_path / "card"
    theirs = terra_project(mine, flight)
    flight.touch(card)
    source = read_files(mine, CaptureOptions(images=str(card)))
    assert_true(source, flight)
    assert any("lens distortion Terra has undone" in each for each in source.warnings)
    theirs.touch(mine / "images")
    for options in (OPTIONS, CaptureOptions(images="images")):  # beside the file's folder, in the project
        source = read_files(mine, options)
        assert_true(source, theirs)
    assert len(source.points) == len(flight.points)


def test_terra_without_tie_points_takes_its_model_about_its_origin(tmp_path):
    flight = true_flight(count=6, lens=PLAIN)
    flight.touch(tmp_path / "images")
    (tmp_path / "BlocksExchangeUndistortAT_WithoutTiePoints.xml").write_text(
        blocks_xml(flight, "EPSG:32632", tie_points=False)
    )
    _, _, points = in_system(flight, "EPSG:32632")
    origin = np.array([710000.0, 5330000.0, 500.0])
    (tmp_path / "terra_ply").mkdir()
    (tmp_path / "terra_ply" / "metadata.xml").write_text(
        '<?xml version="1.0" encoding="utf-8"?>\n<ModelMetadata version="1"><SRS>EPSG:32632</SRS><SRSOrigin>'
        f"{','.join(map(str, origin))}</SRSOrigin></ModelMetadata>"
    )
    write_ply(tmp_path / "cloud.ply", points - origin, np.zeros((900, 3), np.uint8))
    source = read_files(tmp_path, OPTIONS)
    assert_true(source, flight)
    expected = enu_from_geodetic(geodetic_from_enu(flight.points, ORIGIN), source.georef.origin)
    np.testing.assert_allclose(source.points, expected, atol=5e-3)  # written as float32


def test_several_projects_of_a_folder_are_named(tmp_path, flight):
    flight.touch(tmp_path)
    for name in ("one.xml", "two.xml"):
        (tmp_path / name).write_text(blocks_xml(flight, None))
    with pytest.raises(CaptureError, match=r"several projects \(one\.xml, two\.xml\)"):
        read_files(tmp_path, OPTIONS)
    assert_true(read_files(tmp_path / "two.xml", OPTIONS), flight)


def test_a_way_that_puts_tie_points_behind_the_camera_is_not_the_one():
    """From behind, points fall on the same pixels."""
    lens = Intrinsics("PINHOLE", (800.0, 800.0, 400.0, 300.0), 800, 600)
    ahead = np.array([[0.5, 0.2, 4.0], [-1.0, 0.4, 5.0], [0.3, -0.6, 3.0]])
    pixels = ray_pixels(lens, ahead[:, :2] / ahead[:, 2:])
    for way in (0, 1):
        points = (ahead, -ahead) if way == 0 else (-ahead, ahead)
        found, errors = told_by_points([TwoWays(lens, (np.eye(4), np.eye(4)), points, pixels)])
        assert found == way
        assert errors[1 - way] == np.inf
