"""What verbs have in common: presets, the settings that a run recorded, threads, the console."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import tyro

from vdgs.settings.method import MethodConfig
from vdgs.settings.presets import PRESETS, PresetName
from vdgs.settings.ranges import refuse

#: What lines begin with that are printed even where a person asked for quiet.
LOUD = ("[yellow]", "[red]")

if TYPE_CHECKING:
    from rich.console import Console

    from vdgs.runs.folder import RunFolder


Parsed = TypeVar("Parsed")


def parse(kind: type[Parsed], arguments: list[str], prog: str, default: Parsed | None = None) -> Parsed:
    """The arguments of a verb. Raises VdgsError for a number that is outside its range (`settings.ranges`)."""
    if default is None:
        asked = tyro.cli(kind, args=arguments, prog=prog)
    else:
        asked = tyro.cli(kind, args=arguments, prog=prog, default=default)
    refuse(asked)
    return asked


def named_preset(arguments: list[str]) -> PresetName:
    """The preset named on the command line: it decides the defaults of all other options."""
    for place, argument in enumerate(arguments):
        value = argument.partition("=")[2] if argument.startswith("--preset=") else None
        if argument == "--preset" and place + 1 < len(arguments):
            value = arguments[place + 1]
        if value in PRESETS:
            return value  # type: ignore[return-value]
    return "paper"


def recorded_run(arguments: list[str], kind: type, prog: str) -> tuple[RunFolder, MethodConfig]:
    """The run that the arguments name and its settings: they are the defaults of the options, and of their help where
    the run is named."""
    from vdgs.runs.folder import RunFolder

    if "-h" in arguments or "--help" in arguments:
        named = next((RunFolder(Path(a)) for a in arguments if (Path(a) / "config.yaml").is_file()), None)
        return (named, named.method()) if named else parse(kind, arguments, prog)
    run = RunFolder(parse(kind, arguments, prog).run)
    return run, run.method()


def change_settings(run: RunFolder, method: MethodConfig, redo: bool, quiet: bool = False) -> None:
    """Give the run other settings for later stages, if they are other. RunError where another process drives it."""
    from vdgs.errors import VdgsError
    from vdgs.settings.checks import validate
    from vdgs.settings.plain import to_dict

    problems = validate(method)
    if problems:
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))
    wanted = run.settings() | to_dict(method)
    if wanted != run.settings():
        with run.driven(), run.locked():
            for line in run.change_settings(wanted, redo):
                open_console(quiet).print(f"[yellow]changed[/] {line}", highlight=False)


def find_capture(run: RunFolder, at: Path | None) -> None:
    """Let the run find its capture where --capture says that it lies now, if it says so."""
    if at is not None:
        from vdgs.runs.opening import remember_capture

        remember_capture(run, at)


def use_threads(count: int) -> None:
    from vdgs.kernels import set_threads, threads

    set_threads(count if count > 0 else threads())


def use_device(asked: str) -> str:
    """Which device computes, decided before any work begins. Raises VdgsError for one that cannot."""
    from vdgs.kernels.devices import choose

    return choose(asked).device


def open_console(quiet: bool = False) -> Console:
    """Where verbs print to; with `quiet` only notes and warnings are, on standard error."""
    from rich.console import Console

    if not quiet:
        return Console(soft_wrap=True)

    class Warnings(Console):
        """Prints what a person must know, and leaves out how work goes."""

        def print(self, *objects: Any, **options: Any) -> None:
            if objects and str(objects[0]).startswith(LOUD):
                super().print(*objects, **options)

        def rule(self, *_: Any, **__: Any) -> None:
            pass

    return Warnings(soft_wrap=True, stderr=True, force_terminal=False, force_interactive=False)


def as_typed(verb: str, arguments: list[str], paths: tuple[Path, ...]) -> str:
    """The command that was given, for every folder to type it in: paths are whole, `--redo` and `--quiet` left out."""
    whole = {str(path): str(path.resolve()) for path in paths}
    kept = [each for each in arguments if each not in ("--redo", "--quiet")]
    for name, path in list(whole.items()):
        whole[f"--output={name}"] = f"--output={path}"
    return shlex.join(["vdgs", verb, *(whole.get(each, each) for each in kept)])
