"""From a table to the runs that it needs: one folder each, coarse stages shared where their settings are the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from experiments.bench.baseline_stages import BASELINES
from experiments.bench.custom_scenes import resolve_scenes
from experiments.bench.definitions import (
    BenchMethod,
    BenchScene,
    BenchTable,
    Budget,
    has_block_folders,
    has_gaussian_blocks,
)
from experiments.bench.methods import METHODS
from experiments.bench.renders import method_from_renders, renders_digest, renders_folder
from experiments.bench.tables import TABLES
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig
from vdgs.config.serialization import to_dict
from vdgs.config.validation_rules import validate_config
from vdgs.errors import VdgsError
from vdgs.runs.stage_keys import hashable_settings


@dataclass(frozen=True)
class PlanOptions:
    """What a person may change about a table without changing what is compared."""

    seeds: int | None = None
    scenes: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    steps_scaler: float = 1.0
    total_iterations: int | None = None
    max_anchors: int = 0
    validation: bool = False
    #: NAME=FOLDER of renders by other programs.
    renders: tuple[str, ...] = ()
    #: How scenes that are folders are read; `validation` above is that of all scenes.
    options: CaptureOptions = field(default_factory=CaptureOptions)
    #: (scene, method, factor): what the iterations of a method on a scene are multiplied by (`equal_time.py`).
    step_factors: tuple[tuple[str, str, float], ...] = ()
    #: What every seed is moved by: another machine makes others of the same table.
    first_seed: int = 0


@dataclass(frozen=True)
class PlannedRun:
    """A run folder to be filled."""

    scene: str
    method: str
    seed: int
    #: Relative to the output folder.
    folder: Path
    stages: tuple[str, ...]
    config: MethodConfig
    #: The run whose coarse stage this one takes over; None trains its own.
    coarse_from: Path | None = None
    #: The renders by another program that it measures, and what tells them from others; None: it is trained.
    renders: Path | None = None
    identity: str = ""

    @property
    def name(self) -> str:
        return str(self.folder.relative_to("runs"))

    def key(self, capture: Mapping[str, Any], measured: Mapping[str, Any]) -> str:
        """Changes with everything that the run's result depends on."""
        if self.renders is not None:
            return _digest([self.stages, self.identity, dict(capture), dict(measured)])
        plain = to_dict(self.config)
        # A method without blocks does not depend on their settings.
        in_blocks = has_block_folders(self.stages) or has_gaussian_blocks(self.stages)
        sections = list(plain) if in_blocks else ["training"]
        settings = {section: hashable_settings(section, plain[section]) for section in sections}
        content = [self.stages, settings, dict(capture), dict(measured)]
        if self.stages[0] in BASELINES:
            content.append(to_dict(BASELINES[self.stages[0]].settings(self.config)))
        return _digest(content)


@dataclass(frozen=True)
class BenchPlan:
    """All runs of a table."""

    table: BenchTable
    scenes: tuple[BenchScene, ...]
    methods: tuple[BenchMethod, ...]
    seeds: tuple[int, ...]
    budgets: Mapping[str, Budget]
    #: Coarse stages that several runs share, to be trained first.
    coarse: tuple[PlannedRun, ...]
    runs: tuple[PlannedRun, ...]
    #: (scene, method, seed) -> the run that it is measured on: methods with the same settings share one.
    run_of: Mapping[tuple[str, str, int], PlannedRun]
    #: Most anchors of a scene; 0 for no limit.
    max_anchors: int = 0
    #: Measured on held-out training views instead of on the test views.
    validation: bool = False
    #: At equal time: `PlanOptions.step_factors`; empty where all make the same iterations.
    step_factors: tuple[tuple[str, str, float], ...] = ()

    def reference(self, scene: str) -> PlannedRun | None:
        """The run whose coarse model says how often each pixel of the scene is seen, for all methods and seeds: that of
        the table's own method where it is among them, whatever the others are; None where no method has one."""
        ours = next((run for key, run in self.run_of.items() if key[:2] == (scene, self.table.ours)), None)
        runs = [run for run in self.coarse + self.runs if run.scene == scene and "coarse" in run.stages]
        first = [run for run in runs if ours is not None and run.folder == (ours.coarse_from or ours.folder)]
        return next(iter(first + runs), None)


def make_plan(name: str, options: PlanOptions) -> BenchPlan:
    """Raises VdgsError for a scene or method that does not exist and for settings that do not work, CaptureError for a
    folder that is no capture."""
    table = TABLES[name]
    if options.step_factors:
        table = replace(table, title=f"{table.title}, at equal time")
    scenes = resolve_scenes(options.scenes or table.scenes, options.options, options.validation)
    methods = _methods(options.methods or table.methods)
    seeds = table.seeds if options.seeds is None else tuple(range(options.seeds))
    seeds = tuple(options.first_seed + seed for seed in seeds)
    factors = {(scene, method): factor for scene, method, factor in options.step_factors}
    if not seeds:
        raise VdgsError("--seeds must be at least 1")
    external = _render_methods(options, scenes, seeds)
    budgets: dict[str, Budget] = {}
    run_of: dict[tuple[str, str, int], PlannedRun] = {}
    coarse, runs = list[PlannedRun](), list[PlannedRun]()
    for scene in scenes:
        budgets[scene.name] = budget = _budget(scene, options)
        for seed in seeds[:1] if options.seeds is None and scene.name in table.single_seed else seeds:
            base = _base(scene, budget, seed, options)
            planned = [
                _planned(scene, method, seed, budget, options, factors.get((scene.name, method.name), 1.0))
                for method in methods
            ]
            planned += _render_runs(scene, external, base, seed)
            shared, planned = _share_coarse(planned)
            coarse += shared
            distinct: dict[str, PlannedRun] = {}
            for run in planned:
                run_of[scene.name, run.method, seed] = distinct.setdefault(run.key({}, {}), run)
            runs += distinct.values()
    return BenchPlan(
        table, scenes, methods + external, seeds, budgets, tuple(coarse), tuple(runs), run_of, options.max_anchors,
        options.validation, options.step_factors,
    )  # fmt: skip


