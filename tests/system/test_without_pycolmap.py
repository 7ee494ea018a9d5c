"""An installation without pycolmap (docs/third-party.md): all but photographs, lenses and synth works."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from vdgs.system.exit_codes import REMOVABLE_PACKAGES, exit_code_of

#: Modules that serve what needs pycolmap.
ALLOWED = "vdgs.sfm."

IMPORT_ALL = """
import importlib, pkgutil, sys
sys.modules["pycolmap"] = None
import vdgs
for module in pkgutil.walk_packages(vdgs.__path__, "vdgs."):
    if module.name.endswith("__main__") or module.name.startswith("vdgs.kernels._native"):
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        print(module.name, error.name)
"""


def test_only_reconstruction_imports_pycolmap():
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL], capture_output=True, text=True, check=True)
    failed = [line.split() for line in done.stdout.splitlines()]
    assert failed, "pycolmap was not hidden"
    assert {package for _, package in failed} == {"pycolmap"}
    assert [name for name, _ in failed if not name.startswith(ALLOWED)] == []


def test_what_needs_pycolmap_names_it(capsys: pytest.CaptureFixture):
    def action() -> None:
        raise ModuleNotFoundError("No module named 'pycolmap'", name="pycolmap")

    assert exit_code_of("vdgs sfm", action, "") == 1
    error = capsys.readouterr().err
    assert "vdgs sfm: pycolmap is not installed" in error
    assert "pip install pycolmap" in error


def test_other_missing_packages_are_faults_of_the_program():
    def action() -> None:
        raise ModuleNotFoundError("No module named 'scipy'", name="scipy")

    with pytest.raises(ModuleNotFoundError):
        exit_code_of("vdgs eval", action, "")


def test_the_notices_name_what_can_be_left_out():
    text = (Path(__file__).parents[2] / "docs" / "third-party.md").read_text(encoding="utf-8")
    for name in REMOVABLE_PACKAGES:
        assert f"pip uninstall {name}" in text
