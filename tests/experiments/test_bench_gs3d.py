"""3DGS as a method of the bench: its schedule, its settings, its run, its row."""

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from experiments.baselines.gs3d import session as gaussian_session
from experiments.baselines.gs3d.run import gaussians_folder
from experiments.baselines.gs3d.schedule import MIN_INTERVAL, PUBLISHED_ITERATIONS, scale_schedule
from experiments.baselines.gs3d.training import Gs3dConfig
from experiments.bench import bench
from experiments.bench.baseline_stages import gs3d_config
from experiments.bench.bench import BenchSettings, run_bench
from experiments.bench.measure import GROUPS_FILE
from experiments.bench.methods import METHODS
from experiments.bench.notes import make_notes
from experiments.bench.plan import PlanOptions, make_plan
from experiments.bench.results import BenchResult
from support.bench import InThisProcess, benched, write_data
from vdgs.config.method import MethodConfig
from vdgs.errors import RunError, Stopped
from vdgs.runs.open_run import open_run
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json

pytestmark = [pytest.mark.xdist_group("bench_gs3d"), pytest.mark.slow]


def test_the_published_length_has_the_published_schedule():
    assert scale_schedule(PUBLISHED_ITERATIONS) == Gs3dConfig()


@given(st.integers(1, 2_000_000))
def test_a_schedule_is_one_whatever_its_length(iterations):
    config, published = scale_schedule(iterations), Gs3dConfig()
    starts = [start for start, _ in config.resolution_schedule]
    assert starts == sorted(starts)
    assert starts[0] == 0
    assert [factor for _, factor in config.resolution_schedule] == [4, 2, 1]
    assert config.degree_interval >= 1
    assert config.density.interval >= MIN_INTERVAL
    assert config.density.reset_interval >= MIN_INTERVAL
    # Below the end of density control by as much as in the published schedule.
    assert config.density.start <= config.density.until * iterations
    rounding = (0.5 + 1e-9) / iterations
    assert config.density.start / iterations == pytest.approx(published.density.start / 30_000, abs=rounding)


def test_long_and_short_schedules_move_in_proportion():
    long, short = scale_schedule(300_000), scale_schedule(6_000)
    assert (long.density.start, long.density.interval, long.density.reset_interval) == (5_000, 1_000, 30_000)
    assert (short.density.start, short.density.interval, short.density.reset_interval) == (100, 100, 600)
    assert (short.degree_interval, short.resolution_schedule) == (200, ((0, 4), (50, 2), (100, 1)))


def test_its_settings_are_those_of_the_table():
    methods = ("3dgs", "3dgs-black", "full")
    plan = make_plan("table1", PlanOptions(seeds=2, scenes=("tiny",), methods=methods, max_anchors=700))
    ours, black = plan.run_of["tiny", "3dgs", 1], plan.run_of["tiny", "3dgs-black", 1]
    config = gs3d_config(ours.config)
    assert (config.iterations, config.seed, config.background) == (600, 1, "mean")
    assert config.density.max_gaussians == 7_000
    assert gs3d_config(black.config) == replace(config, background="black")
    assert ours.folder != black.folder
    assert ours.coarse_from is None
    reference = plan.reference("tiny")
    assert reference is not None
    assert "coarse" in reference.stages
    assert any("7,000" in note for note in make_notes(plan, list[BenchResult](), [], False))
    alone = make_plan("table1", PlanOptions(scenes=("tiny",), methods=("3dgs",)))
    assert alone.reference("tiny") is None
    assert gs3d_config(alone.runs[0].config).density.max_gaussians == 0
    assert alone.runs[0].key({}, {}) != replace(alone.runs[0], config=MethodConfig()).key({}, {})


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_data(folder)
    return folder


def test_it_stands_beside_methods_with_anchors(data, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "LocalExecutor", InThisProcess)
    both = benched(data, tmp_path, "3dgs", "scaffold-gs-ours")
    explicit, anchored = both["3dgs"].figures, both["scaffold-gs-ours"].figures
    assert explicit["iterations"] == anchored["iterations"] == 40
    assert explicit["anchors"] is None
    assert 0 < explicit["gaussians"] <= 3_000
    assert anchored["gaussians"] == 10 * anchored["anchors"]
    for name in ("psnr", "ssim", "psnr_cc", "psnr@0", "seconds", "peak_memory_bytes", "model_bytes", "fps"):
        assert explicit[name] is not None, name
    assert both["3dgs"].groups == both["scaffold-gs-ours"].groups  # the same pixels
    assert both["3dgs"].visibility_source == "model"
    text = (tmp_path / "table1" / "table.md").read_text()
    assert "3DGS has no anchors" in text
    assert "3,000, as many as they decode to" in text


