"""The published methods that train a scene in blocks with losses, schedules and models of their own: whole methods,
where `partition.strategies` compares their cuts alone."""

from __future__ import annotations

from experiments.bench.definitions import (
    CITYGAUSSIAN_STAGES,
    DOGS_STAGES,
    MOMENTUM_STAGES,
    VASTGAUSSIAN_STAGES,
    BenchMethod,
)
from experiments.bench.overrides import gaussian_blocks_alone, gaussians_in_blocks, momentum_blocks

#: For all methods of explicit Gaussians.
_AS_3DGS = (
    "image formation, background (the mean color of the photographs) and schedule are those of the row 3DGS; a block "
    "that no camera is chosen for gets the best that shows it"
)

#: As the docstrings of `experiments.baselines` have them.
BLOCK_METHODS = [
    BenchMethod(
        "momentum-gs",
        "Momentum-GS",
        momentum_blocks,
        MOMENTUM_STAGES,
        citation="Fan et al., Momentum-GS: Momentum Gaussian Self-Distillation for High-Quality Large Scene "
        "Reconstruction, 2024",
        omissions=(
            "several machines at once: blocks have their turns in one process",
            "Gaussians of the whole coarse scene in every block: a block moves the anchors of its own cell, the "
            "coarse decoder draws those around it",
            "the consistency loss on features of anchors: it moves the decoder",
        ),
        differs="weights of blocks by the training views that they meet, not by views held out; turns of at most a "
        "twelfth of a block's iterations; starts, background, rates and volume weight are those of our coarse stage, "
        "with dense Adam; memory is that of all blocks together",
        adapted="blocks in turns, our starts and rates",
    ),
    BenchMethod(
        "citygaussian-whole",
        "CityGaussian",
        gaussians_in_blocks,
        CITYGAUSSIAN_STAGES,
        citation="Liu et al., CityGaussian: Real-time High-quality Large-Scale Scene Rendering with Gaussians, "
        "ECCV 2024",
        omissions=("levels of detail and compression (its section 3.3)",),
        differs=f"foreground by quantiles of cameras, threshold of 1 - SSIM 0.08 for every scene; {_AS_3DGS}",
        adapted="without levels of detail",
    ),
    BenchMethod(
        "vastgaussian-whole",
        "VastGaussian",
        gaussian_blocks_alone,
        VASTGAUSSIAN_STAGES,
        citation="Lin et al., VastGaussian: Vast 3D Gaussians for Large Scene Reconstruction, CVPR 2024",
        differs="opacities are reset in proportion to a block's iterations, as in 3DGS; the appearance network ends "
        f"with 2 sigmoid(x) and begins as the identity, which the paper leaves open; {_AS_3DGS}",
    ),
    BenchMethod(
        "dogs-whole",
        "DOGS",
        gaussian_blocks_alone,
        DOGS_STAGES,
        citation="Chen and Lee, DOGS: Distributed-Oriented Gaussian Splatting for Large-Scale 3D Reconstruction via "
        "Gaussian Consensus, NeurIPS 2024",
        omissions=(
            "pruning by importance before the consensus begins",
            "its appearance encoding, which its paper reports apart",
        ),
        differs="cut and cameras as its program has them; a block without cameras gets the one that holds most of its "
        "points; penalties, their adaptation and over-relaxation have the usual values of ADMM (Boyd et al. 2011), for "
        "neither paper nor program gives its own; only Gaussians that several blocks hold are pulled; copies keep "
        f"the moments of Adam; at least ten steps of consensus; {_AS_3DGS}",
        adapted="usual penalties of ADMM, no pruning before",
    ),
]
