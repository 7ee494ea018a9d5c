"""CityGaussian: a coarse scene of 3DGS, and blocks that each go on with all of it and keep their own cell.

Source: Liu, Luo, Fan, Wang, Peng and Zhang, "CityGaussian: Real-time High-quality Large-Scale Scene Rendering with
Gaussians", ECCV 2024; "program": the authors' published program says what the paper leaves open. Left out: levels of
detail and compression (its section 3.3).
"""

from __future__ import annotations

from dataclasses import replace

from experiments.baselines.gaussian_blocks.cut import cut_by_removal, merge_cells
from experiments.baselines.gaussian_blocks.training import BlockScene, copies
from experiments.baselines.gs3d.run import train_gs3d
from experiments.baselines.gs3d.training import Gs3dConfig, initial_state
from vdgs.model.gaussians import Gaussians
from vdgs.partition.blocks import xy_positions

#: Factors on the rates of 3DGS (program: 6.4e-5 and 0.004 in place of 1.6e-4 and 0.005).
MEANS_FACTOR, SCALES_FACTOR = 0.4, 0.8


def train_citygaussian(scene: BlockScene) -> Gaussians:
    """The merged scene. Raises what `train_gs3d` and `run_session` raise."""
    config = scene.config
    coarse = train_gs3d(
        scene.capture, config.scene, scene.folder.path / "coarse", scene.console, options=scene.options,
        device=scene.device,
    ).gaussians  # fmt: skip
    drawn = coarse.to(scene.device)
    cut = scene.cut(lambda: cut_by_removal("citygaussian", drawn, scene.cameras, config.blocks, config.image_size))
    owner = cut.blocks.owner(xy_positions(coarse.means))
    parts = []
    for index, views in enumerate(cut.views):
        if not views:
            parts.append(scene.keep(index, coarse, "no camera shows it"))
            continue
        settings = fine_tuning(scene.block_config(int((owner == index).sum()), len(coarse), len(coarse)))
        problem = replace(scene.problem(views, settings), full_degree=True)
        parts.append(scene.train(index, problem, lambda: initial_state(copies(coarse))))
    return merge_cells(cut.blocks, parts)


def fine_tuning(config: Gs3dConfig) -> Gs3dConfig:
    """How a block is trained: as 3DGS from the start of its schedule, but at full size and with smaller steps."""
    first, last = config.rates.means
    rates = replace(
        config.rates,
        means=(MEANS_FACTOR * first, MEANS_FACTOR * last),
        log_scales=SCALES_FACTOR * config.rates.log_scales,
    )
    return replace(config, rates=rates, resolution_schedule=((0, 1),))
