"""Maps on a disk: where they go, what is not written over, and what is left of those that were killed or failed."""

from __future__ import annotations

import inspect
import json
import shutil
import sys
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from vdgs.config.commands import OrthoRequest
from vdgs.config.executor_options import ExecutorOptions
from vdgs.distributed.sharded_job import ExecutionOptions
from vdgs.errors import VdgsError
from vdgs.rendering.ortho import geotiff, map_status, ortho_plan, render_ortho, tile_renderer
from vdgs.rendering.ortho.ortho_plan import OrthoPlan
from vdgs.runs.open_run import ModelLocation
from vdgs.runs.run_context import RunContext

pytestmark = pytest.mark.slow

pytest.importorskip("rasterio")
pytest.importorskip("pyproj")


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"gsd": 0.0}, "--gsd 0.0: a pixel needs a size"),
        ({"gsd": float("nan")}, "--gsd nan"),
        ({"bbox": (5.0, 0.0, 1.0, 3.0)}, "--bbox 5 0 1 3: must be"),
        ({"gsd": 1e-6}, r"more than 1e\+10\. Give --gsd 0\.00018 or larger"),
        (
            {"bbox": (0.0, 0.0, 10.0, 10.0), "gsd": 0.7},
            "0 0 10 10: lies beside the scene, which spans 3812.*Longitudes and latitudes",
        ),
        ({"crs": "EPSG:4978"}, "does not point up"),
        ({"crs": "EPSG:4326"}, "degrees"),
        ({"crs": "EPSG:3857", "gsd": 0.02}, "stretches north and east unlike"),
    ],
)
def test_what_makes_no_map_is_refused_and_leaves_nothing(house, make, tmp_path, asked, message):
    with pytest.raises(VdgsError, match=message):
        make(*house, **asked)
    assert not (tmp_path / "run" / "maps").exists()


def test_a_folder_shards_beside_the_maps_is_not_ours(house, make, tmp_path):
    for name in ("shards/king.png", "shards/white/queen.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"theirs")
    make(*house, gsd=0.5, output=tmp_path)
    assert (
        (tmp_path / "shards/king.png").read_bytes() == (tmp_path / "shards/white/queen.png").read_bytes() == b"theirs"
    )


def test_maps_that_are_put_into_a_run_go_where_its_maps_are(house, make, tmp_path):
    run = tmp_path / "other"
    run.mkdir()
    (run / "config.yaml").write_text("vdgs:\n  version: 1\n")
    make(*house, output=run)
    assert {path.name for path in run.iterdir()} == {"config.yaml", "maps"}
    assert (run / "maps/orthophoto.tif").is_file()


def test_photographs_of_any_folder_are_no_place_for_maps(house, make, tmp_path):
    capture, model = house
    views = [replace(view, image_path=tmp_path / "card" / view.name) for view in capture.views]
    (tmp_path / "card").mkdir()
    with pytest.raises(VdgsError, match=r"is for inputs of the capture.*Nothing was written"):
        make(replace(capture, views=tuple(views)), model, gsd=0.5, output=tmp_path / "card" / "maps")
    assert not list((tmp_path / "card").iterdir())


@pytest.mark.parametrize("facts", [None, "{}", '{"software": "GIS 3", "layers": 2}'])
def test_maps_of_others_are_not_written_over(house, make, tmp_path, monkeypatch, facts):
    monkeypatch.setattr(RunContext, "open_model", lambda *_: pytest.fail("opened"))
    context = RunContext.from_path(tmp_path / "run")
    (tmp_path / "dsm.tif").write_bytes(b"a month in the field")
    if facts is not None:
        (tmp_path / "map.json").write_text(facts)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(VdgsError, match=r"holds dsm\.tif.*Nothing was drawn"):
        render_ortho.render_ortho(context, OrthoRequest(run=tmp_path / "run", output=tmp_path), Console(quiet=True))
    for name, said in (("dsm.tif", "is a file"), ("maps.tif", "Give a folder for them, such as .*maps$")):
        with pytest.raises(VdgsError, match=said):
            render_ortho.render_ortho(
                context, OrthoRequest(run=tmp_path / "run", output=tmp_path / name), Console(quiet=True)
            )
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_what_programs_made_of_an_earlier_map_goes_with_it(tmp_path):
    """They would show its statistics and its overviews for those of the new one."""
    for name in ("dsm.tif.aux.xml", "dsm.tif.ovr", "dsm.tif.msk", "theirs.tif.aux.xml", "dsm.qml"):
        (tmp_path / name).write_text("of the earlier map")
    with pytest.raises(ValueError, match="failed"), ortho_plan.staging_folder(tmp_path):
        raise ValueError("failed")
    assert (tmp_path / "dsm.tif.aux.xml").is_file()
    with ortho_plan.staging_folder(tmp_path) as staging:
        for name in ("dsm.tif", "map.json"):
            (staging / name).write_text("new")
    assert {path.name for path in tmp_path.iterdir()} == {"dsm.tif", "map.json", "theirs.tif.aux.xml", "dsm.qml"}


def test_a_map_killed_while_its_files_take_their_places_is_known_as_ours_and_as_unfinished(house, make, monkeypatch):
    class Killed(BaseException):
        pass

    def kill(source: Path, target: Path) -> None:
        if target.name == "orthophoto.tif":
            raise Killed
        shutil.move(source, target)

    capture, model = house
    with monkeypatch.context() as patch:
        patch.setattr(ortho_plan.os, "replace", kill)
        with pytest.raises(Killed):
            make(capture, model, gsd=0.5)
    run = SimpleNamespace(path=make.path, merged=SimpleNamespace(status=lambda: SimpleNamespace(model_id="1-2")))
    assert (make.path / "maps" / "dsm.tif").exists()
    assert not map_status.is_ortho_current(run)
    make(capture, model, gsd=0.4)
    assert map_status.is_ortho_current(run)


def test_what_a_killed_command_left_goes_before_the_work_and_is_said(house, make, capsys):
    left = make.path / "maps" / ".maps.abc.scratch"
    (left / "maps").mkdir(parents=True)
    (left / ".lock").touch()
    (left / "maps" / "rough-dsm.tif").write_bytes(bytes(100))
    ortho_folder = make(*house, gsd=0.5)
    assert {file.name for file in ortho_folder.iterdir()} == set(ortho_plan.FILE_NAMES)
    assert "removed what a killed command had left" in " ".join(capsys.readouterr().err.split())


def test_a_model_that_stands_in_for_the_merged_one_is_said_and_noted(house, make, capsys):
    stands_in = "this is the coarse model, not the merged one: there is none yet. Next: vdgs merge /home/me/run"
    folder = make(*house, gsd=0.5, warning=stands_in)
    assert f"warning {stands_in}" in " ".join(capsys.readouterr().err.split())
    assert json.loads((folder / "map.json").read_text())["notes"] == ["this is the coarse model, not the merged one"]
    folder = make(*house, gsd=0.5)
    assert "warning" not in capsys.readouterr().err
    assert "coarse model" not in str(json.loads((folder / "map.json").read_text())["notes"])


def test_shards_are_told_of_the_model_as_one_process_is(house, monkeypatch, tmp_path):
    """What the two ways hand to the plan: the warning of the model that was found."""
    plans, signature = list[dict[str, object]](), inspect.signature(OrthoPlan.of)

    def plan(*given: object, **named: object) -> None:
        plans.append(signature.bind(*given, **named).arguments)
        raise VdgsError("planned")

    stage = SimpleNamespace(status=lambda: SimpleNamespace(model_id="1-2"))
    monkeypatch.setattr(render_ortho.OrthoPlan, "of", plan)
    monkeypatch.setattr(render_ortho, "locate_model", lambda *_: ModelLocation(stage, "coarse", "key", "stands in"))
    monkeypatch.setattr(RunContext, "capture", house[0])
    with pytest.raises(VdgsError, match="planned"):
        render_ortho.render_ortho(
            RunContext.from_path(tmp_path), OrthoRequest(run=tmp_path), Console(quiet=True),
            ExecutionOptions(ExecutorOptions(), jobs=2),
        )  # fmt: skip
    assert plans[0]["warning"] == "stands in"


def test_a_disk_without_room_is_named_before_anything_is_drawn(house, make, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 9, 1))
    monkeypatch.setattr(tile_renderer.TileRenderer, "render_tile", lambda *_: pytest.fail("drawn"))
    with pytest.raises(VdgsError, match=r"0 MB are free\. Free some space, or give a larger --gsd"):
        make(*house, gsd=0.2)


