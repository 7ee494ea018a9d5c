"""`vdgs bench --reuse-results`: what other benches measured stands in the table and is not trained again."""

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from rich.console import Console

from experiments.bench.bench import BenchSettings, run_bench
from experiments.bench.cached_results import drop_cached_runs, match_pixel_groups, read_cached_results
from experiments.bench.definitions import CLOCK
from experiments.bench.plan import PlanOptions, make_plan
from experiments.bench.results import BenchResult, results_to_json, without_old_seconds
from experiments.bench.scenes import SCENES
from support.bench import InThisProcess, write_data
from vdgs.captures.image_cache import load_image
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import VdgsError
from vdgs.evaluation.comparison_images import write_png

pytestmark = [pytest.mark.xdist_group("bench_cached_results"), pytest.mark.slow]


def asked(data: Path, output: Path, seeds: int = 1, known: tuple[Path, ...] = (), total: int = 24) -> BenchSettings:
    choices = PlanOptions(seeds, ("copr",), ("coarse", "baseline"), total_iterations=total, max_anchors=300)
    return BenchSettings("table2", output, choices, data, reuse_results=known)


def bench(settings: BenchSettings) -> tuple[dict[tuple[str, int], BenchResult], str]:
    said = io.StringIO()
    return {(each.method, each.seed): each for each in run_bench(settings, Console(file=said))}, said.getvalue()


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("known") / "data"
    write_data(folder)
    return folder


@pytest.fixture(scope="module")
def there(data, tmp_path_factory) -> Path:
    """The results of a bench on another machine."""
    output = tmp_path_factory.mktemp("known") / "there"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("experiments.bench.bench.LocalExecutor", InThisProcess)
        patch.setattr("experiments.bench.provenance.describe_provenance", lambda *_: "1999-12-31, another machine")
        bench(asked(data, output))
    return output / "table2" / "results.json"


def known_psnr(file: Path, method: str) -> float:
    return next(each.figures["psnr"] for each in read_cached_results([file]).values() if each.method == method)


def models(output: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in output.rglob("*.safetensors")}


@pytest.fixture(autouse=True)
def here(monkeypatch) -> None:
    monkeypatch.setattr("experiments.bench.bench.LocalExecutor", InThisProcess)


def test_cached_results_are_not_trained_again(data, there, tmp_path):
    results, said = bench(asked(data, tmp_path / "out", known=(there,)))
    assert "2 of 2 runs are known" in said
    assert not (tmp_path / "out" / "runs").exists()
    before = json.loads(there.read_text())["results"]
    after = json.loads((tmp_path / "out" / "table2" / "results.json").read_text())["results"]
    assert after == before
    assert {each.provenance for each in results.values()} == {"1999-12-31, another machine"}
    assert "1999-12-31, another machine: all." in (tmp_path / "out" / "table2" / "table.md").read_text()
    # A table that was written from a file can be the file of another one.
    again, _ = bench(asked(data, tmp_path / "again", known=(tmp_path / "out" / "table2" / "results.json",)))
    assert again == results


def test_another_seed_is_trained_beside_it(data, there, tmp_path):
    results, said = bench(asked(data, tmp_path / "out", seeds=2, known=(there,)))
    assert "2 of 4 runs are known" in said
    assert {state for each in results.values() for state in [each.state]} == {"done"}
    assert {path.name for path in tmp_path.glob("out/runs/copr/*/*")} == {"1"}
    text = (tmp_path / "out" / "table2" / "table.md").read_text()
    assert "1999-12-31, another machine: seed 0: coarse on copr, baseline on copr." in text
    assert results["baseline", 0].key != results["baseline", 1].key
    # Here a coarse model of each bench says what its groups are: those of another are not compared.
    assert not results["baseline", 0].groups
    assert results["baseline", 1].groups
    assert results["baseline", 0].figures["psnr"] == known_psnr(there, "baseline")
    assert "of other pixels" in text


def test_other_photographs_under_the_same_name_are_trained(data, there, tmp_path):
    """Neither what another bench measured holds for them, nor a finished run in the same folder."""
    other = tmp_path / "data"
    shutil.copytree(data, other)
    for file in (other / "copr" / "images_4").iterdir():
        cv2.imwrite(str(file), 255 - cv2.imread(str(file)))
    results, said = bench(asked(other, tmp_path / "out", known=(there,)))
    assert "0 of 2 runs are known" in said
    assert results["baseline", 0].figures["psnr"] != known_psnr(there, "baseline")
    before = models(tmp_path / "out")
    with pytest.raises(VdgsError, match=r"changed: photographs\. .* give another --output"):
        bench(asked(data, tmp_path / "out"))
    again, said = bench(asked(other, tmp_path / "out"))
    assert "3 of 3 runs are finished already" in said
    assert again == results
    assert models(tmp_path / "out") == before


def test_other_settings_are_another_run(data, there, tmp_path):
    plan = make_plan("table2", asked(data, tmp_path, total=60).plan_options)
    known = read_cached_results([there])
    assert all(run.key({}, {}) not in known for run in plan.runs)


