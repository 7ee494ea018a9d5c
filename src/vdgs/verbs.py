"""The verbs of the command line: options as dataclasses, each handed to the room that does the work.

Nothing heavy is imported before the options are parsed, so that help and usage errors come at once.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from vdgs.captures.options import CaptureOptions
from vdgs.config import (
    PRESETS,
    AssignmentConfig,
    BlockConfig,
    MergeConfig,
    MethodConfig,
    PartitionConfig,
    PresetName,
    TrainConfig,
)
from vdgs.run_options import WatchOptions
from vdgs.synth.options import SynthOptions

if TYPE_CHECKING:
    from vdgs.run import RunFolder

# torch's OpenMP threads must block, not spin, beside the kernels' own pool; read once, when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@dataclass(frozen=True)
class InspectArguments:
    """Say what a capture holds and how well its photographs cover the place, in a table and figures."""

    capture: Positional[Path]
    """Folder of the capture."""
    output: Path
    """Folder for report.json and the figures."""
    check: bool = True
    """Decode every photograph once, to find damaged ones."""
    options: Annotated[CaptureOptions, arg(name="")] = field(default_factory=CaptureOptions)


@dataclass(frozen=True)
class CoarseArguments:
    """Train the global anchor model of a capture. The same command continues a run that was stopped."""

    capture: Positional[Path]
    """Folder of the capture."""
    output: Path
    """Run folder; new, or the run to continue."""
    preset: PresetName = "paper"
    """`paper`: the paper's settings (100 000 iterations). `laptop`: a good result in minutes on a CPU."""
    threads: int = 0
    """Threads of the kernels; 0 for all cores. The result does not depend on it."""
    options: Annotated[CaptureOptions, arg(name="")] = field(default_factory=CaptureOptions)
    training: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)
    watching: Annotated[WatchOptions, arg(name="")] = field(default_factory=WatchOptions)


@dataclass(frozen=True)
class RunArguments:
    """Do everything: coarse model, visibility, blocks, cameras, block training, merge, metrics, report.

    The same command continues a run that was stopped; finished stages are skipped.
    """

    capture: Positional[Path]
    """Folder of the capture."""
    output: Path
    """Run folder; new, or the run to continue."""
    preset: PresetName = "paper"
    """`paper`: the paper's settings (100 000 + 50 000 iterations a block). `laptop`: a good result in minutes."""
    redo: bool = False
    """Allow other settings than the run has to discard what was trained with the old ones."""
    jobs: int = 0
    """Blocks trained at once; 0 takes what cores and memory allow."""
    incomplete: bool = False
    """Go on if a block fails: the coarse model stands in for it."""
    lpips_weights: Path | None = None
    """VGG16 weights for LPIPS (torchvision's vgg16 state dict, .pth or .safetensors). Nothing is downloaded."""
    bins: int = 4
    """Number of visibility quantiles by which metrics are reported."""
    threads: int = 0
    """Threads of the kernels; 0 for all cores. The result does not depend on it."""
    options: Annotated[CaptureOptions, arg(name="")] = field(default_factory=CaptureOptions)
    training: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)
    partition: Annotated[PartitionConfig, arg(name="")] = field(default_factory=PartitionConfig)
    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)
    block: BlockConfig = field(default_factory=BlockConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    watching: Annotated[WatchOptions, arg(name="")] = field(default_factory=WatchOptions)

    def method(self) -> MethodConfig:
        return MethodConfig(self.training, self.partition, self.assignment, self.block, self.merge)


@dataclass(frozen=True)
class VisibilityArguments:
    """Count how many training cameras see each part of a run's scene; writes a map and the distribution."""

    run: Positional[Path]
    """Run folder with a coarse model."""


@dataclass(frozen=True)
class PartitionArguments:
    """Cut a run's scene into blocks by place and visibility, and give each block its cameras."""

    run: Positional[Path]
    """Run folder with a coarse model."""
    redo: bool = False
    """Allow another cut to discard blocks that are trained."""
    why: str | None = None
    """Name of a training photograph: also say how well it shows each block and why it was assigned or not."""
    threads: int = 0
    """Threads of the kernels; 0 for all cores. The result does not depend on it."""
    partition: Annotated[PartitionConfig, arg(name="")] = field(default_factory=PartitionConfig)
    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)


