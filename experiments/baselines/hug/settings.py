"""Settings of HUG: Su et al., "HUG: Hierarchical Urban Gaussian Splatting with Block-Based Reconstruction for
Large-Scale Aerial Scenes", 2025. No program of its authors is public; what its paper leaves open is marked (choice).
Left out or different:

- each step renders one level, drawn in proportion to the weights of the levels in its loss, where HUG renders all in
  every step: the mean of the gradients is that of the weighted sum, for the cost of one render. The weights of L1 and
  SSIM within a level are not told apart;
- coarse levels are compared over the block's whole mask, not only where they are opaque;
- pixels are given to blocks by their nearest projected sparse points;
- blocks are trained from their sparse points, as Octree-GS, whose settings and departures all hold here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from experiments.baselines.octree_gs.settings import OctreeConfig, octree_config


@dataclass(frozen=True, kw_only=True)
class HugConfig:
    """Settings; those of training are of each block."""

    octree: OctreeConfig
    blocks: int = 4
    #: A view trains a block that has more than this share of its pixels (choice).
    min_share: float = 0.05
    #: So many of the nearest projected points say whose a pixel is (choice).
    neighbors: int = 5
    #: Anchors start and grow in the block's box widened by this share of its size (choice); those outside the box are
    #: left out of the merged scene.
    margin: float = 0.1
    #: theta: weight of the coarse levels together, beside the full picture (choice).
    coarse_weight: float = 0.25


def hug_config(iterations: int, blocks: int, seed: int = 0, max_anchors: int = 0) -> HugConfig:
    """HUG with so many iterations in all blocks together. Levels as its section on the octree has them: rounded down,
    from the 0.95 quantile of distances; all levels from the start."""
    each = octree_config(max(1, round(iterations / blocks)), seed, -(-max_anchors // blocks))
    octree = replace(each, round_down=True, distance_quantile=0.95, progressive_share=0.0)
    return HugConfig(octree=octree, blocks=blocks)
