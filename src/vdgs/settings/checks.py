"""What may be wrong with settings, said before any work starts. Only the standard library is imported."""

from __future__ import annotations

import dataclasses

from vdgs.settings.method import CompensationConfig, GrowthConfig, MethodConfig, TrainConfig


def validate(config: MethodConfig) -> list[str]:
    """What is wrong with the settings, one sentence each; empty if nothing is."""
    problems = _validate_training(config.training)
    block = config.block
    problems += [f"block.{each}" for each in _validate_growth(block.growth)]
    problems += [f"block.{each}" for each in _validate_resolutions(block.resolutions)]
    problems += [f"block.{each}" for each in _validate_early(block.early)]
    problems += [f"block.{each}" for each in _validate_compensation(block.compensation)]
    if block.iterations < 0 or block.scale_iterations <= 0:
        problems.append("block.iterations must not be negative and block.scale_iterations must be positive")
    if min(block.offset_rate, block.scale_rate, block.feature_rate) <= 0:
        problems.append("block.offset_rate, block.scale_rate and block.feature_rate must be positive")
    problems += [f"block.{each}" for each in _validate_average(block.average, block.growth, block.resolutions)]
    if block.max_anchors_total < 0:
        problems.append("block.max_anchors_total must not be negative; 0 is no limit")
    if config.partition.blocks != "auto" and config.partition.blocks < 1:
        problems.append(f"blocks is {config.partition.blocks}; it must be at least 1, or auto")
    if min(config.partition.lambda_vis, config.partition.expansion) < 0 or config.partition.block_memory_gb <= 0:
        problems.append("lambda_vis and expansion must not be negative, and block_memory_gb must be positive")
    assignment = config.assignment
    if not (0 <= assignment.threshold <= 1 and 0 <= assignment.threshold_leave_one_out <= 1):
        problems.append("assignment.threshold and assignment.threshold_leave_one_out lie between 0 and 1")
    if assignment.tau <= 0 or assignment.min_cameras < 0 or assignment.longest_side_px < 16:
        problems.append(
            "assignment.tau must be positive, assignment.min_cameras not negative, "
            "assignment.longest_side_px at least 16"
        )
    if block.ring == "ramp" and block.decoder == "own":
        problems.append(
            "block.ring ramp needs --block.decoder frozen: a decoder that moves changes anchors that should stay"
        )
    if config.merge.rule == "best_seen" and block.ring == "frozen":
        problems.append("merge.rule best_seen needs --block.ring ramp or free: a frozen ring has nothing to offer")
    return problems


def _validate_compensation(config: CompensationConfig) -> list[str]:
    if not (0 <= config.t_low <= 1 and 0 <= config.t_low_quantile < 1 and 0 <= config.gamma <= 1):
        return ["compensation.t_low, t_low_quantile and gamma lie between 0 and 1"]
    if config.beta_g < 0 or config.cap < 0:
        return ["compensation.beta_g and cap must not be negative"]
    return []


def _validate_early(early: float) -> list[str]:
    return [] if early >= 1 else [f"early is {early}; it must be at least 1, which is Adam as it is"]


def _validate_growth(growth: GrowthConfig) -> list[str]:
    problems = []
    if growth.coarsest_cell <= 0 or growth.threshold < 0:
        problems.append("growth.coarsest_cell must be positive and growth.threshold not negative")
    if growth.interval < 1 or growth.levels < 0:
        problems.append("growth.interval must be at least 1 and growth.levels at least 0")
    return problems


def _validate_resolutions(resolutions: tuple[tuple[float, int], ...]) -> list[str]:
    problems = []
    if not resolutions or resolutions[0][0] != 0.0:
        problems.append("resolutions must begin at share 0.0")
    if any(factor < 1 for _, factor in resolutions):
        problems.append("resolutions: factors are whole numbers of at least 1")
    if [share for share, _ in resolutions] != sorted({share for share, _ in resolutions}):
        problems.append("resolutions: shares must ascend")
    return problems


def _validate_average(average: float, growth: GrowthConfig, resolutions: tuple[tuple[float, int], ...]) -> list[str]:
    if not 0 <= average < 1:
        return [f"average is {average}; it is a share, 0 or more and below 1"]
    if average and growth.until >= 1:
        return ["average needs growth and pruning to end: growth.until must be below 1"]
    if average and resolutions and resolutions[-1][0] > max(1 - average, growth.until):
        return ["average would mix models of several image sizes: let the last of resolutions begin before it"]
    return []


def _validate_training(config: TrainConfig) -> list[str]:
    problems = _validate_growth(config.growth) + _validate_resolutions(config.resolutions)
    problems += _validate_compensation(config.compensation) + _validate_average(
        config.average, config.growth, config.resolutions
    )
    if config.seed < 0 or config.anchors.appearance < 0 or config.anchors.voxel < 0:
        problems.append("seed, anchors.appearance and anchors.voxel must not be negative")
    if 0 < config.anchors.outlier_distance < 2:
        problems.append("anchors.outlier_distance below 2 would drop ordinary points; give more, or 0 to keep all")
    if config.iterations < 0:
        problems.append(f"iterations is {config.iterations}; it must be at least 1, or 0 for automatic")
    if not 1 <= config.anchors.offsets <= 32:
        problems.append(f"anchors.offsets is {config.anchors.offsets}; 1 to 32 are possible")
    if not 0.0 <= config.loss.ssim_weight <= 1.0:
        problems.append(f"loss.ssim_weight is {config.loss.ssim_weight}; it lies between 0 and 1")
    if config.loss.alpha_weight < 0:
        problems.append(f"loss.alpha_weight is {config.loss.alpha_weight}; it must not be negative, and 0 is without")
    problems += _validate_early(config.early)
    for rate in dataclasses.fields(config.rates):
        if min(getattr(config.rates, rate.name)) <= 0:
            problems.append(f"rates.{rate.name} must be positive")
    return problems
