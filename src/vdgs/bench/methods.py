"""The methods: VDGS, its ablations, its parameter sweeps and the partitions of others.

All but 3DGS share the anchor model, the loss and the block training of this package; all spend the same total of
iterations, one photograph each (blocks that draw parts of photographs: as many photographs in more iterations).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from vdgs.bench.definitions import COARSE_ONLY, EXPLICIT, Budget, Change, Method
from vdgs.comparators.gaussians.schedule import LEAST_INTERVAL, PUBLISHED_ITERATIONS
from vdgs.settings.method import CompensationConfig, MergeConfig, MethodConfig, PartitionStrategy

LAMBDA_VIS = (0.0, 0.5, 1.0, 1.3)
T_LOW = (0.05, 0.15, 0.20, 0.30)
#: The paper's, and 1 - gamma, with which the cache is a mean over cycles and no sum.
BETA_G = (0.1, 0.5, 1.5, 2.0, 3.0)
GAMMA = (0.80, 0.90, 0.95)
BLOCKS = (1, 2, 4, 8, 16)


def full(config: MethodConfig, _budget: Budget) -> MethodConfig:
    return config


def coarse_alone(config: MethodConfig, budget: Budget) -> MethodConfig:
    """All iterations in the coarse stage."""
    return replace(config, training=replace(config.training, iterations=budget.total))


def coarse_alone_averaged(config: MethodConfig, budget: Budget) -> MethodConfig:
    """All iterations in the coarse stage, which ends with a mean of models as blocks do."""
    alone = coarse_alone(config, budget)
    return replace(alone, training=replace(alone.training, average=config.block.average))


def coarse_as_long(config: MethodConfig, budget: Budget) -> MethodConfig:
    """The coarse stage as long as one process takes when every block has its own: coarse + one block's iterations."""
    return replace(config, training=replace(config.training, iterations=budget.coarse + budget.per_block))


def without_blocking(config: MethodConfig, budget: Budget) -> MethodConfig:
    """One block of the whole scene, trained as long as all blocks together, with compensated growth."""
    one = budget.shared_by(1)
    return replace(
        config,
        partition=replace(config.partition, blocking=False, blocks=1),
        block=replace(config.block, iterations=one.per_block),
    )


def without_blocking_as_long(config: MethodConfig, budget: Budget) -> MethodConfig:
    """One block of the whole scene, trained as long as one of several: as much time, if those are trained at once."""
    one = without_blocking(config, budget)
    return replace(one, block=replace(one.block, iterations=budget.per_block))


def without_anchor_generation(config: MethodConfig, _budget: Budget) -> MethodConfig:
    """Blocks grow anchors as the coarse stage does."""
    return _compensated(config, enabled=False)


def as_printed(config: MethodConfig, _budget: Budget) -> MethodConfig:
    """What the paper says of blocks, in place of the preset's own choices: frozen decoder, every photograph used alike
    and at its full size, the coarse stage's rates again, the last model and no mean, cameras above a share of 0.45, its
    compensation. Where it is silent, as the preset `paper`."""
    plain, scene = MethodConfig(), config.block
    return replace(
        config,
        assignment=replace(config.assignment, threshold=plain.assignment.threshold),
        block=replace(
            plain.block,
            iterations=scene.iterations,
            scale_iterations=scene.scale_iterations,
            growth=scene.growth,
            max_anchors_total=scene.max_anchors_total,
        ),
    )


def with_printed_compensation(config: MethodConfig, **values: float) -> MethodConfig:
    """The paper's compensation, with other values where they are given."""
    printed = replace(CompensationConfig(), **values)  # type: ignore[arg-type]
    return replace(config, block=replace(config.block, compensation=printed))


def in_whole_photographs(change: Change) -> Change:
    """A method whose blocks draw whole photographs, so that each makes exactly as many iterations."""
    return lambda config, budget: change(replace(config, block=replace(config.block, crop="off")), budget)


def with_compensation_of_sums(config: MethodConfig, _budget: Budget) -> MethodConfig:
    """The paper's compensation, added to the sums of gradients and not to their means."""
    printed = with_printed_compensation(config)
    return _compensated(printed, added_to="sum")


