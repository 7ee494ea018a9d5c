"""`vdgs export`: what is chosen, in which coordinates it stands, and what is refused before the work."""

from __future__ import annotations

import importlib.util
import io
import json
import re
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from support.captures import look_down
from support.gaussians import random_gaussians
from support.hand_made_models import capture_at, ground, model_at
from vdgs.captures.formats.ply_reader import read_point_cloud
from vdgs.config.commands import ExportRequest
from vdgs.errors import VdgsError
from vdgs.export import export_run as export_module
from vdgs.export import local_bake
from vdgs.export.bake import collect_contributions
from vdgs.export.export_loss import ExportLoss
from vdgs.export.export_record import RECORD_FILE, note_export
from vdgs.export.export_run import export_run, resolve_request
from vdgs.export.formats import html, registry
from vdgs.export.formats.export_scene import ExportMetadata, InitialView
from vdgs.export.gaussian_selection import rows_within_reach, select_rows
from vdgs.export.local_frame import MAX_LOCAL_COORDINATE, LocalFrame, make_local_frame
from vdgs.export.programs import PROGRAMS
from vdgs.geometry.camera import Camera
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_axes
from vdgs.geometry.map_projection import MapProjection
from vdgs.model.anchor_model import AnchorModel, DecoderSpan
from vdgs.model.gaussians import Gaussians, render_gaussians
from vdgs.model.renderer import render
from vdgs.runs.open_run import OpenedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.atomic_files import read_json, write_json
from vdgs.visibility.visibility_counts import count_visibility

pytestmark = pytest.mark.slow

#: Far from the middle of its UTM zone: grid north is 1.1 degrees off.
PLACE = (46.95, 7.44, 560.0)
QUIET = Console(quiet=True)


def scattered(parts: tuple[int, ...] = ()) -> AnchorModel:
    places = np.random.default_rng(0).uniform((-3, -3, 0), (3, 3, 0.5), (200, 3))
    model = model_at(places)
    return replace(model, decoder_spans=tuple(DecoderSpan(count, model.decoder) for count in parts))


@pytest.fixture
def export(tmp_path: Path):
    """`vdgs export` of a model that was never trained, into files of these names; its colors are fitted once, which
    says enough where nobody looks at them."""

    def run(
        *names: str, model: AnchorModel | None = None, origin: tuple[float, float, float] | None = None,
        color_iterations: int | None = 1, evaluate: bool = False, console: Console | None = None, **asked: Any,
    ) -> dict[str, Any]:  # fmt: skip
        file, shown = tmp_path / "run" / "merged" / "model.safetensors", model or scattered()
        shown.save(file)
        opened = OpenedRun(
            folder=RunFolder(tmp_path / "run"),
            model=shown,
            model_path=file,
            name="merged",
            status=StatusRecord(model_id="5-id"),
            key="k",
            warning="",
            capture=capture_at(origin),
        )
        paths = {name: tmp_path / name for name in names}
        request = ExportRequest(
            run=tmp_path / "run", output=tuple(paths[name] for name in names), evaluate=evaluate, device="cpu",
            color_iterations=color_iterations, **asked,
        )  # fmt: skip
        return export_run(opened, resolve_request(request), console or QUIET)

    return run


