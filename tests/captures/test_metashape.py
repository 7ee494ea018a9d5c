"""Metashape's cameras.xml: a known flight as the program writes it, and what people's exports hold besides."""

from __future__ import annotations

import math
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element, tostring

import numpy as np
import pytest
from PIL import Image

from support.captures import write_ply
from support.metashape_files import (
    CHUNK_ORIGIN,
    CHUNK_ROTATION,
    CHUNK_SCALE,
    INITIAL,
    LOCAL,
    WGS84,
    chunk_from_enu,
    metashape_calibration,
    metashape_cameras,
    metashape_rig,
    metashape_transform,
    metashape_xml,
    read_export,
    write_project,
)
from support.true_flight import (
    ORIGIN,
    SIZE,
    Lens,
    TrueFlight,
    assert_read_or_refused,
    assert_true,
    true_flight,
    words,
)
from vdgs.captures.formats.lens_projection import pixel_rays, ray_pixels
from vdgs.captures.formats.source_capture import NoTiePoints
from vdgs.captures.formats.xml_documents import read_xml
from vdgs.captures.loading import read_files
from vdgs.captures.project_formats import read_project
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_from_geodetic, geodetic_from_enu

OPTIONS = CaptureOptions()


@pytest.mark.parametrize(
    "lens",
    [Lens(), Lens(b1=0, b2=0, k=(-0.1, 0.02, -0.01, 0)), Lens(k=(0, 0, 0, 0), p=(0, 0)), Lens(growth=(0.4, -0.2))],
)
def test_a_georeferenced_chunk_is_read_exactly(tmp_path, lens):
    flight = true_flight(lens=lens)
    source = read_export(tmp_path, metashape_xml(flight), flight)
    assert_true(source, flight)
    assert source.georef.method == "Metashape, WGS 84"
    assert source.original_images
    np.testing.assert_allclose(source.georef.origin[:2], ORIGIN[:2], atol=0.01)


def test_the_transform_of_old_files_is_one_matrix(tmp_path):
    flight, matrix = true_flight(), np.eye(4)
    matrix[:3] = np.column_stack([CHUNK_SCALE * CHUNK_ROTATION, CHUNK_ORIGIN])
    xml = metashape_xml(flight, reference=LOCAL, transform=f"<transform>{words(matrix)}</transform>")
    assert_true(read_export(tmp_path, xml, flight), flight)


def test_a_projected_system_of_the_chunk_does_not_matter_for_its_place(tmp_path):
    import pyproj

    flight = true_flight()
    wkt = pyproj.CRS("EPSG:32632").to_wkt("WKT1_GDAL")
    assert_true(read_export(tmp_path, metashape_xml(flight, reference=wkt), flight), flight)


def test_cameras_that_name_no_component_are_of_the_only_one(tmp_path):
    flight = true_flight()
    cameras = metashape_cameras(flight, 'sensor_id="0"')
    assert_true(read_export(tmp_path, metashape_xml(flight, cameras=cameras), flight), flight)


def test_a_system_that_nobody_knows_is_named_and_strict_refuses(tmp_path):
    """The transform is Earth-centred in whichever datum: the place is that of WGS 84, or there is none."""
    flight = true_flight()
    xml = metashape_xml(flight).replace("GEOGCS[&quot;WGS 84", "BOGUS[").replace('GEOGCS["WGS 84"', 'BOGUS["Site 7"')
    source = read_export(tmp_path, xml, flight)
    assert_true(source, flight)
    assert any('\'BOGUS["Site 7"' in each and "is not known" in each for each in source.warnings)
    with pytest.raises(CaptureError, match=r"Site 7.* is not known.*EPSG.*--strict"):
        read_export(tmp_path, xml, flight, CaptureOptions(strict=True))
    local = metashape_xml(flight, reference=LOCAL).replace("LOCAL_CS", "BOGUS")
    source = read_export(tmp_path, local, flight)
    assert_true(source, flight)
    assert source.georef.origin is None


def test_local_coordinates_are_metres_with_z_up(tmp_path):
    flight = true_flight()
    source = read_export(tmp_path, metashape_xml(flight, reference=LOCAL), flight)
    assert_true(source, flight)
    assert source.georef.origin is None