def test_a_coarse_stage_that_only_cached_runs_share_is_not_trained():
    plan = make_plan("toy", PlanOptions(methods=("baseline", "full", "no-blocking")))
    keys = {run.name: run.name for run in plan.coarse + plan.runs}
    full, other = (next(run for run in plan.runs if run.method == name) for name in ("full", "no-blocking"))
    known = {name: BenchResult("tiny", "any", 0, "done") for name in (full.name, other.name)}
    assert plan.coarse
    assert not drop_cached_runs(plan, keys, known).coarse
    assert drop_cached_runs(plan, keys, {full.name: known[full.name]}).coarse == plan.coarse
    assert drop_cached_runs(plan, keys, {}) == plan
    assert not drop_cached_runs(plan, keys, dict.fromkeys(keys, known[full.name])).scenes


@pytest.mark.parametrize("content", ["[]", "{}", '{"results": [{"state": "done"}]}', '{"results": 3}', "no JSON"])
def test_a_file_of_another_kind_is_named(tmp_path, content):
    file = tmp_path / "results.json"
    file.write_text(content)
    with pytest.raises(VdgsError, match=r"results\.json"):
        read_cached_results([file])


def test_seconds_of_another_meaning_do_not_stand_beside_others(there, tmp_path):
    content = json.loads(there.read_text())
    for each in content["results"]:
        del each["figures"]["preparation_seconds"]
    (tmp_path / "results.json").write_text(json.dumps(content))
    with pytest.raises(VdgsError, match="seconds are those of its steps alone"):
        read_cached_results([tmp_path / "results.json"])


def test_seconds_by_an_older_clock_are_left_out_and_the_rest_is_taken(there, tmp_path):
    content = json.loads(there.read_text())
    times = {"seconds": 9.0, "preparation_seconds": 4.0, "block_seconds": 3.0, "longest_block_seconds": 2.0}
    whole, cut = content["results"]
    for each in (whole, cut):
        each["figures"] |= times
        del each["clock"]
    cut["figures"]["blocks"] = 2
    file = tmp_path / "results.json"
    for _ in range(2):  # a table that was written from a file can be the file of another one
        file.write_text(json.dumps(content))
        results = read_cached_results([file])
        assert times.items() <= results[whole["key"]].figures.items()  # of one stage: the same by either
        taken = results[cut["key"]]
        assert dict.fromkeys(times).items() <= taken.figures.items()
        assert taken.figures["psnr"] == cut["figures"]["psnr"]
        assert taken.reason.count("before 2026-11-29") == 1
        content["results"] = results_to_json(list(results.values()))
    assert without_old_seconds(replace(taken, figures=cut["figures"] | times, clock=CLOCK)).figures["seconds"] == 9.0


@pytest.mark.parametrize("state", ["failed", "stopped", "missing"])
def test_of_an_interrupted_bench_the_finished_runs_are_taken(data, there, tmp_path, state):
    content = json.loads(there.read_text())
    finished, other = content["results"]
    content["results"] = [finished, other | {"state": state, "key": "", "figures": {}, "groups": [], "frusta": []}]
    file = tmp_path / "results.json"
    file.write_text(json.dumps(content))
    assert list(read_cached_results([file])) == [finished["key"]]
    if state == "stopped":
        results, said = bench(asked(data, tmp_path / "out", known=(file,)))
        assert "1 of 2 runs are known" in said
        assert {each.state for each in results.values()} == {"done"}


def test_measured_renders_of_another_program_are_taken(data, tmp_path):
    """Also where one equals the photographs; their costs are unknown."""
    (tmp_path / "theirs" / "copr").mkdir(parents=True)
    for view in load_capture(data / "copr", CaptureOptions(**SCENES["copr"].options)).test_views:
        write_png(tmp_path / "theirs" / "copr" / f"{Path(view.name).stem}.png", load_image(view).image.numpy())
    settings = asked(data, tmp_path / "one")
    options = replace(settings.plan_options, renders=(f"Exact={tmp_path / 'theirs'}",))
    results, _ = bench(replace(settings, plan_options=options))
    assert results["exact", 0].figures["psnr"] == 100.0
    known = (tmp_path / "one" / "table2" / "results.json",)
    again, said = bench(replace(asked(data, tmp_path / "two", known=known), plan_options=options))
    assert "3 of 3 runs are known" in said
    assert again["exact", 0] == results["exact", 0]


def test_a_run_without_psnr_is_measured_again(there, tmp_path):
    content = json.loads(there.read_text())
    content["results"][0]["figures"]["psnr"] = None
    (tmp_path / "results.json").write_text(json.dumps(content))
    assert list(read_cached_results([tmp_path / "results.json"])) == [content["results"][1]["key"]]


def test_groups_of_other_pixels_are_not_compared(there):
    first, second = read_cached_results([there]).values()
    groups = tuple({"lower": 1, "upper": 2, "pixels": pixels} for pixels in (10, 12))
    alike = [replace(first, groups=groups), replace(second, groups=groups), replace(second, groups=())]
    assert match_pixel_groups(alike, {}) == alike
    known = replace(first, groups=groups[::-1], figures={"psnr": 20.0, "psnr@0": 19.0, "psnr@frusta0": 18.0})
    here, gone = match_pixel_groups([alike[1], known], {known.key: known})
    assert here == alike[1]
    assert gone.figures == {"psnr": 20.0}
    assert not gone.groups
    assert "other pixels" in gone.reason
    assert match_pixel_groups([known, alike[1]], {known.key: known}) == [gone, here]  # whichever comes first
