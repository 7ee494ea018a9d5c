"""Point clouds for other programs: PLY, LAS and LAZ, read back by laspy and by our own reader of captures."""

import importlib.util
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from support.full_disk import room_for
from support.gaussians import random_gaussians
from vdgs.captures.formats.ply_reader import read_point_cloud
from vdgs.errors import VdgsError
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene

laspy = pytest.importorskip("laspy")
ORIGIN = (690_000.5, 5_334_000.25, 512.75)


@pytest.mark.parametrize("ending", [".las", ".laz"])
def test_points_stand_where_the_map_says(tmp_path, ending):
    some = random_gaussians(500, 1, reach=800.0)
    path = tmp_path / f"a{ending}"
    chunks = iter([some.select(torch.arange(200)), some.select(torch.arange(200, 500))])
    registry.write_scene(
        path, ExportScene(chunks=chunks, count=500, degree=1, metadata=ExportMetadata(ORIGIN, "EPSG:32632"))
    )
    read = laspy.read(path)
    assert len(read.points) == 500
    assert read.header.are_points_compressed == (ending == ".laz")
    np.testing.assert_allclose(read.xyz, some.means.double().numpy() + np.array(ORIGIN), atol=0.0005 + 1e-9, rtol=0)
    assert read.header.parse_crs().to_epsg() == 32632
    np.testing.assert_allclose(np.asarray(read.intensity) / 65535, some.opacity_logits.sigmoid().numpy(), atol=1e-5)
    shown = np.clip(0.5 + 0.28209479 * some.sh0.numpy(), 0, 1)
    read_colors = np.stack([np.asarray(read[name]) for name in ("red", "green", "blue")], 1) / 65535
    np.testing.assert_allclose(read_colors, shown, atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize(
    "name",
    ["EPSG:32632", "EPSG:2056", "EPSG:4978", "EPSG:2263", "EPSG:31467", "EPSG:32761", "EPSG:25832+7837", "EPSG:7415",
     "+proj=utm +zone=33 +ellps=bessel +towgs84=1,2,3,0,0,0,0 +units=m +type=crs"],
)  # fmt: skip
def test_las_holds_its_system_as_the_standard_asks(tmp_path, name):
    """WKT 1 (OGC 01-009) in record 2112, which programs without PROJ look for; x stays east where EPSG has north
    first."""
    pyproj = pytest.importorskip("pyproj")
    given = pyproj.CRS.from_user_input(name)
    registry.write_scene(tmp_path / "a.las", ExportScene.of(random_gaussians(5, 0), ExportMetadata(ORIGIN, name)))
    header = laspy.read(tmp_path / "a.las").header
    (record,) = header.vlrs
    assert header.global_encoding.wkt
    assert (record.user_id, record.record_id) == ("LASF_Projection", 2112)
    assert record.string.startswith(("PROJCS[", "GEOCCS[", "COMPD_CS["))
    read = header.parse_crs()
    assert (read.is_compound, read.is_bound) == (given.is_compound, given.is_bound)
    first = [axis.direction for axis in read.axis_info]
    if [axis.direction for axis in given.axis_info][:2] == ["north", "east"]:
        assert first == ["east", "north"]
    else:
        assert read.equals(given)
    there = pyproj.Transformer.from_crs(read, given, always_xy=True).transform(*ORIGIN)
    np.testing.assert_allclose(there, ORIGIN, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["EPSG:8857", "3d"])
def test_las_holds_what_wkt_1_cannot_say_as_wkt_2(tmp_path, name):
    pyproj = pytest.importorskip("pyproj")
    given = pyproj.CRS(32632).to_3d() if name == "3d" else pyproj.CRS(name)
    scene = ExportScene.of(random_gaussians(5, 0), ExportMetadata(ORIGIN, given.to_wkt()))
    notes = registry.write_scene(tmp_path / "a.las", scene)
    assert any("WKT 2" in note and given.name in note for note in notes)
    assert laspy.read(tmp_path / "a.las").header.parse_crs().equals(given)


def test_without_a_map_coordinates_are_local(tmp_path):
    some = random_gaussians(20, 0)
    registry.write_scene(tmp_path / "a.laz", ExportScene.of(some))
    read = laspy.read(tmp_path / "a.laz")
    np.testing.assert_allclose(read.xyz, some.means.numpy(), atol=0.00051)
    assert read.header.parse_crs() is None
    assert read.header.global_encoding.wkt
    place = (48.1, 11.6, 512.0)
    registry.write_scene(tmp_path / "a.las", replace(ExportScene.of(some), metadata=ExportMetadata(geodetic=place)))
    assert json.loads((tmp_path / "a.las.json").read_text())["geodetic"] == list(place)


def test_what_qgis_made_of_an_earlier_cloud_is_named(tmp_path):
    scene = partial(ExportScene.of, random_gaussians(5, 0))
    assert not any("QGIS" in note for note in registry.write_scene(tmp_path / "a.las", scene()))
    (tmp_path / "a.copc.laz").touch()
    for name in ("a.las", "a.laz"):
        assert any(note.startswith("a.copc.laz beside it") for note in registry.write_scene(tmp_path / name, scene()))
    assert not any("QGIS" in note for note in registry.write_scene(tmp_path / "b.las", scene()))


@pytest.mark.parametrize("ending", [".las", ".laz"])
@pytest.mark.parametrize("kept", [0.05, 0.5, 0.999])
def test_points_for_which_the_disk_has_no_room_are_reported_and_absent(tmp_path, ending, kept):
    """lazrs has an error of its own for it."""
    path, scene = tmp_path / f"a{ending}", partial(ExportScene.of, random_gaussians(6000, 0))
    registry.write_scene(path, scene())
    size = path.stat().st_size
    for file in tmp_path.iterdir():
        file.unlink()
    with room_for(int(kept * size)), pytest.raises(VdgsError, match=f"a{ending}: cannot be written"):
        registry.write_scene(path, scene())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("reach", [1e-4, 0.5, 4000.0])
def test_a_scene_of_unknown_size_keeps_its_points_apart(tmp_path, reach):
    """A millimetre is nothing that such a scene has: steps go by how far it reaches."""
    some = random_gaussians(300, 0, reach=reach)
    origin = (5.5, -6.25, 7.0)
    registry.write_scene(tmp_path / "a.las", ExportScene.of(some, ExportMetadata(origin, unit="units")))
    off = laspy.read(tmp_path / "a.las").xyz - np.array(origin) - some.means.double().numpy()
    assert np.abs(off).max() <= 1e-7 * reach


@pytest.mark.parametrize("unit", ["metre", "US survey foot", "units"])
def test_what_las_rounds_to_is_said(tmp_path, unit):
    scene = ExportScene.of(random_gaussians(300, 0, reach=3.0), ExportMetadata(unit=unit))
    notes = registry.write_scene(tmp_path / "a.las", scene)
    step = laspy.read(tmp_path / "a.las").header.scales[0]
    assert f"coordinates are rounded to {step:g} {unit}" in notes
    assert step == (1e-8 if unit == "units" else 0.001)


def test_what_las_does_not_reach_is_refused_before_work(tmp_path):
    far = random_gaussians(5, 0)
    far.means[3, 0] = 2.5e6
    for bounds in (ExportScene.of(far).bounds, None):
        with pytest.raises(VdgsError, match=r"lies 2\.5e\+06 units from the origin.*--bbox"):
            registry.write_scene(tmp_path / "a.las", replace(ExportScene.of(far), bounds=bounds))
    assert list(tmp_path.iterdir()) == []
    unknown = replace(ExportScene.of(far), metadata=ExportMetadata(unit="units"))
    registry.write_scene(tmp_path / "a.las", unknown)
    assert laspy.read(tmp_path / "a.las").xyz.max() == 2.5e6


def test_facts_of_an_earlier_file_without_a_map_go(tmp_path):
    """Beside a file that knows its map they would tell another place."""
    some = random_gaussians(5, 0)
    registry.write_scene(tmp_path / "a.las", ExportScene.of(some, ExportMetadata((5.0, 6.0, 7.0), unit="units")))
    assert (tmp_path / "a.las.json").is_file()
    registry.write_scene(tmp_path / "a.las", ExportScene.of(some, ExportMetadata(ORIGIN, "EPSG:32632")))
    assert not (tmp_path / "a.las.json").exists()


def test_a_wrong_map_is_refused_before_work(tmp_path):
    with pytest.raises(VdgsError, match="'EPSG:1' is not understood"):
        registry.check_export(
            tmp_path / "a.laz", ExportScene(chunks=[], count=5, degree=0, metadata=ExportMetadata(crs="EPSG:1"))
        )


def test_missing_packages_are_named(tmp_path, monkeypatch):
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "lazrs" else there(name))
    with pytest.raises(VdgsError, match=r"needs lazrs, not installed.*pip install 'vdgs\[geo\]'"):
        registry.check_export(tmp_path / "a.laz", ExportScene(chunks=[], count=5, degree=0))
    registry.check_export(tmp_path / "a.las", ExportScene(chunks=[], count=5, degree=0))


def test_a_point_cloud_has_colors_and_opacity(tmp_path):
    some = random_gaussians(40, 2)
    notes = registry.write_scene(tmp_path / "a.points.ply", ExportScene.of(some, ExportMetadata(ORIGIN)))
    assert "these are points" in notes[0]
    places, shown = read_point_cloud(tmp_path / "a.points.ply")
    np.testing.assert_array_equal(places, some.means.numpy())
    np.testing.assert_allclose(shown / 255, np.clip(0.5 + 0.28209479 * some.sh0.numpy(), 0, 1), atol=0.5 / 255 + 1e-6)
    assert b"comment origin [690000.5, 5334000.25, 512.75]" in (tmp_path / "a.points.ply").read_bytes()
