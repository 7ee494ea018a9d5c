"""Published methods that train a scene whole, and the cuts of others, trained in blocks as ours are."""

from __future__ import annotations

from experiments.baselines.gs3d.schedule import MIN_INTERVAL, PUBLISHED_ITERATIONS
from experiments.bench.definitions import COARSE_STAGES, GS3D_STAGES, BenchMethod
from experiments.bench.overrides import coarse_only, explicit_gaussians, with_dense_adam, with_partition_strategy

#: What the partitions leave out beyond what `partition.strategies` says of each.
_COMMON = (
    "training schedule, losses and (dense) Adam of their own: what is compared is the partition, and blocks are "
    "trained as ours, with plain growth",
)
_3DGS = "Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering, SIGGRAPH 2023"
#: As the docstring of `experiments.baselines.gs3d.run` has it.
_3DGS_LEAVES_OUT = (
    "pruning by footprint in the image (its section 5.2)",
    "its own image formation (alpha at most 0.999, near plane at 0.01 and extent by opacity are as for all methods)",
    "exposure compensation, depth regularisation and anti-aliasing, which came later than its paper",
)
_3DGS_SCHEDULE = (
    f"its schedule of {PUBLISHED_ITERATIONS:,} iterations (warm-up, degree of color, start and interval of density "
    "control, resets of opacity) moves in proportion to the total here, but neither decides nor resets more "
    f"often than every {MIN_INTERVAL} iterations"
)
OTHER_METHODS = [
    BenchMethod(
        "3dgs",
        "3DGS",
        explicit_gaussians("mean"),
        GS3D_STAGES,
        citation=_3DGS,
        omissions=_3DGS_LEAVES_OUT,
        adapted="without pruning by footprint",
        differs=f"background of the mean color of the photographs, as ours; {_3DGS_SCHEDULE}",
    ),
    BenchMethod(
        "3dgs-black",
        "3DGS, black background",
        explicit_gaussians("black"),
        GS3D_STAGES,
        citation=_3DGS,
        omissions=_3DGS_LEAVES_OUT,
        adapted="without pruning by footprint",
        differs=f"background black, as published; {_3DGS_SCHEDULE}",
    ),
    BenchMethod(
        "2dgs",
        "2DGS",
        explicit_gaussians("mean"),
        ("gs2d",),
        citation="Huang et al., 2D Gaussian Splatting for Geometrically Accurate Radiance Fields, SIGGRAPH 2024",
        omissions=(
            "the intersection of ray and disk: flat Gaussians are projected as those of 3DGS",
            *_3DGS_LEAVES_OUT,
        ),
        adapted="3DGS with flat Gaussians, depth distortion and normal consistency",
        differs="background of the mean color of the photographs, as ours; distortion is of the logarithms of depths, "
        f"with weight 1; {_3DGS_SCHEDULE}",
    ),
    BenchMethod(
        "scaffold-gs",
        "Scaffold-GS",
        coarse_only,
        ("scaffold",),
        citation="Lu et al., Scaffold-GS: Structured 3D Gaussians for View-Adaptive Rendering, CVPR 2024",
        differs="its own starts, black background, rates in units of the cameras' radius, volume weight and dense "
        "Adam, its schedule of 30,000 iterations in proportion; the root that its voxel lacks is taken",
        omissions=("the multi-resolution feature bank, which its program leaves off",),
    ),
    BenchMethod(
        "scaffold-gs-ours",
        "Scaffold-GS by our coarse stage",
        with_dense_adam(coarse_only),
        COARSE_STAGES,
        differs="our coarse stage with dense Adam; `baseline` is the same with Adam that moves only what a photograph "
        "shows",
        adapted="our starts, background, rates and volume weight",
    ),
    BenchMethod(
        "octree-gs",
        "Octree-GS",
        coarse_only,
        ("octree",),
        citation="Ren et al., Octree-GS: Towards Consistent Real-time Rendering with LOD-Structured 3D Gaussians, "
        "TPAMI 2025",
        differs="on Scaffold-GS as above, its schedule of 40,000 iterations in proportion; cells, distances and "
        "levels of new anchors differ as experiments/baselines/octree_gs/settings.py lists",
        omissions=(
            "weeding by an adaptive threshold of visibility, which its program leaves off",
            "blending between levels (its program's `progressive` mode of distances)",
        ),
        adapted="cells from the sparse points' spacing, not from 0.02 units",
    ),
    BenchMethod(
        "hug",
        "HUG",
        coarse_only,
        ("hug",),
        citation="Su et al., HUG: Hierarchical Urban Gaussian Splatting with Block-Based Reconstruction for "
        "Large-Scale Aerial Scenes, 2025",
        differs="no program of its authors is public; what its paper leaves open is in "
        "experiments/baselines/hug/settings.py. Each block starts from sparse points, so that blocks share all "
        "iterations",
        omissions=(
            "rendering of every level in every step: each step draws one, in proportion to its weight",
            "masks of coarse levels by their opacity, and different weights of L1 and SSIM within a level",
        ),
        adapted="one level a step, drawn by its weight",
    ),
    BenchMethod(
        "mixgs",
        "MixGS",
        coarse_only,
        ("mixgs",),
        citation="Liu et al., Holistic Large-Scale Scene Reconstruction via Mixed Gaussian Splatting, 2025",
        differs="a third of the iterations is 3DGS, whose schedule moves in proportion; rates of mixed training are "
        "those published for 300,000 iterations. Gaussians: coarse ones and as many decoded",
        omissions=("its hash tables' size and its coarse model's length (experiments/baselines/mixgs/settings.py)",),
        adapted="smaller hash tables, a short coarse model",
    ),
    BenchMethod(
        "vastgaussian",
        "VastGaussian partition",
        with_partition_strategy("vastgaussian"),
        citation="Lin et al., VastGaussian: Vast 3D Gaussians for Large Scene Reconstruction, CVPR 2024",
        omissions=_COMMON,
        adapted="its cut and cameras, trained as ours",
    ),
    BenchMethod(
        "citygaussian",
        "CityGaussian partition",
        with_partition_strategy("citygaussian"),
        citation="Liu et al., CityGaussian: Real-time High-quality Large-Scale Scene Rendering with Gaussians, "
        "ECCV 2024",
        omissions=_COMMON,
        adapted="its cut and cameras, trained as ours",
    ),
    BenchMethod(
        "dogs",
        "DOGS partition",
        with_partition_strategy("dogs"),
        citation="Chen and Lee, DOGS: Distributed-Oriented Gaussian Splatting via Gaussian Consensus, NeurIPS 2024",
        omissions=_COMMON,
        adapted="its cut and cameras, trained as ours",
    ),
]
