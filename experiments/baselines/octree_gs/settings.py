"""The published settings of Scaffold-GS and Octree-GS, their schedules in proportion to the iterations.

"program": the authors' published programs say what the papers leave open. Both differ from them in this:

- the voxel of automatic starts is the root of the median squared distance to three neighbors; the programs leave out
  the root, so that their voxel depends on the unit of the capture;
- growth begins at the published share of the iterations but decides every 100 iterations whatever their number, since
  its statistics need so many views;
- an anchor goes by the sum of its opacities over the number of views whose picture holds its center; the programs
  count every view that may draw it;
- finer cells are tried also where coarser ones added nothing, where that of Scaffold-GS goes on to the next;
- the random numbers (first weights, views, which offsets are kept) are this package's;
- image formation is that of this project (docs/conventions.md), for all methods alike.

Of Octree-GS besides:

- the cell of the level that is in the middle is that voxel, where the program has 0.02 units of the capture; cells are
  centered on multiples of their size, as in Scaffold-GS, not counted from a corner of the scene;
- the distance to an anchor is that to its place, without the half cell that the program adds;
- a cell gets no second anchor of its level: the program looks for those of the parent's level alone;
- finer levels are grown once all levels are open, as the program says it means to (its test is always true), and the
  bias of an anchor grows once a decision, by the threshold of its own level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from vdgs.config.method import DensifyConfig, InitConfig, LossConfig, ModelConfig, TrainConfig

#: Iterations that the schedules were published for.
SCAFFOLD_ITERATIONS, OCTREE_ITERATIONS = 30_000, 40_000
#: Branches of the octree in each direction.
FORK = 2.0


@dataclass(frozen=True, kw_only=True)
class OctreeConfig:
    """Settings of both methods; one level is Scaffold-GS."""

    training: TrainConfig
    #: Number of levels; 0: by the distances of the cameras (Octree-GS section 4.2).
    levels: int = 0
    #: A view shows anchors of at most the level that their distance asks for: the nearest one, or rounded down.
    round_down: bool = False
    #: Quantile of the distances, and one minus it, that say how many levels there are (program).
    distance_quantile: float = 0.999
    #: The threshold of growth rises by 2 to this power from level to level (beta in its eq. for growth; program).
    threshold_power: float = 0.2
    #: Share of an anchor's threshold from which its bias grows, and by how much (program).
    bias_threshold: float = 0.25
    bias_step: float = 0.01
    #: Share of the iterations in which levels are opened one after another, each interval shorter by this factor
    #: (its section on progressive training; program: 10 000 of 40 000).
    progressive_share: float = 0.25
    progressive_factor: float = 1.5
    #: Largest log-scale of Gaussians after a decision, in units of the capture (program).
    max_log_scale: float = 0.05


def scaffold_config(iterations: int, seed: int = 0, max_anchors: int = 0) -> OctreeConfig:
    """Scaffold-GS: everything as its program has it (but for the list above), whatever this package's presets are."""
    growth = _growth(iterations, SCAFFOLD_ITERATIONS, stop=15_000, max_anchors=max_anchors)
    return OctreeConfig(training=_training(iterations, seed, growth), levels=1)


def octree_config(iterations: int, seed: int = 0, max_anchors: int = 0) -> OctreeConfig:
    """Octree-GS on Scaffold-GS."""
    growth = _growth(iterations, OCTREE_ITERATIONS, stop=25_000, max_anchors=max_anchors)
    return OctreeConfig(training=_training(iterations, seed, growth))


def _growth(iterations: int, published: int, *, stop: int, max_anchors: int) -> DensifyConfig:
    """The published growth: statistics after 500, decisions after 1500 and before `stop` of the published number."""
    share = iterations / published
    return replace(
        DensifyConfig(), every=100, stats_start=round(500 * share), start=round(1500 * share) + 1,
        stop_fraction=max(0.0, (round(stop * share) - 1) / iterations), grad_threshold=2e-4, num_levels=3,
        coarsest_voxels=16.0, min_draw_fraction=0.4, prune_opacity=0.005, prune_view_fraction=0.8,
        max_anchors=max_anchors,
    )  # fmt: skip


def _training(iterations: int, seed: int, growth: DensifyConfig) -> TrainConfig:
    """Dense Adam, black background, starts at sparse points alone; learning rates are the defaults of `TrainConfig`,
    which are those of Scaffold-GS, with the offsets' in units of the cameras' radius."""
    return TrainConfig(
        iterations=iterations, seed=seed, optimizer="adam", lr_offsets_unit="cameras", densify=growth,
        model=ModelConfig(
            num_offsets=10, bound_scales=False, photograph_blur=False, view_distance=False, appearance_dim=0
        ),
        init=InitConfig(outlier_distance=0.0, fill_gaps=False, mvs=False, from_colors=False),
        loss=LossConfig(ssim_lambda=0.2, volume_reg=0.01, background="black", random_background=0.0),
    )  # fmt: skip