FEET = 'LOCAL_CS["Local Coordinates (ft)",LOCAL_DATUM["Local Datum",0],UNIT["US survey foot",0.304800609601219]]'


@pytest.mark.parametrize("poses_in_feet", [False, True, None])
def test_local_coordinates_in_feet_are_metres_by_what_references_show(tmp_path, poses_in_feet):
    flight, feet = true_flight(), 0.304800609601219
    xml = metashape_xml(flight, reference=FEET, transform=metashape_transform(LOCAL))
    for center in flight.centers if poses_in_feet is not None else ():
        x, y, z = center / feet + [100, 200, 0]
        xml = xml.replace('<reference x="11.9" y="48.1" z="640"', f'<reference x="{x}" y="{y}" z="{z}"', 1)
    if poses_in_feet is None:
        xml = xml.replace('<reference x="11.9" y="48.1" z="640" enabled="1"/>', "")
    if poses_in_feet:
        scale, translation = (re.search(f"<{name} .*?>(.*?)</{name}>", xml)[1] for name in ("scale", "translation"))
        xml = xml.replace(translation, words(np.fromstring(translation, sep=" ") / feet), 1)
        xml = xml.replace(f">{scale}<", f">{float(scale) / feet!r}<", 1)
    source = read_export(tmp_path, xml, flight)
    assert_true(source, flight)
    (said,) = (each for each in source.warnings if "US survey foot" in each)
    assert ("taken as US survey foot" in said) == bool(poses_in_feet)
    assert ("nothing in the file shows" in said) == (poses_in_feet is None)


@pytest.mark.parametrize("unit", [FEET, FEET.replace("0.304800609601219", "-")])
def test_references_of_another_size_show_nothing_of_a_unit(tmp_path, unit):
    flight = true_flight()
    xml = metashape_xml(flight, reference=unit, transform=metashape_transform(LOCAL))
    source = read_export(tmp_path, xml, flight)  # its references are degrees
    assert_true(source, flight)
    assert not any("references of its cameras show" in each for each in source.warnings)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "gb18030", "shift_jis", "cp1252"])
def test_exports_in_other_encodings(tmp_path, encoding):
    flight = true_flight(count=6)
    declared = "UTF-16" if encoding.startswith("utf-16") else encoding
    xml = metashape_xml(flight).replace("UTF-8", declared)
    flight.touch(tmp_path)
    (tmp_path / "cameras.xml").write_bytes(xml.encode(encoding))
    (tmp_path / "markers.xml").write_bytes('<document version="2.0.0"><chunk/></document>'.encode(encoding))
    assert_true(read_project(tmp_path, "metashape", OPTIONS, needs_points=False), flight)


def test_a_chunk_without_transform_has_the_shape_alone(tmp_path):
    flight = true_flight()
    source = read_export(tmp_path, metashape_xml(flight, transform=""), flight)
    assert source.georef is None
    scaled = replace(flight, centers=chunk_from_enu(flight.centers))
    views = {view.name: view.camera_from_world for view in source.views}
    for name, center in zip(flight.names, scaled.centers, strict=True):
        np.testing.assert_allclose(-views[name][:3, :3].T @ views[name][:3, 3], center, atol=1e-6)


def test_older_files_have_the_transform_in_the_chunk_and_their_own_lens(tmp_path):
    """PhotoScan before 1.2: fx, fy, skew, the principal point from the corner, p1 and p2 the other way round."""
    flight = true_flight()
    lens = flight.lens
    values = {
        "fx": lens.f + lens.b1, "fy": lens.f, "cx": SIZE[0] / 2 + lens.cx, "cy": SIZE[1] / 2 + lens.cy, "skew": lens.b2,
        "p1": lens.p[1], "p2": lens.p[0], **{f"k{n}": k for n, k in enumerate(lens.k, 1)},
    }  # fmt: skip
    text = "".join(f"<{name}>{value!r}</{name}>" for name, value in values.items())
    size = f'<resolution width="{SIZE[0]}" height="{SIZE[1]}"/>'
    sensors = (
        f'<sensor id="0" label="x" type="frame">{size}<calibration type="frame">{size}{text}</calibration></sensor>'
    )
    xml = metashape_xml(flight, sensors=sensors, cameras=metashape_cameras(flight, 'sensor_id="0"'), transform="")
    xml = xml.replace("<reference>", f"{metashape_transform(WGS84)}<reference>")
    assert_true(read_export(tmp_path, xml, flight), flight)


