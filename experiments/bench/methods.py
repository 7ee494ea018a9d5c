"""The methods: VDGS, its ablations, its parameter sweeps and the partitions of others.

All but 3DGS share the anchor model, the loss and the block training of this package; all spend the same total of
iterations, one photograph each (blocks that draw parts of photographs: as many photographs in more iterations).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from experiments.baselines.gs3d.schedule import LEAST_INTERVAL, PUBLISHED_ITERATIONS
from experiments.bench.changes import (
    FACTORIAL_CAMERAS,
    as_printed,
    best_seen,
    coarse_alone,
    coarse_alone_averaged,
    coarse_as_long,
    coarse_compensated,
    densely,
    eager,
    eager_coarse,
    explicit_gaussians,
    factorial,
    full,
    growing_plainly,
    in_blocks,
    in_whole_photographs,
    partitioned_by,
    times_as_many_blocks,
    with_assignment,
    with_beta_g,
    with_block,
    with_compensation_of_sums,
    with_gamma,
    with_lambda_vis,
    with_literal_gate,
    with_longer_blocks,
    with_printed_compensation,
    with_t_low,
    without_anchor_generation,
    without_blocking,
    without_blocking_as_long,
)
from experiments.bench.definitions import COARSE_ONLY, EXPLICIT, Change, Method
from vdgs.config.method import CompensationConfig

LAMBDA_VIS = (0.0, 0.5, 1.0, 1.3)
T_LOW = (0.05, 0.15, 0.20, 0.30)
#: The paper's, and 1 - gamma, with which the cache is a mean over cycles and no sum.
BETA_G = (0.1, 0.5, 1.5, 2.0, 3.0)
GAMMA = (0.80, 0.90, 0.95)
BLOCKS = (1, 2, 4, 8, 16)
#: Of the factorial: a cut by place alone, or by place and visibility; what g is added to (None: plain growth); T_low.
FACTORIAL_VIS, FACTORIAL_T_LOW = (0.0, 1.0), (0.2, 0.3)
FACTORIAL_ADDED: tuple[Literal["mean", "sum"] | None, ...] = (None, "mean", "sum")


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
#: On which the paper is silent, and by which compensated growth gains where few cameras look (reports/findings.md).
_GATE = "the gate of growth is lower where few cameras look, our choice"
#: As the docstring of `experiments.baselines.gs3d.run` has it.
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
    Method("no-blocking-plain", "w/o blocking nor anchor generation", growing_plainly(without_blocking)),
    Method(
        "no-blocking-as-long-plain",
        "w/o blocking nor anchor generation, as long as one block",
        growing_plainly(without_blocking_as_long),
        differs="to be read against `no-anchor-generation`",
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
#: Plain growth: after few steps compensated growth costs one block more than several (reports/findings.md).
_EACH_AS_LONG = [
    Method(
        "each-half", "half as many blocks, each as long, w/o anchor generation",
        growing_plainly(times_as_many_blocks(0.5)), less="iterations: of blocks half as many",
    ),
    *(
        Method(
            f"each-{factor}-times", f"{factor} times as many blocks, each as long, w/o anchor generation",
            growing_plainly(times_as_many_blocks(factor)), more=f"iterations: of blocks {factor} times as many",
        )
        for factor in (2, 4)
    ),
]  # fmt: skip
_COARSE_COMPENSATED = [
    Method(
        f"coarse-compensated-{added_to}",
        f"coarse stage, compensation as printed, {added_to}s",
        coarse_compensated(CompensationConfig(added_to=added_to)),
        COARSE_ONLY,
        less="iterations of the coarse stage only",
        differs=f"to be read against `coarse`; {_GATE}",
    )
    for added_to in ("mean", "sum")
]
#: What compensation is made of: g, and the lower gate for what few cameras see, which is our choice.
_COARSE_PARTS = [
    Method(
        "coarse-compensated-literal-gate", "coarse stage, compensation of means, gate as for all",
        coarse_compensated(CompensationConfig(gate="literal")), COARSE_ONLY,
        less="iterations of the coarse stage only", differs="to be read against `coarse-compensated-mean`",
    ),
    Method(
        "coarse-lower-gate", "coarse stage, lower gate where few cameras look, g = 0",
        coarse_compensated(CompensationConfig(beta_g=1e-9)), COARSE_ONLY,
        less="iterations of the coarse stage only", differs="to be read against `coarse`; g is a billionth, since "
        "the gate is lower only where g is above 0",
    ),
]  # fmt: skip
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
        differs=f"T_low = 0.20, β_g = 2, γ = 0.9; {_GATE}; g is added to the sums of gradients",
    ),
    Method("half-size", "photographs halved at first", with_block(resolutions=((0.0, 2), (0.3, 1)))),
    Method("last-model", "the last model, no mean", with_block(average=0.0)),
    Method(
        "printed-compensation", "compensation as printed", lambda config, _: with_printed_compensation(config),
        differs=f"T_low = 0.20, β_g = 2, γ = 0.9; {_GATE}",
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


def _cell(lambda_vis: float, added_to: Literal["mean", "sum"] | None, t_low: float) -> Method:
    name = f"cell-{lambda_vis:g}-" + ("off" if added_to is None else f"{added_to}-{t_low:g}")
    grown = "plain growth" if added_to is None else f"compensation of {added_to}s, T_low = {t_low:g}"
    return Method(
        name, f"λ_vis = {lambda_vis:g}, {grown}", factorial(lambda_vis, added_to, t_low),
        differs=f"each block has {FACTORIAL_CAMERAS} cameras: those whose best block it is, and those that show it "
        f"best besides; β_g = 2, γ = 0.9; {_GATE}",
    )  # fmt: skip


_FACTORIAL = [
    _cell(lambda_vis, added_to, t_low)
    for lambda_vis in FACTORIAL_VIS
    for added_to in FACTORIAL_ADDED
    for t_low in (FACTORIAL_T_LOW if added_to else FACTORIAL_T_LOW[:1])
]

#: Of the threshold of growth: whether compensated growth is more than that.
EAGER = (0.5, 0.25)
_EAGER = [
    *(
        Method(
            f"coarse-threshold-{factor:g}", f"coarse stage, plain growth at {factor:g} of the threshold",
            eager_coarse(factor), COARSE_ONLY, less="iterations of the coarse stage only",
            differs="to be read against `coarse`",
        )
        for factor in EAGER
    ),
    *(
        Method(
            f"cell-1-threshold-{factor:g}", f"λ_vis = 1, plain growth at {factor:g} of the threshold",
            eager(factorial(1.0, None, FACTORIAL_T_LOW[0]), factor),
            differs=f"each block has {FACTORIAL_CAMERAS} cameras: read it against `cell-1-off`",
        )
        for factor in EAGER
    ),
]  # fmt: skip

#: The cells of the factorial.
FACTORIAL = tuple(method.name for method in _FACTORIAL)
#: Every method by name.
METHODS: dict[str, Method] = {
    method.name: method
    for group in (
        _ABLATIONS, _OTHERS, _BLOCKS, _EACH_AS_LONG, _COARSE_COMPENSATED, _COARSE_PARTS, _LONGER, _CHOICES, _SWEEPS,
        _FACTORIAL, _EAGER,
    )
    for method in group
}  # fmt: skip
