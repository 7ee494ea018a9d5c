"""Maps and exports whose work goes out in shards: whatever is lost on the way, the files are those of one process."""

import os
import signal

import numpy as np
import pytest
import torch
from rich.console import Console

from support.clusters import FINE, alive, copy_run, evaluated
from support.commands import begun, do_tasks_here, vdgs, wait_until
from vdgs.config.commands import RunRequest
from vdgs.config.executor_options import ExecutorOptions
from vdgs.errors import RunError, Stopped
from vdgs.export import bake, bake_plan
from vdgs.export.bake import ViewContributions
from vdgs.export.bake_io import (
    load_color_updates,
    load_contributions,
    load_residual,
    save_color_updates,
    save_contributions,
    save_residual,
)
from vdgs.export.color_refinement import ColorResidual
from vdgs.export.formats.gaussian_store import flatten, open_store, unflatten
from vdgs.pipeline import run_pipeline
from vdgs.rendering.ortho.tile_renderer import OrthoTile
from vdgs.rendering.ortho.tile_shards import load_tile, save_tile
from vdgs.runs.run_context import RunContext

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("shards")]  # one worker, which trains once


def test_whatever_is_killed_maps_drawn_in_shards_are_those_of_one_process(uncut, mapped, tmp_path):
    """The driver while both shards are at work, then a shard."""
    run = copy_run(uncut, tmp_path / uncut.name)  # whose name is on the sheet
    command = ("ortho", run, *FINE, "--jobs", "2")
    with begun(*command, pause_at=("*/shards/*/00000[13].npz", 1)) as first:
        first.wait_until_paused(2)
        first.send_signal(signal.SIGKILL)
        first.finished()
        wait_until(lambda: not any(alive(shard) for shard in first.paused()))
    kept = {file: file.stat().st_mtime_ns for file in run.glob("maps/shards/*/*/*.npz")}
    assert {file.stem for file in kept} == {"000000", "000002"}
    with begun(*command, pause_at=("*/shards/*/000001.npz", 1)) as second:
        second.wait_until_paused(1)
        second.kill_paused()
        wait_until(lambda: "shard 00: crashed by SIGKILL" in second.printed())
        assert {file: file.stat().st_mtime_ns for file in kept} == kept
        done = second.finished()
    assert done.returncode == 0, done.stderr + done.stdout
    assert evaluated(run / "maps") == mapped


def test_detail_from_photographs_is_the_same_in_shards(uncut, mapped, tmp_path):
    command = ("ortho", uncut, *FINE, "--detail-from-images", "--output")
    for name, more, prepare in (("one", (), None), ("shards", ("--jobs", "2"), do_tasks_here)):
        done = vdgs(*command, tmp_path / name, *more, prepare=prepare)
        assert done.returncode == 0, done.stderr + done.stdout
    assert "2 of 2 shards done" in done.stdout
    one, shards = evaluated(tmp_path / "one"), evaluated(tmp_path / "shards")
    assert shards == one
    assert one["orthophoto.tif"] != mapped["orthophoto.tif"]
    assert one["dsm.tif"] == mapped["dsm.tif"]


def test_a_tile_that_is_damaged_is_named(tmp_path):
    tile = OrthoTile(np.zeros((2, 3, 3), np.uint8), np.ones((2, 3), np.uint8), np.zeros((2, 3), np.float32),
                np.full((2, 3), 7, np.uint16))  # fmt: skip
    save_tile(tmp_path / "1.npz", tile)
    read = load_tile(tmp_path / "1.npz")
    assert all((getattr(read, name) == value).all() for name, value in vars(tile).items())
    (tmp_path / "1.npz").write_bytes((tmp_path / "1.npz").read_bytes()[:-40])
    with pytest.raises(RunError, match=r"1\.npz: is missing or damaged .* Delete"):
        load_tile(tmp_path / "1.npz")


def test_a_run_sends_its_maps_where_its_blocks_go_and_stops_when_asked(tmp_path, monkeypatch):
    monkeypatch.setattr(run_pipeline, "has_ortho_dependencies", lambda: True)
    sent = []
    monkeypatch.setattr(run_pipeline, "render_ortho", lambda context, asked, console, execution: sent.append(execution))
    for executor in ("local", "slurm"):
        asked = RunRequest(
            capture=tmp_path, output=tmp_path, jobs=3, executor_options=ExecutorOptions(executor=executor)
        )
        run_pipeline._ortho(RunContext.from_path(tmp_path), asked, Console(quiet=True))
    assert [(each.is_distributed, each.jobs, each.executor_options.executor) for each in sent] == [
        (False, 0, "local"),
        (True, 3, "slurm"),
    ]

    def stopped(*_):
        raise Stopped("Stopped")

    monkeypatch.setattr(run_pipeline, "render_ortho", stopped)
    with pytest.raises(Stopped):
        run_pipeline._ortho(RunContext.from_path(tmp_path), asked, Console(quiet=True))