def test_several_sensors_and_labels_of_one_name_are_told_apart_by_groups(tmp_path):
    flight = true_flight()
    names = [f"{folder}/DJI_{index:04d}.JPG" for folder in ("100MEDIA", "101MEDIA") for index in range(4)]
    flight = replace(flight, names=names)
    second = Lens(f=2900.0, cx=-5, cy=3, b1=0, b2=0, k=(0.02, 0, 0, 0), p=(0, 0))
    sensors = "".join(
        f'<sensor id="{n}" label="s" type="frame">{metashape_calibration(lens)}</sensor>'
        for n, lens in enumerate((flight.lens, second))
    )
    cameras = metashape_cameras(flight)
    head, tail = cameras.split('<group id="1"')
    xml = metashape_xml(
        flight, sensors=sensors, cameras=head + '<group id="1"' + tail.replace('sensor_id="0"', 'sensor_id="1"')
    )
    source = read_export(tmp_path, xml, flight)
    for half, lens in ((0, flight.lens), (4, second)):
        part = TrueFlight(
            names[half : half + 4],
            flight.rotations[half : half + 4],
            flight.centers[half : half + 4],
            flight.points,
            lens,
        )
        assert_true(replace(source, views=tuple(view for view in source.views if view.name in part.names)), part)


def test_a_camera_of_no_use_is_named_and_left_out(tmp_path):
    flight = true_flight()
    extra = (
        '<camera id="90" sensor_id="0" label="unaligned_1"/><camera id="91" sensor_id="0" label="unaligned_2"/>'
        '<camera id="92" sensor_id="0" enabled="false" label="switched_off"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1'
        '</transform></camera><camera id="93" sensor_id="0" master_id="0" label="slave"/>'
    )
    source = read_export(tmp_path, metashape_xml(flight, cameras=metashape_cameras(flight) + extra), flight)
    assert_true(source, flight)
    said = " ".join(source.warnings)
    assert "2 cameras are not aligned and are left out (unaligned_1, unaligned_2)" in said
    assert "1 cameras are disabled" in said
    assert "belong to a multi-camera system" in said


@pytest.mark.parametrize(("b2", "p"), [(0.0, (0.0007, -0.0004)), (-0.3, (0.0007, -0.0004)), (0.0, (0.0, 0.0))])
@pytest.mark.parametrize("kind", ["fisheye", "equisolid_fisheye"])
def test_fisheyes_are_read_as_the_program_describes_them(tmp_path, kind, b2, p):
    lens = Lens(b2=b2, k=(0.02, -0.01, 0.003, -0.001), p=p)
    flight = true_flight(lens=lens)
    sensors = f'<sensor id="0" label="fish" type="{kind}">{metashape_calibration(lens, kind=kind)}</sensor>'
    intrinsics = read_export(tmp_path, metashape_xml(flight, sensors=sensors), flight).views[0].intrinsics
    rays = np.array([[0.5, 0.3], [-0.9, 0.1], [0.0, -1.4]])
    radius = np.hypot(*rays.T)
    angles = np.arctan(radius) if kind == "fisheye" else 2 * np.sin(np.arctan(radius) / 2)
    pixels = lens.pixels(*(rays * (angles / radius)[:, None]).T)
    assert np.abs(ray_pixels(intrinsics, rays) - pixels).max() < 0.01
    np.testing.assert_allclose(pixel_rays(intrinsics, pixels), rays, atol=1e-6)


