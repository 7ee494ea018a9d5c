"""The bench as it runs: processes, a real table that is killed and continued, groups by visibility."""

import fcntl
import io
import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from experiments.bench import bench
from experiments.bench.bench import BenchSettings, run_bench
from experiments.bench.pixel_visibility import visibility_from_frusta, visibility_from_truth
from experiments.bench.plan import PlanOptions
from experiments.bench.result_tables import group_bounds
from support.commands import begun, is_free, vdgs, wait_until
from support.forking import start_tasks
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("bench")]

SMALL = ("--methods", "baseline", "full", "--steps-scaler", "0.1")


def settings(output: Path, scale: float = 0.1) -> BenchSettings:
    """The same in this process."""
    return BenchSettings("toy", output, PlanOptions(methods=("baseline", "full"), steps_scaler=scale), jobs=2)


@pytest.fixture(scope="module")
def benched(tmp_path_factory) -> Path:
    pytest.importorskip("embreex")
    output = tmp_path_factory.mktemp("bench") / "out"
    command = ("bench", "toy", "--output", output, *SMALL, "--jobs")
    with begun(*command, "1", pause_at=("*/runs/*/coarse/log.jsonl", 1), prepare=start_tasks) as process:
        process.wait_until_paused()  # the first run begins to train
        process.send_signal(signal.SIGKILL)  # without a word
        process.finished()
    wait_until(lambda: all(is_free(run) for run in output.glob("runs/*/*/*")))  # its processes notice, save and end
    done = vdgs(*command, "2")
    assert done.returncode == 0, done.stderr + done.stdout
    return output


def models(output: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in output.rglob("*.safetensors")}


def test_a_bench_that_was_killed_continues_to_its_tables(benched):
    results = json.loads((benched / "toy" / "results.json").read_text())
    assert [(each["method"], each["state"]) for each in results["results"]] == [("baseline", "done"), ("full", "done")]
    assert results["results"][0]["figures"]["iterations"] == 60
    for each in results["results"]:  # blocks may draw smaller pictures in more iterations
        assert each["figures"]["iterations"] >= 60
        assert each["figures"]["photographs"] == pytest.approx(60, abs=2)
    for each in results["results"]:
        assert 5 < each["figures"]["psnr"] < 40
        assert each["figures"]["psnr@0"] is not None
        assert each["figures"]["seconds"] > 0
    groups = [each["groups"] for each in results["results"]]
    assert groups[0] == groups[1]  # the same pixels
    assert "**" in (benched / "toy" / "table.md").read_text()
    for name in ("table.tex", "table.csv", "claims.txt", "groups.png"):
        assert (benched / "toy" / name).stat().st_size
    assert len(results["claims"]) == 2


def test_a_finished_bench_trains_nothing_again(benched):
    before, said = models(benched), io.StringIO()
    run_bench(settings(benched), Console(file=said))
    assert "started" not in said.getvalue()
    assert models(benched) == before
    assert len(before) > 3


def test_a_shared_coarse_stage_is_trained_once(benched):
    (shared,) = benched.glob("runs/tiny/shared-coarse-*/0/coarse")
    taken = benched / "runs" / "tiny" / "full" / "0" / "coarse"
    assert (taken / "model.safetensors").samefile(shared / "model.safetensors")
    assert (taken / "status.json").read_text() == (shared / "status.json").read_text()


def test_other_settings_do_not_discard_what_is_trained(benched):
    before = models(benched)
    with pytest.raises(VdgsError, match=r"training\.iterations: 60 -> 180"):
        run_bench(settings(benched, scale=0.3), Console(file=io.StringIO()))
    assert models(benched) == before


def test_generated_scenes_are_grouped_by_the_true_visibility(benched):
    results = json.loads((benched / "toy" / "results.json").read_text())["results"]
    assert {each["visibility_source"] for each in results} == {"truth"}
    root = benched / "captures" / "tiny"
    seen = visibility_from_truth(root, CaptureOptions())
    assert seen is not None
    counted = np.concatenate([seen.visibility_map(view.camera).ravel() for view in seen.capture.test_views])
    assert np.nanmin(counted) >= 1  # what no training camera sees is nobody's fault
    groups = results[0]["groups"]
    assert sum(group["pixels"] for group in groups) == np.isfinite(counted).sum() < len(counted)
    for group in groups:
        assert ((counted >= group["lower"]) & (counted <= group["upper"])).sum() == group["pixels"]
    assert "truly see the surface" in (benched / "toy" / "table.md").read_text()
    assert f"(V {group_bounds(groups[0])})" in (benched / "toy" / "claims.txt").read_text()


