"""`vdgs bench`: the runs of a table, several at once, then its tables, figure and check of the claims.

OUTPUT/
  captures/SCENE/             what was generated
  runs/SCENE/METHOD/SEED/     ordinary run folders; shared-coarse-…: coarse stages of several runs
  jobs/                       what each process is to do, and its log
  TABLE/                      results.json table.md table.tex table.csv claims.txt groups.png
"""

from __future__ import annotations

import fcntl
import os
import time
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from experiments.bench.cached_results import drop_cached_runs, match_pixel_groups, read_cached_results
from experiments.bench.claim_check import check_claims
from experiments.bench.definitions import RECORD_FILE, BenchScene, has_block_folders, has_gaussian_blocks
from experiments.bench.equal_time import step_factors
from experiments.bench.figure import plot_visibility_groups
from experiments.bench.measure import FRUSTA_FILE, GROUPS_FILE, measure_groups
from experiments.bench.notes import make_notes
from experiments.bench.pixel_visibility import (
    PixelVisibility,
    visibility_from_frusta,
    visibility_from_model,
    visibility_from_truth,
)
from experiments.bench.plan import BenchPlan, PlannedRun, PlanOptions, make_plan
from experiments.bench.renders import check_renders
from experiments.bench.result_tables import make_result_tables
from experiments.bench.results import BenchResult, collect_results, results_to_json
from experiments.bench.table_writers import to_latex, to_markdown, to_tidy_csv
from experiments.bench.worker import BenchJob
from vdgs.captures.capture_metadata import capture_fingerprint, check_same_capture
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import check_not_among_files, check_output
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.serialization import diff_settings, to_dict
from vdgs.distributed.executor import LogListener, Task, TaskResult
from vdgs.distributed.local_executor import LocalExecutor
from vdgs.distributed.progress_table import STATE_STYLES
from vdgs.distributed.scheduler import stop_message
from vdgs.errors import RunError, Stopped, VdgsError
from vdgs.evaluation.lpips import check_weights_file
from vdgs.kernels import default_num_threads
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_keys import hashable_settings
from vdgs.synth import SynthOptions, generate
from vdgs.system.atomic_files import read_json, to_jsonable, write_json, write_text
from vdgs.system.child_python import python_command


@dataclass(frozen=True)
class BenchSettings:
    """How a table is worked off."""

    table: str
    output: Path
    plan_options: PlanOptions
    data: Path | None = None
    jobs: int = 1
    visibility_bins: int = 4
    lpips_weights: Path | None = None
    overwrite: bool = False
    #: What other benches wrote as results.json: runs that they hold are not trained.
    reuse_results: tuple[Path, ...] = ()
    #: Afterwards once more, each method with as many iterations as fit into the time of the table's own method.
    equal_time: bool = False
    #: Where runs are trained and measured, selected already.
    device: str = "cpu"


def run_bench(settings: BenchSettings, console: Console) -> list[BenchResult]:
    """Everything; what is finished for the same settings is kept, and the same command continues.

    Raises VdgsError for settings that do not work, Stopped after Ctrl-C or SIGTERM (what is measured so far is
    written), and at the end if a run failed: the tables then say which and why.
    """
    if settings.jobs < 1 or settings.visibility_bins < 1:
        raise VdgsError("--jobs and --visibility-bins must be at least 1")
    check_weights_file(settings.lpips_weights)
    _check_output_outside_inputs(settings.output, plan := make_plan(settings.table, settings.plan_options))
    results, outcomes = _run_plan(plan, settings, console)
    if settings.equal_time and not any(each.state == "stopped" for each in outcomes.values()):
        options = replace(settings.plan_options, step_factors=step_factors(plan, results))
        settings = replace(settings, plan_options=options)
        results, outcomes = _run_plan(make_plan(settings.table, options), settings, console)
    if any(each.state == "stopped" for each in outcomes.values()):
        raise Stopped(stop_message(outcomes.values(), "every run"))
    errors = [each for each in outcomes.values() if each.state == "failed"]
    if errors:
        raise VdgsError(
            f"{len(errors)} of {len(outcomes)} runs failed; the tables say so:\n  "
            + "\n  ".join(f"{each.name}: {each.reason}" for each in errors)
        )
    return results


