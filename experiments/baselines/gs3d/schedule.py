"""The published schedule of 3DGS for another number of iterations."""

from __future__ import annotations

from dataclasses import replace

from experiments.baselines.gs3d.training import Gs3dConfig

#: What the schedule was published for (3DGS section 7.1).
PUBLISHED_ITERATIONS = 30_000
#: No interval between two decisions about density or two resets becomes shorter than the published one between
#: decisions (choice): decisions on fewer views make several times as many Gaussians and a worse scene, and opacities
#: must come back after a reset.
MIN_INTERVAL = 100


def scale_schedule(iterations: int, config: Gs3dConfig | None = None, max_gaussians: int = 0) -> Gs3dConfig:
    """`config` (default: as published) for so many iterations: warm-up, degree of color, start and interval of density
    control and resets of opacity move in proportion, as rates and the end of density control do anyway. Trained as
    published for a fifth of the time, 3DGS would reset its opacities too late, and use colors that depend on the
    direction for a part of it only. At most `max_gaussians`; 0 for no limit."""
    config = config or Gs3dConfig()
    scale, density = iterations / PUBLISHED_ITERATIONS, config.density
    return replace(
        config,
        iterations=iterations,
        resolution_schedule=tuple((round(scale * start), factor) for start, factor in config.resolution_schedule),
        degree_interval=max(1, round(scale * config.degree_interval)),
        density=replace(
            density,
            start=round(scale * density.start),
            interval=max(MIN_INTERVAL, round(scale * density.interval)),
            reset_interval=max(MIN_INTERVAL, round(scale * density.reset_interval)),
            max_gaussians=max_gaussians,
        ),
    )