def test_slaves_are_where_their_masters_and_sensors_say(tmp_path):
    flight = true_flight()
    xml, slaves = metashape_rig(flight, Lens(f=2900.0, cx=4.0))
    slaves.touch(tmp_path)
    source = read_export(tmp_path, xml, flight)
    for part in (flight, slaves):
        assert_true(replace(source, views=tuple(view for view in source.views if view.name in part.names)), part)
    xml, _ = metashape_rig(flight, Lens(), bands="NIR")
    source = read_export(tmp_path, xml, flight)
    assert_true(source, flight)
    assert any("8 cameras show other bands than the masters" in each for each in source.warnings)


def test_what_a_lens_has_besides_is_said(tmp_path):
    flight = true_flight()
    more = '<property name="rolling_shutter" value="true"/><calibration class="adjusted"><corrections type="fourier"/>'
    xml = metashape_xml(flight).replace('<property name="layer_index" value="0"/>', "")
    xml = xml.replace('<calibration type="frame" class="adjusted">', more)
    said = " ".join(read_export(tmp_path, xml, flight).warnings)
    assert "rolling shutter is not modelled" in said
    assert "additional corrections of its lens are not applied" in said


def test_a_camera_whose_transform_is_zeros_is_named_and_the_others_are_used(tmp_path):
    flight = true_flight()
    zeros = f'<camera id="90" sensor_id="0" label="DJI_9"><transform>{"0 " * 16}</transform></camera>'
    source = read_export(tmp_path, metashape_xml(flight, cameras=metashape_cameras(flight) + zeros), flight)
    assert_true(source, flight)
    assert any("all zeros" in each and "(DJI_9)" in each for each in source.warnings)


@pytest.mark.parametrize(("suffix", "color_kind"), [(".psx", "u1"), (".psz", "u1"), (".psx", "u2")])
def test_a_project_is_read_with_its_tie_points(tmp_path, suffix, color_kind):
    flight = true_flight()
    flight.touch(tmp_path)
    file = write_project(tmp_path, flight, suffix=suffix, color_kind=color_kind)
    for given in (tmp_path, file):
        source = read_files(given, OPTIONS)
        assert_true(source, flight)
        np.testing.assert_array_equal(source.colors[0], [10, 11, 12])
        truth = enu_from_geodetic(geodetic_from_enu(flight.points, ORIGIN), source.georef.origin)
        np.testing.assert_allclose(source.points, truth, atol=2e-4)  # written as float32
        for view in source.views:
            seen = view.observations.points @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
            assert np.abs(seen[:, :2] / seen[:, 2:] - view.observations.rays).max() * flight.lens.f < 0.02


def test_the_tie_points_of_a_project_are_those_that_its_frame_names(tmp_path):
    """An older archive beside them has another number."""
    flight = true_flight(count=4)
    flight.touch(tmp_path)
    file = write_project(tmp_path, flight)
    folder = tmp_path / "project.files" / "0" / "0"
    (folder / "point_cloud").rename(folder / "point_cloud.2")
    (folder / "point_cloud.1").mkdir()
    (folder / "point_cloud.1" / "point_cloud.zip").write_bytes(b"an older one")
    frame = read_xml(folder / "frame.zip")
    frame.append(Element("point_cloud", path="point_cloud.2/point_cloud.zip"))
    with zipfile.ZipFile(folder / "frame.zip", "w") as zipped:
        zipped.writestr("doc.xml", tostring(frame))
    assert len(read_files(file, OPTIONS).points) == len(flight.points)


def test_a_project_that_is_not_whole_says_what_to_copy(tmp_path):
    flight = true_flight(count=3)
    flight.touch(tmp_path)
    file = write_project(tmp_path, flight)
    cloud = tmp_path / "project.files" / "0" / "0" / "point_cloud" / "point_cloud.zip"
    cloud.write_bytes(cloud.read_bytes()[:-40])
    with pytest.raises(CaptureError, match=r"point_cloud\.zip: is no zip file"):
        read_files(file, OPTIONS)
    (tmp_path / "project.files").rename(tmp_path / "elsewhere")
    with pytest.raises(CaptureError, match=r"project\.files, which is not beside it whole"):
        read_files(file, OPTIONS)
    with pytest.raises(CaptureError, match=r"not a capture. Not read: project\.psx"):
        read_files(tmp_path, OPTIONS)


