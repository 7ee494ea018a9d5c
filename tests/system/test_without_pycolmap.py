"""An installation without pycolmap (docs/third-party.md): all but photographs, lenses and synth works."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from support.commands import python
from vdgs.system import lazy_pycolmap
from vdgs.system.exit_codes import REMOVABLE_PACKAGES, exit_code_of

pytestmark = pytest.mark.slow  # whole reconstructions, runs or trainings

IMPORT_ALL = """
import importlib, pkgutil, sys
for name in [each for each in sys.modules if each.partition(".")[0] in ("vdgs", "pycolmap")]:
    del sys.modules[name]
sys.modules["pycolmap"] = None
import vdgs
for module in pkgutil.walk_packages(vdgs.__path__, "vdgs."):
    if not module.name.endswith("__main__") and not module.name.startswith("vdgs.kernels._native"):
        importlib.import_module(module.name)
"""


def test_every_module_can_be_imported():
    done = python(IMPORT_ALL)
    assert done.returncode == 0, done.stderr


def test_the_first_use_names_what_is_missing(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr(lazy_pycolmap, "pycolmap", type(lazy_pycolmap.pycolmap)())
    with pytest.raises(ModuleNotFoundError) as caught:
        lazy_pycolmap.pycolmap.Reconstruction()
    assert caught.value.name in REMOVABLE_PACKAGES


def test_what_needs_pycolmap_names_it(capsys: pytest.CaptureFixture):
    def action() -> None:
        raise ModuleNotFoundError("No module named 'pycolmap'", name="pycolmap")

    assert exit_code_of("vdgs sfm", action, "") == 1
    error = capsys.readouterr().err
    assert "vdgs sfm: pycolmap is not installed" in error
    assert "pip install pycolmap" in error


def test_the_notices_name_what_can_be_left_out():
    text = (Path(__file__).parents[2] / "docs" / "third-party.md").read_text(encoding="utf-8")
    for name in REMOVABLE_PACKAGES:
        assert f"pip uninstall {name}" in text