def densely(change: Change) -> Change:
    """A method whose Adam moves all anchors in every step, as Scaffold-GS and 3DGS do."""

    def dense(config: MethodConfig, budget: Budget) -> MethodConfig:
        changed = change(config, budget)
        return replace(changed, training=replace(changed.training, adam="dense"))

    return dense


def best_seen(change: Change) -> Change:
    """Blocks merged by which of them sees a place most (the paper: "based on visibility coverage")."""
    return lambda config, budget: replace(change(config, budget), merge=MergeConfig(rule="best_seen"))


def with_longer_blocks(factor: int) -> Change:
    """Blocks that train so many times as long."""
    return lambda config, budget: replace(config, block=replace(config.block, iterations=factor * budget.per_block))


def with_block(**values: object) -> Change:
    """The full method with other settings of block training."""
    return lambda config, _: replace(config, block=replace(config.block, **values))  # type: ignore[arg-type]


def with_assignment(**values: object) -> Change:
    """The full method with other settings of the assignment of cameras."""
    return lambda config, _: replace(config, assignment=replace(config.assignment, **values))  # type: ignore[arg-type]


def in_blocks(count: int) -> Change:
    """The same total of block iterations shared by `count` blocks."""

    def change(config: MethodConfig, budget: Budget) -> MethodConfig:
        if count == 1:
            return without_blocking(config, budget)
        return replace(
            config,
            partition=replace(config.partition, blocks=count),
            block=replace(config.block, iterations=budget.shared_by(count).per_block),
        )

    return change


def with_lambda_vis(value: float) -> Change:
    return lambda config, _: replace(config, partition=replace(config.partition, lambda_vis=value))


def with_t_low(value: float) -> Change:
    """A fixed T_low, as in the paper: never the quantile that the preset `laptop` takes instead."""
    return lambda config, _: with_printed_compensation(config, t_low=value)


def with_beta_g(value: float) -> Change:
    return lambda config, _: with_printed_compensation(config, beta_g=value)


def with_gamma(value: float) -> Change:
    return lambda config, _: with_printed_compensation(config, gamma=value)


def with_literal_gate(config: MethodConfig, _budget: Budget) -> MethodConfig:
    """Offsets of low visibility are judged after as many draws as the others."""
    return _compensated(config, gate="literal")


def with_cap(thresholds: float) -> Change:
    """The cache g grows to so many thresholds of growth at most."""
    return lambda config, _: _compensated(config, cap=thresholds * config.block.growth.threshold)


def partitioned_by(strategy: PartitionStrategy) -> Change:
    """Another partition; growth is plain, since compensation is what VDGS adds."""

    def change(config: MethodConfig, budget: Budget) -> MethodConfig:
        plain = without_anchor_generation(config, budget)
        return replace(plain, partition=replace(plain.partition, strategy=strategy))

    return change


def explicit_gaussians(background: Literal["mean", "black"]) -> Change:
    """3DGS, told by what it has in common with our coarse stage: iterations, seed, background and the limit of anchors
    (`explicit.gaussians_config` makes its settings of these)."""

    def change(config: MethodConfig, budget: Budget) -> MethodConfig:
        alone = coarse_alone(config, budget)
        loss = replace(alone.training.loss, background=background)
        return replace(alone, training=replace(alone.training, loss=loss))

    return change


def _compensated(config: MethodConfig, **values: float | bool | str) -> MethodConfig:
    changed: CompensationConfig = replace(config.block.compensation, **values)  # type: ignore[arg-type]
    return replace(config, block=replace(config.block, compensation=changed))


def _sweep(
    prefix: str, symbol: str, values: tuple[float, ...], change: Callable[[float], Change], differs: str
) -> list[Method]:
    return [
        Method(f"{prefix}-{value:g}", f"{symbol} = {value:g}", in_whole_photographs(change(value)), differs=differs)
        for value in values
    ]