def small_parts() -> None:
    """Let so few anchors be fitted at once, and shards be so small, that a small scene has several for each step."""
    bake.ANCHORS_PER_PART, bake_plan.VIEWS_OF_SHARD, bake_plan.PARTS_OF_SHARD = 64, (8, 100, 8), (2, 50, 8)


def small_parts_here() -> None:
    """The same, and let it do shards itself, as the commands that they are: it is killed with them."""
    small_parts()
    do_tasks_here()


@pytest.fixture(scope="module")
def exported(uncut, tmp_path_factory) -> bytes:
    """What one process makes of it, on more threads than a shard has."""
    file = tmp_path_factory.mktemp("exported") / "scene.ply"
    done = vdgs(
        "export",
        uncut,
        "--output",
        file,
        "--color-iterations",
        "2",
        "--no-evaluate",
        "--threads",
        "2",
        prepare=small_parts,
    )
    assert done.returncode == 0, done.stderr + done.stdout
    return file.read_bytes()


def test_whenever_its_driver_is_killed_a_scene_baked_in_shards_is_that_of_one_process(uncut, exported, tmp_path):
    """While a second shard surveys; before the first Gaussians, and those with fitted colors, are there whole."""
    run, file = copy_run(uncut, tmp_path / "run"), tmp_path / "scene.ply"
    command = ("export", run, "--output", file, "--color-iterations", "2", "--no-evaluate", "--jobs", "2")
    for moment in ("*/shards/*/01/000010.npy", "*/shards/*/0.spool", "*/shards/*/1.spool"):
        surveyed = {each: each.stat().st_mtime_ns for each in run.glob("baking/shards/*/0[01]/0000*.npy")}
        with begun(*command, prepare=small_parts_here, pause_at=(moment, 1)) as driver:
            driver.wait_until_paused(1)
            assert {each: each.stat().st_mtime_ns for each in surveyed if each.exists()} in (surveyed, {})
            driver.send_signal(signal.SIGKILL)
            driver.finished()
    (work,) = run.glob("baking/shards/*")
    assert sorted(each.name for each in work.glob("*.spool")) == ["0.spool"]  # what it was made of is removed
    assert not list(work.glob("0[01]/*.npy"))
    done = vdgs(*command, prepare=small_parts_here)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "2 of 2 shards to survey views" not in done.stdout
    assert done.stdout.count("shards to fit colors again") == 1
    assert file.read_bytes() == exported
    assert not (run / "baking").exists()


def test_what_is_chosen_is_baked_alike_in_shards_and_moved_on_by_the_driver(uncut, tmp_path):
    chosen = ("--max-gaussians", "150", "--sh-degree", "1", "--color-iterations", "2", "--no-evaluate")
    for name, more, prepare in (("one", (), small_parts), ("shards", ("--jobs", "2"), small_parts_here)):
        done = vdgs("export", uncut, "--output", tmp_path / f"{name}.ply", *chosen, *more, prepare=prepare)
        assert done.returncode == 0, done.stderr + done.stdout
    one, shards = ((tmp_path / f"{name}.ply").read_bytes() for name in ("one", "shards"))
    assert shards == one
    more = ("--optimize-seconds", "0.01", "--jobs", "2")
    done = vdgs("export", uncut, "--output", tmp_path / "refined.ply", *chosen, *more, prepare=small_parts_here)
    assert done.returncode == 0, done.stderr + done.stdout
    refined = (tmp_path / "refined.ply").read_bytes()
    assert len(refined) == len(one)
    assert refined != one


def test_what_views_show_and_lack_is_read_back_to_the_last_bit_and_named_if_damaged(tmp_path):
    numbers = torch.arange(0, 10, 2, dtype=torch.int32)
    shown = ViewContributions(numbers, torch.rand(5))
    lacking = ColorResidual(numbers, torch.rand(5).half(), torch.rand(5, 3).half())
    rows, colors = np.array([3, 7]), torch.rand(2, 4, 3)
    save_contributions(tmp_path / "1.npy", shown)
    save_residual(tmp_path / "2.npy", lacking)
    save_color_updates(tmp_path / "3.npy", rows, colors)
    pairs = [(shown, load_contributions(tmp_path / "1.npy")), (lacking, load_residual(tmp_path / "2.npy"))]
    for one, read in pairs:
        assert all(torch.equal(value, getattr(read, name)) for name, value in vars(one).items())
    read_rows, read_colors = load_color_updates(tmp_path / "3.npy")
    assert read_rows.tolist() == [3, 7]
    assert torch.equal(read_colors, colors)
    gaussians = unflatten(torch.rand(6, 23), 1)
    flatten(gaussians).tofile(tmp_path / "0.spool")
    assert torch.equal(open_store(tmp_path / "0.spool", 1).rows(np.array([4, 1])).shN, gaussians.shN[[4, 1]])
    for name, load in (
        ("1.npy", load_contributions),
        ("2.npy", load_residual),
        ("0.spool", lambda file: open_store(file, 1)),
    ):
        os.truncate(tmp_path / name, (tmp_path / name).stat().st_size - 6)
        with pytest.raises(RunError, match=rf"{name}: is missing or damaged .* Delete"):
            load(tmp_path / name)
