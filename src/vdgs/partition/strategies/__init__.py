"""The partitions of published methods, to compare with: each cuts the scene and chooses cameras in its own way.

Only what is named in `omissions` differs from the publication; training and merging are ours.
"""

from __future__ import annotations

from vdgs.partition.strategies.citygaussian import CityGaussian
from vdgs.partition.strategies.dogs import Dogs
from vdgs.partition.strategies.strategy import PartitionStrategy
from vdgs.partition.strategies.vastgaussian import VastGaussian

__all__ = ["STRATEGIES", "PartitionStrategy"]

#: By the name in `PartitionConfig.strategy`.
STRATEGIES: dict[str, PartitionStrategy] = {
    "vastgaussian": VastGaussian(),
    "citygaussian": CityGaussian(),
    "dogs": Dogs(),
}