def test_all_files_of_one_baking_hold_the_same_scene(export, tmp_path: Path):
    record = export("a.ply", "b.splat", "c.ply", "d.points.ply", sh_degree=2, color_iterations=None)
    whole, small = registry.read_gaussians(tmp_path / "a.ply"), registry.read_gaussians(tmp_path / "b.splat")
    assert record["gaussians"] == len(whole) == len(small)
    assert whole.sh_degree == 2
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "c.ply").read_bytes()
    model = scattered()
    for view in capture_at(None).train_views:
        with torch.no_grad():
            drawn = render_gaussians(whole, view.camera, torch.tensor(model.background), 2)[0].image
        assert (drawn - render(model, view.camera).image).abs().mean() < 0.01
    assert read_json(tmp_path / "run" / RECORD_FILE) == record
    assert [Path(file["file"]).name for file in record["files"]] == ["a.ply", "b.splat", "c.ply", "d.points.ply"]
    assert [file["sh_degree"] for file in record["files"]] == [2, 0, 2, 0]
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("names", "degrees", "said"),
    [
        (("a.ply", "b.sog", "c.glb"), [3], ["a.ply, read back, on", "b.sog, c.glb: not read back, so not compared"]),
        (("b.sog", "c.glb"), [0, 3], ["b.sog: not read back; the Gaussians before", "c.glb: not read back; the"]),
        (("c.glb", "d.glb"), [3], ["c.glb, d.glb: not read back; the Gaussians before they were written to it, on"]),
    ],
)  # fmt: skip
def test_a_loss_is_that_of_the_file_or_said_to_be_of_its_gaussians(
    export, names: tuple[str, ...], degrees: list[int], said: list[str], monkeypatch: pytest.MonkeyPatch
):
    """Where colors are fixed for one of the files, its figure is not that of the scene as it was baked."""
    measured = list[int]()

    def measure(run: OpenedRun, pieces: Iterable[Gaussians], after_view: object) -> ExportLoss:
        measured.append(max(piece.sh_degree for piece in pieces))
        return ExportLoss(
            views=1, views_available=1, of="test", psnr=30.0, psnr_baked=29.0, psnr_cc=30.0, psnr_cc_baked=29.0,
            ssim=0.9, ssim_baked=0.8, by_visibility=[],
        )  # fmt: skip

    monkeypatch.setattr(export_module, "measure_loss", measure)
    monkeypatch.setattr(export_module, "views_to_measure", lambda run: [])
    monkeypatch.setattr(export_module, "choose_fixed_colors", lambda *asked: (True, "fixed"))
    console = Console(file=io.StringIO(), width=500)
    record = export(*names, evaluate=True, console=console)
    assert measured == degrees
    printed = console.file.getvalue()
    assert all(line in printed for line in said)
    assert [each["file"] is None for each in record["losses"]] == [names[0] != "a.ply"] * len(degrees)


def test_the_run_notes_files_within_it_as_they_lie_in_it(export, tmp_path: Path):
    """A run is moved and copied as one."""
    record = export("run/views/a.splat", "b.splat", sh_degree=0)
    noted = read_json(tmp_path / "run" / RECORD_FILE)
    paths = [str(tmp_path / name) for name in ("run/views/a.splat", "b.splat")]
    assert [file["file"] for file in record["files"]] == paths
    assert [file["file"] for file in noted["files"]] == ["views/a.splat", paths[1]]


def test_the_record_keeps_files_of_earlier_exports_with_the_part_of_the_scene_that_each_holds(tmp_path: Path):
    folder, outside = tmp_path / "run", tmp_path / "b.splat"
    folder.mkdir()

    def noted(*files: Path, **part: object) -> list[tuple[object, ...]]:
        for each in files:
            each.write_bytes(b"scene")
        entries = [{"file": str(each), "block": None, **part} for each in files]
        losses = [{"file": str(each), "psnr": 30.0} for each in files] + [{"file": None}]
        note_export({"rounds": 8, "files": entries, "losses": losses}, folder, QUIET)
        record = read_json(folder / RECORD_FILE)
        assert [each["file"] for each in record["losses"] if each["file"]] == [row["file"] for row in record["files"]]
        assert sum(each["file"] is None for each in record["losses"]) == 1  # that of the last export
        return [(each["file"], each["block"]) for each in record["files"]]

    assert noted(folder / "a.html", outside) == [("a.html", None), (str(outside), None)]
    assert noted(folder / "part.html", block=0) == [("part.html", 0), ("a.html", None), (str(outside), None)]
    assert noted(folder / "a.html", block=1) == [("a.html", 1), ("part.html", 0), (str(outside), None)]
    outside.unlink()
    assert noted(folder / "c.ply") == [("c.ply", None), ("a.html", 1), ("part.html", 0)]
    for damaged in ({"files": 3, "losses": [4, {}]}, {"files": [{"file": "\0"}, None, {"file": 3}]}, [1]):
        write_json(folder / RECORD_FILE, damaged)
        assert noted(folder / "c.ply") == [("c.ply", None)]


def test_a_file_is_noted_with_its_model_and_its_part(export):
    (file,) = export("a.splat", sh_degree=0, bbox=(-50.0, -50.0, 50.0, 50.0), min_visibility=1)["files"]
    part = {"model": "merged", "model_id": "5-id", "block": None, "bbox": [-50.0, -50.0, 50.0, 50.0]}
    assert {key: file[key] for key in part} == part
    assert file["min_visibility"] == 1


def test_a_run_that_may_only_be_read_is_exported(export, tmp_path: Path):
    (tmp_path / "run" / RECORD_FILE).mkdir(parents=True)  # stands for a folder that cannot be written, which root can
    assert export("a.splat", sh_degree=0)["gaussians"]
    assert (tmp_path / "a.splat").is_file()


