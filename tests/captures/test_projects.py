"""Projects of other programs as captures: from their files to photographs without distortion in the ground frame."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.captures import TinyScene, render_plane, tiny_scene, write_colmap, write_ply
from support.metashape_files import LOCAL, WGS84, metashape_xml
from support.true_flight import ORIGIN, true_flight, words
from vdgs.captures.capture import Capture
from vdgs.captures.formats.brown_lens import brown_intrinsics, unproject_pixels
from vdgs.captures.formats.project_photographs import find_photographs
from vdgs.captures.loading import load_capture
from vdgs.captures.nested_captures import model_below
from vdgs.captures.output_guard import is_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_axes, enu_from_geodetic, geodetic_from_enu
from vdgs.runs.run_settings import with_absolute_paths
from vdgs.system.quoting import shell_word

WIDTH, HEIGHT = 96, 72
LENS = brown_intrinsics((90.5, 90.0), (49.0, 35.5), (WIDTH, HEIGHT), (-0.06, 0.01, -0.01, 0.01), (0.001, -0.002), 0.3)


@pytest.fixture(scope="module")
def scene() -> TinyScene:
    return tiny_scene(width=WIDTH, height=HEIGHT)


def write_project(root: Path, scene: TinyScene, photographs: Path | None = None, reference: str = WGS84) -> None:
    """Photographs as the bent lens shows the plane, cameras.xml and a point cloud, in metres about ORIGIN."""
    photographs = photographs or root / "photos"
    photographs.mkdir(parents=True)
    root.mkdir(exist_ok=True)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = unproject_pixels(LENS, np.stack([u.ravel(), v.ravel()], axis=1)).reshape(HEIGHT, WIDTH, 2)
    grid = (rays * 250 + [200, 150] - 0.5).astype(np.float32)
    cameras = []
    for number, (name, camera) in enumerate(scene.cameras.items()):
        large = replace(camera, width=400, height=300, fx=250.0, fy=250.0, cx=200.0, cy=150.0)
        picture = cv2.remap(render_plane(large), grid[..., 0], grid[..., 1], cv2.INTER_LINEAR)
        assert cv2.imwrite(str(photographs / name), picture[:, :, ::-1])
        pose = words(np.linalg.inv(camera.camera_from_world))
        cameras.append(
            f'<camera id="{number}" sensor_id="0" component_id="0" label="{Path(name).stem}"><transform>{pose}'
            "</transform></camera>"
        )
    axes, origin = enu_axes(*ORIGIN[:2]).T, ecef_from_geodetic(np.array([ORIGIN]))[0]
    if reference == LOCAL:
        axes, origin = np.eye(3), np.zeros(3)
    sensor = (
        f'<sensor id="0" label="x" type="frame"><calibration type="frame" class="adjusted"><resolution width="{WIDTH}" '
        f'height="{HEIGHT}"/><f>90</f><cx>1</cx><cy>-0.5</cy><b1>0.5</b1><b2>0.3</b2><k1>-0.06</k1><k2>0.01</k2>'
        "<k3>-0.01</k3><k4>0.01</k4><p1>-0.002</p1><p2>0.001</p2></calibration></sensor>"
    )
    placed = f"<transform><rotation>{words(axes)}</rotation><translation>{words(origin)}</translation>"
    placed += "<scale>1</scale></transform>"
    xml = metashape_xml(true_flight(), sensors=sensor, cameras="".join(cameras), transform=placed, reference=reference)
    (root / "cameras.xml").write_text(xml, encoding="utf-8")
    write_ply(root / "points.ply", scene.points, scene.colors)


def assert_true_pictures(capture: Capture, scene: TinyScene) -> None:
    """Photographs without distortion show what the plane shows to their cameras, and cameras see the true points."""
    assert len(capture.views) == len(scene.cameras)
    for view in capture.views:
        truth = scene.cameras[Path(view.name).name]
        pixels, depth = view.camera.project(capture.points)
        pose = truth.camera_from_world
        seen = scene.points @ pose[:3, :3].T + pose[:3, 3]
        expected = seen[:, :2] / seen[:, 2:] * (view.camera.fx, view.camera.fy) + (view.camera.cx, view.camera.cy)
        np.testing.assert_allclose(pixels[depth > 1], expected[depth > 1], atol=1e-2)
        shown = cv2.imread(str(view.image_path))[:, :, ::-1].astype(float)
        ideal = render_plane(replace(truth, width=view.camera.width, height=view.camera.height, fx=view.camera.fx,
                                     fy=view.camera.fy, cx=view.camera.cx, cy=view.camera.cy))  # fmt: skip
        assert np.abs(shown - ideal).mean() < 4


def test_a_project_is_a_capture_and_its_lenses_are_undone(tmp_path, scene):
    write_project(tmp_path, scene)
    for _ in range(2):  # undistorted photographs of the first time are no photographs of the second
        capture = load_capture(tmp_path)
        assert_true_pictures(capture, scene)
        assert (capture.source, capture.ground.metric) == ("metashape", True)
        middle = enu_from_geodetic(np.array([capture.ground.origin_geo]), ORIGIN)[0]
        to_world = geodetic_from_enu(capture.points, capture.ground.origin_geo, capture.ground.axes_origin)
        np.testing.assert_allclose(enu_from_geodetic(to_world, ORIGIN), scene.points, atol=1e-3)
        assert np.abs(middle[:2]).max() < 20
    assert is_capture(tmp_path)


def test_the_file_of_a_project_is_a_capture_with_photographs_anywhere(tmp_path, scene, monkeypatch):
    write_project(tmp_path / "project", scene, tmp_path / "card" / "DCIM")
    monkeypatch.chdir(tmp_path)
    file = Path("project/cameras.xml")
    capture = load_capture(file, CaptureOptions(images="card"))
    assert_true_pictures(capture, scene)
    assert capture.root == file.parent
    kept = with_absolute_paths(CaptureOptions(images="card"), file.resolve())
    assert kept.images == (tmp_path / "card").as_posix()
    monkeypatch.chdir("/")
    assert_true_pictures(load_capture(tmp_path / file, kept), scene)


def test_local_metres_stay_local_metres(tmp_path, scene):
    write_project(tmp_path, scene, reference=LOCAL)
    capture = load_capture(tmp_path)
    assert_true_pictures(capture, scene)
    assert (capture.ground.metric, capture.ground.origin_geo) == (True, None)
    np.testing.assert_allclose(capture.points, scene.points, atol=1e-5)


def test_the_place_of_a_project_and_another_one_contradict_each_other(tmp_path, scene):
    write_project(tmp_path, scene)
    georef = tmp_path / "georef.json"
    georef.write_text('{"origin_lat_deg": 1, "origin_lon_deg": 2, "origin_alt_m": 3}')
    capture = load_capture(tmp_path)
    assert any("georef.json is not used" in each for each in capture.warnings)
    with pytest.raises(CaptureError, match="says itself where it lies"):
        load_capture(tmp_path, CaptureOptions(georef=georef))


def test_photographs_that_are_gone_are_all_named_and_strict_refuses(tmp_path, scene):
    write_project(tmp_path, scene)
    for name in ("frame_003.png", "frame_007.png"):
        (tmp_path / "photos" / name).unlink()
    capture = load_capture(tmp_path)
    assert len(capture.views) == 10
    assert any("2 of 12 images" in each and "frame_003, frame_007" in each for each in capture.warnings)
    with pytest.raises(CaptureError, match=r"2 of 12 images .*--strict(?s:.)*frame_003(?s:.)*frame_007"):
        load_capture(tmp_path, CaptureOptions(strict=True))
    for number in range(5):
        (tmp_path / "photos" / f"frame_{number:03d}.png").unlink(missing_ok=True)
    with pytest.raises(CaptureError, match="at least 67% must be there"):
        load_capture(tmp_path)


def test_strict_is_about_every_format(tmp_path, scene):
    write_colmap(tmp_path, scene)
    (tmp_path / "images" / "frame_003.png").unlink()
    assert len(load_capture(tmp_path).views) == 11
    with pytest.raises(CaptureError, match=r"1 of 12 images(?s:.)*frame_003"):
        load_capture(tmp_path, CaptureOptions(strict=True))


def test_a_colmap_model_beside_a_project_is_read_and_the_project_named(tmp_path, scene):
    write_colmap(tmp_path, scene)
    (tmp_path / "cameras.xml").write_text(metashape_xml(true_flight()), encoding="utf-8")
    capture = load_capture(tmp_path)
    assert capture.source == "colmap"
    assert any("metashape beside it: not read" in each for each in capture.warnings)


def test_a_project_below_is_named_with_the_command_that_reads_it(tmp_path, scene):
    write_project(tmp_path / "export", scene, tmp_path / "my photos")
    said = model_below(tmp_path)
    assert said is not None
    assert (
        f"vdgs run {shell_word(tmp_path / 'export/cameras.xml')} --images {shell_word(tmp_path)} --output RUN" in said
    )
    capture = load_capture(tmp_path / "export" / "cameras.xml", CaptureOptions(images=str(tmp_path)))
    assert_true_pictures(capture, scene)


def test_exports_without_poses_do_not_stand_in_the_way_of_photographs(tmp_path, scene):
    """Metashape's exports of markers and references, and cameras that are not aligned, look alike from outside."""
    write_project(tmp_path, scene)
    whole = (tmp_path / "cameras.xml").read_text()
    for name in ("markers.xml", "reference.xml"):
        (tmp_path / name).write_text(re.sub("<transform>.*?</transform>", "", whole))
    (tmp_path / "bulk.xml").write_text('<BlocksExchange version="3.2"><Block><BulkPhotos/></Block></BlocksExchange>')
    assert_true_pictures(load_capture(tmp_path), scene)
    (tmp_path / "cameras.xml").unlink()
    assert not is_capture(tmp_path)
    for name in ("markers.xml", "bulk.xml"):
        with pytest.raises(CaptureError, match="no camera of it has a pose"):
            load_capture(tmp_path / name)


