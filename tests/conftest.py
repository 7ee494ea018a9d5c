"""Shared by all tests: shapes are checked at run time, figures need no screen."""

import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
from jaxtyping import install_import_hook

PACKAGE = Path(__file__).parents[1] / "src" / "vdgs"


def files_with_shapes() -> list[Path]:
    """The files of the package that annotate shapes: where the arithmetic is."""
    return sorted(file for file in PACKAGE.rglob("*.py") if "from jaxtyping import" in file.read_text(encoding="utf-8"))


def module_name(file: Path) -> str:
    """`vdgs.model.gaps` for src/vdgs/model/gaps.py."""
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


# Their annotations are checked while the tests run.
install_import_hook([module_name(file) for file in files_with_shapes()], "typecheck.checked")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that need a GPU are skipped where torch has none."""
    if not any("gpu" in item.keywords for item in items):
        return
    import torch

    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="no GPU that torch can use"))
