"""The command line: help comes without heavy imports, errors come without tracebacks."""

import importlib.util
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import tyro
from rich.console import Console

from support.clusters import copy_run
from support.commands import PATIENCE_SECONDS, vdgs
from vdgs import cli
from vdgs.cli.common import absolute_command_line, make_console
from vdgs.cli.main import COMMANDS, HELP, get_command, main

HEAVY = ("torch", "numpy", "matplotlib", "pycolmap", "cv2", "scipy")


@pytest.mark.parametrize("arguments", [["--help"], ["train-coarse", "--help"], ["eval", "--help"]])
def test_help_imports_nothing_heavy(arguments):
    code = (
        "import sys\nfrom vdgs.cli.main import main\n"
        f"try:\n    main({arguments!r})\nexcept SystemExit as exit:\n    assert not exit.code, exit.code\n"
        f"heavy = [name for name in {HEAVY!r} if name in sys.modules]\nassert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout.lower()


#: A module of those that take long to import, and what it imports only when it is needed.
IMPORTED_LATE = {"vdgs.export.export_run": "viser", "vdgs.viewer.server": "matplotlib"}
#: Each in a process that has imported torch alone.
EACH = f"""
import importlib, os, sys, torch
def imports(module, late):
    if (process := os.fork()) == 0:
        importlib.import_module(module)
        os._exit(late in sys.modules)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) != 0
print([each for each in {IMPORTED_LATE!r}.items() if imports(*each)])
"""


@pytest.mark.skipif(importlib.util.find_spec("viser") is None or not hasattr(os, "fork"), reason="no viser, or no fork")
def test_what_only_some_work_needs_is_not_waited_for():
    done = subprocess.run([sys.executable, "-c", EACH], capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


def test_every_verb_is_in_the_help_and_has_an_action():
    for verb in COMMANDS:
        assert f"  {verb} " in HELP
        assert callable(get_command(verb))


@pytest.mark.parametrize("verb", COMMANDS)
def test_every_verb_explains_itself(verb, capsys):
    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    assert len(capsys.readouterr().out) > 100


def test_the_preset_decides_the_defaults(capsys):
    with pytest.raises(SystemExit):
        main(["train-coarse", "--preset", "laptop", "--help"])
    laptop = capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["train-coarse", "--help"])
    assert "100000" in capsys.readouterr().out
    assert "100000" not in laptop


def test_an_unknown_verb_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["mrege"])
    assert ended.value.code == 2
    assert "there is no verb 'mrege'; did you mean 'merge'?" in capsys.readouterr().err


def test_the_bench_is_named_where_there_is_only_the_package(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "experiments.bench.cli", None)  # as if it could not be imported
    with pytest.raises(SystemExit) as ended:
        main(["bench", "toy", "--output", "bench"])
    assert ended.value.code == 1
    assert "run `python -m experiments.bench` in its root" in capsys.readouterr().err


def test_the_bench_is_found_from_any_folder(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, "-m", "vdgs", "bench", "--help"], cwd=tmp_path, env=environment,
        capture_output=True, text=True, timeout=PATIENCE_SECONDS,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "usage: vdgs bench" in done.stdout


def test_a_missing_capture_is_one_line_and_no_traceback(tmp_path):
    done = vdgs("train-coarse", tmp_path / "nowhere", "--output", tmp_path / "run")
    assert done.returncode == 1
    assert "nowhere" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "run" / "config.yaml").exists()


def test_settings_that_do_not_work_are_named(tmp_path):
    done = vdgs("train-coarse", str(tmp_path), "--output", str(tmp_path / "run"), "--iterations", "-1")
    assert done.returncode == 1
    assert "--iterations -1: must be at least 0" in done.stderr


def test_quiet_leaves_what_a_person_must_know(capsys):
    for quiet, heard in ((True, ""), (False, "trained\n")):
        console = make_console(quiet)
        console.print("trained", highlight=False)
        console.print("[yellow]warning[/] it may run out of memory", highlight=False)
        said = capsys.readouterr()
        assert said.out.replace("warning it may run out of memory\n", "") == heard
        assert "warning it may run out of memory" in said.out + said.err


@pytest.mark.parametrize(
    ("verb", "does"),
    [("report", "vdgs.report.write_report"), ("ortho", "vdgs.rendering.ortho.render_ortho.render_ortho")],
)
def test_verbs_that_show_a_result_can_be_quiet(verb, does, monkeypatch, capsys):
    def done(*given: object) -> Path:
        for console in (each for each in given if isinstance(each, Console)):
            console.print("how it goes")
            console.print("[yellow]note[/] what a person must know")
        return Path("result")

    monkeypatch.setattr(does, done)
    get_command(verb)(["run"])
    assert capsys.readouterr().out.startswith({"report": "report: result", "ortho": "how it goes"}[verb])
    get_command(verb)(["run", "--quiet"])
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err in ("", "note what a person must know\n")


def test_the_command_that_is_kept_works_in_every_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    typed = ["my place", "--output", "run", "--overwrite", "--blocks", "2", "--quiet"]
    kept = absolute_command_line("run", typed, (Path("my place"), Path("run")))
    assert shlex.split(kept) == ["vdgs", "run", f"{tmp_path}/my place", "--output", f"{tmp_path}/run", "--blocks", "2"]
    assert f"--output={tmp_path}/run" in absolute_command_line(
        "run", ["my place", "--output=run"], (Path("my place"), Path("run"))
    )


def test_the_arguments_are_parsed_once(uncut, monkeypatch, tmp_path, capsys):
    parsed, parse = [], tyro.cli

    def count(kind: type, **options: object) -> object:
        parsed.append(kind.__name__)
        return parse(kind, **options)

    monkeypatch.setattr(tyro, "cli", count)
    for arguments in (
        ("train-coarse", tmp_path / "nowhere", "--output", tmp_path / "run", "--preset=laptop"),
        ("train-blocks", uncut),
        ("merge", uncut, "--rule", "owner"),
        ("partition", "--capture", uncut, tmp_path),
    ):
        with pytest.raises(SystemExit) as ended:
            main([str(each) for each in arguments])
        assert ended.value.code == 1
    assert parsed == ["TrainCoarseArguments", "TrainBlocksArguments", "MergeArguments", "PartitionArguments"]
    assert f"{tmp_path}: is not a run folder" in capsys.readouterr().err


def test_another_run_than_the_one_asked_for_is_named(uncut, tmp_path, capsys):
    other = copy_run(uncut, tmp_path / "other")
    with pytest.raises(SystemExit):
        main(["train-blocks", "--capture", str(other), str(uncut)])
    assert f"{other}: is a run, and so is {uncut}" in capsys.readouterr().err


def test_a_run_decides_the_defaults_of_its_help(uncut, capsys):
    for arguments, sampling in (([str(uncut)], "sqrt-visibility"), ([], "uniform")):
        with pytest.raises(SystemExit):
            main(["train-blocks", *arguments, "--help"])
        assert f"(default: {sampling})" in capsys.readouterr().out
