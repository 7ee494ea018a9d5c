"""Files for single programs: how their axes stand, compressed PLYs, versions of SPZ, what killed exports leave."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from support.commands import python
from support.gaussians import overhead, picture, psnr, random_gaussians
from vdgs.config.commands import ExportRequest
from vdgs.errors import VdgsError
from vdgs.export.formats import registry, spz
from vdgs.export.formats.axes import ALL, Y_UP_LEFT, Axes, reoriented
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene, base_colors
from vdgs.export.formats.gaussian_ply import short_name
from vdgs.export.programs import FREE, PROGRAMS, axes_for, with_files
from vdgs.geometry.camera import Camera
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import host_mark, process_mark
from vdgs.system.scratch import QUIET_SECONDS, remove_leftovers, scratch_folder

pytestmark = pytest.mark.slow

MODULES = Path(os.environ.get("VDGS_NODE") or "none") / "node_modules"
CONVERTER = MODULES / "@playcanvas/splat-transform/bin/cli.mjs"


def turned_camera(camera: Camera, turn: np.ndarray) -> Camera:
    """The camera that sees a turned scene as this one sees the scene."""
    pose = camera.camera_from_world.copy()
    pose[:3, :3] = pose[:3, :3] @ turn.T
    return replace(camera, camera_from_world=pose)


# Axes


@pytest.mark.parametrize("axes", ALL, ids=lambda axes: axes.name)
def test_a_scene_along_other_axes_is_the_same_scene(axes: Axes):
    some = random_gaussians(200, 3)
    there = axes.of_ground(some)
    back = axes.to_ground(there)
    np.testing.assert_allclose(there.means, some.means.numpy() @ axes.turn.T, atol=1e-6)
    for name in ("means", "log_scales", "opacity_logits", "sh0", "shN"):
        torch.testing.assert_close(back.tensors()[name], some.tensors()[name], atol=1e-5, rtol=1e-4)
    if np.linalg.det(axes.turn) > 0:
        shown = picture(there, turned_camera(overhead(), axes.turn))
        assert psnr(shown, picture(some)) > 60


def test_a_mirrored_scene_shows_the_mirrored_picture():
    """In a mirrored scene a mirrored camera sees what the camera sees, its right for its left."""
    some, camera = random_gaussians(200, 3), overhead()
    mirror = np.diag([1.0, 1.0, -1.0])
    pose = np.eye(4)
    flip = np.diag([-1.0, 1.0, 1.0])  # of the picture's own x, so that the camera stays right-handed
    pose[:3, :3] = flip @ camera.camera_from_world[:3, :3] @ mirror
    pose[:3, 3] = flip @ camera.camera_from_world[:3, 3]
    shown = picture(reoriented(some, mirror), replace(camera, camera_from_world=pose))
    assert psnr(shown[:, ::-1], picture(some)) > 60
    assert psnr(shown, picture(some)) < 30


@pytest.mark.parametrize("axes", ALL, ids=lambda axes: axes.name)
@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "a.splat"])
@pytest.mark.parametrize("has_compass", [True, False])
def test_files_along_any_axes_are_read_back_into_the_ground_frame(tmp_path, axes: Axes, name: str, has_compass: bool):
    some = random_gaussians(300, 0 if name.endswith("splat") else 2)
    scene = ExportScene.of(some, ExportMetadata(has_compass=has_compass))
    registry.write_scene(tmp_path / name, replace(scene, axes=axes))
    back = registry.read_gaussians(tmp_path / name)
    assert psnr(picture(back), picture(some)) > 28
    written = b"".join(each.read_bytes()[:2000] for each in sorted(tmp_path.iterdir()))
    assert axes.words(has_compass).encode() in written
    assert (b"east" in written or b"west" in written) == has_compass


def test_each_program_gets_its_axes_and_no_other_files(tmp_path):
    for name, program in PROGRAMS.items():
        asked = with_files(ExportRequest(run=tmp_path, program=name))
        (path,) = asked.output
        assert path == tmp_path / "export" / program.file
        assert axes_for(path, asked) is program.axes[registry.format_from_path(path).suffix]
        assert set(program.axes) <= {each.suffix for each in registry.FORMATS}
    with pytest.raises(VdgsError, match=r"a\.spz is no file for SuperSplat"):
        axes_for(Path("a.spz"), ExportRequest(run=tmp_path, program="supersplat"))
    with pytest.raises(VdgsError, match=r"Write tileset\.json"):
        axes_for(Path("a.ply"), ExportRequest(run=tmp_path, program="cesium"))
    with pytest.raises(VdgsError, match="Leave out one of them"):
        axes_for(Path("a.ply"), ExportRequest(run=tmp_path, program="spark", axes="y-up"))
    with pytest.raises(VdgsError, match="has axes of its own"):
        axes_for(Path("a.glb"), ExportRequest(run=tmp_path, axes="y-down"))
    assert {registry.format_from_path(Path(("a" if ending[0] == "." else "") + ending)).suffix for ending in FREE} == {
        *FREE
    }
    assert axes_for(Path("a.ply"), ExportRequest(run=tmp_path, axes="y-up-left")) is Y_UP_LEFT
    assert axes_for(Path("a.ply"), ExportRequest(run=tmp_path)) is None


# The compressed PLY of PlayCanvas


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (256, 1), (300, 2), (1000, 3)])
def test_a_compressed_ply_holds_the_scene(tmp_path, count: int, degree: int):
    some = random_gaussians(count, degree)
    lost = registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(some))
    assert "rounded" in lost[0]
    assert ("changing colors" in " ".join(lost)) is (degree > 0)
    data = (tmp_path / "a.compressed.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    assert b"element chunk %d\n" % math.ceil(count / 256) in head
    assert len(body) == math.ceil(count / 256) * 72 + count * (16 + 3 * ((degree + 1) ** 2 - 1))
    back = registry.read_gaussians(tmp_path / "a.compressed.ply")
    assert back.sh_degree == degree
    assert psnr(picture(back), picture(some)) > (30 if degree else 34)


def test_a_compressed_ply_rounds_by_half_a_step_and_no_more(tmp_path):
    """One chunk: steps are a 2047th or 1023rd of what it spans. Coefficients are cut off beyond -4 .. 4, and rounded to
    a 256th of it, by less than a whole step."""
    some = random_gaussians(250, 1)
    wide = np.random.default_rng(0).uniform(-4, 4, some.shN.shape)
    wide[:20] = np.sign(wide[:20]) * 9.0
    some = replace(some, shN=torch.from_numpy(wide.astype(np.float32)))
    (down,) = (axes for axes in ALL if axes.name == "y-down")
    written = down.of_ground(some)
    registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(some))
    read = down.of_ground(registry.read_gaussians(tmp_path / "a.compressed.ply"))
    read = read.select(torch.cdist(written.means, read.means).argmin(1))  # in Morton order
    steps = np.array([2047, 1023, 2047])
    for name in ("means", "log_scales"):
        wanted = written.tensors()[name].double().numpy()
        off = np.abs(read.tensors()[name].double().numpy() - wanted)
        assert (off <= 0.501 * np.ptp(wanted, axis=0) / steps + 1e-6).all(), name
    np.testing.assert_allclose(base_colors(read), base_colors(written), atol=np.ptp(base_colors(written)) / 510 + 1e-6)
    torch.testing.assert_close(
        read.opacity_logits.sigmoid(), written.opacity_logits.sigmoid(), atol=0.5 / 255 + 1e-6, rtol=0
    )
    # The three smaller parts of a rotation are within half of a 1023rd of sqrt(2).
    unit = torch.nn.functional.normalize(written.quaternions.double(), dim=1)
    assert 1 - float((unit * read.quaternions.double()).sum(1).abs().min()) < 3e-6
    # Along the axes of the file, where coefficients are what bytes stand for.
    np.testing.assert_allclose(read.shN.numpy(), written.shN.numpy().clip(-4 + 1 / 64, 4 - 1 / 64), atol=1 / 32 + 1e-4)


def test_what_neighbors_have_in_common_in_changing_colors_stays_as_large_as_it_is(tmp_path):
    """All coefficients are far below the least that a byte stands for, 1/64."""
    count = 1000
    common = torch.linspace(-0.009, 0.009, 45).reshape(1, 15, 3).expand(count, 15, 3)
    down = next(axes for axes in ALL if axes.name == "y-down")
    some = down.to_ground(replace(random_gaussians(count, 3), shN=common.contiguous()))  # as the file has them
    registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(some))
    read = down.of_ground(registry.read_gaussians(tmp_path / "a.compressed.ply")).shN
    assert float((read.mean(0) - common[0]).abs().max()) < 1 / 32 / count + 1e-5
    assert float((read[:100].mean(0) - common[0]).abs().max()) < 1 / 32 / 100 + 1e-5  # near each other, too
    # Coefficients change their sign at different Gaussians, so that none differs much from any side.
    assert float(read.mean((1, 2)).abs().max()) < 0.01


def test_the_independent_reader_of_playcanvas_reads_it(tmp_path):
    """splat-transform (MIT, npm) makes a plain PLY of it, with what it reads from it."""
    node = shutil.which("node")
    if node is None or not CONVERTER.is_file():
        pytest.skip("VDGS_NODE names no folder with it: npm install --prefix FOLDER @playcanvas/splat-transform")
    some = random_gaussians(700, 3)
    registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(some))
    subprocess.run([node, CONVERTER, "-w", "a.compressed.ply", "b.ply"], cwd=tmp_path, check=True, capture_output=True)
    theirs = registry.read_gaussians(tmp_path / "b.ply")
    ours = replace(ExportScene.of(registry.read_gaussians(tmp_path / "a.compressed.ply")))
    turned = next(axes for axes in ALL if axes.name == "y-down").of_ground(next(iter(ours.pieces())))
    theirs, mine = by_place(theirs), by_place(turned)
    torch.testing.assert_close(theirs.means, mine.means, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(theirs.log_scales, mine.log_scales, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(theirs.sh0, mine.sh0, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(theirs.shN, mine.shN, atol=0.04, rtol=1e-3)  # turned, bytes of 1/32 apart
    assert ((theirs.quaternions * mine.quaternions).sum(1).abs() > 0.9999).all()


def test_gaussforge_reads_it(tmp_path):
    gaussforge = pytest.importorskip("gaussforge")
    some = random_gaussians(700, 1)
    registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(some))
    answer = gaussforge.GaussForge().convert((tmp_path / "a.compressed.ply").read_bytes(), "compressed.ply", "ply")
    assert "data" in answer, answer
    (tmp_path / "b.ply").write_bytes(answer["data"])
    theirs = by_place(registry.read_gaussians(tmp_path / "b.ply"))
    down = next(axes for axes in ALL if axes.name == "y-down")
    mine = by_place(down.of_ground(registry.read_gaussians(tmp_path / "a.compressed.ply")))
    torch.testing.assert_close(theirs.means, mine.means, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(theirs.sh0, mine.sh0, atol=1e-3, rtol=1e-3)


def by_place(gaussians: Gaussians) -> Gaussians:
    """In the order of their places."""
    places = np.round(gaussians.means.double().numpy(), 3)
    return gaussians.select(torch.from_numpy(np.lexsort(places.T)))


@pytest.mark.parametrize("cut", [10, 2000, 16500])
def test_a_damaged_compressed_ply_is_refused(tmp_path, cut: int):
    registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(random_gaussians(1000, 0)))
    whole = (tmp_path / "a.compressed.ply").read_bytes()
    (tmp_path / "a.compressed.ply").write_bytes(whole[:-cut])
    with pytest.raises(VdgsError, match=r"truncated|no compressed PLY"):
        registry.read_gaussians(tmp_path / "a.compressed.ply")


# Versions of SPZ


@pytest.mark.parametrize("degree", [0, 3])
def test_version_4_holds_what_version_3_holds(tmp_path, degree: int):
    pytest.importorskip("zstandard", reason="zstandard is not installed (pip install zstandard)")
    some = random_gaussians(500, degree)
    for version in (3, 4):
        registry.write_scene(tmp_path / f"{version}.spz", replace(ExportScene.of(some), spz_version=version))
    data = (tmp_path / "4.spz").read_bytes()
    assert data[:8] == b"NGSP" + (4).to_bytes(4, "little")
    assert data[15] == (6 if degree else 5)
    three, four = (registry.read_gaussians(tmp_path / f"{version}.spz") for version in (3, 4))
    for name, tensor in three.tensors().items():
        torch.testing.assert_close(four.tensors()[name], tensor, atol=1e-6, rtol=1e-6)
    (tmp_path / "4.spz").write_bytes(data[:-50])
    with pytest.raises(VdgsError, match="damaged"):
        registry.read_gaussians(tmp_path / "4.spz")


@pytest.mark.parametrize("version", [2, 3, 4])
def test_niantics_own_code_reads_every_version(tmp_path, version: int):
    """In splat-transform, as WebAssembly."""
    node = shutil.which("node")
    if node is None or not CONVERTER.is_file():
        pytest.skip("VDGS_NODE names no folder with it: npm install --prefix FOLDER @playcanvas/splat-transform")
    some = random_gaussians(300, 2)
    registry.write_scene(tmp_path / "a.spz", replace(ExportScene.of(some), spz_version=version))
    subprocess.run([node, CONVERTER, "-w", "a.spz", "b.ply"], cwd=tmp_path, check=True, capture_output=True)
    theirs, mine = registry.read_gaussians(tmp_path / "b.ply"), registry.read_gaussians(tmp_path / "a.spz")
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # Niantic's code gives y down, z ahead, for a PLY
    up = next(axes for axes in ALL if axes.name == "y-up")
    theirs, mine = by_place(theirs), by_place(reoriented(up.of_ground(mine), down))
    torch.testing.assert_close(theirs.means, mine.means, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(theirs.shN, mine.shN, atol=0.01, rtol=1e-3)


def test_version_4_without_its_package_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(spz.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(VdgsError, match="pip install zstandard"):
        registry.write_scene(tmp_path / "a.spz", replace(ExportScene.of(random_gaussians(5, 0)), spz_version=4))


# Headers that other readers have room for


@pytest.mark.parametrize("name", ["a.ply", "a.points.ply", "a.compressed.ply"])
def test_no_line_of_a_header_is_long(tmp_path, name: str):
    pyproj = pytest.importorskip("pyproj")
    wkt = pyproj.CRS.from_epsg(32611).to_wkt()
    assert len(wkt) > 1024
    facts = ExportMetadata((500000.0, 3800000.0, 0.0), wkt)
    registry.write_scene(tmp_path / name, ExportScene.of(random_gaussians(20, 3), facts))
    head = (tmp_path / name).read_bytes().partition(b"end_header")[0].decode()
    assert max(map(len, head.splitlines())) < 256
    assert "comment crs EPSG:32611\n" in head
    assert pyproj.CRS.from_wkt((tmp_path / f"{name}.prj").read_text()).to_epsg() == 32611
    registry.write_scene(
        tmp_path / name, ExportScene.of(random_gaussians(20, 3))
    )  # no system now: none stays beside it
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_a_system_has_a_short_name():
    pyproj = pytest.importorskip("pyproj")
    for code in ("EPSG:25832", "EPSG:4978", "EPSG:2056", "ESRI:54009"):
        crs = pyproj.CRS.from_user_input(code)
        assert short_name(crs.to_wkt()) == code
        assert short_name(crs.to_wkt("WKT1_GDAL")) == code
    both = pyproj.CRS.from_user_input("EPSG:32633+5773")
    assert short_name(both.to_wkt()) == both.name
    assert short_name("EPSG:32633+5773") == "EPSG:32633+5773"


@pytest.mark.parametrize("name", ["a.ply", "a.points.ply", "a.las", "a.laz"])
def test_open3d_shows_the_points(tmp_path, name: str):
    """Where our camera sees their centres, in their colors. Map coordinates come by way of laspy, as Open3D reads no
    LAS."""
    open3d = pytest.importorskip("open3d", reason="Open3D is not installed (pip install open3d)")
    pyproj = pytest.importorskip("pyproj")
    laspy = pytest.importorskip("laspy")
    some, camera, place = random_gaussians(200, 3), overhead(), np.array((5e5, 3.8e6, 0.0))
    facts = ExportMetadata(tuple(place.tolist()), pyproj.CRS.from_epsg(32611).to_wkt())
    registry.write_scene(tmp_path / name, ExportScene.of(some, facts))
    if name.endswith(".ply"):
        cloud = open3d.t.io.read_point_cloud(str(tmp_path / name))
    else:
        read = laspy.read(tmp_path / name)
        cloud = open3d.t.geometry.PointCloud(np.ascontiguousarray(read.xyz - place, np.float32))
        cloud.point.colors = np.stack([read.red, read.green, read.blue], 1).astype(np.float32) / 65535
    np.testing.assert_allclose(cloud.point.positions.numpy(), some.means.numpy(), atol=6e-4)
    if name == "a.ply":
        return  # Open3D knows no harmonics: the points have no colors
    pinhole = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    shown = cloud.project_to_rgbd_image(
        camera.width, camera.height, open3d.core.Tensor(pinhole), open3d.core.Tensor(camera.camera_from_world),
        depth_scale=1.0, depth_max=1e6,
    )  # fmt: skip
    pixels, depth = camera.project(some.means.double().numpy())
    expected = np.zeros((camera.height, camera.width, 3))
    order = np.argsort(-depth)
    columns, rows = np.rint(pixels[order]).astype(int).T  # Open3D counts from the middle of the first pixel
    held = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    expected[rows[held], columns[held]] = base_colors(some)[order][held]
    color = np.asarray(shown.color)
    points = (color.max(axis=2) > 0) | (expected.max(axis=2) > 0)
    assert points.sum() > 100
    assert (np.abs(color - expected)[points].max(axis=1) < 0.01).mean() > (0.99 if name.endswith("ply") else 0.9)


BLENDER = """
import os, bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
file = os.environ["FILE"]
bpy.ops.import_scene.gltf(filepath=file) if file.endswith(".glb") else bpy.ops.wm.ply_import(filepath=file)
(found,) = [each for each in bpy.data.objects if each.type == "MESH"]
places = [list(found.matrix_world @ vertex.co) for vertex in found.data.vertices]
with open(file + ".read.json", "w") as out:
    import json
    json.dump({"places": places, "attributes": [each.name for each in found.data.attributes]}, out)
