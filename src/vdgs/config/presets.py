"""Settings by name.

`paper`     the paper as printed, but for the input of the decoder and for the merge, which takes anchors of widened
            blocks too; where it is silent, the reading that served it best on validation views or, where none clearly
            did, what is nearest to Scaffold-GS. docs/paper.md lists every choice, with its alternatives.
`default`   the paper's numbers, but a scene that can be used whatever the capture: axes that turn with the scene and
            smoothed cores; gaps filled; a random background, bounded Gaussians, sparse Adam; cameras by `coverage`,
            each with a block and each block with a hundred; and a frozen margin.
`laptop`    a good result in minutes on a CPU: what a few thousand steps ask for; pseudo views and agreeing depths, for
            views off the path of the flight; and plain growth in blocks, for compensated growth
            (`--block.compensation.enabled`) lost where few cameras look. docs/paper.md says what decided each
            departure.
"""

from __future__ import annotations

from typing import Literal

from vdgs.config.method import (
    AssignmentConfig,
    BlockConfig,
    CompensationConfig,
    DensifyConfig,
    InitConfig,
    LearningRateConfig,
    LossConfig,
    MergeConfig,
    MethodConfig,
    ModelConfig,
    PartitionConfig,
    TrainConfig,
)

PresetName = Literal["default", "paper", "laptop"]
#: `auto`: that of the run that is there, else `NEW_RUN_PRESET`.
PresetChoice = Literal["auto", "laptop", "default", "paper"]

#: Growth of Scaffold-GS's program: decisions after iteration 1 500 and before half of the iterations, both exclusive.
_SCAFFOLD_GROWTH = DensifyConfig(start=1501, stop_fraction=0.49999)

PRESETS: dict[str, MethodConfig] = {
    "default": MethodConfig(),
    "paper": MethodConfig(
        training=TrainConfig(
            optimizer="adam",
            model=ModelConfig(bound_scales=False, photograph_blur=False, background_model="off"),
            init=InitConfig(fill_gaps=False),
            densify=_SCAFFOLD_GROWTH,
            loss=LossConfig(background="black", random_background=0.0),
        ),
        partition=PartitionConfig(cluster_axes="ground", cluster_clip=0.0, cluster_smoothing=0.5, min_block_share=0.0),
        assignment=AssignmentConfig(mode="paper", always_best=False, min_cameras=0),
        block=BlockConfig(random_background=0.0, margin="ramp", mask_moving="off", densify=_SCAFFOLD_GROWTH),
        merge=MergeConfig(rule="max-visibility"),
    ),
    "laptop": MethodConfig(
        training=TrainConfig(
            iterations=0,
            init=InitConfig(mvs=True),
            exposure_compensation=True,
            exposure_min_spread=0.015,
            oblique_sampling=1.6,
            resolution_schedule=((0.0, 4), (0.1, 2), (0.4, 1)),
            lr=LearningRateConfig(offsets=(0.02, 2e-4), features=(0.015, 0.015), log_scales=(0.014, 0.014)),
            lr_warm_boost=3.0,
            densify=DensifyConfig(stats_start=300, start=500, stop_fraction=0.6, grad_threshold=1e-4),
            loss=LossConfig(depth_agreement=0.05, pseudo_views=0.3),
        ),
        partition=PartitionConfig(blocks="auto"),
        assignment=AssignmentConfig(threshold=0.1),
        block=BlockConfig(
            iterations=0,
            view_sampling="sqrt-visibility",
            resolution_schedule=((0.0, 1),),
            swa_fraction=0.5,
            crop="fixed-pixels",
            lr_scale_offsets=2.0,
            lr_scale_log_scales=2.0,
            lr_scale_features=2.0,
            decoder="own",
            densify=DensifyConfig(stats_start=0, start=100, grad_threshold=1e-4),
            compensation=CompensationConfig(enabled=False, t_low_quantile=0.25, beta_g=0.1),
        ),
    ),
}

#: Of a new run, on any device: minutes to an hour on a CPU, a minute or two on a large GPU, where four times as many
#: steps gained nothing (experiments/reports/gpu.md).
NEW_RUN_PRESET: PresetName = "laptop"
