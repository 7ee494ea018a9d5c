"""What methods change about the settings of the full method: a function from settings to settings for each.

All but 3DGS share the anchor model, the loss and the block training of this package.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from experiments.bench.definitions import Budget, ConfigOverride, scaled_growth
from vdgs.config.method import CompensationConfig, MergeConfig, MethodConfig, PartitionStrategy
from vdgs.config.presets import PRESETS, PresetName

#: So many cameras has each block of the factorial: every camera joins its best block, and each block is topped up to
#: these. With as few as one block's share (160) the cameras of the least seen places join none: the dense ones show
#: more of a block. What was left out, more than how it was cut, then made the difference (reports/findings.md).
FACTORIAL_CAMERAS = 256


def full_method(config: MethodConfig, _budget: Budget) -> MethodConfig:
    return config


def coarse_only(config: MethodConfig, budget: Budget) -> MethodConfig:
    """All iterations in the coarse stage."""
    return replace(config, training=replace(config.training, iterations=budget.total))


def coarse_only_averaged(config: MethodConfig, budget: Budget) -> MethodConfig:
    """All iterations in the coarse stage, which ends with a mean of models as blocks do."""
    alone = coarse_only(config, budget)
    return replace(alone, training=replace(alone.training, swa_fraction=config.block.swa_fraction))


def coarse_same_iterations(config: MethodConfig, budget: Budget) -> MethodConfig:
    """The coarse stage as long as one process takes when every block has its own: coarse + one block's iterations."""
    return replace(config, training=replace(config.training, iterations=budget.coarse + budget.per_block))


def without_blocking(config: MethodConfig, budget: Budget) -> MethodConfig:
    """One block of the whole scene, trained as long as all blocks together, with compensated growth."""
    one = budget.shared_by(1)
    return replace(
        config,
        partition=replace(config.partition, blocks=1),
        block=replace(config.block, iterations=one.per_block),
    )


def without_blocking_same_time(config: MethodConfig, budget: Budget) -> MethodConfig:
    """One block of the whole scene, trained as long as one of several: as much time, if those are trained at once."""
    one = without_blocking(config, budget)
    return replace(one, block=replace(one.block, iterations=budget.per_block))


def without_compensation(config: MethodConfig, _budget: Budget) -> MethodConfig:
    """Blocks grow anchors as the coarse stage does."""
    return enable_compensation(config, enabled=False)


def disable_compensation(change: ConfigOverride) -> ConfigOverride:
    """A method without compensated growth."""
    return lambda config, budget: without_compensation(change(config, budget), budget)


def as_in_paper(config: MethodConfig, _budget: Budget) -> MethodConfig:
    """What the paper says of blocks, in place of the preset's own choices: frozen decoder, every photograph used alike
    and at its full size, the coarse stage's rates again, the last model and no mean, cameras above a share of 0.45, its
    compensation. Where it is silent, as the preset `default`. In both stages no pseudo views and no loss of depths."""
    plain, scene = MethodConfig(), config.block
    return replace(
        config,
        training=replace(config.training, loss=plain.training.loss, oblique_sampling=plain.training.oblique_sampling),
        assignment=replace(config.assignment, threshold=plain.assignment.threshold),
        block=replace(
            plain.block,
            iterations=scene.iterations,
            steps_scaler=scene.steps_scaler,
            densify=scene.densify,
            max_anchors_total=scene.max_anchors_total,
        ),
    )


def as_preset(name: PresetName) -> ConfigOverride:
    """A preset as it is, with the scene's iterations, blocks and limit of anchors. Growth begins at the same share of
    the iterations as in the preset's own."""

    def change(config: MethodConfig, budget: Budget) -> MethodConfig:
        preset = PRESETS[name]
        training, block = preset.training, preset.block
        grown = scaled_growth(training.densify, budget.coarse, budget.coarse / training.iterations)
        grown = replace(grown, max_anchors=config.training.densify.max_anchors)
        inner = scaled_growth(block.densify, budget.per_block, budget.per_block / block.iterations)
        return replace(
            preset,
            training=replace(training, iterations=budget.coarse, seed=config.training.seed, densify=grown),
            partition=replace(preset.partition, blocks=budget.blocks),
            block=replace(block, iterations=budget.per_block, densify=inner,
                          max_anchors_total=config.block.max_anchors_total),
        )  # fmt: skip

    return change


