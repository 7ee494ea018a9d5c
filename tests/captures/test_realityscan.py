"""Tables and XMP of RealityScan, written as the program writes them, against the flight that wrote them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support import project_writers as writers
from support.known_flight import (
    ORIGIN,
    BentLens,
    KnownFlight,
    centers_of,
    ecef,
    known_flight,
)
from support.project_reading import check_numbers, read
from vdgs.captures.format_dispatch import read_source
from vdgs.captures.formats import realityscan
from vdgs.captures.formats.brown_lens import brown_intrinsics
from vdgs.captures.formats.realityscan import RegisteredCamera
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import enu_axes, geodetic_from_enu, is_earth_centered


@pytest.fixture
def flight() -> KnownFlight:
    return known_flight()


@pytest.mark.parametrize(
    "lens", [BentLens(), BentLens(k=(-0.11, 0.034, -0.008, 0.004)), BentLens(k=(0, 0, 0, 0), p=(0, 0))]
)
def test_table_of_realityscan_is_read_to_its_numbers(tmp_path: Path, lens: BentLens) -> None:
    flight = known_flight(lens)
    writers.write_realityscan_csv(tmp_path / "cameras.csv", flight)
    flight.write_photographs(tmp_path / "images")
    check_numbers(read(tmp_path, "realityscan"), flight, placed=False)


def test_table_of_realityscan_for_opencv_is_read_to_its_numbers(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_realityscan_opencv_csv(tmp_path / "cameras.csv", flight)
    flight.write_photographs(tmp_path / "images")
    check_numbers(read(tmp_path, "realityscan"), flight, placed=False)
    file.write_text(file.read_text().replace(f",{flight.lens.center[0]!r},", ",913.0,"))
    with pytest.raises(CaptureError, match="of another size"):
        read(tmp_path, "realityscan")


def test_version_2_of_realityscan_calls_its_columns_otherwise(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_realityscan_csv(tmp_path / "cameras.csv", flight)
    lines = file.read_text().splitlines()
    lines[0] = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
    file.write_text("\n".join(lines))
    flight.write_photographs(tmp_path / "images")
    check_numbers(read(tmp_path, "realityscan"), flight, placed=False)


def test_information_beside_a_cloud_of_realityscan_places_its_table(tmp_path: Path, flight: KnownFlight) -> None:
    code, poses, _, centers = writers.utm_flight(flight)
    writers.write_realityscan_csv(tmp_path / "cameras.csv", flight, centers, poses)
    flight.write_photographs(tmp_path / "images")
    (tmp_path / "cloud.ply.rsInfo").write_text(
        f'<Model globalCoordinateSystem="+proj=utm" globalCoordinateSystemName="{code.lower()} - WGS 84 / UTM"/><X/>'
    )
    check_numbers(read(tmp_path, "realityscan"), flight)
    (tmp_path / "cloud.ply.rsInfo").unlink()
    assert read(tmp_path, "realityscan").georef.origin is None  # type: ignore[union-attr]
    (tmp_path / "cloud.ply.rsInfo").symlink_to(tmp_path / "gone")  # a place must not get lost in silence
    with pytest.raises(CaptureError, match=r"cloud\.ply\.rsInfo: .* cannot be read"):
        read(tmp_path, "realityscan")


def test_information_in_degrees_does_not_place_coordinates_in_metres(tmp_path: Path, flight: KnownFlight) -> None:
    _, poses, _, centers = writers.utm_flight(flight)
    writers.write_realityscan_csv(tmp_path / "cameras.csv", flight, centers, poses)
    flight.write_photographs(tmp_path / "images")
    (tmp_path / "cloud.rsInfo").write_text('<Model globalCoordinateSystemName="epsg:4326 - GPS (WGS 84)"/>')
    assert read(tmp_path, "realityscan").georef.origin is None  # type: ignore[union-attr]


def test_cameras_of_several_components_share_no_world(tmp_path: Path, flight: KnownFlight) -> None:
    """Those of the component of most cameras are read, be their poses relative to it, as it is written."""
    flight.write_photographs(tmp_path / "images")
    writers.write_realityscan_xmp(tmp_path / "images", flight)
    for number, file in enumerate(sorted((tmp_path / "images").glob("*.xmp"))):
        component = "{B}" if number < 3 else "{A}"
        text = file.read_text().replace('"absolute"', f'"relative" xcr:ComponentId="{component}"')
        file.write_text(text)
    source = read(tmp_path, "realityscan")
    assert [view.name for view in source.views] == list(flight.names[3:])
    assert any("3 cameras of other components" in note for note in source.warnings)


@pytest.mark.parametrize("height", [8.0, 45.0, 300.0])
@pytest.mark.parametrize("wide", [0.01, 0.06])
def test_low_and_wide_flights_in_degrees_are_told_from_worlds_without_scale(tmp_path, height, wide):
    rng = np.random.default_rng(0)
    rows = [(4.5 + wide * rng.random(), 52 + wide * rng.random(), height + rng.normal()) for _ in range(12)]
    head = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    lens = "0,0.5,0,24,0,0,0,0,0,0,0,0"
    for k in range(12):
        Image.new("RGB", (40, 30)).save(tmp_path / f"{k}.jpg")
    table = tmp_path / "cameras.csv"
    table.write_text(head + "".join(f"{k}.jpg,{x},{y},{z},{lens}\n" for k, (x, y, z) in enumerate(rows)))
    assert realityscan.read(table, CaptureOptions()).in_degrees
    table.write_text(
        head + "".join(f"{k}.jpg,{x - 4.5},{y - 52},{z / 1e3},{lens}\n" for k, (x, y, z) in enumerate(rows))
    )
    assert not realityscan.read(table, CaptureOptions()).in_degrees


def test_angles_that_degrees_have_spoiled_are_refused(tmp_path: Path, flight: KnownFlight) -> None:
    degrees = geodetic_from_enu(flight.centers, ORIGIN)[:, [1, 0, 2]]
    file = writers.write_realityscan_csv(tmp_path / "cameras.csv", flight, degrees)
    flight.write_photographs(tmp_path / "images")
    lines = [line.split(",") for line in file.read_text().splitlines()]
    file.write_text(
        "\n".join(
            ",".join([*line[:5], *(line[5:7] if not k else ["1.5e-4", "89.9993"]), *line[7:]])
            for k, line in enumerate(lines)
        )
    )
    with pytest.raises(CaptureError, match="its cameras mean nothing"):
        read(tmp_path, "realityscan")


def test_table_of_realityscan_in_degrees_is_placed(tmp_path: Path, flight: KnownFlight) -> None:
    level = _turned_to_each_place(flight)
    degrees = geodetic_from_enu(flight.centers, ORIGIN)[:, [1, 0, 2]]
    writers.write_realityscan_csv(tmp_path / "cameras.csv", level, degrees)
    flight.write_photographs(tmp_path / "images")
    check_numbers(read(tmp_path, "realityscan"), flight)


def _turned_to_each_place(flight: KnownFlight) -> KnownFlight:
    """The flight with the rotation of each camera about the east, north and up of where it is."""
    poses = np.array(flight.poses)
    for pose, (latitude, longitude, _) in zip(poses, geodetic_from_enu(flight.centers, ORIGIN), strict=True):
        pose[:3, :3] = pose[:3, :3] @ enu_axes(*ORIGIN[:2]) @ enu_axes(latitude, longitude).T
    return replace(flight, poses=poses)


def test_semicolons_decimal_commas_and_other_names_of_columns_are_understood(
    tmp_path: Path, flight: KnownFlight
) -> None:
    file = writers.write_realityscan_csv(tmp_path / "cameras.csv", flight)
    lines = file.read_text().replace(",", ";").replace(".", ",").replace(",JPG", ".JPG").splitlines()
    lines[0] = (
        "#Name;Easting;Northing;Altitude;Yaw;Pitch;Roll;FocalLength35mm;PrincipalPointU;PrincipalPointV;k1;k2;k3;k4;t1;t2"
    )
    file.write_text("\ufeff#cameras 12\n" + "\r\n".join(lines), encoding="utf-8")
    flight.write_photographs(tmp_path / "images")
    check_numbers(read(tmp_path, "realityscan"), flight, placed=False)


def test_xmp_of_photographs_that_are_called_alike_in_folders(tmp_path: Path, flight: KnownFlight) -> None:
    images = tmp_path / "images"
    halves = [replace(flight, poses=flight.poses[k::2], names=flight.names[:6]) for k in (0, 1)]
    for number, half in enumerate(halves):
        half.write_photographs(images / f"10{number}MEDIA")
        writers.write_realityscan_xmp(images / f"10{number}MEDIA", half)
    source = read(tmp_path, "realityscan")
    poses = np.stack([view.camera_from_world for view in source.views])
    assert np.abs(centers_of(poses) - np.concatenate([half.centers for half in halves])).max() < 1e-9


def test_exports_in_utf_16_are_read(tmp_path: Path, flight: KnownFlight) -> None:
    """As PowerShell and editors on Windows save them, with their mark."""
    for name in ("table", "xmp"):
        images = tmp_path / name / "images"
        flight.write_photographs(images)
        if name == "xmp":
            writers.write_realityscan_xmp(images, flight)
        else:
            writers.write_realityscan_csv(tmp_path / name / "cameras.csv", flight)
        for file in [*images.glob("*.xmp"), *(tmp_path / name).glob("*.csv")]:
            file.write_bytes(file.read_text().encode("utf-16"))
        check_numbers(read(tmp_path / name, "realityscan"), flight, placed=False)


@pytest.mark.parametrize("as_attributes", [False, True])
def test_xmp_of_realityscan_is_read_to_its_numbers(tmp_path: Path, flight: KnownFlight, as_attributes: bool) -> None:
    flight.write_photographs(tmp_path / "images")
    writers.write_realityscan_xmp(tmp_path / "images", flight, as_attributes=as_attributes)
    check_numbers(read(tmp_path, "realityscan"), flight, placed=False)


def test_xmp_without_a_pose_and_of_other_lenses_is_named(tmp_path: Path, flight: KnownFlight) -> None:
    images = tmp_path / "images"
    flight.write_photographs(images)
    writers.write_realityscan_xmp(images, flight)
    first, second = ((images / name).with_suffix(".xmp") for name in flight.names[:2])
    first.write_text(first.read_text().replace("xcr:Rotation", "xcr:Gravity"))
    second.write_text(second.read_text().replace("brown4t2", "division"))
    source = read(tmp_path, "realityscan")
    assert len(source.views) == len(flight.names) - 2
    [note] = [note for note in source.warnings if "cannot be used" in note]
    assert "'division'" in note
    assert any("not aligned" in each and flight.names[0][:-4] in each for each in source.warnings)


def test_xmp_of_other_writers_is_read(tmp_path: Path, flight: KnownFlight) -> None:
    """RealityScan's own sample has the model division without distortion; other programs write three terms of six."""
    flight = replace(flight, lens=BentLens(k=(0, 0, 0, 0), p=(0, 0)))
    flight.write_photographs(tmp_path / "images")
    writers.write_realityscan_xmp(tmp_path / "images", flight)
    files = sorted((tmp_path / "images").glob("*.xmp"))
    for index, file in enumerate(files):
        text = file.read_text().replace('"brown4t2"', '"division"' if index % 2 else '"brown3"')
        file.write_text(text.replace("<xcr:DistortionCoeficients>0 0 0 ", "<xcr:DistortionCoeficients>"))
    check_numbers(read(tmp_path, "realityscan"), flight, placed=False)
    for file in files:
        file.write_text(file.read_text().replace("xcr:Version", 'xcr:ProjectionModel="spherical" xcr:Version'))
    with pytest.raises(CaptureError, match=r"12 of its 12 cameras cannot be used(.|\n)*'spherical' is not supported"):
        read(tmp_path, "realityscan")