@dataclass(frozen=True)
class TrainArguments:
    """Train the blocks of a run. The same command continues; blocks may also be trained on several machines."""

    run: Positional[Path]
    """Run folder that is cut into blocks."""
    block: int | None = None
    """Only this block, in this process; without it all of them, several at once."""
    jobs: int = 0
    """Blocks trained at once; 0 takes what cores and memory allow."""
    redo: bool = False
    """Allow other settings to discard blocks that are trained with the old ones."""
    threads: int = 0
    """Threads of the kernels for --block; 0 for all cores. The result does not depend on it."""
    settings: Annotated[BlockConfig, arg(name="block")] = field(default_factory=BlockConfig)
    watching: Annotated[WatchOptions, arg(name="")] = field(default_factory=WatchOptions)


@dataclass(frozen=True)
class MergeArguments:
    """Merge the trained blocks of a run into one scene."""

    run: Positional[Path]
    """Run folder whose blocks are trained."""
    incomplete: bool = False
    """Let the coarse model stand in for blocks that are missing or failed."""
    merge: Annotated[MergeConfig, arg(name="")] = field(default_factory=MergeConfig)


@dataclass(frozen=True)
class ReportArguments:
    """Write RUN/report.html: one file with the figures, metrics, pictures and settings of a run."""

    run: Positional[Path]
    """Run folder."""


@dataclass(frozen=True)
class EvalArguments:
    """Render the test views of a run and measure them: metrics.json, per_view.json, pictures, a table."""

    run: Positional[Path]
    """Run folder."""
    model: Literal["best", "coarse", "merged"] = "best"
    """Which model; `best` is the merged one where there is one."""
    lpips_weights: Path | None = None
    """VGG16 weights for LPIPS (torchvision's vgg16 state dict, .pth or .safetensors). Nothing is downloaded."""
    bins: int = 4
    """Number of visibility quantiles by which metrics are reported."""
    threads: int = 0
    """Threads of the kernels; 0 for all cores."""


@dataclass(frozen=True)
class RenderArguments:
    """Render a run: its test views, its training views, or a camera path; as PNG files or a video."""

    run: Positional[Path]
    """Run folder."""
    output: Path
    """Folder for PNG files, or a file that ends in .mp4."""
    views: Literal["test", "train", "orbit", "flyover"] = "test"
    """Which cameras; `orbit` and `flyover` are paths made from the capture."""
    path: Path | None = None
    """JSON file with a camera path (docs/conventions.md); overrides --views."""
    seconds: float = 0.0
    """Length of a camera path; 0: what its file says, or 12 seconds."""
    fps: float = 0.0
    """Frames per second of a camera path and of the video; 0: what its file says, or 30 (2 for separate views)."""
    width: int = 0
    """Image width; 0 takes that of the training views."""
    kind: Literal["image", "depth", "visibility"] = "image"
    """What to draw: the picture, expected depth, or the number of cameras that see each place."""
    model: Literal["best", "coarse", "merged"] = "best"
    """Which model; `best` is the merged one where there is one."""
    threads: int = 0
    """Threads of the kernels; 0 for all cores."""


@dataclass(frozen=True)
class SynthArguments:
    """Generate an aerial place and a drone flight over it, as a COLMAP capture."""

    output: Positional[Path]
    """Folder for the capture; it must not exist or be empty."""
    options: Annotated[SynthOptions, arg(name="")] = field(default_factory=SynthOptions)


@dataclass(frozen=True)
class BenchArguments:
    """Train methods on scenes with several seeds and write tables, a figure and a verdict.

    The same command continues what was stopped; finished runs are kept.
    """

    table: Positional[Literal["table1", "table2", "table3", "table4", "efficiency", "toy"]]
    """table1 to table4: those of the paper; efficiency: its paragraph; toy: a small one in a minute or two."""
    output: Path
    """Folder for runs and results; new, or the one to continue."""
    seeds: int | None = None
    """How many seeds (0, 1, ...); by default as many as the table has."""
    scenes: tuple[str, ...] = ()
    """Other scenes than the table's, by name: tiny, toy-uneven, town-even, copr, residence, sci-art, ..."""
    methods: tuple[str, ...] = ()
    """Other methods than the table's, by name: full, baseline, no-blocking, vastgaussian, lambda-vis-0, ..."""
    data: Path | None = None
    """Folder that holds the captures which are not generated: residence-pixsfm, copr, ..."""
    scale_iterations: float = 1.0
    """Factor on the iterations of every scene."""
    iterations_total: int | None = None
    """Iterations that every method may spend on a scene, shared out as the scene's own; overrides the factor."""
    max_anchors: int = 0
    """No growth beyond this many anchors, of the scene or of all blocks together; 0 for no limit."""
    validation: bool = False
    """Measure on training photographs that are held out instead of on the test views: for choosing settings."""
    jobs: int = 1
    """Runs at once; cores are shared among them."""
    redo: bool = False
    """Allow other settings than those of the runs that are there to discard what they trained."""
    lpips_weights: Path | None = None
    """VGG16 weights for LPIPS (torchvision's vgg16 state dict, .pth or .safetensors). Nothing is downloaded."""
    bins: int = 4
    """Number of groups by visibility."""


