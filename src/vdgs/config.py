"""Every setting of training, with its meaning, its default and where that comes from.

Only the standard library is imported here, so that the command line can show the settings at once.
The defaults are the paper's (preset `paper`); `PRESETS` holds the others.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, replace
from typing import Any, Literal

PresetName = Literal["paper", "laptop"]


@dataclass(frozen=True)
class AnchorConfig:
    """The anchor model (Scaffold-GS, section III-B of the paper)."""

    offsets: int = 10
    """Gaussians per anchor (k)."""
    voxel: float = 0.0
    """Edge of the initial voxel grid in units of the ground frame; 0 takes the median nearest-neighbour distance of the
    sparse points."""
    outlier_distance: float = 30.0
    """Sparse points start no anchor where their fourth neighbour is this many times farther than the median one's; 0
    keeps all (choice: a few points deep below the ground become a backdrop that every camera sees through it)."""
    fill_gaps: bool = True
    """Also start anchors on ground that cameras see but that holds no sparse points: woods, water, fields (choice)."""
    distance: bool = False
    """Feed the distance between camera and anchor to the decoder too."""
    appearance: int = 0
    """Size of the appearance embedding of each training image (colour only); 0 for none."""
    colour_start: bool = False
    """Start the features from the colours of the sparse points instead of zeros."""


@dataclass(frozen=True)
class RateConfig:
    """Learning rates of Adam; pairs decay exponentially from the first to the second value."""

    offsets: tuple[float, float] = (0.01, 1e-4)
    """Offsets, in units of the anchor's own scale (choice: not multiplied by the size of the scene)."""
    features: tuple[float, float] = (0.0075, 0.0075)
    """Anchor features."""
    log_scales: tuple[float, float] = (0.007, 0.007)
    """Logarithms of the anchor scales."""
    opacity: tuple[float, float] = (0.002, 2e-5)
    """Opacity decoder."""
    covariance: tuple[float, float] = (0.004, 0.004)
    """Covariance decoder."""
    colour: tuple[float, float] = (0.008, 5e-5)
    """Colour decoder."""
    appearance: tuple[float, float] = (0.05, 5e-4)
    """Appearance embedding."""


@dataclass(frozen=True)
class GrowthConfig:
    """Where anchors are added and removed (Scaffold-GS, section 4.2 there)."""

    interval: int = 100
    """Iterations between two growth decisions."""
    statistics_from: int = 500
    """Iteration from which gradients and opacities are counted."""
    start: int = 1500
    """Iteration from which anchors grow and are pruned."""
    until: float = 0.5
    """Share of the iterations after which growth and pruning end."""
    threshold: float = 2e-4
    """Mean norm of dL/d(mean) in NDC units above which an offset asks for a new anchor."""
    levels: int = 3
    """Number of cell sizes tried; level i has threshold 2^i times and cells 4^i times finer."""
    coarsest_cell: float = 16.0
    """Edge of the coarsest cell, in voxels."""
    gate: float = 0.4
    """An offset is judged once it was rendered more often than this share of the interval."""
    prune_opacity: float = 0.005
    """An anchor goes when the opacity of its Gaussians, summed over them, averaged over the views, is below this."""
    prune_views: float = 0.8
    """... and it was seen more often than this share of the interval."""
    max_anchors: int = 0
    """No growth beyond this many anchors; 0 for no limit."""


@dataclass(frozen=True)
class LossConfig:
    """What training minimises."""

    ssim_weight: float = 0.2
    """Loss = (1 - w) L1 + w (1 - SSIM) + volume."""
    volume_weight: float = 0.01
    """Weight of the mean product of the three scales of the Gaussians that are drawn."""
    background: Literal["mean", "black"] = "mean"
    """Colour behind the scene: the mean of the training photographs (choice: what no photograph shows is then drawn
    in a colour of the place), or black."""
    background_noise: float = 0.2
    """In training the background is up to this much brighter or darker in each channel, at random, fading to nothing at
    the end: transparent ground cannot then hide before a background of its own colour (choice)."""