def _run_plan(
    plan: BenchPlan, settings: BenchSettings, console: Console
) -> tuple[list[BenchResult], dict[str, TaskResult]]:
    """Train and measure what is not finished, and write the tables; the results, and how each run ended."""
    plan = _with_contents(plan, settings)
    cached = read_cached_results(settings.reuse_results)
    keys = {run.name: _key(run, plan, settings) for run in plan.coarse + plan.runs}
    remaining = drop_cached_runs(plan, keys, cached)
    if settings.reuse_results:
        num_cached = len(plan.runs) - len(remaining.runs)
        console.print(f"{num_cached} of {len(plan.runs)} runs are known and not trained here", highlight=False)
    began = time.monotonic()
    with _locked(settings.output):
        captures, failed = _captures(remaining, settings, console)
        outcomes = failed | _train(remaining, captures, keys, settings, console)
        outcomes |= _measure(remaining, captures, outcomes, settings, console)
        results = match_pixel_groups(collect_results(plan, settings.output, outcomes, keys, cached), cached)
        _write(plan, results, settings, console)
    console.print(f"{(time.monotonic() - began) / 60:.1f} min", highlight=False)
    return results, outcomes


def _check_output_outside_inputs(output: Path, plan: BenchPlan) -> None:
    """Raise VdgsError before anything is written where the output lies among photographs or masks of a scene."""
    check_output(output)
    for scene in plan.scenes:
        if scene.folder is not None:
            names = [scene.options.get("images"), scene.options.get("masks")]
            check_not_among_files(output, scene.folder, [scene.folder / name / "any" for name in names if name])


def _with_contents(plan: BenchPlan, settings: BenchSettings) -> BenchPlan:
    """The plan, its scenes under --data with their fingerprints: runs hold for what lies there, not for its name.

    A scene that cannot be read keeps its name alone. What was trained on any capture has another key, so that its runs
    are to be trained, where `_captures` or the run says what is wrong.
    """

    def read(scene: BenchScene) -> BenchScene:
        if scene.capture is None or settings.data is None:
            return scene
        try:
            capture = load_capture(settings.data / scene.capture, CaptureOptions(**scene.options))
        except VdgsError:
            return scene
        return replace(scene, contents=capture_fingerprint(capture))

    return replace(plan, scenes=tuple(map(read, plan.scenes)))


def _captures(
    plan: BenchPlan, settings: BenchSettings, console: Console
) -> tuple[dict[str, Path], dict[str, TaskResult]]:
    """The folder of every scene, generated where there is none yet; the runs of those that cannot be had, failed."""
    folders, failed = {}, dict[str, TaskResult]()
    for scene in plan.scenes:
        try:
            folders[scene.name] = _capture(scene, settings, console)
        except VdgsError as error:
            names = [run.name for run in plan.coarse + plan.runs if run.scene == scene.name]
            failed |= {name: TaskResult(name=name, state="failed", reason=str(error)) for name in names}
    if failed and not folders:
        raise VdgsError(next(iter(failed.values())).reason)
    return folders, failed


def _capture(scene: BenchScene, settings: BenchSettings, console: Console) -> Path:
    if scene.folder is not None:
        return scene.folder
    if scene.capture is not None:
        if settings.data is None:
            raise VdgsError(f"{scene.name}: say where the data is: --data FOLDER. {scene.note}")
        folder = settings.data / scene.capture
        if not folder.is_dir():
            raise VdgsError(f"{folder}: is not there. {scene.note}")
        return folder
    folder = settings.output / "captures" / scene.name
    if not folder.exists():
        for name in ("size", "flight"):
            choices = typing.get_args(typing.get_type_hints(SynthOptions)[name])
            if name in scene.synth and scene.synth[name] not in choices:
                raise VdgsError(f"{scene.name}: this version generates no {name} {scene.synth[name]!r}")
        console.print(f"generating {scene.name}", highlight=False)
        folder.parent.mkdir(parents=True, exist_ok=True)
        generate(folder, SynthOptions(**{**scene.synth, "truth": True}))
    return folder


