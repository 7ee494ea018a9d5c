"""Runs of two blocks: a finished one with a copy of it that a test may change, and one to be trained on clusters."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.clusters import CUT, FINE, copy_run, evaluated, train_here
from support.commands import vdgs
from vdgs.rendering.ortho.ortho_plan import FILE_NAMES


@pytest.fixture(scope="module")
def capture(two_blocks) -> Path:
    return two_blocks.capture


@pytest.fixture(scope="module")
def unbroken(two_blocks) -> Path:
    return two_blocks.run


@pytest.fixture
def copied(unbroken, tmp_path) -> Path:
    return copy_run(unbroken, tmp_path / "run")


@pytest.fixture(scope="session")
def cut(uncut, tmp_path_factory) -> Path:
    """`uncut`, cut into two blocks that are not trained. Not to be changed: `clusters.copy_run`."""
    run = copy_run(uncut, tmp_path_factory.mktemp("cut") / "cut")
    done = vdgs("partition", run, *CUT)
    assert done.returncode == 0, done.stderr + done.stdout
    return run


@pytest.fixture(scope="session")
def local(cut) -> Path:
    """`cut`, its blocks trained by this machine alone. Not to be changed."""
    return train_here(cut, cut.parent / "local")


@pytest.fixture(scope="session")
def mapped(uncut, tmp_path_factory) -> dict[str, object]:
    """Maps of `uncut` as one process draws them."""
    pytest.importorskip("rasterio")
    folder = tmp_path_factory.mktemp("mapped") / "maps"
    done = vdgs("ortho", uncut, *FINE, "--output", folder)
    assert done.returncode == 0, done.stderr + done.stdout
    files = evaluated(folder)
    assert files.keys() == set(FILE_NAMES)
    return files