def test_the_size_of_tiles_is_theirs_alone(export, tmp_path: Path):
    (tmp_path / "other.bin").write_bytes(bytes(10_000_000))
    (tmp_path / "tiles-9").mkdir()
    (tmp_path / "tiles-9" / "0.glb").write_bytes(bytes(10_000_000))
    (file,) = export("tileset.json")["files"]
    (tile,) = (tmp_path / "tiles-10").iterdir()
    assert file["bytes"] == tile.stat().st_size + (tmp_path / "tileset.json").stat().st_size


def test_files_about_a_place_on_earth_keep_its_origin_apart(export, tmp_path: Path):
    pytest.importorskip("pyproj")
    export("utm.ply", "enu.ply", origin=PLACE, crs="EPSG:32632")
    frame = make_local_frame(ground(PLACE), "EPSG:32632", np.zeros(3))
    assert max(np.abs(frame.facts.origin)) > MAX_LOCAL_COORDINATE
    assert all(value % 100 == 0 for value in frame.facts.origin)
    local = registry.read_gaussians(tmp_path / "utm.ply")
    assert float(local.means.abs().max()) < 100
    back = frame.to_ground(local)
    assert float(back.means[:, :2].abs().max()) < 20
    text = (tmp_path / "utm.ply").read_bytes()[:6000].decode("ascii", "replace")
    assert "origin" in text
    assert "comment crs EPSG:32632\n" in text  # no more: some readers are killed by long lines
    assert "UTM zone 32N" in (tmp_path / "utm.ply.prj").read_text()
    # In the default system, metres east and north of the origin, nothing is turned.
    export("plain.ply", origin=PLACE)
    export("local.ply")
    plain, local_bake = registry.read_gaussians(tmp_path / "plain.ply"), registry.read_gaussians(tmp_path / "local.ply")
    assert torch.allclose(plain.means, local_bake.means, atol=1e-4)


@pytest.mark.parametrize(
    ("crs", "note"),
    [("EPSG:32733", "made for .*lies outside"), ("EPSG:31468", "datum shift|lies outside"), ("EPSG:32632", None)],
)
def test_what_a_map_says_of_its_system_files_say_too(export, tmp_path: Path, monkeypatch, crs, note):
    pytest.importorskip("pyproj")
    said = io.StringIO()
    monkeypatch.setattr(sys.modules[__name__], "QUIET", Console(file=said, width=1000))
    files = export("a.points.ply", "b.splat", "c.ply", "tileset.json", origin=PLACE, crs=crs)["files"]
    placement = MapProjection.of(ground(PLACE), crs)
    assert bool(placement.notes) == (note is not None)
    assert all(re.search(note, each) for each in placement.notes[-1:])
    assert f"a.points.ply, c.ply: {placement.name}; heights {placement.height_reference}\n" in said.getvalue()
    assert f"b.splat: {placement.name}; x west, y down, z south\n" in said.getvalue()
    for file in files[:3]:
        assert file["crs_name"] == placement.name
        assert file["heights"] == (None if file["file"].endswith(".splat") else placement.height_reference)
        assert file["notes"][: len(placement.notes)] == list(placement.notes)
    for each in placement.notes:  # once for all files
        assert said.getvalue().count(each) == 1
        assert each not in files[3]["notes"]  # on the globe, whatever the map
    assert files[3]["crs_name"].startswith("Earth-centered")
    assert files[3]["heights"] is None
    assert any("heights on the globe are ellipsoidal (WGS 84)" in each for each in files[3]["notes"])


def test_axes_are_named_as_files_record_them_and_heights_only_where_the_third_goes_up(export, tmp_path: Path):
    names = ["a.ply", "a.points.ply", "a.compressed.ply", "a.spz", "a.splat", "a.sog", "a.rad", "a.glb"]
    found = {Path(file["file"]).name: file for file in export(*names, origin=PLACE)["files"]}
    assert list(found) == names
    for name, file in found.items():
        beside, content = tmp_path / f"{name}.json", (tmp_path / name).read_bytes()
        assert file["axes"].encode() in (beside.read_bytes() if beside.exists() else content[:6000])
        assert (file["heights"] is not None) == file["axes"].endswith("z up")
    for axes, up in (("y-up", False), ("z-up", True)):
        (file,) = export("b.ply", origin=PLACE, axes=axes)["files"]
        assert (file["heights"] is not None) == up