@dataclass(frozen=True)
class DoctorArguments:
    """Say what this machine can use, and what to install for the rest."""

    json: bool = False
    """Print JSON instead of a table."""


def inspect(arguments: list[str]) -> None:
    asked = tyro.cli(InspectArguments, args=arguments, prog="vdgs inspect")
    from vdgs.captures.checks import check_images
    from vdgs.captures.loading import load_capture
    from vdgs.inspect import inspect_capture, print_report

    capture = load_capture(asked.capture, asked.options)
    if asked.check:
        check_images(capture)
    print_report(inspect_capture(capture, asked.output))


def coarse(arguments: list[str]) -> None:
    preset = _preset(arguments)
    default = CoarseArguments(tyro.MISSING, tyro.MISSING, preset, training=PRESETS[preset].training)
    asked = tyro.cli(CoarseArguments, args=arguments, prog="vdgs coarse", default=default)
    from vdgs.stages.coarse import begin_run, train_coarse

    _use_threads(asked.threads)
    method = replace(PRESETS[preset], training=asked.training)
    run, capture = begin_run(asked.capture, asked.output, asked.options, method)
    train_coarse(run, capture, asked.watching, _console())


def run(arguments: list[str]) -> None:
    preset = _preset(arguments)
    settings = PRESETS[preset]
    default = RunArguments(
        tyro.MISSING, tyro.MISSING, preset, training=settings.training, partition=settings.partition,
        assignment=settings.assignment, block=settings.block, merge=settings.merge,
    )  # fmt: skip
    asked = tyro.cli(RunArguments, args=arguments, prog="vdgs run", default=default)
    from vdgs.stages.pipeline import run_all

    _use_threads(asked.threads)
    run_all(asked, _console())


def visibility(arguments: list[str]) -> None:
    asked = tyro.cli(VisibilityArguments, args=arguments, prog="vdgs visibility")
    from vdgs.run import RunFolder
    from vdgs.stages.partition import measure_visibility

    measure_visibility(RunFolder(asked.run), _console())


def partition(arguments: list[str]) -> None:
    run, method = _recorded(arguments, PartitionArguments, "vdgs partition")
    default = PartitionArguments(tyro.MISSING, partition=method.partition, assignment=method.assignment)
    asked = tyro.cli(PartitionArguments, args=arguments, prog="vdgs partition", default=default)
    from vdgs.stages.partition import explain_view, partition_run

    _use_threads(asked.threads)
    _change(run, replace(method, partition=asked.partition, assignment=asked.assignment), asked.redo)
    partition_run(run, _console())
    if asked.why is not None:
        explain_view(run, asked.why, _console())


def train(arguments: list[str]) -> None:
    run, method = _recorded(arguments, TrainArguments, "vdgs train")
    default = TrainArguments(tyro.MISSING, settings=method.block)
    asked = tyro.cli(TrainArguments, args=arguments, prog="vdgs train", default=default)
    _change(run, replace(method, block=asked.settings), asked.redo)
    if asked.block is not None:
        from vdgs.executors.parent import stop_when_parent_dies
        from vdgs.stages.block import train_block

        stop_when_parent_dies()
        _use_threads(asked.threads)
        train_block(asked.run, asked.block, asked.watching, _console())
    else:
        from vdgs.stages.train import train_blocks

        train_blocks(asked.run, asked.watching, asked.jobs, _console())