@pytest.fixture(scope="module")
def alone(data, tmp_path_factory) -> tuple[Path, BenchResult]:
    """A bench of nothing else, and its result."""
    output = tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "LocalExecutor", InThisProcess)
        return output, benched(data, output, "3dgs")["3dgs"]


def test_alone_it_has_no_groups_and_other_settings_train_it_again(data, alone, monkeypatch):
    monkeypatch.setattr(bench, "LocalExecutor", InThisProcess)
    output, alone = alone
    assert (alone.state, alone.groups, alone.visibility_source) == ("done", (), "")
    run = RunFolder(output / alone.folder)
    assert not (run.path / GROUPS_FILE).exists()
    with pytest.raises(RunError, match="has no coarse model"):
        open_run(run.path)
    model = gaussians_folder(run).model
    before = model.stat().st_mtime_ns
    (run.path / "bench.json").unlink()  # measured again, not trained
    assert benched(data, output, "3dgs")["3dgs"].figures["psnr"] == alone.figures["psnr"]
    assert model.stat().st_mtime_ns == before
    assert benched(data, output, "3dgs", total=24, overwrite=True)["3dgs"].figures["iterations"] == 24
    assert model.stat().st_mtime_ns != before


def test_a_stopped_run_continues(data, alone, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "LocalExecutor", InThisProcess)
    whole, train = alone[1], gaussian_session.train

    def half(state, stage, *, stop, after_step):
        return train(state, stage, stop=lambda: state.iteration == 20, after_step=after_step)

    with monkeypatch.context() as patched:
        patched.setattr(gaussian_session, "train", half)
        with pytest.raises(Stopped):
            benched(data, tmp_path / "half", "3dgs")
    folder = gaussians_folder(RunFolder(tmp_path / "half" / whole.folder))
    assert json.loads(folder.status_file.read_text())["iteration"] == 20
    continued = benched(data, tmp_path / "half", "3dgs")["3dgs"]
    assert continued.figures["psnr"] == whole.figures["psnr"]
    assert continued.figures["iterations"] == 40


def test_methods_that_train_in_blocks_stand_beside_the_others(data, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "LocalExecutor", InThisProcess)
    names = ("momentum-gs", "citygaussian-whole")
    for name, result in benched(data, tmp_path, *names).items():
        figures = result.figures
        assert figures["iterations"] == 40, name
        assert figures["blocks"] == 4, name
        for figure in ("psnr", "psnr@0", "longest_block_seconds", "block_memory_bytes", "cameras_per_block", "fps"):
            assert figures[figure] is not None, (name, figure)
        assert (figures["anchors"] is None) == (name != "momentum-gs")
        # All that leads to the model counts, the cut and a coarse stage that was taken over too; measuring does not.
        run = tmp_path / result.folder
        clock = read_json(run / "bench.json")["seconds"]
        for shared in tmp_path.glob("runs/copr/shared-coarse-*/0/bench.json"):
            clock |= {stage: taken for stage, taken in read_json(shared)["seconds"].items() if stage in clock}
        measuring = clock.get("evaluate", read_json(run / "evaluation" / "status.json")["seconds"])
        assert figures["seconds"] == pytest.approx(sum(clock.values()) - measuring)
        assert 0 < figures["preparation_seconds"] < figures["seconds"]
    text = (tmp_path / "table1" / "table.md").read_text()
    assert all(f"{METHODS[name].title} ({METHODS[name].citation})" in text for name in names)


def test_other_methods_stand_beside_ours_at_equal_steps_and_at_equal_time(data, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "LocalExecutor", InThisProcess)
    monkeypatch.setattr(bench, "step_factors", lambda plan, results: (("copr", "scaffold-gs", 0.5),))
    methods = ("scaffold-gs", "hug", "mixgs")
    options = PlanOptions(seeds=1, scenes=("copr",), methods=methods, total_iterations=24, max_anchors=300)
    settings = BenchSettings("table1", tmp_path, options, data, equal_time=True)
    at_equal_time = {each.method: each for each in run_bench(settings, Console(file=io.StringIO()))}
    results = json.loads((tmp_path / "table1" / "results.json").read_text())["results"]
    for name, figures in ((each["method"], each["figures"]) for each in results):
        assert figures["iterations"] == 24, name
        assert figures["psnr"] is not None
        assert (figures["anchors"] is None) == (name == "mixgs")
        assert figures["blocks"] == (4 if name == "hug" else None)
        expected = pytest.approx(12, abs=2) if name == "scaffold-gs" else 24  # blocks round theirs
        assert at_equal_time[name].figures["iterations"] == expected
    assert (tmp_path / "runs" / "copr" / "scaffold-gs-equal-time").is_dir()
    assert "scaffold-gs on copr: 0.5" in (tmp_path / "table1-equal-time" / "table.md").read_text()
