"""Every setting of training, with its meaning, its default and where that comes from.

Only the standard library is imported here, so that the command line can show the settings at once.
The defaults are the preset `default`: the paper's numbers, and our choices where it is silent and one was needed.
`presets.py` holds the others, and says which of those choices are left out in `paper`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from vdgs.config.ranges import FRACTION, MAX_COUNT, MAX_FLOAT, FlagName, Range

PartitionStrategy = Literal["visibility", "vastgaussian", "citygaussian", "dogs"]
#: From which share of the iterations on images are shrunk by which factor.
ResolutionSchedule = tuple[tuple[Annotated[float, FRACTION], Annotated[int, Range(1, 1024)]], ...]

#: More blocks than any scene is cut into.
MAX_BLOCKS = 10_000
LEARNING_RATE_RANGE = Range(0, 100, exclusive_min=True)
FACTOR_RANGE = Range(0, 1000, exclusive_min=True)


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """The anchor model (Scaffold-GS, section III-B of the paper)."""

    num_offsets: Annotated[int, Range(1, 32)] = 10
    """Gaussians per anchor (k)."""
    bound_scales: bool = True
    """No Gaussian may be longer than a quarter of the images that train it, and the unit of an anchor's offsets is
    bounded likewise: fewer floaters (choice)."""
    photograph_blur: bool = True
    """Drawn from nearer than the photographs, Gaussians stay as blurred as a pixel of these makes them: fewer needles.
    Training draws as without (choice)."""
    levels: Annotated[int, Range(0, 16)] = 1
    """Levels of anchors, drawn by the size of a pixel (Octree-GS): far views draw fewer splats. 1: none. 0: as many as
    the photographs' pixels ask for; one unless some are about three times as large as others, as in flights of several
    heights (choice)."""
    view_distance: bool = False
    """Feed the distance between camera and anchor to the decoder too (eq. 4). Experimental: not measured."""
    appearance_dim: Annotated[int, Range(0, 1024)] = 0
    """Size of the appearance embedding of each training image (color only); 0 for none. Experimental: not measured."""
    background_model: Literal["auto", "envmap", "off"] = "auto"
    """What is behind the scene. `envmap`: an environment map, colors by direction, trained in the coarse stage: sky and
    what is far away. `off`: one color. `auto`: an environment map where photographs show sky (choice)."""


@dataclass(frozen=True, kw_only=True)
class InitConfig:
    """Where anchors start, and with which features."""

    voxel_size: Annotated[float, Range(0, MAX_FLOAT)] = 0.0
    """Edge of the initial voxel grid in units of the ground frame; 0 takes the median nearest-neighbor distance of the
    sparse points."""
    outlier_distance: Annotated[float, Range(2, MAX_FLOAT, allow_zero=True)] = 30.0
    """Sparse points whose fourth neighbor is this many times farther than the median start no anchor; 0 keeps all
    (choice: points deep below the ground become a backdrop)."""
    fill_gaps: bool = True
    """Also start anchors on ground that cameras see but that holds no sparse points: woods, water, fields (choice)."""
    mvs: bool = False
    """Also start anchors at dense stereo points (semi-global matching): where few photographs look, sparse points are
    few, and anchors that start at a wrong height stay there (choice)."""
    from_colors: bool = False
    """Start the features from the colors of the sparse points instead of zeros. Experimental: not measured."""


@dataclass(frozen=True, kw_only=True)
class LearningRateConfig:
    """Learning rates of Adam; pairs decay exponentially from the first to the second value."""

    offsets: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.01, 1e-4)
    """Offsets, in the unit that `lr_offsets_unit` names."""
    features: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.0075, 0.0075)
    """Anchor features."""
    log_scales: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.007, 0.007)
    """Logarithms of the anchor scales."""
    opacity: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.002, 2e-5)
    """Opacity decoder."""
    covariance: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.004, 0.004)
    """Covariance decoder."""
    color: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.008, 5e-5)
    """Color decoder."""
    appearance: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.05, 5e-4)
    """Appearance embedding."""
    exposure: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.001, 1e-4)
    """Exposure of the photographs, where one is fitted."""
    envmap: Annotated[tuple[float, float], LEARNING_RATE_RANGE] = (0.002, 2e-4)
    """Environment map behind the scene, where there is one: plain steps in the mean gradient of the pixels that show a
    cell, in units of color."""


@dataclass(frozen=True, kw_only=True)
class DensifyConfig:
    """Where anchors are added and removed (Scaffold-GS, section 4.2 there)."""

    every: Annotated[int, Range(1, MAX_COUNT)] = 100
    """Iterations between two growth decisions."""
    stats_start: Annotated[int, Range(0, MAX_COUNT)] = 500
    """Iteration from which gradients and opacities are counted."""
    start: Annotated[int, Range(0, MAX_COUNT)] = 1500
    """Iteration from which anchors grow and are pruned."""
    stop_fraction: Annotated[float, FRACTION] = 0.5
    """Share of the iterations after which growth and pruning end."""
    grad_threshold: Annotated[float, Range(0, MAX_COUNT)] = 2e-4
    """Mean norm of dL/d(mean) in NDC units above which an offset asks for a new anchor."""
    num_levels: Annotated[int, Range(0, 16)] = 3
    """Number of cell sizes tried; level i has threshold 2^i times and cells 4^i times finer."""
    coarsest_voxels: Annotated[float, Range(0, MAX_FLOAT, exclusive_min=True)] = 16.0
    """Edge of the coarsest cell, in voxels."""
    min_draw_fraction: Annotated[float, Range(0, MAX_COUNT)] = 0.4
    """An offset is judged once it was rendered more often than this share of the interval."""
    prune_opacity: Annotated[float, Range(0, MAX_FLOAT)] = 0.005
    """An anchor goes when the opacity of its Gaussians, summed over them, averaged over the views, is below this."""
    prune_view_fraction: Annotated[float, Range(0, MAX_COUNT)] = 0.8
    """... and it was seen more often than this share of the interval."""
    max_anchors: Annotated[int, Range(0, MAX_COUNT)] = 0
    """No growth beyond this many anchors; 0 for no limit. Nothing is removed to keep to it."""


@dataclass(frozen=True, kw_only=True)
class CompensationConfig:
    """Compensated anchor growth: gradients of places that few cameras see are remembered and added (eqs. 8-10)."""

    enabled: bool = True
    """Off: plain growth (the paper's "w/o Anchor Generation")."""
    t_low: Annotated[float, FRACTION] = 0.20
    """T_low: an anchor is in the set L when fewer than this share of the cameras of a growth cycle see it."""
    t_low_quantile: Annotated[float, Range(0, 1, exclusive_max=True)] = 0.0
    """Above 0: T_low is this quantile of the shares of the anchors that a camera of the cycle sees (choice: on a large
    scene nearly every anchor is below a fixed share). Ties are in L all or none, whichever is nearer the quantile."""
    beta_g: Annotated[float, Range(0, MAX_FLOAT)] = 2.0
    """beta_g: weight of a cycle's mean gradient in the cache g. With the paper's 2, g grows to twenty times its
    gradients; with 1 - gamma (the preset `laptop`) it is a mean over cycles."""
    gamma: Annotated[float, FRACTION] = 0.9
    """gamma: decay of the cache g from cycle to cycle."""
    target: Literal["mean", "sum"] = "mean"
    """What g is added to; the paper says "the raw gradient statistics". `mean`: the mean gradient over the draws of an
    offset. `sum`: the sum before the division, so that g is divided by the draws too."""
    history: Literal["current", "past"] = "current"
    """Which cycles g holds when growth is decided; the paper does not say. `current`: the one that ends too, whose
    gradients an offset of L then counts 1 + beta_g times. `past`: earlier ones alone; the one that ends joins g after
    the decision."""
    min_draws: Literal["scaled", "paper"] = "scaled"
    """Above how many draws an offset of L is judged: `scaled` takes T_low times the gate of the others, at least 2
    (choice: within one cycle it can never pass theirs); `paper` the same as the others."""


@dataclass(frozen=True)
class LossConfig:
    """What training minimizes."""

    ssim_lambda: Annotated[float, FRACTION] = 0.2
    """Loss = (1 - w) L1 + w (1 - SSIM) + volume."""
    volume_reg: Annotated[float, Range(0, MAX_FLOAT)] = 0.01
    """Weight of the mean product of the three scales of the Gaussians that are drawn."""
    depth_agreement: Annotated[float, Range(0, MAX_FLOAT)] = 0.0
    """Weight of the mean difference between expected and median depth, in camera heights: better depth in views from
    where nobody flew, for 4 to 7 % more time: every second step counts it, twice (choice)."""
    opacity_noise: Annotated[float, Range(0, 1)] = 0.0
    """Standard deviation of the factor by which the opacity of each Gaussian is multiplied in a step: Gaussians that
    make a surface only together, spread in depth, come apart (choice)."""
    pseudo_views: Annotated[float, Range(0, MAX_FLOAT)] = 0.0
    """Weight of views that nobody photographed, nearer and more tilted than a photograph: every fourth step also draws
    one, of 0.7 of the width and height, and compares it with the photograph where depths agree. 0.3 makes views from
    where nobody flew better, for a seventh more time (choice)."""
    background: Literal["mean", "black"] = "mean"
    """Color behind the scene: the mean of the training photographs (choice), or black."""
    random_background: Annotated[float, FRACTION] = 1.0
    """Share of the background's color that is drawn at random in every step, from the RGB cube: transparent ground
    cannot borrow its color (choice; the paper does not name its background)."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Training of the coarse stage."""

    iterations: Annotated[int, Range(0, MAX_COUNT)] = 100_000
    """Steps of the coarse stage; 0: by photograph count. Each step draws one photograph; 0 takes sixty steps for each
    training photograph, at least 3000 and at most 30 000 (choice: with few photographs a model overfits soon)."""
    view_sampling: Literal["uniform", "visibility", "sqrt-visibility"] = "uniform"
    """How often each photograph is used. `uniform`: all alike (the paper). `visibility`: every anchor divides one vote
    among the cameras that see it, and photographs are used in proportion to their votes. `sqrt-visibility`: in
    proportion to the square root of their votes, which keeps more photographs in use (choice). In the coarse stage all
    but `uniform` are experimental: they gained nothing in our trials."""
    resolution_schedule: ResolutionSchedule = ((0.0, 1),)
    """Resolution schedule: from this share of the iterations on, images are shrunk by this factor."""
    oblique_sampling: Annotated[float, Range(1, 1000)] = 1.0
    """How many times as often photographs are used that look more than 25 degrees from straight down, here and in
    blocks; together at most as often as the others. They alone show facades (choice)."""
    swa_fraction: Annotated[float, Range(0, 1, exclusive_max=True)] = 0.0
    """The stage ends with the mean of the models of this last share of its iterations, after growth and at full size; 0
    for the very last model (choice)."""
    optimizer: Literal["sparse-adam", "adam"] = "sparse-adam"
    """Which anchors a step moves, here and in blocks. `sparse-adam`: those that its photograph shows; the others keep
    parameters and moments (choice). `adam`: all, as in Scaffold-GS and 3DGS: others continue along their moments, and
    the bias correction counts the steps of the stage."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Everything random follows from it. On the CPU the same seed gives the same bits."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """The anchor model."""
    init: InitConfig = field(default_factory=InitConfig)
    """Where anchors start."""
    lr: LearningRateConfig = field(default_factory=LearningRateConfig)
    """Learning rates."""
    lr_offsets_unit: Literal["anchor", "cameras"] = "anchor"
    """Unit of the rates of offsets. `anchor`: the scale of the anchor, to which offsets relate (choice). `cameras`:
    times the radius of the training cameras in the capture's own units, as Scaffold-GS has it."""
    lr_warm_boost: Annotated[float, Range(1, 1000)] = 1.0
    """Up to how many times faster an anchor moves while it has had few updates: after u of them, by the least of this
    and 1 / sqrt(1 - 0.999^u), which is 3 after 118 updates and 1.3 after 900 (choice, for short trainings; 1: Adam)."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    """Growth and pruning of anchors."""
    loss: LossConfig = field(default_factory=LossConfig)
    """The loss."""
    exposure_compensation: bool = False
    """Fit an affine color model to each photograph. The scene is drawn in neutral colors (--merge.reference-exposure),
    and compared with a test photograph in the exposure predicted from the training photographs taken before and after
    it and from its metadata (no pixel of it is used). Blocks keep the models (choice)."""
    exposure_min_spread: Annotated[float, Range(0, 1)] = 0.0
    """Fit exposures only where photographs of the same sparse points differ in brightness by at least this share
    (choice: with one exposure, fitting gains nothing). At 0, and in a capture without tracks, always fitted."""
    compensation: CompensationConfig = field(default_factory=lambda: CompensationConfig(enabled=False))
    """Compensated growth already in this stage (choice: only blocks have it; the ablation without blocks needs it)."""


@dataclass(frozen=True, kw_only=True)
class PartitionConfig:
    """How the scene is cut into blocks (eq. 5 and what follows it)."""

    strategy: PartitionStrategy = "visibility"
    """How blocks are cut. `visibility`: by position and visibility (the paper). The others are published methods for
    comparison, which also assign cameras in their own way, whatever the settings of the assignment."""
    blocks: Annotated[int | Literal["auto"], Range(1, MAX_BLOCKS)] = 8
    """Number of blocks (K); `auto`: by memory. 1 is the whole scene (the paper's "w/o Blocking"); `auto`
    takes as few as --block-memory-gb allows."""
    lambda_vis: Annotated[float, Range(0, 1000)] = 1.0
    """Weight of visibility beside place in the clustering. lambda_vis; paper: 0.7 to 1.3; 0 is purely spatial."""
    balanced: bool = False
    """Blocks of about equally many anchors. Choice: plain k-means leaves them several times apart. Experimental: no
    table has it."""
    cluster_axes: Literal["principal", "ground"] = "principal"
    """Axes along which positions are normalized. `principal`: those of the anchors, so that the cut turns with the
    scene (choice). `ground`: x and y of the ground frame, as printed."""
    cluster_scale: Literal["axis", "common"] = "axis"
    """Unit of normalized positions; the paper says "normalized". `axis`: the extent along each axis, so that both run
    from 0 to 1. `common`: the larger extent for both, so that distances are as on the ground."""
    cluster_clip: Annotated[float, Range(0, 0.5, exclusive_max=True)] = 0.01
    """Positions are normalized between this quantile and its opposite, and clipped; 0: between the outermost anchors
    (choice: outliers would squash the scene; the paper says "normalized")."""
    cluster_smoothing: Annotated[float, Range(0, 100)] = 1.5
    """Components are sought where a cluster is the strongest within about so many cells; 0: over its own cells. At 0
    all cells that hold an anchor of the cluster count, as printed (choice: clusters that mix have ragged borders)."""
    min_block_share: Annotated[float, FRACTION] = 0.05
    """A block that owns less than this share of an average one is left out; 0: one that owns none. Its anchors join the
    blocks around it (choice)."""
    expansion: Annotated[float, Range(0, 1000)] = 0.4
    """Share of its radius by which a block is widened. The radius is that of a disc of its area. With a frozen margin
    (the default) that only decides what is drawn when cameras are assigned."""
    block_memory_gb: Annotated[float, Range(0, MAX_FLOAT, exclusive_min=True)] = 4.0
    """Memory of an average block, for `--blocks auto`. By estimate, in training, beside cached
    photographs. All take more where more blocks would have too few photographs (fifty) each."""


@dataclass(frozen=True, kw_only=True)
class AssignmentConfig:
    """Which cameras train which block (eqs. 6-7)."""

    mode: Literal["coverage", "paper", "leave-one-out", "frustum"] = "coverage"
    """How cameras are scored. `coverage`: share of the drawn pixels that the block alone draws alike (choice). `paper`:
    eq. 7 as printed, where pixels empty in both renders count too. `leave-one-out`: 1 - SSIM of the scene without the
    block (experimental: gained nothing in our tables). `frustum`: share of the block's anchors that the camera holds
    (needs no renders)."""
    tau: Annotated[float, Range(0, 1, exclusive_min=True)] = 0.05
    """tau: pixels differ when the mean absolute difference of their channels is above this (choice)."""
    threshold: Annotated[float, FRACTION] = 0.45
    """Share of pixels above which a camera is assigned. For `frustum`: of anchors."""
    threshold_leave_one_out: Annotated[float, FRACTION] = 0.05
    """The same for `leave-one-out` (peers: 0.05 to 0.12)."""
    always_best: bool = True
    """Every camera also joins its best block (choice: else one that is above the threshold nowhere trains nothing)."""
    min_cameras: Annotated[int, Range(0, MAX_COUNT)] = 100
    """Each block gets at least this many cameras; 0: no minimum. As far as any show it (choice)."""
    image_size: Annotated[int, Range(16, 16_384)] = 320
    """Size at which the renders are compared."""


@dataclass(frozen=True, kw_only=True)
class BlockConfig:
    """Training of each block from the coarse anchors of its place. Loss and seed are those of the coarse stage."""

    iterations: Annotated[int, Range(0, MAX_COUNT)] = 50_000
    """Steps for each block; 0: by its photograph count. 0 takes fifteen for each of them, at least 500 and at
    most 15 000 (choice)."""
    steps_scaler: Annotated[float, Range(0, 1000, exclusive_min=True)] = 1.0
    """Factor on the steps and on the start of statistics and growth, for scenes smaller than the paper's."""
    view_sampling: Literal["uniform", "visibility", "sqrt-visibility"] = "uniform"
    """As in the coarse stage, by the votes of the anchors that the block moves."""
    resolution_schedule: ResolutionSchedule = ((0.0, 1),)
    """Resolution schedule, as in the coarse stage."""
    swa_fraction: Annotated[float, Range(0, 1, exclusive_max=True)] = 0.0
    """As in the coarse stage."""
    crop: Literal["off", "fixed-steps", "fixed-pixels"] = "off"
    """Draw only the part of each photograph that shows the block, and all of it in every fifth step. `fixed-steps`:
    each step costs less (experimental: no table has it); `fixed-pixels`: as many pixels are drawn as without, in up to
    four times more steps; `iterations` then counts whole photographs (choice)."""
    lr_scale_offsets: Annotated[float, FACTOR_RANGE] = 1.0
    """The rates of the coarse stage start again, those of offsets times this (CityGaussian: 0.4)."""
    lr_scale_log_scales: Annotated[float, FACTOR_RANGE] = 1.0
    """... and those of log-scales times this (CityGaussian: 0.8)."""
    lr_scale_features: Annotated[float, FACTOR_RANGE] = 1.0
    """... and those of features times this."""
    random_background: Annotated[float, FRACTION] = 1.0
    """As in the loss of the coarse stage (choice: at 0 blocks make opaque ground transparent)."""
    decoder: Literal["frozen", "own"] = "frozen"
    """`frozen`: that of the coarse stage (the paper). `own`: each block trains a copy, which its anchors keep in the
    merged scene (choice: with a frozen decoder blocks overfit sooner where few cameras see them)."""
    margin: Literal["frozen", "ramp", "free"] = "frozen"
    """Anchors between core and widened boundary: `frozen` are drawn and never move (choice for "gradients at the
    boundary are suppressed"); `ramp`: their learning rate falls linearly to zero at the widened boundary; `free`
    move as those of the core (experimental: gained nothing in our tables)."""
    draw_outside: bool = True
    """Draw the anchors outside the block too, frozen (choice). Off: what the block's cameras see there is empty."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    """Growth and pruning of anchors, by default as in the coarse stage: the paper says nothing else."""
    mask_moving: Literal["auto", "on", "off"] = "auto"
    """Leave out what moves between the photographs. It is found by the coarse model after its training, and left out of
    the blocks and of the detail of maps. auto: where a sample of the photographs shows enough that moves
    (docs/sfm.md)."""
    max_anchors_total: Annotated[int, Range(0, MAX_COUNT)] = 0
    """The same for all blocks together; 0 for no limit. Each block has a share in proportion
    to the coarse anchors it owns. No anchor is removed: a block that starts with more grows none."""
    compensation: CompensationConfig = field(default_factory=CompensationConfig)
    """Compensated growth (eqs. 8-10)."""


@dataclass(frozen=True)
class MergeConfig:
    """How trained blocks become one scene."""

    rule: Literal["owner", "max-visibility"] = "owner"
    """Whose anchors stay at a position: `owner`: those of the block with the nearest core. `max-visibility`: those of
    the block whose cameras see it most, among those that reach it (needs --block.margin ramp or free)."""
    reference_exposure: Literal["local", "global"] = "local"
    """The exposure of pictures, maps and files of a scene, where exposures were fitted: `local`: the mean of the
    photographs that show a place, which changes smoothly; `global`: one for all. `vdgs merge RUN --reference-exposure`
    changes it without training. The coarse model always has `local`."""


@dataclass(frozen=True)
class MethodConfig:
    """Everything that the result of a run depends on, but for the capture."""

    training: Annotated[TrainConfig, FlagName("")] = field(default_factory=TrainConfig)
    """The coarse stage."""
    partition: Annotated[PartitionConfig, FlagName("")] = field(default_factory=PartitionConfig)
    """The cut into blocks."""
    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)
    """Cameras of each block."""
    block: BlockConfig = field(default_factory=BlockConfig)
    """Block training."""
    merge: MergeConfig = field(default_factory=MergeConfig)
    """The merge."""


#: How `iterations = 0` follows from the number of training photographs: steps for each, least, most.
AUTO_COARSE_ITERATIONS, AUTO_BLOCK_ITERATIONS = (60, 3_000, 30_000), (15, 500, 15_000)


def resolve_iterations(config: TrainConfig, num_views: int) -> TrainConfig:
    """The settings with `iterations = 0` replaced by what the number of training photographs asks for."""
    return replace(config, iterations=config.iterations or _steps(num_views, *AUTO_COARSE_ITERATIONS))


def max_block_anchors(config: BlockConfig, num_anchors: int, total_anchors: int) -> int:
    """Up to how many anchors a block may grow that owns `num_anchors` of all coarse anchors; 0 for no limit. Shares are
    rounded down, so that their sum is at most the total, but at least 1, since 0 means no limit."""
    share = max(1, config.max_anchors_total * num_anchors // total_anchors) if config.max_anchors_total else 0
    limits = [limit for limit in (config.densify.max_anchors, share) if limit]
    return min(limits, default=0)


def block_train_config(config: MethodConfig, num_views: int) -> TrainConfig:
    """The settings of the training loop for one block with so many photographs."""
    block, scale = config.block, config.block.steps_scaler
    rates = config.training.lr
    factors = {name: getattr(block, f"lr_scale_{name}") for name in ("offsets", "log_scales", "features")}
    scaled = {name: (f * getattr(rates, name)[0], f * getattr(rates, name)[1]) for name, f in factors.items()}
    return replace(
        config.training,
        iterations=max(1, round(scale * (block.iterations or _steps(num_views, *AUTO_BLOCK_ITERATIONS)))),
        view_sampling=block.view_sampling,
        swa_fraction=block.swa_fraction,
        lr_warm_boost=1.0,  # anchors of a block begin trained: in no table did a boost help them
        resolution_schedule=block.resolution_schedule,
        lr=replace(rates, **scaled),
        densify=replace(
            block.densify,
            stats_start=round(scale * block.densify.stats_start),
            start=scaled_growth_start(block.densify, scale),
        ),
        loss=replace(config.training.loss, random_background=block.random_background),
        compensation=block.compensation,
    )


def scaled_growth_start(growth: DensifyConfig, scale: float) -> int:
    """Where growth begins in a training of `scale` times as many steps. A start right behind a decision leaves that
    decision out, and so does the scaled one (preset `paper`)."""
    behind = growth.start % growth.every == 1
    return round(scale * (growth.start - behind)) + behind


def _steps(views: int, per_view: int, least: int, most: int) -> int:
    return min(max(per_view * views, least), most)