@pytest.mark.parametrize(
    ("sensors", "says"),
    [
        (
            '<sensor id="0" label="pano" type="spherical"><resolution width="8" height="4"/></sensor>',
            "pano.*'spherical'",
        ),
        (
            '<sensor id="0" label="bare" type="frame"><resolution width="8" height="4"/></sensor>',
            "bare.*no calibration",
        ),
        (f'<sensor id="0" label="sat" type="rpc">{metashape_calibration(Lens(), kind="rpc")}</sensor>', "sat.*'rpc'"),
        ("", "sensor 0 is missing"),
        (f'<sensor id="0" label="x" type="frame">{metashape_calibration(Lens(f=-3.0))}</sensor>', "focal length"),
        (
            '<sensor id="0" label="x" type="fisheye">'
            f"{metashape_calibration(Lens(growth=(0.1, 0.0)), kind='fisheye')}</sensor>",
            "fisheye with p3, p4",
        ),
    ],
)
def test_lenses_that_are_not_read_are_named(tmp_path, sensors, says):
    flight = true_flight()
    with pytest.raises(CaptureError, match=f"(?s)8 of its 8 cameras cannot be used.*{says}.*DJI_0000, DJI_0001"):
        read_export(tmp_path, metashape_xml(flight, sensors=sensors), flight)


def test_a_sensor_without_calibration_is_named_and_the_others_are_used(tmp_path):
    flight = true_flight()
    sensors = f'<sensor id="0" label="x" type="frame">{metashape_calibration(flight.lens)}</sensor>'
    sensors += '<sensor id="1" label="thermal" type="frame"><resolution width="640" height="512"/></sensor>'
    cameras = metashape_cameras(flight)
    cut = cameras.index('<camera id="6"')
    cameras = cameras[:cut] + cameras[cut:].replace('sensor_id="0"', 'sensor_id="1"')
    xml = metashape_xml(flight, sensors=sensors, cameras=cameras)
    source = read_export(tmp_path, xml, flight)
    assert_true(source, replace(flight, names=flight.names[:6]))
    [said] = [each for each in source.warnings if "cannot be used" in each]
    assert "2 of 8 cameras" in said
    assert "sensor 1 (thermal) has no calibration" in said
    assert "(DJI_0006, DJI_0007)" in said
    with pytest.raises(CaptureError, match=r"(?s)2 of its 8 cameras.*--strict.*thermal.*DJI_0006, DJI_0007"):
        read_export(tmp_path, xml, flight, CaptureOptions(strict=True))


def test_a_chunk_whose_cameras_are_all_disabled_has_none(tmp_path):
    flight = true_flight()
    cameras = metashape_cameras(flight).replace("<camera ", '<camera enabled="false" ')
    with pytest.raises(CaptureError, match="no camera of it has a pose"):
        read_export(tmp_path, metashape_xml(flight, cameras=cameras), flight)


def test_the_adjusted_calibration_is_used_and_the_initial_one_where_there_is_no_other(tmp_path):
    flight = true_flight()
    first, second = metashape_calibration(Lens(f=3000.0), which=INITIAL), metashape_calibration(flight.lens)
    for text in (first + second, second + first, metashape_calibration(flight.lens, which=INITIAL)):
        sensors = f'<sensor id="0" label="x" type="frame">{text}</sensor>'
        assert_true(read_export(tmp_path, metashape_xml(flight, sensors=sensors), flight), flight)


def test_chunks(tmp_path):
    flight = true_flight()
    xml = metashape_xml(flight)
    start, end = xml.index("<chunk"), xml.index("</document>")
    chunk = xml[start:end]
    empty = '<chunk label="other" enabled="true"><sensors/><cameras/></chunk>'
    off = chunk.replace('enabled="true"', 'enabled="false"', 1)
    for others in (empty, off):
        assert_true(read_export(tmp_path, xml[:start] + others + xml[start:], flight), flight)
    with pytest.raises(CaptureError, match="2 chunks have cameras"):
        read_export(tmp_path, xml[:start] + chunk + xml[start:], flight)
    (tmp_path / "empty.xml").write_text(xml[:start] + empty + xml[end:])
    with pytest.raises(CaptureError, match="no camera of it has a pose"):
        read_project(tmp_path / "empty.xml", "metashape", OPTIONS)


