"""The command line: help comes without heavy imports, errors come without tracebacks."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from experiments.bench.cli import BenchArguments
from support.commands import PATIENCE_SECONDS, vdgs
from vdgs import cli
from vdgs.cli import common
from vdgs.cli.argument_parser import GivenArguments, parse_words
from vdgs.cli.capture_cmds import SfmArguments, SynthArguments
from vdgs.cli.common import make_console
from vdgs.cli.export_cmd import ExportArguments
from vdgs.cli.help_text import COMMON_OPTIONS
from vdgs.cli.main import COMMANDS, HELP, get_command, main, verb_arguments
from vdgs.cli.run_cmd import NOT_KEPT, RunArguments
from vdgs.cli.start_settings import start_settings
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.options import Option, options_of
from vdgs.config.presets import PRESETS
from vdgs.runs.config_file import run_command as written_command
from vdgs.runs.run_settings import RunSettings

#: Modules of those that take long to import, in the order in which they are, and what each imports only when needed: of
#: each of two processes.
IMPORTED_LATE = (
    {"vdgs.report.write_report": "torch"},
    {"vdgs.viewer.server": "matplotlib", "vdgs.export.export_run": "viser"},
)
EACH = """
import importlib, sys
for module, late in {!r}.items():
    importlib.import_module(module)
    if late in sys.modules:
        sys.exit(f"{{module}} imports {{late}}")
