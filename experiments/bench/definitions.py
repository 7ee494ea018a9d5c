"""What a table is made of, as plain objects. Only the standard library and the settings are imported."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vdgs.config.method import DensifyConfig, MethodConfig, TrainConfig, scaled_growth_start
from vdgs.config.presets import PRESETS, PresetName

#: In the run folder: state, key, provenance, seconds of each stage, and by which clock.
RECORD_FILE = "bench.json"
#: What seconds mean. 2, since 2026-11-29: blocks train one after another, each on all threads, and pictures for people
#: are left out. 1: blocks trained side by side, each on some of the threads, and the pictures of the cut counted.
CLOCK = 2
#: Stages of the run of a method, by the names that `worker.STAGES` knows.
COARSE_STAGES = ("coarse", "evaluate")
BLOCK_STAGES = ("coarse", "partition", "blocks", "merge", "evaluate")
GS3D_STAGES = ("gaussians",)
RENDER_STAGES = ("renders",)
MOMENTUM_STAGES = ("coarse", "partition", "momentum-gs", "merge", "evaluate")
#: Of explicit Gaussians in blocks: one stage, named after the method.
CITYGAUSSIAN_STAGES, VASTGAUSSIAN_STAGES, DOGS_STAGES = ("citygaussian",), ("vastgaussian",), ("dogs",)


def has_block_folders(stages: Sequence[str]) -> bool:
    """Whether the run is cut into blocks of anchors, which lie in RUN/blocks."""
    return "blocks" in stages or "momentum-gs" in stages


def has_gaussian_blocks(stages: Sequence[str]) -> bool:
    """Whether explicit Gaussians are trained in blocks, which lie in RUN/gaussians/blocks."""
    return tuple(stages) in (CITYGAUSSIAN_STAGES, VASTGAUSSIAN_STAGES, DOGS_STAGES)


@dataclass(frozen=True)
class Budget:
    """Training iterations that every method of a table may spend on a scene, one photograph each."""

    coarse: int
    blocks: int
    per_block: int

    @property
    def total(self) -> int:
        return self.coarse + self.blocks * self.per_block

    def scaled(self, factor: float) -> Budget:
        """As many blocks, every count times `factor`, at least one."""
        return Budget(max(1, round(factor * self.coarse)), self.blocks, max(1, round(factor * self.per_block)))

    def shared_by(self, blocks: int) -> Budget:
        """The same total for another number of blocks."""
        return Budget(self.coarse, blocks, max(1, round(self.blocks * self.per_block / blocks)))


ConfigOverride = Callable[[MethodConfig, Budget], MethodConfig]

#: Training that is shorter than its schedule was made for decides about growth so often, in intervals of so many steps
#: at least: gradients of fewer views say little.
LEAST_DECISIONS, LEAST_INTERVAL = 3, 20


def scaled_growth(growth: DensifyConfig, iterations: int, scale: float) -> DensifyConfig:
    """Growth of `iterations`, `scale` times as many as its settings were made for: begins so much earlier or later, as
    in `block.steps_scaler`, and where it is cut short decides in shorter intervals if else it hardly ever did."""
    interval = max(LEAST_INTERVAL, int(growth.stop_fraction * iterations / LEAST_DECISIONS))
    return replace(
        growth,
        stats_start=round(scale * growth.stats_start),
        start=scaled_growth_start(growth, scale),
        every=min(growth.every, interval) if scale < 1 else growth.every,
    )


def growth_decisions(training: TrainConfig) -> int:
    """How often a training decides about growth."""
    growth = training.densify
    last = int(growth.stop_fraction * training.iterations)
    return sum(step >= growth.start for step in range(growth.every, last + 1, growth.every))


@dataclass(frozen=True)
class BenchMethod:
    """A way to turn a capture into a model."""

    #: Unique; the name of its folder.
    name: str
    #: What people read.
    title: str
    #: The method's settings from those of the full method with the scene's preset and the budget.
    override: ConfigOverride
    #: Its stages in order (`worker.STAGES`).
    stages: tuple[str, ...] = BLOCK_STAGES
    #: Where it was published.
    citation: str = ""
    #: What of the published method is not here.
    omissions: tuple[str, ...] = ()
    #: What is set otherwise than published, or than for the other methods.
    differs: str = ""
    #: What it gets less than the others, where it does not spend the whole budget.
    less: str = ""
    #: What it gets more than the others, to find out what holds them back.
    more: str = ""
    #: How it departs from what was published, in a few words for the column "rests on"; empty: it is whole.
    adapted: str = ""
    #: Where another program left its renders of the test views (`renders.py`); None: the method is trained here.
    renders: Path | None = None

    @property
    def rests_on(self) -> str:
        """What a row of Table I is: the published method whole, adapted, or another program's renders."""
        if self.renders is not None:
            return "renders of its own program"
        return f"adapted: {self.adapted}" if self.adapted else "whole"

    def settings(self, base: MethodConfig, budget: Budget) -> MethodConfig:
        return self.override(base, budget)


