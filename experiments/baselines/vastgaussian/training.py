"""VastGaussian: cells with equally many cameras, each trained as 3DGS from the points that its cameras hold, with
decoupled appearance, and merged by place.

Source: Lin, Li, Tang, Liu, Liu, Liu, Lu, Wu, Xu, Yan and Yang, "VastGaussian: Vast 3D Gaussians for Large Scene
Reconstruction", CVPR 2024. Its density control (from 1 000 to 30 000 of 60 000 iterations, every 200) is that of 3DGS
in proportion to a block's iterations, as `gs3d.schedule` has it. Opacities are reset in that proportion too, where the
paper keeps the interval of 3DGS.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool

from experiments.baselines.gaussian_blocks.cut import GaussianCut, cut_points, holds, merge_cells
from experiments.baselines.gaussian_blocks.training import BlockScene
from experiments.baselines.gs3d.session import state_from_points
from experiments.baselines.gs3d.training import Gs3dConfig, Gs3dState
from experiments.baselines.vastgaussian.appearance import AppearanceLoss, initial_appearance
from vdgs.model.gaussians import Gaussians
from vdgs.partition.blocks import xy_positions


def train_vastgaussian(scene: BlockScene, *, appearance: bool = True) -> Gaussians:
    """The merged scene; `appearance`: whether photographs may look different. Raises what `run_session` raises."""
    points = scene.capture.points
    cut = scene.cut(lambda: cut_points("vastgaussian", points, scene.cameras, scene.config.blocks))
    owner, parts = cut.blocks.owner(xy_positions(points)), []
    for index, views in enumerate(cut.views):
        held = selected_points(scene, cut, index)
        config = scene.block_config(int((owner == index).sum()), len(points), int(held.sum()))
        problem = scene.problem(views, config)
        start = partial(_start, scene, held, len(views), config, appearance)
        if not views:
            parts.append(scene.keep(index, start().gaussians, "no camera shows it"))
            continue
        if appearance:
            problem = replace(problem, image_loss=AppearanceLoss(config.ssim_weight))
        parts.append(scene.train(index, problem, start))
    return merge_cells(cut.blocks, parts)


def _start(scene: BlockScene, held: np.ndarray, views: int, config: Gs3dConfig, appearance: bool) -> Gs3dState:
    state = state_from_points(scene.capture, config, torch.from_numpy(held))
    state.extra = initial_appearance(views, config.seed) if appearance else {}
    return state


def selected_points(scene: BlockScene, cut: GaussianCut, index: int) -> Bool[np.ndarray, " n"]:
    """The sparse points of the widened cell, and all that a camera of the block holds (coverage-based point selection):
    without these, Gaussians in the cell would stand in for what the cameras see beyond it."""
    points = scene.capture.points
    chosen = cut.blocks.in_expanded(index, xy_positions(points))
    places = torch.from_numpy(points.astype(np.float32))
    for view in cut.views[index]:
        chosen |= holds(places, scene.cameras[view])
    return chosen
