"""Which view and which image size an iteration uses: functions of (seed, iteration) alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from vdgs.captures.flight_parts import is_oblique
from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.model.anchors import Anchors
from vdgs.training.training_state import TrainingProblem
from vdgs.visibility.visibility_counts import visibility_sampling_weights


def view_at(iteration: int, count: int, seed: int, shares: tuple[float, ...] | None = None) -> int:
    """Which training view iteration (from 0) uses.

    Without `shares` every `count` iterations are a fresh permutation of all views. With them, one number >= 0 for each
    view and some > 0, every `count` iterations hold each view as often as its share of their sum asks for, rounded
    down or up at random (systematic sampling), in random order.
    """
    epoch, place = divmod(iteration, count)
    return int(_epoch(epoch, count, seed, shares)[place])


@lru_cache(maxsize=4)
def _epoch(epoch: int, count: int, seed: int, shares: tuple[float, ...] | None) -> np.ndarray:
    generator = np.random.default_rng((seed, epoch))
    if shares is None:
        return generator.permutation(count)
    marks = np.cumsum(shares) * (count / np.sum(shares))
    marks[-1] = count  # rounding must not lose the last one
    drawn = np.searchsorted(marks, np.arange(count) + generator.random(), side="right")
    return generator.permutation(drawn)


def downscale_at(iteration: int, config: TrainConfig) -> int:
    """Factor by which images are shrunk at this iteration (from 0)."""
    share = iteration / config.iterations
    return [factor for start, factor in config.resolution_schedule if share >= start][-1]


def views_in_cycle(iteration: int, stage: TrainingProblem) -> list[int]:
    """The views, each once, that were used in the growth cycle which ends after `iteration` steps.

    A cycle lasts from one growth decision to the next; the first one starts with the statistics.
    """
    growth = stage.config.densify
    begin = iteration - growth.every
    if begin < growth.start:  # no decision was made before
        begin = growth.stats_start
    used = range(max(min(begin, iteration - 1), 0), iteration)
    return sorted({view_at(each, stage.num_images, stage.config.seed, stage.view_weights) for each in used})


def view_sampling_weights(config: TrainConfig, anchors: Anchors, cameras: Sequence[Camera]) -> tuple[float, ...] | None:
    """How often each training view is used, by the settings, for the anchors that training starts with.

    Roots, because a view with few votes also costs little (`training.crops`): a mean varies least for what it costs
    if strata are drawn in proportion to their weight over the root of their cost (Cochran, 1977, section 5.5).
    """
    shares = None
    if config.view_sampling != "uniform":
        shares = visibility_sampling_weights(anchors.positions, cameras)
        if config.view_sampling == "sqrt-visibility":
            shares = tuple(math.sqrt(share) for share in shares)
    return _with_more_obliques(shares, config.oblique_sampling, cameras)


def _with_more_obliques(
    shares: tuple[float, ...] | None, factor: float, cameras: Sequence[Camera]
) -> tuple[float, ...] | None:
    """The shares with those of photographs that look obliquely times a factor, less where all of them together would
    be drawn more often than the others."""
    oblique, each = [is_oblique(camera) for camera in cameras], shares or (1.0,) * len(cameras)
    of_obliques = sum(share for share, leans in zip(each, oblique, strict=True) if leans)
    if factor == 1.0 or not of_obliques:
        return shares
    factor = min(factor, max(1.0, (sum(each) - of_obliques) / of_obliques))
    return tuple(share * factor if leans else share for share, leans in zip(each, oblique, strict=True))