"""


@pytest.mark.parametrize("name", ["a.ply", "a.points.ply", "a.glb"])
def test_blender_reads_what_is_written_for_it(tmp_path, name: str):
    """At its place, z up, with what draws Gaussians: harmonics, opacities, sizes and turns as attributes."""
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("Blender's module is not installed (pip install bpy)")
    some, file = random_gaussians(200, 1), tmp_path / name
    axes = PROGRAMS["blender"].axes[registry.format_from_path(file).suffix]
    registry.write_scene(file, replace(ExportScene.of(some), axes=axes))
    environment = os.environ | {"FILE": str(file)}
    subprocess.run([sys.executable, "-c", BLENDER], env=environment, check=True, capture_output=True)
    read = json.loads(file.with_name(f"{name}.read.json").read_text())
    np.testing.assert_allclose(read["places"], some.means.numpy(), atol=1e-6)
    needed = {"f_dc_0", "f_rest_8", "opacity", "scale_2", "rot_3"} if name == "a.ply" else {"position"}
    assert needed <= set(read["attributes"])


# What killed exports leave

KILLED = """
import os, signal
from pathlib import Path
from dataclasses import replace
from support.gaussians import random_gaussians
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportScene

def chunks():
    yield random_gaussians(3000, 0)
    os.kill(os.getpid(), signal.SIGKILL)

