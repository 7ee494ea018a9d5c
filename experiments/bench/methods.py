"""The methods: VDGS, its ablations, its parameter sweeps and the partitions of others.

All but 3DGS share the anchor model, the loss and the block training of this package; all spend the same total of
iterations, one photograph each (blocks that draw parts of photographs: as many photographs in more iterations).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from experiments.bench.block_methods import BLOCK_METHODS
from experiments.bench.definitions import COARSE_STAGES, BenchMethod, ConfigOverride
from experiments.bench.other_methods import OTHER_METHODS
from experiments.bench.overrides import (
    FACTORIAL_CAMERAS,
    as_in_paper,
    as_preset,
    coarse_only,
    coarse_only_averaged,
    coarse_same_iterations,
    coarse_with_compensation,
    coarse_with_lower_threshold,
    crossed_cell,
    disable_compensation,
    factorial_cell,
    full_method,
    in_preset_paper,
    with_assignment,
    with_beta_g,
    with_block,
    with_block_count,
    with_dense_adam,
    with_full_images,
    with_gamma,
    with_lambda_vis,
    with_longer_blocks,
    with_lower_threshold,
    with_max_visibility_merge,
    with_more_blocks,
    with_paper_compensation,
    with_paper_gate,
    with_summed_compensation,
    with_t_low,
    without_blocking,
    without_blocking_same_time,
    without_compensation,
)
from vdgs.config.method import CompensationConfig

LAMBDA_VIS = (0.0, 0.5, 1.0, 1.3)
T_LOW = (0.05, 0.15, 0.20, 0.30)
#: The paper's, and 1 - gamma, with which the cache is a mean over cycles and no sum.
BETA_G = (0.1, 0.5, 1.5, 2.0, 3.0)
GAMMA = (0.80, 0.90, 0.95)
BLOCKS = (1, 2, 4, 8, 16)
#: Of the factorial: a cut by place alone, or by place and visibility; what g is added to (None: plain growth); T_low.
FACTORIAL_VIS, FACTORIAL_T_LOW = (0.0, 1.0), (0.2, 0.3)
FACTORIAL_TARGETS: tuple[Literal["mean", "sum"] | None, ...] = (None, "mean", "sum")


def _sweep(
    prefix: str, symbol: str, values: tuple[float, ...], change: Callable[[float], ConfigOverride], differs: str
) -> list[BenchMethod]:
    return [
        BenchMethod(f"{prefix}-{value:g}", f"{symbol} = {value:g}", with_full_images(change(value)), differs=differs)
        for value in values
    ]


#: On which the paper is silent, and by which compensated growth gains where few cameras look (reports/findings.md).
_GATE = "the gate of growth is lower where few cameras look, our choice"
_ABLATIONS = [
    BenchMethod("full", "VDGS (full)", full_method, citation="VDGS, sections IV-B and IV-C"),
    BenchMethod(
        "vdgs-paper",
        "VDGS (preset paper)",
        as_preset("paper"),
        citation="VDGS, sections IV-B and IV-C",
        differs="the paper as printed, its schedule in proportion to the iterations here; docs/paper.md says what it "
        "takes where the paper is silent",
    ),
    BenchMethod(
        "vdgs-default",
        "VDGS (preset default)",
        as_preset("default"),
        citation="VDGS, sections IV-B and IV-C",
        differs="the paper's numbers with this package's choices, its schedule in proportion to the iterations here",
    ),
    BenchMethod("baseline", "baseline: coarse alone", coarse_only, COARSE_STAGES, citation="VDGS, Table II (a)"),
    BenchMethod(
        "baseline-mean",
        "baseline with a mean of models",
        coarse_only_averaged,
        COARSE_STAGES,
        differs="ends as the blocks of `full_method` do: with a mean of models, where they have one",
    ),
    BenchMethod(
        "coarse",
        "coarse stage, as blocks begin",
        full_method,
        COARSE_STAGES,
        less="iterations of the coarse stage only",
    ),
    BenchMethod(
        "coarse-as-long",
        "coarse alone, as long as one block",
        coarse_same_iterations,
        COARSE_STAGES,
        differs="ends with its last model; the blocks of `full_method` with a mean of models, where the preset says so",
        less="iterations of the coarse stage and one block: as much time, if all blocks are trained at once",
    ),
    BenchMethod(
        "printed",
        "VDGS, blocks as printed",
        as_in_paper,
        citation="VDGS, sections IV-B and IV-C",
        differs="blocks of the paper: frozen decoder, even use of photographs, the coarse stage's rates again, full "
        "size, no mean of models, whole photographs, share of 0.45, its compensation; no pseudo views and no loss of "
        "depths; growth, and coarse stage and cut else, as `full_method`; where the paper is silent, the choices of "
        "the preset `default`",
    ),
    BenchMethod("whole-photographs", "VDGS (full), whole photographs", with_full_images(full_method)),
    BenchMethod("no-blocking", "w/o blocking", without_blocking, citation="VDGS, Table II (b)"),
    BenchMethod(
        "no-blocking-as-long",
        "w/o blocking, as long as one block",
        without_blocking_same_time,
        less="photographs of the coarse stage and one block: as much time, if all blocks are trained at once",
    ),
    BenchMethod("no-blocking-plain", "w/o blocking nor anchor generation", disable_compensation(without_blocking)),
    BenchMethod(
        "no-blocking-as-long-plain",
        "w/o blocking nor anchor generation, as long as one block",
        disable_compensation(without_blocking_same_time),
        differs="to be read against `no-anchor-generation`",
        less="photographs of the coarse stage and one block: as much time, if all blocks are trained at once",
    ),
    BenchMethod("no-anchor-generation", "w/o anchor generation", without_compensation, citation="VDGS, Table II (c)"),
]
_BLOCKS = [
    BenchMethod(f"blocks-{count}", f"{count} block{'s' * (count > 1)}", with_block_count(count)) for count in BLOCKS
]
#: Plain growth: after few steps compensated growth costs one block more than several (reports/findings.md).
_EACH_AS_LONG = [
    BenchMethod(
        "each-half", "half as many blocks, each as long, w/o anchor generation",
        disable_compensation(with_more_blocks(0.5)), less="iterations: of blocks half as many",
    ),
    *(
        BenchMethod(
            f"each-{factor}-times", f"{factor} times as many blocks, each as long, w/o anchor generation",
            disable_compensation(with_more_blocks(factor)), more=f"iterations: of blocks {factor} times as many",
        )
        for factor in (2, 4)
    ),
]  # fmt: skip
_COARSE_COMPENSATED = [
    BenchMethod(
        f"coarse-compensated-{target}",
        f"coarse stage, compensation as printed, {target}s",
        coarse_with_compensation(CompensationConfig(target=target)),
        COARSE_STAGES,
        less="iterations of the coarse stage only",
        differs=f"to be read against `coarse`; {_GATE}",
    )
    for target in ("mean", "sum")
]
#: What compensation is made of: g, and the lower gate for what few cameras see, which is our choice.
_COARSE_PARTS = [
    BenchMethod(
        "coarse-compensated-literal-gate", "coarse stage, compensation of means, gate as for all",
        coarse_with_compensation(CompensationConfig(min_draws="paper")), COARSE_STAGES,
        less="iterations of the coarse stage only", differs="to be read against `coarse-compensated-mean`",
    ),
    BenchMethod(
        "coarse-lower-gate", "coarse stage, lower gate where few cameras look, g = 0",
        coarse_with_compensation(CompensationConfig(beta_g=1e-9)), COARSE_STAGES,
        less="iterations of the coarse stage only", differs="to be read against `coarse`; g is a billionth, since "
        "the gate is lower only where g is above 0",
    ),
]  # fmt: skip
_LONGER = [
    BenchMethod(
        f"longer-{factor}", f"VDGS (full), blocks {factor} times as long", with_longer_blocks(factor),
        more=f"iterations: {factor} times as many for blocks",
    )
    for factor in (2, 4)
]  # fmt: skip
_CHOICES = [
    BenchMethod("frozen-decoder", "frozen decoder", with_block(decoder="frozen")),
    BenchMethod("even-sampling", "photographs used alike, but for obliques", with_block(view_sampling="uniform")),
    BenchMethod("by-votes", "photographs by votes", with_block(view_sampling="visibility")),
    BenchMethod("share-0.45", "cameras above a share of 0.45", with_assignment(threshold=0.45)),
    BenchMethod(
        "literal-assignment", "eq. 7 as printed", with_assignment(mode="paper", threshold=0.45),
        differs="eq. 7 with its threshold of 0.45: to be read against `share-0.45`",
    ),
    BenchMethod("leave-one-out", "cameras by leave-one-out", with_assignment(mode="leave-one-out")),
    BenchMethod(
        "frustum", "cameras by frusta", with_assignment(mode="frustum"),
        differs="the share is one of the block's anchors, not of pixels",
    ),
    BenchMethod(
        "printed-rates", "the coarse stage's rates again",
        with_block(lr_scale_offsets=1.0, lr_scale_log_scales=1.0, lr_scale_features=1.0),
    ),
    BenchMethod(
        "damped-rates", "damped rates",
        with_block(lr_scale_offsets=0.4, lr_scale_log_scales=0.8, lr_scale_features=1.0),
        differs="0.4 and 0.8 times the coarse stage's rates of offsets and scales, with which CityGaussian fine-tunes",
    ),
    BenchMethod(
        "printed-damped", "blocks as printed, damped rates",
        lambda config, budget: with_block(lr_scale_offsets=0.4, lr_scale_log_scales=0.8)(
            as_in_paper(config, budget), budget
        ),
        differs="`printed` with the rates of `damped-rates`: what earlier versions took for printed",
    ),
    BenchMethod("dense-adam", "dense Adam", with_dense_adam(full_method), differs="in the coarse stage and in blocks"),
    BenchMethod(
        "compensation-of-sums", "compensation as printed, of sums", with_summed_compensation,
        differs=f"T_low = 0.20, β_g = 2, γ = 0.9; {_GATE}; g is added to the sums of gradients",
    ),
    BenchMethod("half-size", "photographs halved at first", with_block(resolution_schedule=((0.0, 2), (0.3, 1)))),
    BenchMethod("last-model", "the last model, no mean", with_block(swa_fraction=0.0)),
    BenchMethod(
        "printed-compensation", "compensation as printed", lambda config, _: with_paper_compensation(config),
        differs=f"T_low = 0.20, β_g = 2, γ = 0.9; {_GATE}",
    ),
    BenchMethod("no-context", "without context", with_block(draw_outside=False)),
    BenchMethod("free-ring", "free ring", with_block(margin="free")),
    BenchMethod(
        "free-best-seen", "free ring, merged by best seen", with_max_visibility_merge(with_block(margin="free")),
        differs="to be read against `free-ring`",
    ),
    BenchMethod(
        "ramp", "ramp ring, frozen decoder", with_block(margin="ramp", decoder="frozen"),
        differs="to be read against `frozen-decoder`: a ramp needs one",
    ),
    BenchMethod(
        "ramp-best-seen", "ramp ring, frozen decoder, merged by best seen",
        with_max_visibility_merge(with_block(margin="ramp", decoder="frozen")), differs="to be read against `ramp`",
    ),
    BenchMethod("literal-gate", "literal gate", with_paper_gate),
]  # fmt: skip
_WHOLE = "whole photographs"
_AS_PRINTED = f"{_WHOLE}; all other settings of compensation are the paper's"
_SWEEPS = [
    BenchMethod("plain-growth", "no compensation", with_full_images(without_compensation), differs=_WHOLE),
    *_sweep("lambda-vis", "λ_vis", LAMBDA_VIS, with_lambda_vis, _WHOLE),
    *_sweep("t-low", "T_low", T_LOW, with_t_low, _AS_PRINTED),
    *_sweep("beta-g", "β_g", BETA_G, with_beta_g, _AS_PRINTED),
    *_sweep("gamma", "γ", GAMMA, with_gamma, _AS_PRINTED),
]


def _cell(lambda_vis: float, target: Literal["mean", "sum"] | None, t_low: float) -> BenchMethod:
    name = f"cell-{lambda_vis:g}-" + ("off" if target is None else f"{target}-{t_low:g}")
    grown = "plain growth" if target is None else f"compensation of {target}s, T_low = {t_low:g}"
    return BenchMethod(
        name, f"λ_vis = {lambda_vis:g}, {grown}", factorial_cell(lambda_vis, target, t_low),
        differs=f"each block has {FACTORIAL_CAMERAS} cameras: those whose best block it is, and those that show it "
        f"best besides; β_g = 2, γ = 0.9; {_GATE}",
    )  # fmt: skip


_FACTORIAL = [
    _cell(lambda_vis, target, t_low)
    for lambda_vis in FACTORIAL_VIS
    for target in FACTORIAL_TARGETS
    for t_low in (FACTORIAL_T_LOW if target else FACTORIAL_T_LOW[:1])
]

#: Of the threshold of growth: whether compensated growth is more than that.
LOWER_THRESHOLDS = (0.5, 0.25)
_EAGER = [
    *(
        BenchMethod(
            f"coarse-threshold-{factor:g}", f"coarse stage, plain growth at {factor:g} of the threshold",
            coarse_with_lower_threshold(factor), COARSE_STAGES, less="iterations of the coarse stage only",
            differs="to be read against `coarse`",
        )
        for factor in LOWER_THRESHOLDS
    ),
    *(
        BenchMethod(
            f"cell-1-threshold-{factor:g}", f"λ_vis = 1, plain growth at {factor:g} of the threshold",
            with_lower_threshold(factorial_cell(1.0, None, FACTORIAL_T_LOW[0]), factor),
            differs=f"each block has {FACTORIAL_CAMERAS} cameras: read it against `cell-1-off`",
        )
        for factor in LOWER_THRESHOLDS
    ),
]  # fmt: skip

_CROSSED = [
    BenchMethod(
        f"paper-{lambda_vis:g}-{'on' if compensated else 'off'}",
        f"preset paper, λ_vis = {lambda_vis:g}, {'compensated' if compensated else 'plain'} growth",
        crossed_cell(lambda_vis, compensated),
        differs="its schedule in proportion to the iterations here",
    )
    for lambda_vis in FACTORIAL_VIS
    for compensated in (False, True)
]

#: Beside the cells above with λ_vis = 1, which have four blocks.
_PAPER_BLOCKS = [
    BenchMethod(
        "paper-coarse", "preset paper, coarse stage", in_preset_paper(full_method), COARSE_STAGES,
        less="iterations of the coarse stage only",
    ),
    BenchMethod(
        "paper-coarse-as-long", "preset paper, coarse stage, as long as one block",
        in_preset_paper(coarse_same_iterations), COARSE_STAGES, less="iterations of the coarse stage and one block",
    ),
    BenchMethod(
        "paper-baseline", "preset paper, coarse stage, as long as four blocks", in_preset_paper(coarse_only),
        COARSE_STAGES,
    ),
    *(
        BenchMethod(
            f"paper-blocks-{count}", f"preset paper, {count} block{'s' * (count > 1)}, each as long as one of four",
            in_preset_paper(with_more_blocks(count / 4)),
            less=f"iterations: of {count} of four blocks" if count < 4 else "",
            more=f"iterations: of {count} blocks, not four" if count > 4 else "",
        )
        for count in (1, 2, 8)
    ),
]  # fmt: skip

#: The cells of the preset `paper`.
CROSSED = tuple(method.name for method in _CROSSED)
#: The cells of the factorial.
FACTORIAL = tuple(method.name for method in _FACTORIAL)
#: Every method by name.
METHODS: dict[str, BenchMethod] = {
    method.name: method
    for group in (
        _ABLATIONS, OTHER_METHODS, BLOCK_METHODS, _BLOCKS, _EACH_AS_LONG, _COARSE_COMPENSATED, _COARSE_PARTS, _LONGER,
        _CHOICES, _SWEEPS, _FACTORIAL, _CROSSED, _PAPER_BLOCKS, _EAGER,
    )
    for method in group
}  # fmt: skip
