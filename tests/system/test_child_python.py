"""Other Python processes import what this one would, whatever files lie in the folder where a person typed `vdgs`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import vdgs
from vdgs.system.child_python import python_command

#: Says with which options and from which `vdgs` a child of this process works.
PARENT = """
import subprocess, sys
from vdgs.system.child_python import python_command
sys.exit(subprocess.run(python_command("json.tool", *sys.argv[1:])).returncode)
"""
CHILD = """
import json, sys
import vdgs.errors
print(json.dumps([vdgs.errors.__file__, sys.flags.optimize, sys.warnoptions, sys.flags.safe_path]))
"""
PACKAGE = Path(vdgs.__file__).parent


def run(command: list[str], folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"} | variables
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


@pytest.fixture
def folder(tmp_path) -> Path:
    """Where a person types: files of theirs are called as modules are that everything imports."""
    here = tmp_path / "here"
    here.mkdir()
    for name in ("random", "types", "numpy", "json"):
        (here / f"{name}.py").write_text("raise SystemExit('mine')")
    return here


def test_the_files_of_the_current_folder_are_not_imported(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each not in ("", os.getcwd())])
    (tmp_path / "values").write_text("[1]")
    done = run(python_command("json.tool", tmp_path / "values"), folder)
    assert (done.returncode, json.loads(done.stdout), done.stderr) == (0, [1], "")


@pytest.mark.parametrize("options", [[], ["-P"], ["-I"]])
def test_a_child_has_the_folder_where_its_parent_has(folder, options, tmp_path):
    """As where `python -m vdgs` is typed in a checkout; a script that a person starts does not have it."""
    code = f"import sys; sys.path.append({str(PACKAGE.parent)!r})\n{PARENT}"
    (tmp_path / "values").write_text("[1]")
    (folder / "json.py").rename(folder / "another.py")
    done = run([sys.executable, *options, "-c", code.replace("json.tool", "another")], folder)
    assert "mine" in done.stderr if not options else "No module named another" in done.stderr


def test_a_child_of_a_checkout_finds_it(tmp_path):
    """Nothing names the package but the current folder, as in a checkout that is not installed (-S: as this may be)."""
    package = tmp_path / "vdgs"
    (package / "system").mkdir(parents=True)
    for name in ("__init__.py", "system/__init__.py"):
        (package / name).touch()
    source = Path(sys.modules[python_command.__module__].__file__)
    (package / "system" / "child_python.py").write_text(source.read_text())
    (package / "__main__.py").write_text(PARENT.replace("json.tool", "vdgs.told"))
    (package / "told.py").write_text("print(__file__)")
    done = run([sys.executable, "-S", "-m", "vdgs"], tmp_path, PYTHONPATH="")
    assert done.stdout.strip() == str(package / "told.py"), done.stderr


def test_a_child_has_the_options_of_its_parent(tmp_path):
    (tmp_path / "told.py").write_text(CHILD)
    code = PARENT.replace("json.tool", "told")
    done = run(
        [sys.executable, "-O", "-W", "ignore::ImportWarning", "-c", code], tmp_path, PYTHONPATH=str(PACKAGE.parent)
    )
    assert json.loads(done.stdout) == [str(PACKAGE / "errors.py"), 1, ["ignore::ImportWarning"], False], done.stderr
