"""What verbs have in common: presets, the settings that a run recorded, threads, the console."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import tyro

from vdgs.config.method import MethodConfig
from vdgs.config.presets import PRESETS, PresetName
from vdgs.config.ranges import check_ranges

#: What lines begin with that are printed even where a person asked for quiet.
ALWAYS_PRINTED_PREFIXES = ("[yellow]", "[red]")

if TYPE_CHECKING:
    from rich.console import Console

    from vdgs.runs.run_folder import RunFolder


Parsed = TypeVar("Parsed")


def parse_arguments(
    arguments_type: type[Parsed], arguments: list[str], prog: str, default: Parsed | None = None
) -> Parsed:
    """The arguments of a verb. Raises VdgsError for a number that is outside its range (`settings.ranges`)."""
    if default is None:
        asked = tyro.cli(arguments_type, args=arguments, prog=prog)
    else:
        asked = tyro.cli(arguments_type, args=arguments, prog=prog, default=default)
    check_ranges(asked)
    return asked


# The values of a preset, or those that a run recorded, are the defaults of all other options, and --help shows them:
# tyro must be given them before it parses and cannot look up one argument first. The two functions below look up that
# one and nothing else.


def preset_defaults(arguments: list[str]) -> tuple[PresetName, MethodConfig]:
    """The preset that the arguments name, and its settings; `default` without one, or where tyro is to refuse it."""
    named = "default"
    for argument, following in zip(arguments, [*arguments[1:], ""], strict=True):
        option, joined, value = argument.partition("=")
        if option == "--preset":
            named = value if joined else following
    name: PresetName = named if named in PRESETS else "default"  # type: ignore[assignment]
    return name, PRESETS[name]


def parse_for_run(
    kind: type[Parsed], arguments: list[str], prog: str, defaults: Callable[[MethodConfig], Parsed]
) -> tuple[Parsed, RunFolder, MethodConfig]:
    """The arguments of a verb, the run that they name and its settings, which are the `defaults`.

    Raises what `parse_arguments` raises, RunError where the run is none, VdgsError where another option names a run.
    """
    named = next((Path(each) for each in arguments if (Path(each) / "config.yaml").is_file()), None)
    if named is None:
        method = MethodConfig()
    else:
        from vdgs.runs.run_folder import RunFolder

        method = RunFolder(named).method()
    asked = parse_arguments(kind, arguments, prog, defaults(method))
    from vdgs.errors import VdgsError
    from vdgs.runs.run_folder import RunFolder

    run = RunFolder(asked.run)  # type: ignore[attr-defined]
    own = run.method()
    if named != run.path:
        raise VdgsError(f"{named}: is a run, and so is {run.path}. Name one run; --capture takes a capture's folder.")
    return asked, run, own


def update_run_settings(run: RunFolder, method: MethodConfig, overwrite: bool, quiet: bool = False) -> None:
    """Give the run other settings for later stages, if they are other. RunError where another process drives it."""
    from vdgs.config.validation_rules import validate_config
    from vdgs.errors import VdgsError

    problems = validate_config(method)
    if problems:
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))
    wanted = replace(run.settings(), **vars(method))
    if wanted != run.settings():
        with run.drive_lock(), run.locked():
            for line in run.change_settings(wanted, overwrite):
                make_console(quiet).print(f"[yellow]changed[/] {line}", highlight=False)


def select_device(name: str) -> str:
    """Which device computes, decided before any work begins. Raises VdgsError for one that cannot."""
    from vdgs.kernels.device_selection import select_device

    return select_device(name).device


def make_console(quiet: bool = False) -> Console:
    """Where verbs print to; with `quiet` only notes and warnings are, on standard error."""
    from rich.console import Console

    if not quiet:
        return Console(soft_wrap=True)

    class Warnings(Console):
        """Prints what a person must know, and leaves out how work goes."""

        def print(self, *objects: Any, **options: Any) -> None:
            if objects and str(objects[0]).startswith(ALWAYS_PRINTED_PREFIXES):
                super().print(*objects, **options)

        def rule(self, *_: Any, **__: Any) -> None:
            pass

    return Warnings(soft_wrap=True, stderr=True, force_terminal=False, force_interactive=False)


def absolute_command_line(verb: str, arguments: list[str], paths: tuple[Path, ...]) -> str:
    """The command that was given, for every folder to type it in: paths are whole, `--overwrite` and `--quiet` left out."""
    whole = {str(path): str(path.resolve()) for path in paths}
    kept = [each for each in arguments if each not in ("--overwrite", "--quiet")]
    for name, path in list(whole.items()):
        whole[f"--output={name}"] = f"--output={path}"
    return shlex.join(["vdgs", verb, *(whole.get(each, each) for each in kept)])
