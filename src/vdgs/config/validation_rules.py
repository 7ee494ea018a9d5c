"""What may be wrong with settings, said before any work starts. Only the standard library is imported."""

from __future__ import annotations

from vdgs.config.method import DensifyConfig, MethodConfig, ResolutionSchedule
from vdgs.config.ranges import find_range_errors


def validate_config(config: MethodConfig) -> list[str]:
    """What is wrong with the settings, one sentence each; empty if nothing is."""
    found = find_range_errors(config)
    training, block = config.training, config.block
    found += _validate_schedule(training.swa_fraction, training.densify, training.resolution_schedule)
    found += [
        f"block.{each}" for each in _validate_schedule(block.swa_fraction, block.densify, block.resolution_schedule)
    ]
    if block.margin == "ramp" and block.decoder == "own":
        found.append(
            "block.ring ramp needs --block.decoder frozen: a decoder that moves changes anchors that should stay"
        )
    if config.merge.rule == "max-visibility" and block.margin == "frozen":
        found.append("merge.rule best_seen needs --block.margin ramp or free: a frozen ring has nothing to offer")
    return found


def _validate_schedule(average: float, growth: DensifyConfig, resolutions: ResolutionSchedule) -> list[str]:
    """What does not fit together in the course of a training."""
    return _validate_resolutions(resolutions) + _validate_average(average, growth, resolutions)


def _validate_resolutions(resolutions: ResolutionSchedule) -> list[str]:
    found = []
    if not resolutions or resolutions[0][0] != 0.0:
        found.append("resolutions must begin at share 0.0")
    if [share for share, _ in resolutions] != sorted({share for share, _ in resolutions}):
        found.append("resolutions: shares must ascend")
    return found


def _validate_average(average: float, growth: DensifyConfig, resolutions: ResolutionSchedule) -> list[str]:
    if not 0 < average < 1:
        return []
    if growth.stop_fraction >= 1:
        return ["average needs growth and pruning to end: growth.until must be below 1"]
    if resolutions and resolutions[-1][0] > max(1 - average, growth.stop_fraction):
        return ["average would mix models of several image sizes: let the last of resolutions begin before it"]
    return []
