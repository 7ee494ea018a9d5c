"""The paper's tables as methods × scenes × seeds. By default on generated scenes; --scenes names others."""

from __future__ import annotations

from experiments.bench.definitions import BenchTable, MethodGroup
from experiments.bench.methods import BETA_G, BLOCKS, CROSSED, FACTORIAL, GAMMA, LAMBDA_VIS, LOWER_THRESHOLDS, T_LOW

LAB_SCENES = ("lab-uneven", "lab-distant", "lab-even")
#: Where the paper's premise holds.
REGIME_SCENES = ("regime-uneven",)


def _sweep(title: str, prefix: str, values: tuple[float, ...]) -> MethodGroup:
    return MethodGroup(title, tuple(f"{prefix}-{value:g}" for value in values))


#: The rows of the paper's Table I that are trained here, and this package's presets.
TABLE1_METHODS = (
    "3dgs-black", "scaffold-gs", "octree-gs", "momentum-gs", "hug", "dogs-whole", "vastgaussian-whole",
    "citygaussian-whole", "mixgs", "baseline-mean", "vdgs-paper", "vdgs-default", "full",
)  # fmt: skip
_SWEEPS = (
    MethodGroup("plain growth", ("plain-growth",)),
    _sweep("(a) visibility weight λ_vis", "lambda-vis", LAMBDA_VIS),
    _sweep("(b) low-visibility threshold T_low", "t-low", T_LOW),
    _sweep("(c) compensation scale β_g", "beta-g", BETA_G),
    _sweep("(d) decay factor γ", "gamma", GAMMA),
)
_MORE_ANCHORS = (
    MethodGroup(
        "four blocks",
        (
            "cell-1-off",
            "cell-1-sum-0.2",
            "cell-1-mean-0.2",
            *(f"cell-1-threshold-{factor:g}" for factor in LOWER_THRESHOLDS),
        ),
    ),
    MethodGroup(
        "coarse stage alone",
        (
            "coarse",
            "coarse-compensated-sum",
            "coarse-compensated-mean",
            "coarse-compensated-literal-gate",
            "coarse-lower-gate",
            *(f"coarse-threshold-{factor:g}" for factor in LOWER_THRESHOLDS),
        ),
    ),
)
_ABLATION = (
    "coarse",
    "coarse-as-long",
    "baseline",
    "baseline-mean",
    "no-blocking-as-long-plain",
    "no-blocking-as-long",
    "no-blocking-plain",
    "no-blocking",
    "no-anchor-generation",
    "printed-compensation",
    "printed",
    "whole-photographs",
    "full",
)

#: Each departs from the full method in one choice, or says beside it in what else.
CHOICE_METHODS = (
    "full", "frozen-decoder", "even-sampling", "by-votes", "printed-rates", "damped-rates", "half-size", "last-model",
    "whole-photographs", "no-anchor-generation", "printed-compensation", "compensation-of-sums", "share-0.45",
    "literal-assignment", "leave-one-out", "frustum", "no-context", "free-ring", "free-best-seen", "ramp",
    "ramp-best-seen", "literal-gate", "dense-adam", "printed", "printed-damped",
)  # fmt: skip

#: Every table by name.
TABLES: dict[str, BenchTable] = {
    table.name: table
    for table in (
        BenchTable(
            "table1",
            "Table I: methods × scenes",
            TABLE1_METHODS,
            ("copr", "seneca", "regime-uneven"),
            single_seed=("seneca", "regime-uneven"),
            quoted=("Switch-NeRF",),
            overview=True,
        ),
        BenchTable("table2", "Table II: training strategies", _ABLATION, LAB_SCENES),
        BenchTable(
            "table3",
            "Table III: number of blocks",
            tuple(f"blocks-{count}" for count in BLOCKS),
            LAB_SCENES[:1],
            ours="blocks-8",
        ),
        BenchTable(
            "table4",
            "Table IV: parameters",
            tuple(name for group in _SWEEPS for name in group.methods),
            LAB_SCENES[:1],
            seeds=(0,),
            groups=_SWEEPS,
            ours="lambda-vis-1",
        ),
        BenchTable(
            "table3-each",
            "Table III: number of blocks, each trained as long, plain growth",
            (
                "coarse",
                "no-blocking-as-long-plain",
                "each-half",
                "no-anchor-generation",
                "each-2-times",
                "each-4-times",
            ),
            REGIME_SCENES,
            ours="no-anchor-generation",
        ),
        BenchTable(
            "factorial",
            "Factorial: cut by visibility × compensation × T_low, equally many cameras",
            FACTORIAL,
            REGIME_SCENES,
            ours="cell-1-mean-0.2",
        ),
        BenchTable(
            "crossed",
            "Crossed factors of the preset paper: cut by visibility × compensation",
            CROSSED,
            ("regime-small",),
            ours="paper-1-on",
        ),
        BenchTable(
            "paper-blocks",
            "Tables II and III in the preset paper, each block trained as long",
            (
                "paper-coarse",
                "paper-coarse-as-long",
                "paper-baseline",
                "paper-blocks-1",
                "paper-blocks-2",
                "paper-1-off",
                "paper-1-on",
                "paper-blocks-8",
            ),
            ("regime-small",),
            ours="paper-1-on",
        ),
        BenchTable(
            "coarse-compensation",
            "Compensation in the coarse stage alone",
            ("coarse", "coarse-compensated-mean", "coarse-compensated-sum"),
            REGIME_SCENES,
            ours="coarse-compensated-mean",
        ),
        BenchTable(
            "more-anchors",
            "Compensated growth, its parts, and plain growth at lower thresholds",
            tuple(name for group in _MORE_ANCHORS for name in group.methods),
            REGIME_SCENES,
            groups=_MORE_ANCHORS,
            ours="cell-1-mean-0.2",
        ),
        BenchTable(
            "longer",
            "Blocks trained longer",
            ("coarse", "baseline", "baseline-mean", "full", "longer-2", "longer-4"),
            LAB_SCENES[:2],
        ),
        BenchTable("choices", "Our choices, one at a time", CHOICE_METHODS, LAB_SCENES[:1], seeds=(0,)),
        BenchTable("efficiency", "Efficiency", ("baseline", "baseline-mean", "full"), LAB_SCENES[:1], seeds=(0,)),
        BenchTable(
            "toy",
            "Toy: the training strategies on a tiny town",
            ("baseline", "no-blocking", "no-anchor-generation", "full"),
            ("tiny",),
            seeds=(0,),
        ),
    )
}