def test_components_without_a_common_world_leave_the_smaller_out(tmp_path):
    flight = true_flight()
    cameras = metashape_cameras(flight)
    cut = cameras.index('<camera id="6"')
    cameras = cameras[:cut] + cameras[cut:].replace('component_id="0"', 'component_id="1"')
    source = read_export(tmp_path, metashape_xml(flight, cameras=cameras), flight)
    kept = TrueFlight(flight.names[:6], flight.rotations[:6], flight.centers[:6], flight.points, flight.lens)
    assert_true(source, kept)
    assert any("2 cameras of other components" in each for each in source.warnings)


# ------------------------------------------------------------------------------------------- photographs


def test_photographs_are_found_in_another_folder_in_other_case_and_with_paths(tmp_path):
    flight = true_flight()
    xml = metashape_xml(flight)
    for index, name in enumerate(flight.names):
        label = f'"{Path(name).stem}"'
        path = f'"C:\\card\\{name}"'.replace("/", "\\") if index % 2 else f'"file:///C:/card/{name}"'
        xml = xml.replace(f"label={label}", f"label={path}")
    elsewhere = tmp_path / "card copy"
    for name in flight.names:
        (elsewhere / name.lower()).parent.mkdir(parents=True, exist_ok=True)
        (elsewhere / name.lower()).touch()
    project = tmp_path / "project"
    project.mkdir()
    (project / "cameras.xml").write_text(xml, encoding="utf-8")
    options = CaptureOptions(images=str(elsewhere))
    source = read_project(project / "cameras.xml", "metashape", options, needs_points=False)
    assert all(view.image_path.is_file() for view in source.views)
    assert_true(source, replace(flight, names=[name.lower() for name in flight.names]))


def test_a_project_whose_photographs_are_elsewhere_says_which_command_works(tmp_path):
    flight = true_flight()
    (tmp_path / "cameras.xml").write_text(metashape_xml(flight), encoding="utf-8")
    with pytest.raises(CaptureError, match=r"none of its 8 photographs.*--images FOLDER"):
        read_files(tmp_path, OPTIONS)


def test_names_that_may_be_of_two_photographs_are_none(tmp_path):
    flight = true_flight()
    flight.touch(tmp_path)
    (tmp_path / "copy" / "DJI_0001.JPG").parent.mkdir()
    (tmp_path / "copy" / "DJI_0001.JPG").touch()
    xml = metashape_xml(flight).replace('label="100MEDIA"', 'label="Group 1"')
    source = read_export(tmp_path, xml, flight)
    assert any("may be of several photographs" in each and "DJI_0001" in each for each in source.warnings)
    assert not next(view for view in source.views if "DJI_0001" in view.name).image_path.is_file()


@pytest.mark.parametrize(
    ("copied", "remedy"),
    [
        (("DCIM", "resized"), "choose the folder of one with --images"),
        ((".JPG", ".TIF"), "keep only one of each there"),
    ],
)
def test_of_two_photographs_the_one_as_large_as_the_camera_is_taken(tmp_path, copied, remedy):
    """Shrunk copies of a card, and thermal pictures beside those in colors."""
    flight = true_flight()
    flight.touch(tmp_path)
    for name in flight.names:
        copy = tmp_path / name.replace(*copied)
        copy.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (64, 48)).save(copy)
    with pytest.raises(
        CaptureError, match=rf"8 of its 8 names .*: DCIM\S* or \S*{re.escape(copied[1])}.*Of these {remedy}"
    ):
        read_export(tmp_path, metashape_xml(flight), flight)
    Image.new("L", SIZE).save(tmp_path / flight.names[0])
    for name in flight.names[1:]:
        (tmp_path / name).write_bytes((tmp_path / flight.names[0]).read_bytes())
    source = read_export(tmp_path, metashape_xml(flight), flight)
    assert {view.name for view in source.views} == {*flight.names}
    assert any("8 names of the project may be of several" in each for each in source.warnings)


# ------------------------------------------------------------------------------------------------ points


