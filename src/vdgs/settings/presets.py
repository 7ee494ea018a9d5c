"""Settings by name: `paper`, and those that give a good result in minutes."""

from __future__ import annotations

from typing import Literal

from vdgs.settings.method import (
    AssignmentConfig,
    BlockConfig,
    CompensationConfig,
    GrowthConfig,
    MethodConfig,
    PartitionConfig,
    TrainConfig,
)

PresetName = Literal["paper", "laptop"]

PRESETS: dict[str, MethodConfig] = {
    "paper": MethodConfig(),
    "laptop": MethodConfig(
        training=TrainConfig(
            iterations=0,
            resolutions=((0.0, 4), (0.1, 2), (0.4, 1)),
            early=10.0,
            growth=GrowthConfig(statistics_from=300, start=500, until=0.6, threshold=1e-4),
        ),
        partition=PartitionConfig(blocks="auto"),
        assignment=AssignmentConfig(threshold=0.1),
        block=BlockConfig(
            iterations=0,
            sampling="roots",
            resolutions=((0.0, 2), (0.3, 1)),
            average=0.5,
            crop="pixels",
            offset_rate=4.0,
            scale_rate=4.0,
            feature_rate=4.0,
            decoder="own",
            growth=GrowthConfig(statistics_from=0, start=100, threshold=1e-4),
            compensation=CompensationConfig(t_low_quantile=0.25, beta_g=0.1),
        ),
    ),
}