path = Path(os.environ["WRITTEN"])
if path.name == "tileset.json":
    from vdgs.export.formats import tiles_3d as tiles
    from vdgs.system.atomic_files import write_atomic
    written, files = tiles.write_bytes, []
    def half(temporary):
        temporary.write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    def write(file, content):
        files.append(file)
        return written(file, content) if len(files) == 1 else write_atomic(file, half)
    tiles.write_bytes = write
    tiles.write_tiles(path, ExportScene.of(random_gaussians(3000, 0)), max_gaussians=500)
registry.write_scene(path, ExportScene(chunks=chunks(), count=6000, degree=0))
"""


@pytest.mark.parametrize(
    "name", ["a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.glb", "tileset.json", "lod-meta.json"]
)
def test_what_a_killed_export_left_goes_with_the_next(tmp_path, name: str):
    (tmp_path / ".a.ply.notes.scratch.txt").write_text("mine")
    (tmp_path / "tiles-7").mkdir()
    (tmp_path / "tiles-7" / "0.glb").write_text("mine")
    mine = listed(tmp_path)
    done = python(KILLED, WRITTEN=str(tmp_path / name))
    assert done.returncode == -9, done.stderr
    left = listed(tmp_path)
    assert left > mine
    found = registry.format_from_path(tmp_path / name).tidy(tmp_path / name)
    assert found
    assert listed(tmp_path) == mine


def listed(folder: Path) -> set[str]:
    return {str(each.relative_to(folder)) for each in folder.rglob("*")}


def test_what_a_living_process_needs_stays(tmp_path):
    path = tmp_path / "a.ply"
    alive = tmp_path / f".a.ply.{process_mark()}.tmp"
    alive.write_text("half")
    with scratch_folder(path) as folder:
        assert remove_leftovers(path) == []
        assert folder.is_dir()
        young = tmp_path / ".a.ply.abc.scratch"
        young.mkdir()  # as another process has just made it
        assert remove_leftovers(path) == []
        os.utime(young, (time.time() - 1000,) * 2)
        assert remove_leftovers(path) == [young]
    assert listed(tmp_path) == {alive.name}
    gone, elsewhere = (tmp_path / f".b.ply.{mark}-999999999.tmp" for mark in (host_mark(), "0" * 6))
    for each in (gone, elsewhere):
        each.write_text("of another file")
    assert remove_leftovers(path) == []
    assert remove_leftovers(tmp_path / "b.ply") == [gone]  # a process of another machine may write the other
    os.utime(elsewhere, (time.time() - 2 * QUIET_SECONDS,) * 2)
    assert remove_leftovers(tmp_path / "b.ply") == [elsewhere]


def test_the_facts_beside_a_file_say_how_it_stands(tmp_path):
    for has_compass, words in (
        (True, "x east, y up, z north"),
        (False, "x, z, y of the ground frame (its z is up; north is not known)"),
    ):
        scene = ExportScene.of(random_gaussians(20, 0), ExportMetadata(has_compass=has_compass))
        registry.write_scene(tmp_path / "a.spz", replace(scene, axes=Y_UP_LEFT))
        assert json.loads((tmp_path / "a.spz.json").read_text())["axes"] == words