def test_a_map_that_fails_leaves_the_old_one_whole(house, make, monkeypatch):
    ortho_folder = make(*house, gsd=0.5)
    before = {file.name: file.read_bytes() for file in ortho_folder.iterdir()}

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(render_ortho, "write_preview", full)
    with pytest.raises(VdgsError, match=r"No space left on device.*maps that were there are kept"):
        make(*house, gsd=0.4)
    assert {file.name: file.read_bytes() for file in ortho_folder.iterdir()} == before


@pytest.mark.parametrize("name", ["PROJ_LIB", "PROJ_DATA", None])
def test_the_catalogue_of_another_proj_is_named_before_anything_is_drawn(house, make, monkeypatch, name):
    """Conda, OSGeo4W and PostGIS set such a variable."""
    import rasterio

    def fail(*_: object) -> None:
        raise rasterio.errors.CRSError("no database context specified")

    monkeypatch.setattr(geotiff, "require_rasterio", lambda: SimpleNamespace(crs=SimpleNamespace(CRS=UnknownSystems)))
    monkeypatch.setattr(UnknownSystems, "from_user_input", fail, raising=False)
    monkeypatch.setattr(tile_renderer.TileRenderer, "render_tile", lambda *_: pytest.fail("drawn"))
    for each in ("PROJ_LIB", "PROJ_DATA"):
        monkeypatch.delenv(each, raising=False)
    if name is not None:
        monkeypatch.setenv(name, "/usr/share/proj")
    remedy = "pip install -U rasterio" if name is None else rf"by {name} \(/usr/share/proj\)\. Run `unset {name}`"
    with pytest.raises(VdgsError, match=rf"EPSG:32632: rasterio does not know.*no database context.*{remedy}"):
        make(*house, gsd=0.5, crs="EPSG:32632")


class UnknownSystems:
    """A `rasterio.crs.CRS` that knows none."""


def test_without_rasterio_the_remedy_is_named(house, make, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(VdgsError, match=r"pip install 'vdgs\[geo\]'"):
        make(*house)


def test_maps_of_views_at_grazing_angles_say_that_they_are_rough(house, make, capsys, monkeypatch):
    monkeypatch.setattr(ortho_plan, "grazing_share", lambda _: 0.56)
    folder = make(*house, gsd=0.5)
    record = json.loads((folder / "map.json").read_text())
    assert record["seen_at_grazing_angles_share"] == 0.56
    (note,) = (each for each in record["notes"] if "straight down" in each)
    assert note.startswith("56% of the ground")
    assert note in " ".join(capsys.readouterr().err.split())