#: What the partitions leave out beyond what `partition.strategies` says of each.
_COMMON = (
    "training schedule, losses and (dense) Adam of their own: what is compared is the partition, and blocks are "
    "trained as ours, with plain growth",
)
_3DGS = "Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering, SIGGRAPH 2023"
#: As the docstring of `comparators.gaussians.run` has it.
_3DGS_LEAVES_OUT = (
    "pruning by footprint in the image (its section 5.2)",
    "its own image formation (alpha at most 0.999, near plane at 0.01 and extent by opacity are as for all methods)",
    "exposure compensation, depth regularisation and anti-aliasing, which came later than its paper",
)
_3DGS_SCHEDULE = (
    f"its schedule of {PUBLISHED_ITERATIONS:,} iterations (warm-up, degree of colour, start and interval of density "
    "control, resets of opacity) moves in proportion to the total here, but neither decides nor resets more "
    f"often than every {LEAST_INTERVAL} iterations"
)
_ABLATIONS = [
    Method("full", "VDGS (full)", full, cites="VDGS, sections IV-B and IV-C"),
    Method("baseline", "baseline: coarse alone", coarse_alone, COARSE_ONLY, cites="VDGS, Table II (a)"),
    Method(
        "baseline-mean",
        "baseline with a mean of models",
        coarse_alone_averaged,
        COARSE_ONLY,
        differs="ends as the blocks of `full` do: with a mean of models, where they have one",
    ),
    Method("coarse", "coarse stage, as blocks begin", full, COARSE_ONLY, less="iterations of the coarse stage only"),
    Method(
        "coarse-as-long",
        "coarse alone, as long as one block",
        coarse_as_long,
        COARSE_ONLY,
        differs="ends with its last model; the blocks of `full` with a mean of models, where the preset says so",
        less="iterations of the coarse stage and one block: as much time, if all blocks are trained at once",
    ),
    Method(
        "printed",
        "VDGS, blocks as printed",
        as_printed,
        cites="VDGS, sections IV-B and IV-C",
        differs="blocks of the paper: frozen decoder, even use of photographs, the coarse stage's rates again, full "
        "size, no mean of models, whole photographs, share of 0.45, its compensation; growth, coarse stage and cut as "
        "`full`; where the paper is silent, the choices of the preset `paper`",
    ),
    Method("whole-photographs", "VDGS (full), whole photographs", in_whole_photographs(full)),
    Method("no-blocking", "w/o blocking", without_blocking, cites="VDGS, Table II (b)"),
    Method(
        "no-blocking-as-long",
        "w/o blocking, as long as one block",
        without_blocking_as_long,
        less="photographs of the coarse stage and one block: as much time, if all blocks are trained at once",
    ),
    Method("no-anchor-generation", "w/o anchor generation", without_anchor_generation, cites="VDGS, Table II (c)"),
]
_OTHERS = [
    Method(
        "3dgs", "3DGS", explicit_gaussians("mean"), EXPLICIT, cites=_3DGS, leaves_out=_3DGS_LEAVES_OUT,
        differs=f"background of the mean colour of the photographs, as ours; {_3DGS_SCHEDULE}",
    ),
    Method(
        "3dgs-black", "3DGS, black background", explicit_gaussians("black"), EXPLICIT, cites=_3DGS,
        leaves_out=_3DGS_LEAVES_OUT, differs=f"background black, as published; {_3DGS_SCHEDULE}",
    ),
    Method(
        "scaffold-gs", "Scaffold-GS", densely(coarse_alone), COARSE_ONLY,
        cites="Lu et al., Scaffold-GS: Structured 3D Gaussians for View-Adaptive Rendering, CVPR 2024",
        leaves_out=("its starts, background, rates and volume weight: they are those of our coarse stage",),
        differs="its dense Adam; `baseline` is the same with ours, which moves only what a photograph shows",
    ),
    Method(
        "vastgaussian", "VastGaussian partition", partitioned_by("vastgaussian"),
        cites="Lin et al., VastGaussian: Vast 3D Gaussians for Large Scene Reconstruction, CVPR 2024",
        leaves_out=_COMMON,
    ),
    Method(
        "citygaussian", "CityGaussian partition", partitioned_by("citygaussian"),
        cites="Liu et al., CityGaussian: Real-time High-quality Large-Scale Scene Rendering with Gaussians, ECCV 2024",
        leaves_out=_COMMON,
    ),
    Method(
        "dogs", "DOGS partition", partitioned_by("dogs"),
        cites="Chen and Lee, DOGS: Distributed-Oriented Gaussian Splatting via Gaussian Consensus, NeurIPS 2024",
        leaves_out=_COMMON,
    ),
]  # fmt: skip
_BLOCKS = [Method(f"blocks-{count}", f"{count} block{'s' * (count > 1)}", in_blocks(count)) for count in BLOCKS]
_LONGER = [
    Method(
        f"longer-{factor}", f"VDGS (full), blocks {factor} times as long", with_longer_blocks(factor),
        more=f"iterations: {factor} times as many for blocks",
    )
    for factor in (2, 4)
]  # fmt: skip
_CHOICES = [
    Method("frozen-decoder", "frozen decoder", with_block(decoder="frozen")),
    Method("even-sampling", "photographs used alike", with_block(sampling="even")),
    Method("by-votes", "photographs by votes", with_block(sampling="shares")),
    Method("share-0.45", "cameras above a share of 0.45", with_assignment(threshold=0.45)),
    Method(
        "literal-assignment", "eq. 7 as printed", with_assignment(mode="literal", threshold=0.45),
        differs="eq. 7 with its threshold of 0.45: to be read against `share-0.45`",
    ),
    Method("leave-one-out", "cameras by leave-one-out", with_assignment(mode="leave_one_out")),
    Method(
        "frustum", "cameras by frusta", with_assignment(mode="frustum"),
        differs="the share is one of the block's anchors, not of pixels",
    ),
    Method(
        "printed-rates", "the coarse stage's rates again",
        with_block(offset_rate=1.0, scale_rate=1.0, feature_rate=1.0),
    ),
    Method(
        "damped-rates", "damped rates", with_block(offset_rate=0.4, scale_rate=0.8, feature_rate=1.0),
        differs="0.4 and 0.8 times the coarse stage's rates of offsets and scales, with which CityGaussian fine-tunes",
    ),
    Method(
        "printed-damped", "blocks as printed, damped rates",
        lambda config, budget: with_block(offset_rate=0.4, scale_rate=0.8)(as_printed(config, budget), budget),
        differs="`printed` with the rates of `damped-rates`: what earlier versions took for printed",
    ),
    Method("dense-adam", "dense Adam", densely(full), differs="in the coarse stage and in blocks"),
    Method(
        "compensation-of-sums", "compensation as printed, of sums", with_compensation_of_sums,
        differs="T_low = 0.20, β_g = 2, γ = 0.9; g is added to the sums of gradients",
    ),
    Method("half-size", "photographs halved at first", with_block(resolutions=((0.0, 2), (0.3, 1)))),
    Method("last-model", "the last model, no mean", with_block(average=0.0)),
    Method(
        "printed-compensation", "compensation as printed", lambda config, _: with_printed_compensation(config),
        differs="T_low = 0.20, β_g = 2, γ = 0.9",
    ),
    Method("no-context", "without context", with_block(context=False)),
    Method("free-ring", "free ring", with_block(ring="free")),
    Method(
        "free-best-seen", "free ring, merged by best seen", best_seen(with_block(ring="free")),
        differs="to be read against `free-ring`",
    ),
    Method(
        "ramp", "ramp ring, frozen decoder", with_block(ring="ramp", decoder="frozen"),
        differs="to be read against `frozen-decoder`: a ramp needs one",
    ),
    Method(
        "ramp-best-seen", "ramp ring, frozen decoder, merged by best seen",
        best_seen(with_block(ring="ramp", decoder="frozen")), differs="to be read against `ramp`",
    ),
    Method("literal-gate", "literal gate", with_literal_gate),
    Method("cap", "g capped at 4 thresholds", with_cap(4)),
]  # fmt: skip
_WHOLE = "whole photographs"
_AS_PRINTED = f"{_WHOLE}; all other settings of compensation are the paper's"
_SWEEPS = [
    Method("plain-growth", "no compensation", in_whole_photographs(without_anchor_generation), differs=_WHOLE),
    *_sweep("lambda-vis", "λ_vis", LAMBDA_VIS, with_lambda_vis, _WHOLE),
    *_sweep("t-low", "T_low", T_LOW, with_t_low, _AS_PRINTED),
    *_sweep("beta-g", "β_g", BETA_G, with_beta_g, _AS_PRINTED),
    *_sweep("gamma", "γ", GAMMA, with_gamma, _AS_PRINTED),
]

#: Every method by name.
METHODS: dict[str, Method] = {
    method.name: method for method in _ABLATIONS + _OTHERS + _BLOCKS + _LONGER + _CHOICES + _SWEEPS
}