def test_focal_lengths_in_pixels_are_refused(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_realityscan_csv(tmp_path / "cameras.csv", flight)
    flight.write_photographs(tmp_path / "images")
    file.write_text(file.read_text().replace(",31.5,", ",3656.4,"))
    with pytest.raises(CaptureError, match="in pixels"):
        read(tmp_path, "realityscan")


def test_rows_that_cannot_be_read_are_told_all_at_once(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_realityscan_csv(tmp_path / "cameras.csv", flight)
    flight.write_photographs(tmp_path / "images")
    lines = file.read_text().splitlines()
    lines[2], lines[5] = lines[2].replace(",", ",x", 1), "short.jpg,1,2"
    file.write_text("\n".join(lines))
    with pytest.raises(CaptureError, match=r"2 of its rows(.|\n)*line 3(.|\n)*line 6"):
        read(tmp_path, "realityscan")


@pytest.mark.parametrize("for_opencv", [True, False])
def test_rows_that_end_before_the_lens_are_refused(tmp_path: Path, flight: KnownFlight, for_opencv: bool) -> None:
    """The terms that are cut off would be taken for zeros."""
    write = writers.write_realityscan_opencv_csv if for_opencv else writers.write_realityscan_csv
    file = write(tmp_path / "cameras.csv", flight)
    flight.write_photographs(tmp_path / "images")
    lines = file.read_text().splitlines()
    lines[3] = lines[3].rsplit(",", 3)[0]
    file.write_text("\n".join(lines))
    with pytest.raises(CaptureError, match=r"1 of its rows(.|\n)*line 4: ends before \w+, \w+, \w+$"):
        read(tmp_path, "realityscan")


def test_rows_may_leave_out_the_terms_that_no_row_has(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_realityscan_csv(tmp_path / "cameras.csv", flight)
    whole = realityscan.read_camera_table(file)
    head, *rows = file.read_text().splitlines()
    file.write_text("\n".join([f"{head},pxpix", *rows[:2], *(f"{row}," for row in rows[2:])]))
    assert [camera.lens for camera in realityscan.read_camera_table(file)] == [camera.lens for camera in whole]
    file.write_text("name,x,y,alt,heading,pitch,roll,f,k1,k2,k3\na.jpg,1,2,3,4,5,6,35,0.1\nb.jpg,1,2,3,4,5,6,35,,,\n")
    assert [dict(camera.lens) for camera in realityscan.read_camera_table(file)] == [{"k1": 0.1}, {}]


@pytest.mark.parametrize(
    ("head", "lacks"),
    [
        ("name,x,y,alt,heading,pitch,roll,fpix", "tx, ty, tz, r00"),
        ("name,tx,ty,tz,r00,r01,r02,r10,r11,r12,r20,r21,r22,f", "x, y, alt, heading"),
    ],
)
def test_a_table_whose_focal_length_is_not_of_its_poses_is_refused(tmp_path: Path, head: str, lacks: str) -> None:
    file = tmp_path / "cameras.csv"
    file.write_text(f"{head}\n{','.join(['1'] * len(head.split(',')))}\n")
    with pytest.raises(CaptureError, match=f"has no column {lacks}"):
        realityscan.read_camera_table(file)


def test_equal_names_in_a_project_that_knows_no_folders_need_names_of_their_own(
    tmp_path: Path, flight: KnownFlight
) -> None:
    """No choice of a folder tells them apart, and none is advised."""
    names = [f"DJI_{k % 6:04d}.JPG" for k in range(12)]
    writers.write_realityscan_csv(tmp_path / "cameras.csv", replace(flight, names=names))
    replace(flight, names=[f"{'ab'[k // 6]}/{name}" for k, name in enumerate(names)]).write_photographs(
        tmp_path / "images"
    )
    for images in (None, str(tmp_path / "images" / "a")):
        with pytest.raises(CaptureError, match=r"names of their own(.|\n)*export it again") as refused:
            read_source(tmp_path, CaptureOptions(images=images), needs_points=False)
        assert "--images" not in str(refused.value)


@pytest.mark.parametrize("as_table", [True, False])
def test_earth_centred_cameras_are_placed(tmp_path: Path, flight: KnownFlight, as_table: bool) -> None:
    axes, centers = enu_axes(*ORIGIN[:2]), ecef(flight.centers)
    poses = np.array(flight.poses)
    poses[:, :3, :3] = poses[:, :3, :3] @ axes
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], centers)
    flight.write_photographs(tmp_path / "images")
    if as_table:
        writers.write_realityscan_csv(tmp_path / "cameras.csv", flight, centers, poses)
    else:
        writers.write_realityscan_xmp(tmp_path / "images", replace(flight, poses=poses))
    source = read(tmp_path, "realityscan")
    check_numbers(source, flight)
    assert source.georef is not None
    assert "Earth-centred" in source.georef.method


def test_projected_coordinates_as_far_from_their_origin_as_the_earth_is_wide_are_not_earth_centred() -> None:
    assert not is_earth_centered(np.array([[500_000.0, 6_360_000.0, 80.0]]))  # UTM in Scotland
    assert is_earth_centered(ecef(np.zeros((1, 3))))


def test_skew_and_aspect_of_xmp_are_read_to_their_numbers(tmp_path: Path, flight: KnownFlight) -> None:
    """RealityScan counts the skew, like the principal point, in shares of the longer side."""
    flight.write_photographs(tmp_path / "images")
    writers.write_realityscan_xmp(tmp_path / "images", flight)
    for file in (tmp_path / "images").rglob("*.xmp"):
        text = file.read_text().replace('xcr:Skew="0"', 'xcr:Skew="0.002"')
        file.write_text(text.replace('xcr:AspectRatio="1"', 'xcr:AspectRatio="1.01"'))
    lens = flight.lens
    bent = brown_intrinsics(
        (lens.focal, 1.01 * lens.focal), lens.center, lens.size, lens.k, lens.p, 0.002 * max(lens.size)
    )
    view = read(tmp_path, "realityscan").views[0]
    np.testing.assert_allclose(view.intrinsics.params, bent.params, rtol=1e-9)


def test_a_table_in_pixels_is_of_the_photographs_that_were_aligned() -> None:
    """Photographs may be shrunk evenly; the lens follows where the principal point tells by how much."""
    camera = RegisteredCamera(
        name="a.jpg", camera_from_world=np.eye(4), focal_35mm=3650.0, lens={"px": 2747.0, "py": 1815.0}, in_pixels=True
    )
    for size in ((5472, 3648), (2736, 1824)):
        lens = camera.intrinsics(size, Path("cameras.csv"))
        assert (lens.width, lens.height, lens.focal[0]) == (5472, 3648, 3650.0)
    for share in (0.8, 1.5):
        with pytest.raises(CaptureError, match="of another size"):
            camera.intrinsics((round(5472 * share), round(3648 * share)), Path("cameras.csv"))