@pytest.mark.parametrize("crs", [None, "local"])
def test_only_of_a_place_on_earth_files_say_where_east_is(export, crs):
    (placed,), (nowhere,) = export("a.ply", origin=PLACE, crs=crs)["files"], export("b.ply", crs=crs)["files"]
    assert placed["axes"] == "x east, y north, z up"
    assert nowhere["axes"] == "x, y, z of the ground frame (its z is up; north is not known)"


def test_the_usual_system_is_named(export, tmp_path: Path):
    pytest.importorskip("pyproj")
    (on_map,) = export("a.points.ply", origin=PLACE, crs="EPSG:25832")["files"]
    (as_usual,) = export("a.points.ply", origin=PLACE)["files"]
    (nowhere,) = export("a.points.ply")["files"]
    assert "ellipsoidal (WGS 84), if the altitudes" in on_map["heights"]
    assert "east, north, up about latitude" in as_usual["crs_name"]
    assert "ground frame" in nowhere["crs_name"]


def test_earth_centered_coordinates_are_for_points_alone(export, tmp_path: Path):
    """Nothing stands upright in them: what is shown would lie on its side."""
    pytest.importorskip("pyproj")
    for name, asked in (("a.ply", {}), ("a.spz", {}), ("a.html", {}), ("a.points.ply", {"axes": "y-up"})):
        with pytest.raises(VdgsError, match=r"4978: the third axis .* does not point up here.*\.points\.ply"):
            export(name, origin=PLACE, crs="EPSG:4978", **asked)
        assert not (tmp_path / name).exists()
    export("a.points.ply", "tileset.json", origin=PLACE, crs="EPSG:4978")
    assert b"comment axes x to latitude 0 longitude 0, y to" in (tmp_path / "a.points.ply").read_bytes()[:3000]


def test_a_program_gets_its_file_turned_and_placed(export, tmp_path: Path):
    export("plain.ply", sh_degree=1)
    plain = registry.read_gaussians(tmp_path / "plain.ply")
    for program in PROGRAMS:
        (file,) = export(program=program, sh_degree=1)["files"]
        path = tmp_path / "run" / "export" / PROGRAMS[program].file
        assert Path(file["file"]) == path
        if registry.format_from_path(path).read is not None:  # in the ground frame again, whichever way it stands
            back = registry.read_gaussians(path)
            assert len(back) == len(plain)
            torch.testing.assert_close(back.means.median(0).values, plain.means.median(0).values, atol=0.01, rtol=0.01)
    stored = np.fromfile(tmp_path / "run/export/unity.ply", "<f4", 3, offset=_body(tmp_path / "run/export/unity.ply"))
    np.testing.assert_allclose(stored, plain.means[0].numpy()[[0, 2, 1]], atol=1e-6)  # left-handed, y up
    with pytest.raises(VdgsError, match=r"for cesium: a\.ply is no file for CesiumJS"):
        export("a.ply", program="cesium")
    with pytest.raises(VdgsError, match=r"axes y-up: tileset\.json has axes of its own"):
        export("tileset.json", axes="y-up")


def _body(path: Path) -> int:
    return path.read_bytes().index(b"end_header\n") + len(b"end_header\n")


def test_what_killed_exports_left_goes_before_the_work_and_is_said(export, tmp_path: Path, monkeypatch):
    left = [tmp_path / name for name in (".baking.abc.scratch", ".a.spz.abc.scratch")]
    for folder in left:
        folder.mkdir()
        (folder / ".lock").touch()
        (folder / "spool").write_bytes(bytes(1000))
    said = io.StringIO()
    monkeypatch.setattr(sys.modules[__name__], "QUIET", Console(file=said, width=500))
    export("a.spz")
    assert not any(folder.exists() for folder in left)
    assert all(str(folder) in said.getvalue() for folder in left)


def on_earth(local: torch.Tensor, geodetic: tuple[float, float, float]) -> np.ndarray:
    """Earth-centered metres [n, 3] of what lies so far east, north and up of a place."""
    return local.double().numpy() @ enu_axes(*geodetic[:2]) + ecef_from_geodetic(np.array([geodetic]))