def _train(
    plan: BenchPlan, captures: Mapping[str, Path], keys: Mapping[str, str], settings: BenchSettings, console: Console
) -> dict[str, TaskResult]:
    """Every run whose scene is there, trained or found finished."""
    done, tasks = dict[str, TaskResult](), list[Task]()
    wanted = [run for run in plan.coarse + plan.runs if run.scene in captures]
    threads = max(1, default_num_threads() // settings.jobs)
    for run in wanted:
        _check_same_settings(settings, run)
    for scene in plan.scenes:
        if scene.name in captures:
            _check_same_capture(
                scene, captures[scene.name], [run for run in wanted if run.scene == scene.name], settings
            )
    for run in wanted:
        job = _job(run, plan, captures[run.scene], keys[run.name], settings, threads)
        if _is_done(settings.output, run, job.key):
            done[run.name] = TaskResult(name=run.name, state="done")
            continue
        _check_renders(run, plan, captures[run.scene], settings)
        stem = settings.output / "jobs" / run.name.replace("/", "__")
        job.write(stem.with_name(stem.name + ".json"))
        after = None if run.coarse_from is None else str(run.coarse_from.relative_to("runs"))
        command = python_command("experiments.bench.worker", stem.with_name(stem.name + ".json"))
        output = stem.with_name(stem.name + ".log")
        tasks.append(Task(name=run.name, command=command, output=output, environment=_environment(), after=after))
    if done:
        console.print(f"{len(done)} of {len(wanted)} runs are finished already", highlight=False)
    outcomes = LocalExecutor(settings.jobs).run(tasks, ProgressReporter(len(tasks), console))
    return done | {outcome.name: outcome for outcome in outcomes}


def _environment() -> dict[str, str]:
    """Variables of a worker: `experiments` is not installed, so that the folder above it has to be named."""
    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    return {"OMP_WAIT_POLICY": "PASSIVE", "PYTHONPATH": os.pathsep.join(path for path in paths if path)}


class ProgressReporter(LogListener):
    """One line when a run starts and one when it ended."""

    def __init__(self, total: int, console: Console):
        super().__init__(self._print)
        self._left, self._total, self._console = total, total, console

    def on_started(self, task: Task, attempt: int) -> None:
        self.print_line(f"started  {task.name}", "dim")

    def on_ended(self, task: Task, result: TaskResult) -> None:
        self._left -= 1
        if result.state == "stopped" and not result.attempts:
            return
        count = f"({self._total - self._left} of {self._total})"
        self.print_line(
            f"{result.state:8} {task.name}  {result.seconds:.0f} s  {count} {result.reason}",
            STATE_STYLES[result.state],
        )

    def _print(self, text: str, style: str) -> None:
        self._console.print(text, style=style, highlight=False, markup=False)
        self._console.file.flush()  # also into a file that someone follows


def _check_renders(run: PlannedRun, plan: BenchPlan, capture: Path, settings: BenchSettings) -> None:
    """Raise VdgsError, before anything is trained, for renders by another program that cannot be measured."""
    if run.renders is not None:
        scene = next(scene for scene in plan.scenes if scene.name == run.scene)
        check_renders(run.renders, load_capture(capture, _options(scene, settings)).test_views)


def _check_same_settings(settings: BenchSettings, run: PlannedRun) -> None:
    """Raise VdgsError, before anything is trained, if the run's folder was filled with other settings."""
    folder = RunFolder(settings.output / run.folder)
    if settings.overwrite or not folder.config_file.exists():
        return
    wanted, held = to_dict(run.config), folder.settings().to_dict()
    if not (has_block_folders(run.stages) or has_gaussian_blocks(run.stages)):  # no other section matters to it
        wanted = {"training": wanted["training"]}
    before, after = ({name: hashable_settings(name, each[name]) for name in wanted} for each in (held, wanted))
    changed = diff_settings(before, after)
    if changed:
        raise VdgsError(
            f"{folder.path}: was trained with other settings:\n  "
            + "\n  ".join(changed)
            + "\nGive the old options to continue, --overwrite to train again what depends on them, or another "
            "--output."
        )


def _check_same_capture(scene: BenchScene, folder: Path, runs: Sequence[PlannedRun], settings: BenchSettings) -> None:
    """Raise VdgsError, before anything is trained, if the folder of a run was filled from another capture."""
    filled = [RunFolder(settings.output / run.folder) for run in runs]
    filled = [run for run in filled if run.capture_file.exists()]
    if settings.overwrite or not filled:
        return
    capture = load_capture(folder, _options(scene, settings))
    for run in filled:
        try:
            check_same_capture(run.capture_file, read_json(run.capture_file), capture)
        except RunError as error:
            raise VdgsError(f"{error}. Of a bench: give another --output") from error


def _key(run: PlannedRun, plan: BenchPlan, settings: BenchSettings) -> str:
    """Of a run of this bench: its settings, what it is trained on and how it is measured."""
    scene = next(scene for scene in plan.scenes if scene.name == run.scene)
    options = hashable_settings("capture", to_dict(_options(scene, settings)))
    of = {"options": options, "scene": dict(scene.synth or scene.contents) or scene.capture}
    return run.key(of, {"bins": settings.visibility_bins, "lpips": str(settings.lpips_weights)})


def _job(run: PlannedRun, plan: BenchPlan, capture: Path, key: str, settings: BenchSettings, threads: int) -> BenchJob:
    scene = next(scene for scene in plan.scenes if scene.name == run.scene)
    return BenchJob(
        capture.resolve(), to_dict(_options(scene, settings)), to_dict(run.config), run.stages,
        (settings.output / run.folder).resolve(),
        None if run.coarse_from is None else (settings.output / run.coarse_from).resolve(), key,
        settings.lpips_weights and settings.lpips_weights.resolve(), settings.visibility_bins, threads,
        settings.overwrite,
        run.renders and run.renders.resolve(), settings.device,
    )  # fmt: skip


def _options(scene: BenchScene, settings: BenchSettings) -> CaptureOptions:
    return CaptureOptions(**scene.options, validation=settings.plan_options.validation)


def _is_done(output: Path, run: PlannedRun, key: str) -> bool:
    """Finished for this key. Any doubt (a damaged record) means no."""
    try:
        record = read_json(output / run.folder / RECORD_FILE)
    except (VdgsError, FileNotFoundError):
        return False
    return isinstance(record, dict) and record.get("state") == "done" and record.get("key") == key


def _measure(
    plan: BenchPlan,
    captures: Mapping[str, Path],
    ended: Mapping[str, TaskResult],
    settings: BenchSettings,
    console: Console,
) -> dict[str, TaskResult]:
    """Groups by visibility of every finished run, scene by scene; runs that cannot be measured, as failed."""
    failed = dict[str, TaskResult]()
    for scene in [scene for scene in plan.scenes if scene.name in captures]:
        done = [run for run in plan.runs if run.scene == scene.name and ended[run.name].state == "done"]
        if not done:
            continue
        try:
            seen = _pixel_visibility(plan, scene, captures[scene.name], ended, settings)
            if seen is None:
                for run in done:  # what an earlier table may have left there is of another V
                    for file in (GROUPS_FILE, FRUSTA_FILE):
                        (settings.output / run.folder / file).unlink(missing_ok=True)
                continue
            by_frusta = (
                visibility_from_frusta(captures[scene.name], _options(scene, settings))
                if seen.source == "truth"
                else None
            )
            folders = [settings.output / run.folder for run in done]
            keys = {folder: read_json(folder / RECORD_FILE)["key"] for folder in folders}
            with console.status(f"{scene.name}: measuring by visibility") as status:
                for each in (seen, by_frusta) if by_frusta is not None else (seen,):
                    measure_groups(
                        each, keys, settings.visibility_bins,
                        lambda text, scene=scene, status=status: status.update(f"{scene.name}: {text}"),  # type: ignore[misc]
                    )  # fmt: skip
            if by_frusta is None:
                for folder in folders:
                    (folder / FRUSTA_FILE).unlink(missing_ok=True)
        except VdgsError as error:
            failed |= {run.name: TaskResult(name=run.name, state="failed", reason=str(error)) for run in done}
    return failed


def _pixel_visibility(
    plan: BenchPlan, scene: BenchScene, capture: Path, ended: Mapping[str, TaskResult], settings: BenchSettings
) -> PixelVisibility | None:
    """By truth where the capture has it, else by a reference model; None without either."""
    truly = visibility_from_truth(capture, _options(scene, settings))
    if truly is not None:
        return truly
    reference = plan.reference(scene.name)
    if reference is None or ended[reference.name].state != "done":
        return None
    return visibility_from_model(settings.output / reference.folder)


def _write(plan: BenchPlan, results: list[BenchResult], settings: BenchSettings, console: Console) -> None:
    output = settings.output / (plan.table.name + "-equal-time" * bool(plan.step_factors))
    result_tables, claims = make_result_tables(plan, results), check_claims(plan, results)
    output.mkdir(exist_ok=True)
    write_json(
        output / "results.json",
        to_jsonable({
            "table": plan.table.name, "title": plan.table.title, "seeds": plan.seeds,
            "budgets": {name: vars(budget) | {"total": budget.total} for name, budget in plan.budgets.items()},
            "plan_options": to_dict(settings.plan_options), "results": results_to_json(results),
            "claims": [vars(line) for line in claims],
        }),
    )  # fmt: skip
    text = "\n".join(map(str, claims)) or "This table asks no question."
    drawn = plot_visibility_groups(output / "groups.png", plan, results)
    paragraphs = make_notes(plan, results, claims, drawn)
    write_text(output / "table.md", to_markdown(result_tables, plan.table.title, paragraphs))
    write_text(output / "table.tex", to_latex(result_tables))
    write_text(output / "table.csv", to_tidy_csv(result_tables))
    write_text(output / "claims.txt", text + "\n")
    console.print(text, highlight=False, markup=False)
    console.print(f"tables: {output / 'table.md'} and beside it", highlight=False)


@contextmanager
def _locked(output: Path) -> Iterator[None]:
    """Hold the folder: two benches in one would train the same runs."""
    output.mkdir(parents=True, exist_ok=True)
    with (output / ".lock").open("w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise VdgsError(f"{output}: another `vdgs bench` works here. Wait for it or stop it.") from error
        yield
