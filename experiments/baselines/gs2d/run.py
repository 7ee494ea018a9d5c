"""2DGS (Huang et al. 2024) as a comparator: 3DGS of `gs3d.run` with the terms of `gs2d.surface`."""

from __future__ import annotations

from functools import partial

from experiments.baselines.gs2d.surface import with_surface_terms
from experiments.baselines.gs3d.run import run_gs3d

#: What metrics.json calls this method.
METHOD_NAME = "2dgs"

run_gs2d = partial(run_gs3d, method=METHOD_NAME, adapt=with_surface_terms)
