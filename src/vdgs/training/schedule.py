"""Which view and which image size an iteration uses: functions of (seed, iteration) alone."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from vdgs.config import TrainConfig
from vdgs.training.state import Stage


def view_at(iteration: int, count: int, seed: int) -> int:
    """Which training view iteration (from 0) uses: a fresh permutation of all views every `count` iterations."""
    epoch, place = divmod(iteration, count)
    return int(_permutation(epoch, count, seed)[place])


@lru_cache(maxsize=4)
def _permutation(epoch: int, count: int, seed: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)


def downscale_at(iteration: int, config: TrainConfig) -> int:
    """Factor by which images are shrunk at this iteration (from 0)."""
    share = iteration / config.iterations
    return [factor for start, factor in config.resolutions if share >= start][-1]


def views_in_cycle(iteration: int, stage: Stage) -> list[int]:
    """The views, each once, that were used in the growth cycle which ends after `iteration` steps.

    A cycle lasts from one growth decision to the next; the first one starts with the statistics.
    """
    growth = stage.config.growth
    begin = iteration - growth.interval
    if begin < growth.start:  # no decision was made before
        begin = growth.statistics_from
    used = range(max(min(begin, iteration - 1), 0), iteration)
    return sorted({view_at(each, stage.image_count, stage.config.seed) for each in used})