def test_frusta_hold_at_least_what_is_truly_seen(benched):
    """The paper counts frusta, which hidden surfaces lie in too: groups by both stand in the table."""
    root = benched / "captures" / "tiny"
    truly, frusta = visibility_from_truth(root, CaptureOptions()), visibility_from_frusta(root, CaptureOptions())
    assert truly is not None
    assert frusta is not None
    more, unseen, pixels = 0, 0, 0
    for view in truly.capture.test_views:
        seen, held = truly.count_map(view.camera), frusta.count_map(view.camera)
        assert np.array_equal(np.isnan(seen), np.isnan(held))  # sky
        assert np.mean(held[~np.isnan(held)] >= seen[~np.isnan(seen)]) > 0.99  # rounding at the edge of a picture
        more += np.nansum(held - seen)
        unseen, pixels = unseen + int((seen == 0).sum()), pixels + seen.size
    assert more > 0
    results = json.loads((benched / "toy" / "results.json").read_text())["results"]
    assert {each["figures"]["unseen_share"] for each in results} == {unseen / pixels}
    assert all(each["frusta"] and each["figures"]["psnr@frusta0"] > 0 for each in results)
    assert results[0]["frusta"] != results[0]["groups"]
    table = (benched / "toy" / "table.md").read_text()
    assert "PSNR by visibility as the paper counts it" in table
    assert f"{unseen / pixels:.1%}. There every method only guesses" in table


def test_the_truth_is_that_of_the_views_that_are_used(benched):
    root = benched / "captures" / "tiny"
    small = visibility_from_truth(root, CaptureOptions(downscale=2.0, validation=True))
    assert small is not None
    assert all(view.name.startswith("validation") for view in small.capture.test_views)
    for view in small.capture.test_views:
        assert small.visibility_map(view.camera).shape == (36, 48) == (view.camera.height, view.camera.width)
    assert visibility_from_truth(root, CaptureOptions(max_images=20)) is None  # fewer train than the truth counts
    assert visibility_from_truth(root, CaptureOptions(split="every")) is None


def test_sky_belongs_to_no_group(benched, tmp_path, monkeypatch):
    seen = visibility_from_truth(benched / "captures" / "tiny", CaptureOptions())
    assert seen is not None

    def with_sky(camera: Camera) -> np.ndarray:
        below = seen.visibility_map(camera).copy()
        below[:10] = np.nan
        return below

    monkeypatch.setattr(
        bench, "visibility_from_truth", lambda *_: replace(seen, count_map=with_sky, identity="with sky")
    )
    shutil.copytree(benched, tmp_path / "copy")
    pixels = sum(int(np.isfinite(with_sky(view.camera)).sum()) for view in seen.capture.test_views)
    for result in run_bench(settings(tmp_path / "copy"), Console(file=io.StringIO())):
        assert sum(group["pixels"] for group in result.groups) == pixels
        assert result.groups[0]["lower"] is not None


def test_without_truth_pixels_are_grouped_anew_by_a_model(benched, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(benched, copy)
    shutil.rmtree(copy / "captures" / "tiny" / "truth")
    before, said = models(copy), io.StringIO()
    by_model = run_bench(settings(copy), Console(file=said))
    assert {each.visibility_source for each in by_model} == {"model"}
    assert not any(each.frusta for each in by_model)
    by_truth = json.loads((benched / "toy" / "results.json").read_text())["results"][0]
    assert by_model[0].groups != tuple(by_truth["groups"])
    assert models(copy) == before
    assert "one coarse model draws" in (copy / "toy" / "table.md").read_text()


def test_one_bench_at_a_time_in_a_folder(tmp_path):
    with (tmp_path / ".lock").open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(VdgsError, match="another `vdgs bench`"):
            run_bench(settings(tmp_path), Console(file=io.StringIO()))


def test_data_that_is_not_there_is_named(tmp_path):
    asked = BenchSettings("table2", tmp_path, PlanOptions(scenes=("residence",)))
    with pytest.raises(VdgsError, match="--data"):
        run_bench(asked, Console(file=io.StringIO()))
    with pytest.raises(VdgsError, match="residence-pixsfm"):
        run_bench(replace(asked, data=tmp_path), Console(file=io.StringIO()))
