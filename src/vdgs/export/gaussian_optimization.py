"""Baked Gaussians moved for some seconds towards the model's own pictures: colors, opacities and shapes, by Adam.

What fits in closed form is done before (`bake`, `color_refinement`); this takes longer, needs the whole scene in
memory, three times (0.7 kB for each Gaussian of degree 3), and gains what is left.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch

from vdgs.export.color_refinement import BakedGaussians
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import AdamState
from vdgs.model.gaussians import Gaussians, render_gaussians

#: Learning rates: half of what trains Gaussians from nothing (3DGS), for these start near the end.
LEARNING_RATES = {"sh0": 1.25e-3, "shN": 6e-5, "opacity_logits": 0.025, "log_scales": 2.5e-3, "quaternions": 5e-4}


def optimize_gaussians(
    baked: BakedGaussians,
    cameras: Iterator[Camera],
    seconds: float = math.inf,
    after_step: Callable[[float], None] = lambda passed: None,
    clock: Callable[[], float] = time.monotonic,
    max_steps: float = math.inf,
    rate: float = 1.0,
    center_rate: float = 0.0,
) -> int:
    """Move the Gaussians on the disk for so long, in so many steps at most; returns in how many, each by the picture of
    the next camera. `rate` multiplies the learning rates; `center_rate` is that of the centers, in median sizes.

    `after_step` is told how many seconds have passed.
    """
    every = np.arange(len(baked.spool.means))
    gaussians = baked.spool.rows(every)
    named = gaussians.tensors()
    rates = {name: rate * each for name, each in LEARNING_RATES.items() if named[name].numel()}
    if center_rate:
        rates["means"] = center_rate * float(gaussians.log_scales.amax(1).median().exp())
    states = {
        name: AdamState(named[name], torch.zeros_like(named[name]), torch.zeros_like(named[name]), each)
        for name, each in rates.items()
    }
    updates = torch.zeros(len(every), dtype=torch.int32, device="cpu")
    began, steps = clock(), 0
    while (passed := clock() - began) < seconds and steps < max_steps:
        _step(baked, gaussians, next(cameras), states, updates)
        steps += 1
        after_step(passed)
    baked.spool.replace(every, gaussians)
    return steps


def _step(
    baked: BakedGaussians, gaussians: Gaussians, camera: Camera, states: dict[str, AdamState], updates: torch.Tensor
) -> None:
    wanted, numbers = baked.render_target(camera)
    rows = torch.from_numpy(numbers)
    seen = gaussians.select(rows)
    moved = [seen.tensors()[name].requires_grad_() for name in states]
    with torch.enable_grad():
        background = torch.tensor(baked.model.background, dtype=torch.float32, device="cpu")
        raster, _ = render_gaussians(seen, camera, background, gaussians.sh_degree)
        gradients = torch.autograd.grad((raster.image - wanted).square().sum(), moved, materialize_grads=True)
    updates[rows] += 1
    for state, gradient in zip(states.values(), gradients, strict=True):
        get_backend(rows.device).adam_rows(state, rows, gradient, updates[rows])
