"""Which file, cameras, scale and point cloud are used where people's Metashape projects hold several, or too little."""

from __future__ import annotations

import re
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support import metashape_files
from support.captures import look_down, write_ply
from support.metashape_files import (
    CHUNK_ROTATION,
    LOCAL,
    WGS84,
    chunk_from_enu,
    metashape_calibration,
    metashape_transform,
    metashape_xml,
    read_export,
    write_project,
)
from support.true_flight import ORIGIN, TrueFlight, assert_true, true_flight
from vdgs.captures.formats.source_capture import NoTiePoints
from vdgs.captures.loading import read_files
from vdgs.captures.project_formats import read_project
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu

OPTIONS = CaptureOptions()
GRAY = 90


def write_cloud(file: Path, points: np.ndarray) -> None:
    """A PLY of doubles: degrees need them."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    listed = "".join(f"property double {axis}\n" for axis in "xyz")
    file.write_bytes((head + listed + "end_header\n").encode() + points.astype("<f8").tobytes())


# ----------------------------------------------------------------------------------------------- which file


def test_of_a_project_and_its_export_the_project_is_read(tmp_path: Path) -> None:
    flight = true_flight(count=4)
    flight.touch(tmp_path)
    project, export = write_project(tmp_path, flight), tmp_path / "cameras.xml"
    export.write_text(metashape_xml(flight))
    source = read_project(tmp_path, "metashape", OPTIONS)
    assert len(source.points) == len(flight.points)
    assert any("project.psx and cameras.xml beside it the project is read" in each for each in source.warnings)
    source = read_project(export, "metashape", OPTIONS, needs_points=False)
    assert any("cameras.xml is read, not project.psx" in each for each in source.warnings)
    with pytest.raises(NoTiePoints, match=r"which has tie points: \S+project\.psx"):
        read_project(export, "metashape", OPTIONS)
    (tmp_path / "project.files" / "project.zip").unlink()  # not whole
    assert not len(read_project(tmp_path, "metashape", OPTIONS, needs_points=False).points)
    assert project.is_file()


def test_an_export_tells_which_of_several_projects_is_meant(tmp_path: Path) -> None:
    flight = true_flight(count=4)
    flight.touch(tmp_path)
    write_project(tmp_path, flight)
    write_project(tmp_path, flight, suffix=".psz")
    (tmp_path / "cameras.xml").write_text(metashape_xml(flight))
    assert_true(read_project(tmp_path, "metashape", OPTIONS, needs_points=False), flight)


def test_an_export_tells_which_of_several_chunks_is_meant(tmp_path: Path) -> None:
    """Where the active chunk has no cameras that are aligned, as one that was just begun."""
    flight = true_flight(count=4)
    flight.touch(tmp_path)
    write_project(tmp_path, flight)
    folder = tmp_path / "project.files"
    shutil.copytree(folder / "0", folder / "1")
    chunks = "".join(f'<chunk id="{number}" path="{number}/chunk.zip"/>' for number in (0, 1))
    with zipfile.ZipFile(folder / "project.zip", "w") as archive:
        archive.writestr("doc.xml", f'<document version="1.2.0"><chunks active_id="2">{chunks}</chunks></document>')
    with pytest.raises(CaptureError, match="2 chunks have cameras"):
        read_project(tmp_path, "metashape", OPTIONS)
    (tmp_path / "cameras.xml").write_text(metashape_xml(flight))
    assert_true(read_project(tmp_path, "metashape", OPTIONS, needs_points=False), flight)
    with pytest.raises(NoTiePoints) as raised:
        read_project(tmp_path, "metashape", OPTIONS)
    assert "give the project itself" not in str(raised.value)


# -------------------------------------------------------------------------------------------------- cameras


@pytest.mark.parametrize("band", ["Green", "LWIR"])
def test_sensors_of_other_bands_are_left_out_beside_those_in_color(tmp_path: Path, band: str) -> None:
    flight = true_flight()
    label = '<bands><band label="Red"/></bands>'
    colors = label.replace("/></", '/><band label="Green"/><band label="Blue"/></')
    other = f'<sensor id="1" label="M3M, MS" type="frame"><bands><band label="{band}"/></bands>'
    other += f"{metashape_calibration(flight.lens)}</sensor>"
    xml = re.sub(r'<camera id="([4-7])" sensor_id="0"', r'<camera id="\1" sensor_id="1"', metashape_xml(flight))
    xml = xml.replace("</sensors>", f"{other}</sensors>")
    source = read_export(tmp_path, xml.replace(label, colors), flight)
    assert_true(source, replace(flight, names=flight.names[:4]))
    assert any(f"4 cameras show other bands ({band})" in each for each in source.warnings)
    alone = xml.replace(label, f'<bands><band label="{band}"/></bands>')
    assert_true(read_export(tmp_path, alone, flight), flight)


# ---------------------------------------------------------------------------------------------------- scale


def without_scale(xml: str) -> str:
    return re.sub(r"<scale .*?</scale>", "", xml)


@pytest.mark.parametrize("reference", [LOCAL, WGS84, ""])
def test_a_transform_without_scale_turns_and_does_not_give_metres(tmp_path: Path, reference: str) -> None:
    flight = true_flight()
    xml = without_scale(metashape_xml(flight, reference=reference, transform=metashape_transform(LOCAL)))
    flight.touch(tmp_path)
    write_ply(tmp_path / "cloud.ply", chunk_from_enu(flight.points), np.full((len(flight.points), 3), GRAY, np.uint8))
    (tmp_path / "cameras.xml").write_text(xml)
    source = read_project(tmp_path, "metashape", OPTIONS)
    assert source.georef is None
    turned = chunk_from_enu(flight.points) @ CHUNK_ROTATION.T
    np.testing.assert_allclose(np.ptp(source.points, axis=0), np.ptp(turned, axis=0), rtol=1e-4)
    for view in source.views:  # as the flight has them
        np.testing.assert_allclose(view.camera_from_world[:3, :3], flight.rotations[flight.names.index(view.name)])


@pytest.mark.parametrize(("reference", "enabled", "is_metric"), [("", "1", True), ("", "0", False), (LOCAL, "0", True)])
def test_the_scale_one_gives_metres_where_a_system_or_references_say_so(
    tmp_path: Path, reference: str, enabled: str, is_metric: bool
) -> None:
    flight = true_flight()
    transform = re.sub(r"(<scale .*?>).*?<", r"\g<1>1<", metashape_transform(LOCAL))
    xml = metashape_xml(flight, reference=reference, transform=transform).replace('enabled="1"', f'enabled="{enabled}"')
    assert (read_export(tmp_path, xml, flight).georef is not None) == is_metric


def test_components_without_scale_are_left_out_beside_one_with_scale(tmp_path: Path) -> None:
    flight = true_flight()
    xml = re.sub(r'(<camera id="[67]" sensor_id="0" component_id=)"0"', r'\1"1"', metashape_xml(flight))
    turned = f'<component id="1">{without_scale(metashape_transform(LOCAL))}</component></components>'
    source = read_export(tmp_path, xml.replace("</components>", turned), flight)
    assert_true(source, replace(flight, names=flight.names[:6]))
    assert any("2 cameras of other components" in each for each in source.warnings)


def test_a_transform_that_does_not_lead_to_the_globe_gives_no_place(tmp_path: Path) -> None:
    """A chunk of WGS 84 whose scale is of scale bars alone."""
    flight = true_flight()
    source = read_export(tmp_path, metashape_xml(flight, transform=metashape_transform(LOCAL)), flight)
    assert source.georef.origin is None
    assert_true(source, flight)
    assert any("no place on Earth, though the chunk is of WGS 84" in each for each in source.warnings)


# ---------------------------------------------------------------------------------------------- point clouds


def grid_flight() -> TrueFlight:
    """A flight in lines that looks straight down, with points beyond it."""
    generator = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(-150, 151, 50.0), np.arange(-150, 151, 50.0))
    centers = np.column_stack([x.ravel(), y.ravel(), generator.normal(100, 1, x.size)])
    rotations = np.stack([look_down(center, 0.0, 0.0)[:3, :3] for center in centers])
    ground = np.column_stack([generator.uniform(-170, 170, (3000, 2)), generator.normal(0, 2, 3000)])
    far = np.column_stack([generator.uniform(-450, 450, (30, 2)), generator.normal(0, 2, 30)])
    names = [f"DCIM/100MEDIA/DJI_{index:04d}.JPG" for index in range(len(centers))]
    return TrueFlight(names, rotations, centers, np.vstack([ground, far]))


def test_degrees_are_not_metres_of_a_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the chunk's coordinates, which are those of its first camera, they are at one spot that cameras see."""
    monkeypatch.setattr(metashape_files, "CHUNK_ROTATION", np.diag([1.0, -1, -1]))
    monkeypatch.setattr(metashape_files, "CHUNK_ORIGIN", np.array([0.0, 0, 100]))
    flight = grid_flight()
    flight.touch(tmp_path)
    (tmp_path / "cameras.xml").write_text(metashape_xml(flight))
    geodetic = geodetic_from_enu(flight.points, ORIGIN)
    write_cloud(tmp_path / "points.ply", geodetic[:, [1, 0, 2]])
    source = read_files(tmp_path, OPTIONS)
    np.testing.assert_allclose(source.points, enu_from_geodetic(geodetic, source.georef.origin), atol=1e-3)
    assert any("coordinates of WGS 84" in each for each in source.warnings)
    write_cloud(tmp_path / "points.ply", geodetic[:, [1, 0, 2]] + [5, 0, 0])
    with pytest.raises(NoTiePoints, match="not where the cameras"):
        read_files(tmp_path, OPTIONS)