def _render_methods(
    options: PlanOptions, scenes: Sequence[BenchScene], seeds: Sequence[int]
) -> tuple[BenchMethod, ...]:
    """The methods whose renders are given. Raises VdgsError for a name that is taken or a folder without renders."""
    methods = list[BenchMethod]()
    for text in options.renders:
        method = method_from_renders(text, [*METHODS.values(), *methods])
        if not any(renders_folder(method, scene.name, seed) for scene in scenes for seed in seeds):
            names = ", ".join(scene.name for scene in scenes)
            raise VdgsError(
                f"--renders {text!r}: {method.renders} holds no renders. They are looked for in folders named after "
                f"the scenes ({names}): SCENE/*.png, or SCENE/0/*.png, SCENE/1/*.png, ... for several seeds."
            )
        methods.append(method)
    return tuple(methods)


def _render_runs(scene: BenchScene, methods: Sequence[BenchMethod], base: MethodConfig, seed: int) -> list[PlannedRun]:
    """The runs that measure what others rendered of a scene, where they did."""
    renders = [(method, renders_folder(method, scene.name, seed)) for method in methods]
    return [
        PlannedRun(scene.name, method.name, seed, Path("runs", scene.name, f"renders-{method.name}", str(seed)),
                   method.stages, base, renders=folder, identity=renders_digest(folder))
        for method, folder in renders if folder is not None
    ]  # fmt: skip


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


def _methods(names: Sequence[str]) -> tuple[BenchMethod, ...]:
    """Raises VdgsError for a name that is of no method or stands there twice: a method is a row."""
    for name in dict.fromkeys(names):
        if names.count(name) > 1:
            raise VdgsError(f"--methods names {name} {names.count(name)} times. Name each once; --seeds repeats them.")
    return tuple(_method(name) for name in names)


def _method(name: str) -> BenchMethod:
    if name not in METHODS:
        raise VdgsError(f"there is no method {name!r}. There are: {', '.join(METHODS)}")
    return METHODS[name]


def _budget(scene: BenchScene, options: PlanOptions) -> Budget:
    factor = options.steps_scaler
    if options.total_iterations is not None:
        factor = options.total_iterations / scene.budget.total
    if factor <= 0:
        raise VdgsError("--steps-scaler and --total-iterations must be positive")
    return scene.budget.scaled(factor)


def _base(scene: BenchScene, budget: Budget, seed: int, options: PlanOptions) -> MethodConfig:
    return _limit_anchors(scene.base(budget, seed, budget.total / scene.budget.total), options)


def _limit_anchors(config: MethodConfig, options: PlanOptions) -> MethodConfig:
    """With --max-anchors: a scene may hold so many, all its blocks together too."""
    if not options.max_anchors:
        return config
    training, block = config.training, config.block
    return replace(
        config,
        training=replace(training, densify=replace(training.densify, max_anchors=options.max_anchors)),
        block=replace(block, max_anchors_total=options.max_anchors),
    )


def _planned(
    scene: BenchScene, method: BenchMethod, seed: int, budget: Budget, options: PlanOptions, factor: float
) -> PlannedRun:
    """The run of a method with `factor` times the budget; in a folder of its own where that is not 1."""
    budget = budget.scaled(factor)
    config = method.settings(_base(scene, budget, seed, options), budget)
    problems = validate_config(config)
    if problems:
        raise VdgsError(f"{method.name} on {scene.name}: these settings do not work:\n  " + "\n  ".join(problems))
    name = method.name if factor == 1.0 else f"{method.name}-equal-time"
    return PlannedRun(scene.name, method.name, seed, Path("runs", scene.name, name, str(seed)), method.stages,
                      config)  # fmt: skip


def _share_coarse(planned: Sequence[PlannedRun]) -> tuple[list[PlannedRun], list[PlannedRun]]:
    """The coarse stages that blocks begin with, as runs of their own, and the runs that take them over. The row that
    measures such a stage takes it over too, also where its blocks stand in another table of the folder."""
    shared: dict[str, PlannedRun] = {}
    for run in planned:
        digest = _coarse_digest(run)
        if (has_block_folders(run.stages) or run.method == SHARED_COARSE_NAME) and digest not in shared:
            folder = Path("runs", run.scene, f"shared-coarse-{digest}", str(run.seed))
            # Nothing but what it depends on: which methods share it, and so are asked for, must not change it.
            alone = MethodConfig(training=run.config.training)
            shared[digest] = replace(run, method="coarse", folder=folder, stages=("coarse",), config=alone)
    taken = [
        replace(run, coarse_from=shared[_coarse_digest(run)].folder)
        if "coarse" in run.stages and _coarse_digest(run) in shared
        else run
        for run in planned
    ]
    return list(shared.values()), taken


#: The method that is what blocks begin with.
SHARED_COARSE_NAME = "coarse"


def _coarse_digest(run: PlannedRun) -> str:
    settings = hashable_settings("training", to_dict(run.config.training))
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
