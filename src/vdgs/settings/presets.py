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
    RateConfig,
    TrainConfig,
)

PresetName = Literal["paper", "laptop"]

PRESETS: dict[str, MethodConfig] = {
    "paper": MethodConfig(),
    "laptop": MethodConfig(
        training=TrainConfig(
            iterations=0,
            resolutions=((0.0, 4), (0.1, 2), (0.4, 1)),
            rates=RateConfig(offsets=(0.02, 2e-4), features=(0.015, 0.015), log_scales=(0.014, 0.014)),
            early=5.0,
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
            offset_rate=2.0,
            scale_rate=2.0,
            feature_rate=2.0,
            decoder="own",
            growth=GrowthConfig(statistics_from=0, start=100, threshold=1e-4),
            compensation=CompensationConfig(t_low_quantile=0.25, beta_g=0.1),
        ),
    ),
}
