"""Shared by all tests: shapes are checked at run time, figures need no screen."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("MPLBACKEND", "Agg")

from jaxtyping import install_import_hook

# The numerical core's annotations (shapes and types) are checked while the tests run.
CORE = (
    "kernels",
    "evaluation",
    "anchors",
    "cameras",
    "comparators",
    "compensation",
    "decoder",
    "growth",
    "merging",
    "optimiser",
    "partition",
    "render",
    "training",
    "visibility",
)
install_import_hook([f"vdgs.{room}" for room in CORE], "typecheck.checked")