@dataclass(frozen=True)
class BenchScene:
    """A place to reconstruct: generated (`synth`), a folder under --data (`capture`) or any folder (`folder`)."""

    name: str
    title: str
    budget: Budget
    preset: PresetName = "laptop"
    #: Path below --data; None for a generated scene.
    capture: str | None = None
    #: Where it lies, if it was given as a folder, and the fingerprint of what lies there or under --data
    #: (`captures.capture_metadata`): folders may share a name.
    folder: Path | None = None
    contents: Mapping[str, int] = field(default_factory=dict)
    #: SynthOptions by name.
    synth: Mapping[str, Any] = field(default_factory=dict)
    #: CaptureOptions by name.
    options: Mapping[str, Any] = field(default_factory=dict)
    #: How the settings of the preset are adapted to the scene.
    override: Callable[[MethodConfig], MethodConfig] = lambda config: config
    #: Whether some parts are seen far less than others; the verdict asks other questions of even scenes.
    uneven: bool = True
    #: What people should know: where the data comes from, how its folder is laid out.
    note: str = ""

    def base(self, budget: Budget, seed: int, scale: float = 1.0) -> MethodConfig:
        """The full method on this scene with so many iterations: the scene's preset, with compensated growth, which the
        paper's method has and the preset `laptop` leaves out. `scale` is that of the budget to the scene's own."""
        config = self.override(PRESETS[self.preset])
        early = scaled_growth(config.training.densify, budget.coarse, scale)
        earlier = scaled_growth(config.block.densify, budget.per_block, scale)
        return replace(
            config,
            training=replace(config.training, iterations=budget.coarse, seed=seed, densify=early),
            partition=replace(config.partition, blocks=budget.blocks),
            block=replace(
                config.block,
                iterations=budget.per_block,
                densify=earlier,
                compensation=replace(config.block.compensation, enabled=True),
            ),
        )


@dataclass(frozen=True)
class MethodGroup:
    """Methods that stand together in a table under a heading."""

    title: str
    methods: tuple[str, ...]


@dataclass(frozen=True)
class BenchTable:
    """Methods × scenes × seeds, by name."""

    name: str
    title: str
    methods: tuple[str, ...]
    scenes: tuple[str, ...]
    seeds: tuple[int, ...] = (0, 1, 2)
    #: Scenes of which, unless --seeds asks for more, only the first seed is trained: they take hours for each.
    single_seed: tuple[str, ...] = ()
    groups: tuple[MethodGroup, ...] = ()
    #: The method that the verdict is about.
    ours: str = "full"
    #: Rows of the paper's table that are not trained here, by the names that `paper_numbers.py` has for them.
    quoted: tuple[str, ...] = ()
    #: Whether it has one table a scene with quality, groups, size and cost of each method, and what its row rests on.
    overview: bool = False