def _found(root, names, **options):
    return find_photographs(root, CaptureOptions(**options), [(name,) for name in names], root / "project.xml")


def test_photographs_of_other_folders_stand_in_for_none(tmp_path):
    """Cards number the photographs of each folder anew."""
    for folder, numbers in (("100MEDIA", range(6, 9)), ("101MEDIA", range(1, 9))):
        (tmp_path / folder).mkdir()
        for k in numbers:
            (tmp_path / folder / f"DJI_{k:04d}.JPG").touch()
    names = [f"D:\\DCIM\\{100 + (k < 5)}MEDIA\\DJI_{k:04d}.JPG" for k in range(1, 9)]
    found = _found(tmp_path, names)
    assert [path.is_file() for path in found.paths] == [True] * 4 + [False] + [True] * 3
    assert not (tmp_path / found.names[4]).is_file()
    assert "DCIM/100MEDIA/DJI_0005.JPG, for which 101MEDIA/DJI_0005.JPG is there" in found.warnings[0]
    shutil.rmtree(tmp_path / "100MEDIA")
    with pytest.raises(CaptureError, match=r"4 of its 8 photographs are only in other folders .* with --images"):
        _found(tmp_path, names)
    assert all(path.is_file() for path in _found(tmp_path, names, images="101MEDIA").paths)  # a person says so
    (tmp_path / "101MEDIA").rename(tmp_path / "all of them")
    assert all(path.is_file() for path in _found(tmp_path, names).paths)


def test_folders_above_that_are_others_count_too(tmp_path):
    (tmp_path / "flight2" / "images").mkdir(parents=True)
    for k in range(3):
        (tmp_path / "flight2" / "images" / f"{k}.jpg").touch()
    with pytest.raises(CaptureError, match="3 of its 3 photographs are only in other folders"):
        _found(tmp_path, [f"/data/flight1/images/{k}.jpg" for k in range(3)])
    assert all(path.is_file() for path in _found(tmp_path, [f"/data/flight2/images/{k}.jpg" for k in range(3)]).paths)
