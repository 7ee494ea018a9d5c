"""No message names an option that the verb lacks."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

import vdgs
from experiments.bench.cli import BenchArguments
from vdgs.cli.advice import COMMAND, OPTION, Advice, flags_of
from vdgs.cli.main import COMMANDS, verb_arguments
from vdgs.system.exit_codes import exit_code_of

pytestmark = [pytest.mark.xdist_group("advice"), pytest.mark.slow]

SOURCE = Path(vdgs.__file__).parent
#: Options of other programs, by the end of the file that names them.
OF_OTHERS = {
    "broken_packages.py": {"--force-reinstall"},
    "system_checks.py": {"--force-reinstall"},
    "executor_options.py": {"--gres", "--qos", "--constraint"},
    "slurm_commands.py": {
        "--batch",
        "--signal",
        "--oneliner",
        "--me",
        "--noheader",
        "--array",
        "--format",
        "--parsable",
    },
    "slurm_executor.py": {"--requeue", "--exclude", "--name"},
    "crs.py": {"--file"},
    "launch.py": {"--std"},
    "nvrtc.py": {"--gpu-architecture"},
    "cli/main.py": {"--version"},
    "config_file.py": {"--no"},  # the beginning of a switch
    "mega_nerf.py": {"--image", "--dataset"},  # --image_path and --dataset_path of its script
    "nested_captures.py": {"--image", "--dataset"},
}  # fmt: skip

#: Tables of options, and style sheets, whose variables look like options.
NO_MESSAGES = {SOURCE / "cli" / "help_text.py", SOURCE / "report" / "html_page.py"}


def all_arguments() -> dict[str, type | None]:
    return verb_arguments() | {"bench": BenchArguments}


@cache
def texts_with_options() -> list[tuple[str, str]]:
    """Every text of the sources that names an option of vdgs, and the file; `{}` stands for what is filled in."""
    found = set()
    for path in sorted(set(SOURCE.rglob("*.py")) - NO_MESSAGES):
        file, skipped = path.relative_to(SOURCE).as_posix(), set[int]()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):  # a node before what it holds
            if isinstance(node, ast.Expr):
                skipped.add(id(node.value))
            elif isinstance(node, ast.JoinedStr):
                skipped |= {id(part) for part in node.values}
            if isinstance(node, ast.JoinedStr):
                text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in skipped:
                text = node.value
            else:
                continue
            if set(OPTION.findall(text)) - others_of(file):
                found.add((file, text))
    return sorted(found)


def others_of(file: str) -> set[str]:
    return next((flags for name, flags in OF_OTHERS.items() if f"vdgs/{file}".endswith(name)), set())


def test_there_is_advice_to_check():
    assert len(texts_with_options()) > 100
    assert {"captures/loading.py", "sfm/georeferencing.py", "training/session/trainer.py"} <= {
        file for file, _ in texts_with_options()
    }


def test_a_command_in_a_message_has_the_options_it_is_shown_with():
    kinds = all_arguments()
    for file, text in texts_with_options():
        for command in COMMAND.finditer(text):
            verb = command.group(1)
            assert verb in kinds or f"`{command.group()}`" not in text, f"{file}: there is no verb {verb}: {text}"
            if verb not in kinds:  # "vdgs turns a folder ..."
                continue
            wrong = set(OPTION.findall(command.group())) - flags_of(kinds[verb])
            assert not wrong, f"{file}: vdgs {verb} has no {wrong}: {text}"


def test_every_option_in_a_message_is_one_of_some_verb():
    known = {flag for kind in all_arguments().values() for flag in flags_of(kind)}
    known |= {f"--{flag.rpartition('.')[2]}" for flag in known if flag.startswith("--sfm.")}
    for file, text in texts_with_options():
        assert not set(OPTION.findall(text)) - known - others_of(file), f"{file}: {text}"


@pytest.mark.parametrize("verb", COMMANDS)
def test_a_verb_names_an_option_that_it_lacks_only_with_those_that_have_it(verb):
    kinds = all_arguments()
    own = flags_of(kinds[verb])
    for file, text in texts_with_options():
        fitted = Advice(verb, lambda: kinds).fit(text)
        advice, _, note = (
            fitted.rpartition(" (") if fitted.endswith(")") and " of `vdgs " in fitted else (fitted, "", "")
        )
        commands = [found.group() for found in COMMAND.finditer(advice) if found.group(1) in kinds]
        of_commands = {flag for command in commands for flag in OPTION.findall(command)}
        lacked = set(OPTION.findall(advice)) - own - of_commands - others_of(file)
        assert lacked == set(OPTION.findall(note)), f"vdgs {verb}: {fitted}"


def test_what_all_verbs_say_of_a_run_is_said_as_a_command():
    """Few verbs have --output, and not all --capture: what a run says of itself, any verb may print."""
    for file, text in texts_with_options():
        of_run = file.startswith("runs/") and file != "runs/settings_file.py"  # which `vdgs config` writes
        if " " in text and (of_run or file == "captures/capture_metadata.py"):
            outside = COMMAND.sub("", text)
            assert not {"--output", "--capture"} & set(OPTION.findall(outside)), f"{file}: {text}"


def test_advice_is_fitted_to_the_verb():
    fit = Advice("run", all_arguments).fit
    assert fit("Leave the positions out: --georeference off") == "Leave the positions out: --sfm.georeference off"
    assert fit("Give --jobs 1.") == "Give --jobs 1."
    assert Advice("sfm", all_arguments).fit("say --georeference off") == "say --georeference off"
    assert Advice("train-blocks", all_arguments).fit("raise --densify.grad-threshold") == (
        "raise --block.densify.grad-threshold"
    )
    assert Advice("merge", all_arguments).fit("Add --undistort.") == "Add --undistort. (--undistort of `vdgs run`)"
    named = "Cut the scene again: vdgs partition RUN --blocks 2"
    assert Advice("merge", all_arguments).fit(named) == named


def test_advice_that_fails_hides_no_error(capsys):
    """Where memory is short, making advice needs some too."""

    def action() -> None:
        raise MemoryError

    def fit(text: str) -> str:
        raise MemoryError

    assert exit_code_of("vdgs run", action, "", fit) == 1
    assert capsys.readouterr().err.startswith("vdgs run: out of memory (no room). What was saved is kept. Smaller")
