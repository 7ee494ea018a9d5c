"""Shared by all tests: shapes are checked at run time, figures need no screen."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that need a GPU are skipped where torch has none."""
    if not any("gpu" in item.keywords for item in items):
        return
    import torch

    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="no GPU that torch can use"))
