"""An installation with a package that is missing or broken: one line says which and what to type, no traceback."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from support.commands import PATIENCE_SECONDS
from vdgs.cli.doctor import system_checks
from vdgs.system.broken_packages import explain_shadows, shadowing_file
from vdgs.system.exit_codes import exit_code_of

NO_LIBRARY = "libtorch_cpu.so: cannot open shared object file: No such file or directory"
OTHER_ABI = "numpy.dtype size changed, may indicate binary incompatibility. Expected 96 from C header, got 88"
ADVICE = "\\n\\nIMPORTANT: PLEASE READ THIS FOR ADVICE\\n\\nOriginal error was: No module named 'numpy._core'\\n"


def write_package(folder: Path, name: str, code: str) -> None:
    (folder / name).mkdir()
    (folder / name / "__init__.py").write_text(code)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (f"raise ImportError({NO_LIBRARY!r}, name='heavy._C')", NO_LIBRARY),
        (f"raise OSError({NO_LIBRARY!r})", NO_LIBRARY),  # ctypes
        (f"raise ValueError({OTHER_ABI!r})", OTHER_ABI),
        (f'raise ImportError("{ADVICE}")', "No module named 'numpy._core'"),
        ("import no_such_package", "No module named 'no_such_package'"),
        ("import sys; sys.no_such_name", "no attribute 'no_such_name'"),
    ],
)
def test_what_cannot_be_imported_is_named(error, said, tmp_path, monkeypatch, capsys):
    write_package(tmp_path, "heavy", error)
    monkeypatch.syspath_prepend(tmp_path)
    assert exit_code_of("vdgs run", lambda: importlib.import_module("heavy"), "") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("vdgs run: heavy cannot be used (")
    assert said in line
    assert "pip install --force-reinstall heavy mends it; `vdgs doctor` tests all packages." in line


@pytest.mark.parametrize(
    "said", ["libtorch_cpu.so: failed to map segment from shared object", "_flapack.so: cannot map zero-fill pages"]
)
def test_a_package_for_which_memory_is_short_is_not_called_broken(said, tmp_path, monkeypatch, capsys):
    write_package(tmp_path, "heavy", f"raise ImportError({said!r}, name='heavy._C')")
    monkeypatch.syspath_prepend(tmp_path)
    assert exit_code_of("vdgs run", lambda: importlib.import_module("heavy"), "") == 1
    error = capsys.readouterr().err
    assert error.startswith(f"vdgs run: out of memory ({said})")
    assert "ulimit -v" in error
    assert "pip" not in error


def test_libraries_where_no_program_may_run_are_not_called_short_of_memory(tmp_path, monkeypatch, capsys):
    said = f"{tmp_path}/heavy/_C.so: failed to map segment from shared object"
    write_package(tmp_path, "heavy", f"raise ImportError({said!r}, name='heavy._C')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(os, "statvfs", lambda path: SimpleNamespace(f_flag=os.ST_NOEXEC))
    assert exit_code_of("vdgs run", lambda: importlib.import_module("heavy"), "") == 1
    assert f"No program may run where {tmp_path}/heavy/_C.so lies (noexec)" in capsys.readouterr().err


def test_the_package_below_is_named_too(tmp_path, monkeypatch, capsys):
    write_package(tmp_path, "upper", "import lower")
    write_package(tmp_path, "lower", "raise RuntimeError('module compiled against ABI version 0x1000009')")
    monkeypatch.syspath_prepend(tmp_path)
    assert exit_code_of("vdgs run", lambda: importlib.import_module("upper"), "") == 1
    assert "pip install --force-reinstall upper lower" in capsys.readouterr().err


def test_a_torch_of_another_numpy(monkeypatch, capsys):
    import torch

    def refuse(*_: object) -> None:
        raise RuntimeError("Numpy is not available")

    monkeypatch.setattr(torch, "from_numpy", refuse)
    assert exit_code_of("vdgs run", lambda: torch.from_numpy(0), "") == 1
    assert "torch cannot be used (Numpy is not available)" in capsys.readouterr().err
    (check,) = system_checks._dependencies()
    assert not check.is_ok
    assert check.value == "torch (RuntimeError: Numpy is not available)"
    assert check.remedy == "pip install --force-reinstall torch"


@pytest.mark.parametrize("error", [ImportError("cannot import name 'x'", name="vdgs.x"), ValueError(OTHER_ABI)])
def test_faults_of_the_program_are_raised(error):
    def action() -> None:
        raise error

    with pytest.raises(type(error)):
        exit_code_of("vdgs run", action, "")


@pytest.mark.slow
@pytest.mark.parametrize("verb", [["run", ".", "--output", "run"], ["doctor"]], ids=lambda words: words[0])
def test_the_command_line_without_a_whole_torch(verb, tmp_path):
    installed = tmp_path / "site-packages"
    installed.mkdir()
    write_package(installed, "torch", f"raise ImportError({NO_LIBRARY!r}, name='torch._C')")
    path = os.pathsep.join([str(installed), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-m", "vdgs", *verb], capture_output=True, text=True, cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path}, timeout=PATIENCE_SECONDS, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert NO_LIBRARY in done.stdout + done.stderr
    assert "pip install --force-reinstall torch" in done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("verb", [["run", ".", "--output", "run"], ["doctor"]], ids=lambda words: words[0])
@pytest.mark.parametrize("name", ["torch", "numpy", "yaml"])
def test_a_file_of_a_package_s_name_in_the_current_folder_is_named(name, verb, tmp_path):
    """Python looks there first. What is installed behind it is whole: to install it again mends nothing."""
    (tmp_path / f"{name}.py").write_text("answer = 42\n")
    done = subprocess.run(
        [sys.executable, "-m", "vdgs", *verb], capture_output=True, text=True, cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}, timeout=PATIENCE_SECONDS, check=False,
    )  # fmt: skip
    said = done.stdout + done.stderr
    assert done.returncode == 1
    assert "Traceback" not in said
    assert f"{tmp_path / name}.py is taken for the package {name} and hides it: rename it or start vdgs in" in said
    assert f"--force-reinstall {name}" not in said


def test_only_a_package_that_lies_behind_another_is_hidden(tmp_path, monkeypatch):
    """A package of one's own, and packages that are installed over those of Python or of the system, hide nothing."""
    first, second = tmp_path / "first", tmp_path / "second" / "site-packages"
    for folder in (first, second):
        folder.mkdir(parents=True)
        write_package(folder, "twice", "")
    write_package(first, "once", "")
    monkeypatch.setattr(sys, "path", [str(first), str(second), *sys.path])
    assert shadowing_file("twice") == first / "twice"
    assert shadowing_file("once") is None
    assert shadowing_file("nowhere_at_all") is None
    monkeypatch.setenv("PYTHONPATH", str(first))
    assert "take its folder out of PYTHONPATH" in explain_shadows(["once", "twice"])
    monkeypatch.setattr(sys, "path", [str(second), str(first), *sys.path[2:]])
    assert shadowing_file("twice") is None
    assert explain_shadows([*sys.stdlib_module_names, "torch", "numpy", "yaml"]) == ""