"""


@pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="no viser")
@pytest.mark.parametrize("late", IMPORTED_LATE)
def test_what_only_some_work_needs_is_not_waited_for(late):
    done = subprocess.run(
        [sys.executable, "-c", EACH.format(late)], capture_output=True, text=True, timeout=PATIENCE_SECONDS
    )
    assert done.returncode == 0, done.stderr


def test_every_verb_is_in_the_help_and_has_an_action():
    for verb in COMMANDS:
        assert f"  {verb} " in HELP
        assert callable(get_command(verb))


def test_the_help_begins_with_five_verbs():
    assert COMMANDS[:5] == ("run", "status", "view", "export", "doctor")


@pytest.mark.parametrize("verb", COMMANDS)
@pytest.mark.parametrize("columns", [70, 100])
def test_every_verb_explains_itself_on_two_screens_and_in_full(verb, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    pages = {}
    for flag in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as ended:
            main([verb, flag])
        assert ended.value.code == 0
        pages[flag] = capsys.readouterr().out
        assert max(map(len, pages[flag].splitlines())) <= columns
    assert len(pages["--help"].splitlines()) <= 96
    kind = (verb_arguments() | {"bench": BenchArguments})[verb]
    assert kind is not None
    said = " ".join(pages["--help-all"].split())
    for option in options_of(kind):
        assert option.help
        assert option.help.rstrip(".") in said
        assert option.is_positional or re.search(rf"{re.escape(option.flag)}[ ,]", said)


def test_what_people_set_has_a_line_each(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    shown = [flag for flags in COMMON_OPTIONS["run"].values() for flag in flags]
    assert {"--images", "--preset", "--blocks", "--output", "--overwrite", "--config", "--dry-run"} <= set(shown)
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 60
    assert sum(line.startswith("      ") for line in lines) <= 1  # a long list of formats


def help_of(capsys, *arguments: object) -> str:
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    assert ended.value.code == 0
    return " ".join(capsys.readouterr().out.split())


def test_the_preset_decides_the_defaults(capsys):
    for arguments, shown in ((["--preset", "laptop"], "0.0001"), (["--preset=default"], "0.0002"), ([], "0.0001")):
        text = help_of(capsys, "train-coarse", "--device", "cpu", *arguments, "--help-all")
        assert re.findall(r"--densify\.grad-threshold NUMBER .*?\(default: ([^)]*)\)", text) == [shown]
    assert "(default: 100000)" in help_of(capsys, "train-coarse", "--help", "--preset", "default")
    assert "100000" not in help_of(capsys, "train-coarse", "--help", "--preset", "laptop")


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
    [("report", "vdgs.report.write_report.write_report"), ("ortho", "vdgs.rendering.ortho.render_ortho.render_ortho")],
)
def test_verbs_that_show_a_result_can_be_quiet(verb, does, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    Path("run/config.yaml").touch()

    def done(*given: object) -> Path:
        for console in (each for each in given if isinstance(each, Console)):
            console.print("how it goes")
            console.print("[yellow]note[/] what a person must know")
        return Path("result")

    monkeypatch.setattr(does, done)
    monkeypatch.setattr("vdgs.runs.run_context.RunContext.from_path", lambda run, *_: run)
    get_command(verb)(["run"])
    assert capsys.readouterr().out.startswith({"report": "report: result", "ortho": "how it goes"}[verb])
    get_command(verb)(["run", "--quiet"])
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err in ("", "note what a person must know\n")


def test_scripts_of_before_may_keep_their_names_of_options(tmp_path):
    (tmp_path / "DCIM").mkdir()
    sfm = parse_words(SfmArguments, [str(tmp_path / "DCIM"), "-o", str(tmp_path / "c"), "--features", "1500"])
    assert sfm.over().options.max_num_features == 1500
    town = parse_words(SynthArguments, [str(tmp_path / "t"), "--images", "16", "--test-images=2"])
    asked = town.over().options
    assert (asked.num_images, asked.num_test_images) == (16, 2)


def test_the_command_that_is_kept_works_in_every_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for output in (["--output", "run"], ["-o", "run"], ["--out=run"]):
        typed = ["my place", *output, "--overwrite", "--blocks", "2", "--no-ortho", "--quiet"]
        kept = parse_words(RunArguments, typed).command_line("run", NOT_KEPT)
        assert shlex.split(kept) == [
            "vdgs", "run", f"{tmp_path}/my place", "--output", f"{tmp_path}/run", "--no-ortho", "--blocks", "2",
        ]  # fmt: skip


@pytest.mark.parametrize(
    "options",
    [
        ["--sfm.check-points", "P4", "P7", "--slurm.sbatch-args", "--qos=long", "--exclusive"],
        ["--images=--odd", "--slurm.sbatch-args", "--qos=long"],
    ],
)
def test_the_command_that_is_kept_says_the_same(options):
    given = parse_words(RunArguments, ["A", "B", "-o", "R", *options])
    again = parse_words(RunArguments, shlex.split(given.command_line("run"))[2:])
    absolute = {path: again.values[path] for path in (("capture",), ("output",), ("extra_image_folders",))}
    assert absolute["extra_image_folders",] == (Path("B").resolve(),)
    assert again.values == given.values | absolute


@pytest.mark.parametrize("name", ["--odd", "-o", "~x", "7"])
def test_the_command_that_is_written_for_a_run_asks_for_its_settings(name):
    options = CaptureOptions(images=name, max_images=12)
    settings = RunSettings.create("/place", options, PRESETS["laptop"])
    given = parse_words(RunArguments, shlex.split(written_command(settings, Path("R")))[2:])
    assert given.over(start_settings(given).layer()).options == options


def test_more_folders_of_photographs_are_used_wherever_they_stand():
    after_many = ["-o", "R", "--sfm.check-points", "P4", "P7", "--", "A", "B", "D"]
    for words in (
        ["A", "B", "D", "-o", "R"], ["A", "-o", "R", "B", "D"], ["-o", "R", "--quiet", "A", "--", "B", "D"], after_many,
    ):  # fmt: skip
        arguments = parse_words(RunArguments, words).over()
        assert (arguments.capture, arguments.extra_image_folders) == (Path("A"), (Path("B"), Path("D")))


def test_values_are_read_as_their_types_say():
    words = [
        "C", "-o", "R", "--up", "-x", "--resolution-schedule", "0", "4", "0.5", "1", "--lr.offsets", "1e-2", "1e-4",
        "--blocks", "auto", "--max_images", "None", "--init.no-mvs", "--sfm.check-points", "a", "b",
        "--slurm.sbatch-args", "--qos=long", "--exclusive", "--seed=3",
    ]  # fmt: skip
    given = parse_words(RunArguments, words).over()
    assert given.options.up == "-x"
    assert given.training.resolution_schedule == ((0.0, 4), (0.5, 1))
    assert given.training.lr.offsets == (0.01, 1e-4)
    assert (given.partition.blocks, given.options.max_images, given.training.seed) == ("auto", None, 3)
    assert given.training.init.mvs is False
    assert given.sfm.check_points == ("a", "b")
    assert given.executor_options.slurm.sbatch_args == ("--qos=long", "--exclusive")
    files = parse_words(
        ExportArguments, ["R", "-o", "a.ply", "--output", "b.spz", "--bbox", "-1", "-2e1", "3", "4"]
    ).over()
    assert files.output == (Path("a.ply"), Path("b.spz"))
    assert files.bbox == (-1.0, -20.0, 3.0, 4.0)


def test_the_arguments_are_parsed_once(uncut, monkeypatch, tmp_path, capsys):
    parsed = []

    def count(kind: type, words: list[str]) -> GivenArguments:
        parsed.append(kind.__name__)
        return parse_words(kind, words)

    monkeypatch.setattr(common, "parse_words", count)
    (tmp_path / "empty").mkdir()
    for arguments in (
        ("train-coarse", tmp_path / "empty", "--output", tmp_path / "run", "--preset=laptop"),
        ("train-blocks", uncut),
        ("merge", uncut, "--rule", "owner"),
        ("partition", "--capture", uncut, tmp_path),
    ):
        with pytest.raises(SystemExit) as ended:
            main([str(each) for each in arguments])
        assert ended.value.code == 1
    assert parsed == ["TrainCoarseArguments", "TrainBlocksArguments", "MergeArguments", "PartitionArguments"]
    assert f"{tmp_path}: is not a run folder" in capsys.readouterr().err


def test_a_short_help_ends_a_clause_where_it_makes_sense(capsys):
    def option(text: str) -> Option:
        return Option(path=("x",), flag="--x", hint=int, help=text)

    assert option("Depth of the views (with what hides), and of points. More.").summary(40).endswith("and of points")
    assert option("Frames of a film, of its path and the film; 0: what its file says").summary(50).endswith("the film")
    assert option("Folder of maps, not among photographs, nor others").summary(20).endswith("nor others")
    assert option("Steps (one for each photograph)").summary(20) == "Steps"
    assert "(default: on; off: --no-ortho)" in help_of(capsys, "run", "--help")


def test_no_explanation_of_the_short_help_breaks_off():
    for kind in filter(None, verb_arguments().values()):
        for option in options_of(kind):
            assert not option.summary(68).endswith((",", ":", "(")), option.flag


def test_a_word_of_an_option_is_refused_with_words_that_may_stand_there():
    program = next(each for each in options_of(ExportArguments) if each.flag == "--for")
    with pytest.raises(ValueError, match=r"^ros: must be supersplat or .* or unity$"):
        program.read(["ros"])


def test_a_run_decides_the_defaults_of_its_help(uncut, capsys):
    for arguments, sampling in (([uncut], "sqrt-visibility"), ([], "uniform")):
        assert f"(default: {sampling})" in help_of(capsys, "train-blocks", *arguments, "--help-all")