@pytest.mark.parametrize("crs", [None, "enu", "EPSG:32632", "source", "local"])
def test_tiles_stand_on_the_globe_whatever_other_files_are_written_in(export, tmp_path: Path, crs):
    pytest.importorskip("pyproj")
    record = export("a.ply", "tileset.json", origin=PLACE, crs=crs)
    assert not any("center of the Earth" in note for file in record["files"] for note in file["notes"])
    matrix = np.array(read_json(tmp_path / "tileset.json")["root"]["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, 3], ecef_from_geodetic(np.array([PLACE]))[0], atol=1e-6)
    np.testing.assert_allclose(matrix[:3, :3], enu_axes(*PLACE[:2]).T, atol=1e-12)


def test_tiles_of_nowhere_in_a_map_are_refused(export, tmp_path: Path):
    with pytest.raises(VdgsError, match="not georeferenced"):
        export("tileset.json", crs="EPSG:32632")
    assert not (tmp_path / "tileset.json").exists()
    (file,) = export("tileset.json")["files"]
    assert any("center of the Earth" in note for note in file["notes"])


def test_a_scene_far_from_its_origin_stays_where_it_is_on_earth(export, tmp_path, monkeypatch):
    looking_down_at(monkeypatch, 3000.0)
    model = moved(scattered(), torch.full((200,), 3000.0))
    export("a.spz", "a.ply", model=model, origin=PLACE)
    near, whole = registry.read_gaussians(tmp_path / "a.spz"), registry.read_gaussians(tmp_path / "a.ply")
    facts = read_json(tmp_path / "a.spz.json")
    assert facts["origin"] == [0, 0, 0]
    assert facts["geodetic"] != list(PLACE)
    assert float(near.means.abs().max()) < 100
    apart = on_earth(near.means, facts["geodetic"]) - on_earth(whole.means, PLACE)
    assert np.abs(apart).max() < 1e-3
    # Tiles that are farther away than single precision reaches say so in their transform.
    looking_down_at(monkeypatch, 30_000.0)
    model = moved(scattered(), torch.full((200,), 30_000.0))
    export("tileset.json", model=model, origin=PLACE)
    root = read_json(tmp_path / "tileset.json")["root"]
    matrix = np.array(root["transform"]).reshape(4, 4).T
    middle = (matrix @ [*root["boundingVolume"]["box"][:3], 1.0])[:3]
    expected = on_earth(torch.tensor([[30_000.0, 0.0, 0.0]]), PLACE)[0]
    assert np.linalg.norm(middle - expected) < 10
    assert np.abs(root["boundingVolume"]["box"][:3]).max() < 200


def test_a_frame_and_back_is_where_it_was():
    pytest.importorskip("pyproj")
    model = scattered()
    seen = collect_contributions(model, [view.camera for view in capture_at(None).train_views])
    gaussians = next(iter(local_bake.bake(seen, np.flatnonzero(seen.pixels > 0), 3)))
    for crs in ("EPSG:32632", "enu", "local"):
        frame = make_local_frame(ground(PLACE), crs, np.zeros(3))
        back = frame.to_ground(frame.to_local(gaussians))
        for name in ("means", "log_scales", "shN"):
            assert torch.allclose(getattr(back, name), getattr(gaussians, name), atol=1e-3), (crs, name)
    frame = make_local_frame(ground(PLACE), "enu", np.array([5000.0, -3000.0, 20.0]), max_coordinate=1000.0)
    back = frame.to_ground(frame.to_local(gaussians))
    assert torch.allclose(back.means, gaussians.means, atol=1e-3)


def test_boxes_blocks_and_numbers_choose(export, tmp_path: Path):
    whole = export("all.ply")["gaussians"]
    assert export("few.ply", max_gaussians=50)["gaussians"] == 50
    assert export("many.ply", max_gaussians=whole + 1)["gaussians"] == whole
    cameras = [view.camera for view in capture_at(None).train_views]
    seen = int(count_visibility(scattered().anchors.positions, cameras).max())
    assert 0 < export("seen.ply", min_visibility=seen)["gaussians"] < whole
    with pytest.raises(VdgsError, match=f"at most {seen}"):
        export("unseen.ply", min_visibility=seen + 1)
    box = export("box.ply", bbox=(-1.0, -1.0, 2.0, 0.5))["gaussians"]
    inside = registry.read_gaussians(tmp_path / "box.ply").means
    assert 0 < box < whole
    assert float(inside[:, 0].min()) >= -1.0
    assert float(inside[:, 1].max()) <= 0.5
    parted = scattered((80, 120))
    first, second = (export(f"{block}.ply", model=parted, block=block)["gaussians"] for block in (0, 1))
    assert first + second == whole
    assert min(first, second) > 0


def test_fewer_gaussians_are_merged_and_moved_not_dropped(export, tmp_path: Path, monkeypatch):
    whole = export("all.ply")["gaussians"]
    few = export("few.ply", max_gaussians=whole // 4)
    assert few["gaussians"] == whole // 4
    every, merged = (registry.read_gaussians(tmp_path / name) for name in ("all.ply", "few.ply"))
    seen = collect_contributions(scattered(), [view.camera for view in capture_at(None).train_views])
    most = np.argsort(-seen.pixels[seen.pixels > 0], kind="stable")[: whole // 4]
    dropped = every.select(torch.from_numpy(np.sort(most)))
    camera = capture_at(None).train_views[0].camera

    def error(gaussians: Gaussians) -> float:
        drawn = [render_gaussians(each, camera, torch.zeros(3), each.sh_degree)[0].image for each in (gaussians, every)]
        return float((drawn[0] - drawn[1]).square().mean())

    assert error(merged) < error(dropped) / 2
    assert not {tuple(each) for each in merged.means.tolist()} <= {tuple(each) for each in every.means.tolist()}
    # Twice the same: no clock decides.
    export("again.ply", max_gaussians=whole // 4)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "few.ply").read_bytes()
    # A page that has room for fewer gets as many; the other file of the same command keeps all.
    monkeypatch.setattr("vdgs.export.export_run._capacity", lambda path, scene: 60 if path.suffix == ".html" else 10**9)
    record = export("page.html", "both.ply")
    assert [each["gaussians"] for each in record["files"]] == [60, whole]
    assert "merged from" in record["files"][0]["notes"][0]
    assert len(registry.read_gaussians(tmp_path / "page.html")) == 60


@pytest.mark.parametrize(
    ("names", "asked", "said"),
    [
        ((), {}, "--output FILE"),
        (("scene.obj",), {}, "no format is known"),
        (("a.ply", "a.ply"), {}, "given twice"),
        (("a.ply", "run/../a.ply"), {}, "given twice"),
        (("web/scene.json", "web/index.html"), {}, r"index.html and --output .*scene.json: both write"),
        (("web/index.html", "run/../web/scene.json"), {}, r"scene.json and --output .*index.html: both write"),
        (("a.ply", "page.html"), {"html_max_mb": 5.0}, "A page of 5 MB has no room.*client alone takes 6.0 MB"),
        (("run/report.html",), {}, "is the report of the run"),
        (("a.ply", "run/../run/report.html"), {}, "is the report of the run"),
        (("a.ply",), {"bbox": (50.0, 50.0, 60.0, 60.0)}, "lies within"),
        (("a.ply",), {"bbox": (1.0, 0.0, 1.0, 5.0)}, "is empty"),
        (("a.ply",), {"bbox": (float("nan"), 0.0, 1.0, 5.0)}, "is empty"),
        (("a.ply",), {"block": 3}, "--block 3"),
        (("a.ply",), {"crs": "EPSG:32632"}, "not georeferenced"),
    ],
)
def test_what_cannot_be_written_is_said_before_any_view_is_drawn(
    export, tmp_path: Path, monkeypatch, names, asked, said
):
    monkeypatch.setattr(local_bake, "collect_contributions", lambda *_: pytest.fail("drawn"))
    monkeypatch.setattr(html, "_frame_bytes", lambda: 6_000_000)
    with pytest.raises(VdgsError, match=said):
        export(*names, **asked)
    assert not list(tmp_path.glob("*.ply"))


@pytest.mark.parametrize(
    ("name", "package"), [("a.laz", "laspy"), ("a.laz", "lazrs"), ("a.spz", "zstandard"), ("a.html", "viser")]
)
def test_a_package_that_a_file_needs_is_asked_for_before_any_view_is_drawn(
    export, tmp_path: Path, monkeypatch, name, package
):
    monkeypatch.setattr(local_bake, "collect_contributions", lambda *_: pytest.fail("drawn"))
    monkeypatch.setitem(sys.modules, package, None)  # not to be imported
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else there(name))
    with pytest.raises(VdgsError, match=rf"{name}: .*needs? .*{package}"):
        export(name, spz_version=4)


@pytest.mark.parametrize(("name", "taken"), [("tileset.json", "tileset.json"), ("scene.json", "index.html")])
def test_a_place_that_is_taken_is_named_before_any_view_is_drawn(export, tmp_path: Path, monkeypatch, name, taken):
    monkeypatch.setattr(local_bake, "collect_contributions", lambda *_: pytest.fail("drawn"))
    if taken == name:
        (tmp_path / taken).mkdir()
    else:
        (tmp_path / taken).write_text("<p>of somebody")
    with pytest.raises(VdgsError, match=taken):
        export(name)


def test_a_box_is_refused_by_what_lies_where(export):
    """A block in the west and one in the east; a box in which the model has something that no photograph shows."""
    parted = scattered((80, 120))
    apart = moved(parted, torch.where(torch.arange(200) < 80, -10.0, 10.0))
    with pytest.raises(VdgsError, match=r"nothing of block 0, which lies within -1\d\.\d .* of --crs local\."):
        export("a.ply", model=apart, block=0, bbox=(7.0, -3.0, 13.0, 3.0))
    high = replace(parted.anchors, positions=parted.anchors.positions + torch.tensor([0, 0, 500.0]))
    for asked in ({}, {"bbox": (-1.0, -1.0, 1.0, 1.0)}, {"block": 1}):
        with pytest.raises(VdgsError, match="no training camera draws anything of what was asked for"):
            export("a.ply", model=replace(parted, anchors=high), **asked)


def test_a_background_is_an_output_like_the_others(export, tmp_path: Path, monkeypatch):
    """No picture of others is overwritten, nor a link replaced, nor a folder found locked after the work."""
    monkeypatch.setattr(local_bake, "bake", lambda *_: pytest.fail("baked"))
    (tmp_path / "mine.png").write_bytes(b"\x89PNG of somebody")
    (tmp_path / "link.png").symlink_to("elsewhere.png")
    (tmp_path / "file").touch()
    plain = scattered()
    model = replace(plain, decoder=replace(plain.decoder, envmap=torch.zeros(16, 64, 3)))
    for name, said in (
        ("mine.png", "not written by vdgs"), ("link.png", "is a link"), ("file/sky.png", "file"),
    ):  # fmt: skip
        with pytest.raises(VdgsError, match=said):
            export("a.ply", model=model, background=tmp_path / name)
    assert (tmp_path / "mine.png").read_bytes() == b"\x89PNG of somebody"


def looking_down_at(monkeypatch: pytest.MonkeyPatch, *x: float) -> None:
    """Let captures have training cameras above these places."""
    capture = capture_at(None)
    cameras = [
        Camera(
            camera_from_world=look_down(np.array([at, 0, 8.0]), 0.0, 90.0),
            fx=60.0,
            fy=60.0,
            cx=32.0,
            cy=24.0,
            width=64,
            height=48,
        )
        for at in x
    ]
    views = tuple(replace(capture.views[0], camera=camera) for camera in cameras)
    monkeypatch.setattr(f"{__name__}.capture_at", lambda origin: replace(capture, views=views, ground=ground(origin)))


def moved(model: AnchorModel, x: torch.Tensor) -> AnchorModel:
    positions = model.anchors.positions + torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], 1)
    return replace(model, anchors=replace(model.anchors, positions=positions))


def test_a_scene_too_wide_for_a_format_is_refused_before_it_is_baked(export, monkeypatch):
    monkeypatch.setattr(local_bake, "bake", lambda *_: pytest.fail("baked"))
    looking_down_at(monkeypatch, -3000.0, 3000.0)
    sides = torch.where(torch.arange(200) % 2 == 0, 3000.0, -3000.0)
    with pytest.raises(VdgsError, match="2048"):
        export("a.spz", model=moved(scattered(), sides))


def test_points_stand_where_the_map_has_them_and_gaussians_say_how_far_they_stand_off(export, tmp_path, monkeypatch):
    """The Earth falls by 70 cm in 3 km: points agree with an elevation map of the same run."""
    laspy = pytest.importorskip("laspy")
    looking_down_at(monkeypatch, -3000.0, 3000.0)
    wide = moved(scattered(), torch.where(torch.arange(200) % 2 == 0, 3000.0, -3000.0))
    (plain,) = export("plain.ply", model=wide, origin=PLACE, crs="enu")["files"]
    assert plain["notes"] == []
    places = registry.read_gaussians(tmp_path / "plain.ply").means.double().numpy()
    wanted = MapProjection.of(ground(PLACE), "EPSG:32632").project(places)

    names = ("a.laz", "a.points.ply", "a.ply")
    laz, points, ply = export(*names, model=wide, origin=PLACE, crs="EPSG:32632")["files"]
    np.testing.assert_allclose(laspy.read(tmp_path / "a.laz").xyz, wanted, atol=0.002, rtol=0)
    read, _ = read_point_cloud(tmp_path / "a.points.ply")
    (header,) = re.findall(rb"comment origin (.*)\n", (tmp_path / "a.points.ply").read_bytes())
    origin = np.array(json.loads(header))
    np.testing.assert_allclose(read + origin, wanted, atol=0.002, rtol=0)
    assert not any("curved map" in note for file in (laz, points) for note in file["notes"])
    stored = registry.read_gaussians(tmp_path / "a.ply").means.double().numpy() + origin
    off = np.linalg.norm(stored - wanted, axis=1).max()
    assert off > 0.3
    assert any(f"up to {off:.2f} m from their places" in note for note in ply["notes"])


def test_a_small_scene_on_a_map_says_nothing(export):
    pytest.importorskip("pyproj")
    (file,) = export("a.ply", origin=PLACE, crs="EPSG:32632")["files"]
    assert file["notes"] == []


def test_a_scene_far_from_its_origin_is_placed_near_one(export, tmp_path, monkeypatch):
    looking_down_at(monkeypatch, 3000.0)
    export("a.spz", "a.ply", model=moved(scattered(), torch.full((200,), 3000.0)))
    near, whole = registry.read_gaussians(tmp_path / "a.spz"), registry.read_gaussians(tmp_path / "a.ply")
    origin = torch.tensor(read_json(tmp_path / "a.spz.json")["origin"])
    assert origin.tolist() == [3000.0, 0.0, 0.0]
    assert torch.allclose(near.means + origin, whole.means, atol=1e-3)


def test_a_file_goes_without_the_few_that_lie_beyond_its_reach(export, tmp_path, monkeypatch):
    model = scattered()
    positions = model.anchors.positions.clone()
    positions[7] = torch.tensor([0.0, 0.0, -5000.0])
    model = replace(model, anchors=replace(model.anchors, positions=positions))
    real = collect_contributions(model, [view.camera for view in capture_at(None).train_views])
    pixels = real.pixels.copy()
    k = model.anchors.offsets.shape[1]
    there = slice(7 * k, 8 * k)
    pixels[there] = 0.01
    monkeypatch.setattr(local_bake, "collect_contributions", lambda *_: replace(real, pixels=pixels))
    monkeypatch.setattr(local_bake, "bake", lambda seen, kept, degree, _: iter([random_gaussians(len(kept), degree)]))
    monkeypatch.setattr(local_bake, "refine_colors", lambda *_: None)
    record = export("all.ply", "near.spz", model=model)
    assert [file["gaussians"] for file in record["files"]] == [record["gaussians"], record["gaussians"] - k]
    assert len(registry.read_gaussians(tmp_path / "near.spz")) == record["gaussians"] - k
    pixels[there] = pixels.sum()
    with pytest.raises(VdgsError, match="2048"):
        export("near.spz", model=model)


@pytest.mark.parametrize(("unit", "reach", "outlier", "why"), [
    ("units", 3e6, 9e6, None), ("units", 3.0, 1e5, "more than 2000 times as far as 99 of 100 Gaussians"),
    ("units", 3.0, 4000.0, None), ("metre", 3.0, 1e5, None), ("metre", 3.0, 9e6, "where the format does not reach"),
])  # fmt: skip
def test_las_reaches_what_a_scene_of_unknown_unit_reaches(tmp_path, unit, reach, outlier, why):
    """Whether 2 million units are far is not known; what would make the steps coarse for all others is."""
    pytest.importorskip("laspy")
    means = np.random.default_rng(0).uniform(-reach, reach, (1000, 3))
    means[5] = (0.0, 0.0, -outlier)
    pixels = np.where(np.arange(1000) == 5, 0.01, 10.0)
    frame = LocalFrame(1.0, np.eye(3), np.zeros(3), ExportMetadata(unit=unit))
    path = tmp_path / "a.las"
    request = resolve_request(ExportRequest(run=tmp_path, output=(path,)))
    said = Console(file=io.StringIO(), width=1000)
    rows = select_rows({path: frame}, means, pixels, request, InitialView((0, 0, 9), (0, 0, 0)), said)[path]
    assert len(rows) == len(rows_within_reach(path, frame, means)) == 1000 - (why is not None)
    told = said.file.getvalue()
    assert told == "" if why is None else why in told


def test_a_disk_that_fills_leaves_nothing(export, tmp_path: Path, monkeypatch):
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(local_bake, "write_store", full)
    with pytest.raises(VdgsError, match="No space left"):
        export("a.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
