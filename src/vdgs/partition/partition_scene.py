"""The scene cut into blocks (section IV-B, fig. 4): clusters, boundaries, and how many blocks there should be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float, Int

from vdgs.config.method import MethodConfig, PartitionConfig
from vdgs.errors import VdgsError
from vdgs.partition.blocks import Block, Blocks
from vdgs.partition.boundary import MIN_CELLS, block_cores, cell_size, expand_core, scene_extent
from vdgs.partition.clustering import (
    check_distinct,
    cluster_anchors,
    clustering_features,
    fit_principal_plane,
    ground_plane,
)
from vdgs.partition.polygon_lookup import BlockCores
from vdgs.system.memory.memory_estimate import block_workload, estimate_memory

#: `--blocks auto` (choice): images that an average block needs.
CAMERAS_PER_BLOCK = 50


def partition_scene(
    positions: Float[np.ndarray, "n 3"], visibility: Int[np.ndarray, " n"], config: PartitionConfig, seed: int
) -> tuple[Blocks, list[str]]:
    """Cut a scene into blocks by the positions of its anchors and their visibility V; also returns warnings.

    Every point has exactly one owner (`Blocks.owner`). The cut moves and scales with the scene (and turns with it, with
    `config.cluster_axes` principal) and does not depend on the order of the anchors. Blocks are numbered along the
    first axis. There are fewer blocks than requested, and a warning, where a cluster is the strongest nowhere on the
    plane (choice: its anchors join the blocks around them). Raises VdgsError if the anchors cannot be cut.
    """
    ground = _checked_positions(positions, visibility)
    if config.blocks == "auto":
        raise ValueError("the number of blocks is still 'auto': choose_block_count first")
    count = config.blocks
    if count < 1:
        raise VdgsError(f"--blocks {count}: a scene is cut into at least 1 block")
    if count == 1:
        return _single_block(ground, config.expansion), []
    check_distinct(count, ground)
    ground, visibility = _sorted(ground, np.asarray(visibility, np.int64))
    plane = fit_principal_plane(ground) if config.cluster_axes == "principal" else ground_plane()
    points, visibility = _sorted(plane.to_plane(ground), visibility)
    features = clustering_features(points, visibility, config)
    labels = cluster_anchors(features, count, seed, config.balanced)
    candidates = block_cores(points, labels, count, config.cluster_smoothing)
    ordered = sorted(
        (core for core in candidates if core is not None), key=lambda core: (core.centroid.x, core.centroid.y)
    )
    least_owned = max(config.min_block_share * len(points) / count, 1.0)
    cores, warnings = _drop_tiny_blocks(ordered, points, least_owned), []
    if len(cores) < count:
        lost = [label for label, core in enumerate(candidates) if not any(core is each for each in cores)]
        reason = _fewer_blocks_reason([points[labels == each] for each in lost], points, least_owned, config)
        warnings.append(f"the scene is cut into {len(cores)} blocks instead of {count}: {reason}")
    if len(cores) == 1:
        return _single_block(ground, config.expansion), warnings
    grounded = [plane.to_ground(core) for core in cores]
    return Blocks(tuple(Block(core, expand_core(core, config.expansion)) for core in grounded)), warnings


def _fewer_blocks_reason(
    lost: Sequence[np.ndarray], points: Float[np.ndarray, "n 2"], least_owned: float,
    config: PartitionConfig,
) -> str:  # fmt: skip
    """Why the `lost` clusters became no blocks, and what to do about it."""
    assert config.blocks != "auto"
    cell = cell_size(points, config.blocks)
    if any(len(each) >= least_owned and scene_extent(each) < MIN_CELLS * cell for each in lost):
        return (
            f"blocks are told apart on cells of 1/{scene_extent(points) / cell:.0f} of the scene's extent, and the "
            f"other clusters are less than {MIN_CELLS} such cells across. Fewer blocks avoid this; of places that lie "
            "far apart, each is better a run of its own."
        )
    if config.lambda_vis > 0:
        return (
            "the anchors of the other clusters are scattered among those of their neighbors. A smaller --lambda-vis "
            "or fewer blocks avoid this."
        )
    return "the other clusters hold hardly any anchors, or lie scattered among their neighbors. Use fewer blocks."


def choose_block_count(n_anchors: int, n_cameras: int, image_pixels: int, method: MethodConfig) -> int:
    """The number of blocks that the settings ask for; for "auto" it follows from the scene and the memory.

    Choice: the fewest that keep an average block within `block_memory_gb` in training (`estimate_memory`), with images
    of up to `image_pixels`, the rest of the scene around it and half of all anchors in view, cached images aside; but
    never fewer than 50 images for an average block. Few, because of one total of steps each block gets fewer.
    """
    config = method.partition
    if config.blocks != "auto":
        return config.blocks
    most = max(1, min(n_cameras // CAMERAS_PER_BLOCK, n_anchors))

    def fits(blocks: int) -> bool:
        need = block_workload(method, -(-n_anchors // blocks), n_anchors, image_pixels)
        return estimate_memory(need).total <= 1e9 * config.block_memory_gb

    return next((blocks for blocks in range(1, most + 1) if fits(blocks)), most)


def _checked_positions(positions: np.ndarray, visibility: np.ndarray) -> Float[np.ndarray, "n 2"]:
    """x, y of the anchors in float64."""
    ground = np.asarray(positions, np.float64)[:, :2]
    if len(ground) == 0:
        raise VdgsError("the coarse model holds no anchors: there is nothing to cut into blocks. Train it again.")
    if not np.isfinite(ground).all():
        raise VdgsError("the coarse model holds anchors at places that are not finite numbers. Train it again.")
    if len(visibility) != len(ground):
        raise ValueError(f"{len(visibility)} counts of visibility for {len(ground)} anchors")
    return ground


def _sorted(points: np.ndarray, visibility: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A canonical order, so that sums and draws do not depend on the order of the anchors."""
    order = np.lexsort((visibility, points[:, 1], points[:, 0]))
    return points[order], visibility[order]


def _single_block(ground: np.ndarray, expansion: float) -> Blocks:
    """One block whose core holds every anchor; it owns every place."""
    low, high = ground.min(axis=0), ground.max(axis=0)
    margin = 0.01 * (high - low).max() + 1e-6 * np.abs(ground).max() + 1e-6
    core = shapely.box(*(low - margin), *(high + margin))
    return Blocks((Block(core, expand_core(core, expansion)),))


def _drop_tiny_blocks(cores: list[shapely.Polygon], points: np.ndarray, least_owned: float) -> list[shapely.Polygon]:
    """The cores that own at least so many anchors; at least one. The smallest goes first, and only what it owned
    changes its owner."""
    lookup, left = BlockCores(cores), np.arange(len(cores))
    owner = lookup.nearest(points)
    while len(left) > 1:
        owned = np.bincount(owner, minlength=len(cores))[left]
        least = int(owned.argmin())
        if owned[least] >= least_owned:
            break
        orphans = np.flatnonzero(owner == left[least])
        left = np.delete(left, least)
        owner[orphans] = lookup.nearest(points[orphans], among=left)
    return [cores[index] for index in left]