def in_preset_paper(change: ConfigOverride) -> ConfigOverride:
    """A change of the preset `paper`."""
    return lambda config, budget: change(as_preset("paper")(config, budget), budget)


def crossed_cell(lambda_vis: float, compensated: bool) -> ConfigOverride:
    """The preset `paper`, cut by visibility or by place alone, grown with compensation or plainly."""
    cut = in_preset_paper(with_lambda_vis(lambda_vis))
    return lambda config, budget: enable_compensation(cut(config, budget), enabled=compensated)


def with_paper_compensation(config: MethodConfig, **values: float) -> MethodConfig:
    """The paper's compensation, with other values where they are given."""
    printed = replace(CompensationConfig(), **values)  # type: ignore[arg-type]
    return replace(config, block=replace(config.block, compensation=printed))


def with_full_images(change: ConfigOverride) -> ConfigOverride:
    """A method whose blocks draw whole photographs, so that each makes exactly as many iterations."""
    return lambda config, budget: change(replace(config, block=replace(config.block, crop="off")), budget)


def with_summed_compensation(config: MethodConfig, _budget: Budget) -> MethodConfig:
    """The paper's compensation, added to the sums of gradients and not to their means."""
    printed = with_paper_compensation(config)
    return enable_compensation(printed, target="sum")


def with_dense_adam(change: ConfigOverride) -> ConfigOverride:
    """A method whose Adam moves all anchors in every step, as Scaffold-GS and 3DGS do."""

    def dense(config: MethodConfig, budget: Budget) -> MethodConfig:
        changed = change(config, budget)
        return replace(changed, training=replace(changed.training, optimizer="adam"))

    return dense


def with_max_visibility_merge(change: ConfigOverride) -> ConfigOverride:
    """Blocks merged by which of them sees a place most (the paper: "based on visibility coverage")."""
    return lambda config, budget: replace(change(config, budget), merge=MergeConfig(rule="max-visibility"))


def with_longer_blocks(factor: int) -> ConfigOverride:
    """Blocks that train so many times as long."""
    return lambda config, budget: replace(config, block=replace(config.block, iterations=factor * budget.per_block))


def with_block(**values: object) -> ConfigOverride:
    """The full method with other settings of block training."""
    return lambda config, _: replace(config, block=replace(config.block, **values))  # type: ignore[arg-type]


def with_assignment(**values: object) -> ConfigOverride:
    """The full method with other settings of the assignment of cameras."""
    return lambda config, _: replace(config, assignment=replace(config.assignment, **values))  # type: ignore[arg-type]


def with_block_count(count: int) -> ConfigOverride:
    """The same total of block iterations shared by `count` blocks."""

    def change(config: MethodConfig, budget: Budget) -> MethodConfig:
        if count == 1:
            return without_blocking(config, budget)
        return replace(
            config,
            partition=replace(config.partition, blocks=count),
            block=replace(config.block, iterations=budget.shared_by(count).per_block),
        )

    return change


def with_more_blocks(factor: float) -> ConfigOverride:
    """`factor` times as many blocks, each of which trains as long as one of the full method."""
    return lambda config, budget: replace(
        config, partition=replace(config.partition, blocks=max(1, round(factor * budget.blocks)))
    )


def coarse_with_compensation(compensation: CompensationConfig) -> ConfigOverride:
    """The coarse stage alone, grown with compensation (the paper's Table III counts one block so)."""

    def change(config: MethodConfig, _budget: Budget) -> MethodConfig:
        return replace(config, training=replace(config.training, compensation=compensation))

    return change


def factorial_cell(lambda_vis: float, target: Literal["mean", "sum"] | None, t_low: float) -> ConfigOverride:
    """One cell of the factorial: all blocks have equally many cameras, and all of compensation but `target` and T_low
    is the paper's."""

    def change(config: MethodConfig, budget: Budget) -> MethodConfig:
        printed = with_paper_compensation(with_lambda_vis(lambda_vis)(config, budget), t_low=t_low)
        equal = replace(printed.assignment, threshold=1.0, min_cameras=FACTORIAL_CAMERAS)
        changed = replace(printed, assignment=equal)
        if target is None:
            return enable_compensation(changed, enabled=False)
        return enable_compensation(changed, target=target)

    return change


