"""The verb that trains and measures methods side by side: `bench_command`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from vdgs.cli.common import make_console, parse_arguments
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import BIN_COUNT_RANGE
from vdgs.config.output_paths import Output
from vdgs.config.ranges import MAX_COUNT, FlagName, Positional, Range
from vdgs.config.typed_paths import MaybeFolder

TableName = Literal[
    "table1", "table2", "table3", "table3-each", "table4", "factorial", "crossed", "paper-blocks",
    "coarse-compensation", "more-anchors", "efficiency", "longer", "choices", "toy",
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class BenchArguments:
    """Train methods on scenes with several seeds and write tables, a figure and a check of the claims.

    The same command continues what was stopped; finished runs are kept.
    """

    table: Annotated[TableName, Positional()]
    """What to measure. table1 to table4: those of the paper; table3-each, factorial, coarse-compensation, more-anchors:
    where its premise holds, each block trained as long, its choices crossed, its compensation without blocks, and its
    parts against plain growth at lower thresholds; crossed: the cut and compensation in the preset `paper`;
    paper-blocks: tables 2 and 3 in it, each block trained as long; efficiency: its paragraph; longer: blocks that train
    two and four times as long; choices: one choice of ours changed at a time; toy: a small one in a minute or two."""
    output: Annotated[Path, Output()]
    """Folder for runs and results; new, or the one to continue."""
    seeds: Annotated[int | None, Range(1, 1000)] = None
    """How many seeds (0, 1, ...); by default as many as the table has."""
    first_seed: Annotated[int, Range(0, MAX_COUNT)] = 0
    """The first of them, where other machines make those before it (--reuse-results puts them into one table)."""
    scenes: Annotated[tuple[str, ...], MaybeFolder()] = ()
    """Other scenes than the table's, by name: tiny, lab-uneven, town-even, copr, residence, sci-art, ... Or captures of
    your own, as folders: ./my-place. What says how a capture is read (--images, --downscale and on) is about these."""
    methods: tuple[str, ...] = ()
    """Other methods than the table's, by name: full, baseline, no-blocking, momentum-gs, lambda-vis-0, ..."""
    renders: tuple[str, ...] = ()
    """What other programs rendered of the test views, a row for each NAME=FOLDER (several after one --renders):
    FOLDER/SCENE/VIEW.png or FOLDER/SCENE/SEED/VIEW.png. Measured as all others (docs/bench.md)."""
    reuse_results: tuple[Path, ...] = ()
    """results.json of other benches, of this machine or of others (several after one --reuse-results): runs with the
    same settings, seeds and scenes are taken from there and not trained, and the table says where each is from."""
    data: Path | None = None
    """Folder that holds the scenes with names which are not generated: residence-pixsfm, copr, ..."""
    steps_scaler: Annotated[float, Range(0, 1000, exclusive_min=True)] = 1.0
    """Factor on the iterations of every scene."""
    total_iterations: Annotated[int | None, Range(1, MAX_COUNT)] = None
    """Iterations that every method may spend on a scene, shared out as the scene's own; overrides the factor."""
    equal: Literal["steps", "time"] = "steps"
    """What all methods get alike. steps: iterations in all. time: then also a second table, TABLE-equal-time, for which
    each method makes as many iterations as fit into the time that the table's own method (full) took."""
    max_anchors: Annotated[int, Range(0, MAX_COUNT)] = 0
    """No growth beyond this many anchors, of the scene or of all blocks together; 0 for no limit."""
    jobs: Annotated[int, Range(1, 1024)] = 1
    """Runs at once; cores are shared among them. The blocks of a run are trained one after another."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda or cuda:0."""
    overwrite: bool = False
    """Let other settings discard what was trained with the old ones."""
    lpips_weights: Path | None = None
    """VGG16 weights for LPIPS (torchvision's vgg16 state dict, .pth or .safetensors). Nothing is downloaded."""
    visibility_bins: Annotated[int, BIN_COUNT_RANGE] = 4
    """Number of groups by visibility."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    options: Annotated[CaptureOptions, FlagName("")] = field(default_factory=CaptureOptions)
    """How folders among --scenes are read; scenes with names have their own. --validation holds for all."""


def bench_command(arguments: list[str]) -> None:
    args = parse_arguments(BenchArguments, arguments, "bench")
    from experiments.bench.bench import BenchSettings, run_bench
    from experiments.bench.plan import PlanOptions
    from vdgs.kernels.device_selection import select_device

    options = PlanOptions(
        args.seeds, args.scenes, args.methods, args.steps_scaler, args.total_iterations, args.max_anchors,
        args.options.validation, args.renders, replace(args.options, validation=False),
        first_seed=args.first_seed,
    )  # fmt: skip
    run_bench(
        BenchSettings(
            args.table,
            args.output,
            options,
            args.data,
            args.jobs,
            args.visibility_bins,
            args.lpips_weights,
            args.overwrite,
            args.reuse_results,
            args.equal == "time",
            select_device(args.device).device,
        ),
        make_console(args.quiet),
    )