@pytest.mark.parametrize(("code", "meters"), [(32632, 1.0), (2225, 1200 / 3937)])
def test_a_las_file_is_read_in_the_system_that_its_header_names(tmp_path: Path, code: int, meters: float) -> None:
    """Also in feet, heights too, of a system that has no heights."""
    laspy, pyproj = pytest.importorskip("laspy"), pytest.importorskip("pyproj")
    flight = true_flight()
    flight.touch(tmp_path)
    (tmp_path / "cameras.xml").write_text(metashape_xml(flight))
    geodetic = geodetic_from_enu(flight.points, ORIGIN)
    to_system = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True)
    x, y = to_system.transform(geodetic[:, 1], geodetic[:, 0])
    header = laspy.LasHeader(point_format=2, version="1.4")
    header.offsets, header.scales = [x.min(), y.min(), 0], [0.001] * 3
    header.add_crs(pyproj.CRS(code))
    las = laspy.LasData(header)
    las.x, las.y, las.z = x, y, geodetic[:, 2] / meters
    las.write(tmp_path / "cloud.las")
    source = read_files(tmp_path, OPTIONS)
    truth = enu_from_geodetic(geodetic, source.georef.origin)
    np.testing.assert_allclose(source.points, truth, atol=0.01 if code == 32632 else 3.0)
    assert any(f"coordinates of {pyproj.CRS(code).name}" in each for each in source.warnings)