def with_lower_threshold(change: ConfigOverride, factor: float) -> ConfigOverride:
    """A method whose blocks grow at `factor` times the threshold: where it is below 1, more anchors than plain growth,
    and so a measure of whether compensation is more than that."""

    def grown(config: MethodConfig, budget: Budget) -> MethodConfig:
        changed = change(config, budget)
        growth = replace(changed.block.densify, grad_threshold=factor * changed.block.densify.grad_threshold)
        return replace(changed, block=replace(changed.block, densify=growth))

    return grown


def coarse_with_lower_threshold(factor: float) -> ConfigOverride:
    """The coarse stage alone, plainly grown at `factor` times the threshold."""

    def change(config: MethodConfig, _budget: Budget) -> MethodConfig:
        growth = replace(config.training.densify, grad_threshold=factor * config.training.densify.grad_threshold)
        return replace(config, training=replace(config.training, densify=growth))

    return change


def with_lambda_vis(value: float) -> ConfigOverride:
    return lambda config, _: replace(config, partition=replace(config.partition, lambda_vis=value))


def with_t_low(value: float) -> ConfigOverride:
    """A fixed T_low, as in the paper: never the quantile that the preset `laptop` takes instead."""
    return lambda config, _: with_paper_compensation(config, t_low=value)


def with_beta_g(value: float) -> ConfigOverride:
    return lambda config, _: with_paper_compensation(config, beta_g=value)


def with_gamma(value: float) -> ConfigOverride:
    return lambda config, _: with_paper_compensation(config, gamma=value)


def with_paper_gate(config: MethodConfig, _budget: Budget) -> MethodConfig:
    """Offsets of low visibility are judged after as many draws as the others."""
    return enable_compensation(config, min_draws="paper")


def with_partition_strategy(strategy: PartitionStrategy) -> ConfigOverride:
    """Another partition; growth is plain, since compensation is what VDGS adds."""

    def change(config: MethodConfig, budget: Budget) -> MethodConfig:
        plain = without_compensation(config, budget)
        return replace(plain, partition=replace(plain.partition, strategy=strategy))

    return change


def momentum_blocks(config: MethodConfig, budget: Budget) -> MethodConfig:
    """Momentum-GS: blocks of CityGaussian's cut, of which each moves the one decoder, from the coarse stage of
    Scaffold-GS; whole photographs used alike, the coarse stage's rates again, the last model."""
    cut = with_partition_strategy("citygaussian")(as_in_paper(config, budget), budget)
    shared = replace(cut, block=replace(cut.block, decoder="own"))
    return with_dense_adam(lambda changed, _: changed)(shared, budget)


def explicit_gaussians(background: Literal["mean", "black"]) -> ConfigOverride:
    """3DGS, by what it has in common with our coarse stage: iterations, seed, background and the limit of anchors
    (`baseline_stages.gs3d_config` makes its settings of these)."""

    def change(config: MethodConfig, budget: Budget) -> MethodConfig:
        alone = coarse_only(config, budget)
        loss = replace(alone.training.loss, background=background)
        return replace(alone, training=replace(alone.training, loss=loss))

    return change


def gaussians_in_blocks(config: MethodConfig, budget: Budget) -> MethodConfig:
    """Explicit Gaussians in blocks, after a coarse stage that is one of explicit Gaussians too."""
    return replace(config, training=replace(config.training, loss=replace(config.training.loss, background="mean")))


def gaussian_blocks_alone(config: MethodConfig, budget: Budget) -> MethodConfig:
    """Explicit Gaussians in blocks that share all iterations: nothing is trained before them."""
    alone = gaussians_in_blocks(config, budget)
    return replace(alone, block=replace(alone.block, iterations=max(1, round(budget.total / budget.blocks))))


def enable_compensation(config: MethodConfig, **values: float | bool | str) -> MethodConfig:
    changed: CompensationConfig = replace(config.block.compensation, **values)  # type: ignore[arg-type]
    return replace(config, block=replace(config.block, compensation=changed))