def merge(arguments: list[str]) -> None:
    run, method = _recorded(arguments, MergeArguments, "vdgs merge")
    default = MergeArguments(tyro.MISSING, merge=method.merge)
    asked = tyro.cli(MergeArguments, args=arguments, prog="vdgs merge", default=default)
    from vdgs.stages.merge import merge_run

    _change(run, replace(method, merge=asked.merge), redo=False)
    merge_run(asked.run, asked.incomplete, _console())


def eval(arguments: list[str]) -> None:
    asked = tyro.cli(EvalArguments, args=arguments, prog="vdgs eval")
    from vdgs.stages.evaluate import evaluate_stage

    _use_threads(asked.threads)
    evaluate_stage(asked.run, asked.model, asked.lpips_weights, asked.bins, _console())


def report(arguments: list[str]) -> None:
    asked = tyro.cli(ReportArguments, args=arguments, prog="vdgs report")
    from vdgs.report import write_report
    from vdgs.run import RunFolder

    _console().print(f"report: {write_report(RunFolder(asked.run))}", highlight=False)


def render(arguments: list[str]) -> None:
    asked = tyro.cli(RenderArguments, args=arguments, prog="vdgs render")
    from vdgs.render_run import render_run

    _use_threads(asked.threads)
    render_run(asked, _console())


def synth(arguments: list[str]) -> None:
    asked = tyro.cli(SynthArguments, args=arguments, prog="vdgs synth")
    from rich.progress import Progress, TaskID

    from vdgs.synth import generate

    console = _console()
    with Progress(console=console, disable=not console.is_terminal) as bar:
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done)

        found = generate(asked.output, asked.options, show)
    console.print(f"{found.line}\ncapture: {asked.output}", highlight=False)


def bench(arguments: list[str]) -> None:
    asked = tyro.cli(BenchArguments, args=arguments, prog="vdgs bench")
    from vdgs.bench.bench import BenchSettings, run_bench
    from vdgs.bench.plan import Choices

    choices = Choices(
        asked.seeds, asked.scenes, asked.methods, asked.scale_iterations, asked.iterations_total, asked.max_anchors,
        asked.validation,
    )  # fmt: skip
    run_bench(
        BenchSettings(
            asked.table, asked.output, choices, asked.data, asked.jobs, asked.bins, asked.lpips_weights, asked.redo
        ),
        _console(),
    )


def doctor(arguments: list[str]) -> int:
    asked = tyro.cli(DoctorArguments, args=arguments, prog="vdgs doctor")
    from vdgs.doctor import print_report

    return print_report(as_json=asked.json)


def _recorded(arguments: list[str], kind: type, prog: str) -> tuple[RunFolder, MethodConfig]:
    """The run that the arguments name and its settings: they are the defaults of the options, and of their help where
    the run is named."""
    from vdgs.run import RunFolder

    if "-h" in arguments or "--help" in arguments:
        named = next((RunFolder(Path(a)) for a in arguments if (Path(a) / "config.yaml").is_file()), None)
        return (named, named.method()) if named else tyro.cli(kind, args=arguments, prog=prog)
    run = RunFolder(tyro.cli(kind, args=arguments, prog=prog).run)
    return run, run.method()


def _change(run: RunFolder, method: MethodConfig, redo: bool) -> None:
    """Give the run other settings for later stages, if they are other."""
    from vdgs.config import to_dict
    from vdgs.config_checks import validate
    from vdgs.errors import VdgsError

    problems = validate(method)
    if problems:
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))
    wanted = run.settings() | to_dict(method)
    if wanted != run.settings():
        with run.locked():
            for line in run.change(wanted, redo):
                _console().print(f"[yellow]changed[/] {line}", highlight=False)


def _preset(arguments: list[str]) -> PresetName:
    """The preset named on the command line: it decides the defaults of all other options."""
    for place, argument in enumerate(arguments):
        value = argument.partition("=")[2] if argument.startswith("--preset=") else None
        if argument == "--preset" and place + 1 < len(arguments):
            value = arguments[place + 1]
        if value in PRESETS:
            return value  # type: ignore[return-value]
    return "paper"


def _use_threads(count: int) -> None:
    import torch

    from vdgs.kernels.native.module import set_threads, threads

    if count > 0:
        set_threads(count)
    torch.set_num_threads(max(1, threads()))


def _console():  # type: ignore[no-untyped-def]
    from rich.console import Console

    return Console(soft_wrap=True)
