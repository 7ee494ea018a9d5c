"""Settings of MixGS: Liu, Wang, Yu and Xia, "Holistic Large-Scale Scene Reconstruction via Mixed Gaussian Splatting",
2025. "program": its authors' published program says what the paper leaves open. Left out or different:

- the coarse Gaussians are trained here, as 3DGS, with a third of all iterations; the authors start from a finished
  model, and mix for ten times as long;
- coarse Gaussians of opacity above 0.05 are kept, not above 0.5: after few iterations few are so opaque;
- the hash tables have 16 levels, from a grid of 16 cells a side to one of 2048, each 1.38 times finer than the one
  before, and as many entries as there are Gaussians; not 32 levels, from 32 cells on, of 4 million entries;
- decoded scales are in units of the median size of the coarse Gaussians, not of the capture, and so is their minimum;
- image formation is that of this project (docs/conventions.md), for all methods alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from experiments.baselines.gs3d.schedule import scale_schedule
from experiments.baselines.gs3d.training import Gs3dConfig, Gs3dLearningRates


@dataclass(frozen=True, kw_only=True)
class MixConfig:
    """Settings of both stages."""

    #: 3DGS before anything is mixed.
    coarse: Gs3dConfig
    #: Iterations of mixed training; in the first part of them the coarse Gaussians stay as they are (program: a sixth).
    iterations: int
    frozen_share: float = 1 / 6
    #: Only coarse Gaussians that are more opaque are kept.
    min_opacity: float = 0.05
    #: Rates of mixed training, those of means times the extent; offsets have the first rate of means throughout.
    rates: Gs3dLearningRates = field(default_factory=lambda: Gs3dLearningRates(means=(6.4e-6, 6.4e-8)))
    #: Rates of the hash tables and of the decoder, first and last (program: 600 times those of means; of the decoder
    #: the first is 80 times that of means, the last is theirs).
    table_rate: tuple[float, float] = (3.84e-3, 3.84e-5)
    decoder_rate: tuple[float, float] = (5.12e-4, 6.4e-8)
    #: Hash tables: levels, features of a level, coarsest and finest grid; the decoder's width.
    num_levels: int = 16
    level_size: int = 2
    resolutions: tuple[int, int] = (16, 2048)
    width: int = 64
    #: Smallest decoded scale in units of the median size.
    min_scale: float = 0.01

    @property
    def frozen_iterations(self) -> int:
        return round(self.frozen_share * self.iterations)


def mix_config(iterations: int, seed: int = 0, max_gaussians: int = 0) -> MixConfig:
    """MixGS with so many iterations in all."""
    coarse = max(1, round(iterations / 3))
    return MixConfig(
        coarse=scale_schedule(coarse, Gs3dConfig(seed=seed), max_gaussians), iterations=max(1, iterations - coarse)
    )