@pytest.mark.parametrize("frame", ["enu of the scene", "ecef", "chunk", "utm"])
def test_a_point_cloud_beside_is_used_in_whichever_coordinates_it_is(tmp_path, frame):
    import pyproj

    flight = true_flight()
    geodetic = geodetic_from_enu(flight.points, ORIGIN)
    source = read_export(
        tmp_path, metashape_xml(flight, reference=pyproj.CRS("EPSG:32632").to_wkt("WKT1_GDAL")), flight
    )
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(
        geodetic[:, 1], geodetic[:, 0]
    )
    points = {
        "enu of the scene": enu_from_geodetic(geodetic, source.georef.origin),
        "ecef": ecef_from_geodetic(geodetic),
        "chunk": chunk_from_enu(flight.points),
        "utm": np.column_stack([*utm, geodetic[:, 2]]),
    }[frame]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    rows = "\n".join(" ".join(map(repr, map(float, row))) for row in points)
    (tmp_path / "tie points.ply").write_text(header + rows + "\n")
    found = read_files(tmp_path, OPTIONS)
    np.testing.assert_allclose(found.points, enu_from_geodetic(geodetic, found.georef.origin), atol=1e-3)


def test_a_cloud_of_another_place_is_refused_and_none_names_the_command(tmp_path):
    flight = true_flight()
    flight.touch(tmp_path)
    (tmp_path / "cameras.xml").write_text(metashape_xml(flight), encoding="utf-8")
    with pytest.raises(NoTiePoints, match=r"vdgs sfm .*cameras.xml'? --output CAPTURE"):
        read_files(tmp_path, OPTIONS)
    with pytest.raises(NoTiePoints, match=r"vdgs sfm .*cameras.xml'? --images DCIM --output CAPTURE"):
        read_files(tmp_path, CaptureOptions(images="DCIM"))
    write_ply(tmp_path / "points.ply", flight.points + np.array([5000.0, 0, 0]), np.zeros((900, 3), np.uint8))
    with pytest.raises(NoTiePoints, match="not where the cameras"):
        read_files(tmp_path, OPTIONS)


# ------------------------------------------------------------------------------------------ hostile files


def test_damaged_files_end_in_a_message(tmp_path):
    flight = true_flight(count=3)
    flight.touch(tmp_path)
    whole = metashape_xml(flight).encode()
    file = tmp_path / "cameras.xml"
    assert_read_or_refused(file, whole, lambda: read_project(file, "metashape", OPTIONS, needs_points=False), seed=0)


@pytest.mark.parametrize(
    "text",
    [
        '<?xml version="1.0"?><!DOCTYPE d [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;&a;">]><document>&b;</document>',
        '<?xml version="1.0"?><!DOCTYPE d SYSTEM "file:///etc/passwd"><document/>',
        "<document>" + "<chunk>" * 5000,
        "<document><chunk><cameras><camera><transform>"
        + "1 " * 15
        + "nan</transform></camera></cameras></chunk></document>",
        "<document><chunk><cameras><camera><transform>"
        + "0 " * 16
        + "</transform></camera></cameras></chunk></document>",
        '<document encoding="nothing"/>',
    ],
)
def test_hostile_files_are_refused(tmp_path, text):
    file = tmp_path / "cameras.xml"
    file.write_text(text)
    with pytest.raises(CaptureError, match=r"cameras\.xml"):
        read_project(file, "metashape", OPTIONS, needs_points=False)


def test_angles_of_the_flight_are_those_of_the_sample_in_bentleys_description():
    """The matrix and the angles that the format's own example gives for one photograph."""
    from support.true_flight import angles_of, omega_phi_kappa

    given = [179.6523471469934, 0.04985630236313049, 179.9065465708369]
    matrix = omega_phi_kappa(*given)
    np.testing.assert_allclose(
        matrix[0], [-0.9999982912233401, -0.001636319085375301, -0.0008602425863163225], atol=2e-5
    )
    np.testing.assert_allclose(
        matrix[2], [0.0008701565192966738, -0.006067647409696231, -0.9999812130648239], atol=2e-5
    )
    assert angles_of(matrix) == pytest.approx(given)
    assert math.isclose(np.linalg.det(matrix), 1)