@dataclass(frozen=True)
class TrainConfig:
    """One stage of training."""

    iterations: int = 100_000
    """Number of steps, one photograph each; 0 takes sixty for each training photograph, but at least 3000 and at
    most 30 000 (choice: few photographs are soon learnt by heart, many need their time)."""
    resolutions: tuple[tuple[float, int], ...] = ((0.0, 1),)
    """Resolution schedule: from this share of the iterations on, images are shrunk by this factor."""
    seed: int = 0
    """Everything random follows from it: on the CPU the same seed gives the same bits."""
    anchors: AnchorConfig = field(default_factory=AnchorConfig)
    """The anchor model."""
    rates: RateConfig = field(default_factory=RateConfig)
    """Learning rates."""
    growth: GrowthConfig = field(default_factory=GrowthConfig)
    """Growth and pruning of anchors."""
    loss: LossConfig = field(default_factory=LossConfig)
    """The loss."""


#: How `iterations = 0` follows from the number of training photographs.
ITERATIONS_PER_VIEW, FEWEST_ITERATIONS, MOST_ITERATIONS = 60, 3_000, 30_000


def with_iterations(config: TrainConfig, training_views: int) -> TrainConfig:
    """The settings with `iterations = 0` replaced by what the number of training photographs asks for."""
    if config.iterations:
        return config
    wanted = ITERATIONS_PER_VIEW * training_views
    return replace(config, iterations=min(max(wanted, FEWEST_ITERATIONS), MOST_ITERATIONS))


PRESETS: dict[str, TrainConfig] = {
    "paper": TrainConfig(),
    "laptop": TrainConfig(
        iterations=0,
        resolutions=((0.0, 4), (0.1, 2), (0.4, 1)),
        growth=GrowthConfig(statistics_from=300, start=500, until=0.6, threshold=1e-4),
    ),
}


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain dictionaries and lists, ready for YAML or JSON."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(item) for item in value]
        if isinstance(value, (str, int, float, bool)) or value is None:
            return value
        return str(value)

    return plain(dataclasses.asdict(config))


def differences(old: dict[str, Any], new: dict[str, Any], prefix: str = "") -> list[str]:
    """Lines that say which settings differ, e.g. `growth.threshold: 0.0002 -> 0.0004`."""
    lines = []
    for key in sorted(old.keys() | new.keys()):
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            lines += differences(before, after, f"{prefix}{key}.")
        elif before != after:
            lines.append(f"{prefix}{key}: {before} -> {after}")
    return lines


def validate(config: TrainConfig) -> list[str]:
    """What is wrong with the settings, one sentence each; empty if nothing is."""
    growth, problems = config.growth, []
    if config.seed < 0 or config.anchors.appearance < 0 or config.anchors.voxel < 0:
        problems.append("seed, anchors.appearance and anchors.voxel must not be negative")
    if 0 < config.anchors.outlier_distance < 2:
        problems.append("anchors.outlier_distance below 2 would drop ordinary points; give more, or 0 to keep all")
    if growth.coarsest_cell <= 0 or growth.threshold < 0:
        problems.append("growth.coarsest_cell must be positive and growth.threshold not negative")
    if config.iterations < 0:
        problems.append(f"iterations is {config.iterations}; it must be at least 1, or 0 for automatic")
    if not config.resolutions or config.resolutions[0][0] != 0.0:
        problems.append("resolutions must begin at share 0.0")
    if any(factor < 1 for _, factor in config.resolutions):
        problems.append("resolutions: factors are whole numbers of at least 1")
    if [share for share, _ in config.resolutions] != sorted({share for share, _ in config.resolutions}):
        problems.append("resolutions: shares must ascend")
    if not 1 <= config.anchors.offsets <= 32:
        problems.append(f"anchors.offsets is {config.anchors.offsets}; 1 to 32 are possible")
    if growth.interval < 1 or growth.levels < 0:
        problems.append("growth.interval must be at least 1 and growth.levels at least 0")
    if not 0.0 <= config.loss.ssim_weight <= 1.0:
        problems.append(f"loss.ssim_weight is {config.loss.ssim_weight}; it lies between 0 and 1")
    for rate in dataclasses.fields(config.rates):
        if min(getattr(config.rates, rate.name)) <= 0:
            problems.append(f"rates.{rate.name} must be positive")
    return problems
