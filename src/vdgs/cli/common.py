"""What verbs have in common: arguments, presets, the settings that a run recorded, the console."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro
from tyro.conf import Positional, arg

from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.method import MethodConfig
from vdgs.config.output_paths import output_paths
from vdgs.config.presets import PRESETS, PresetName
from vdgs.config.ranges import WORKER_COUNT, check_ranges
from vdgs.errors import VdgsError
from vdgs.system.quoting import shell_line

#: What lines begin with that are printed even where a person asked for quiet.
ALWAYS_PRINTED_PREFIXES = ("[yellow]", "[red]")

if TYPE_CHECKING:
    from rich.console import Console

    from vdgs.distributed.sharded_job import ExecutionOptions
    from vdgs.runs.run_folder import RunFolder

Parsed = TypeVar("Parsed")


@dataclass(frozen=True, kw_only=True)
class QuietArguments:
    """What every verb that prints takes."""

    quiet: bool = False
    """Print nothing but notes, warnings and errors."""


@dataclass(frozen=True, kw_only=True)
class ComputeArguments(QuietArguments):
    """What verbs that compute take."""

    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads of the kernels; 0 for all cores. The result does not depend on it."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda or cuda:0. `auto` takes a GPU only if every operation runs on it."""


@dataclass(frozen=True, kw_only=True)
class RunPathArguments:
    """What verbs about a run that is there take."""

    run: Positional[Path]
    """Run folder."""


@dataclass(frozen=True, kw_only=True)
class StageArguments(RunPathArguments, QuietArguments):
    """What verbs take that read the capture of a run."""

    capture: Path | None = None
    """Where the capture lies now, if it was moved; the run remembers it."""


@dataclass(frozen=True, kw_only=True)
class ShardArguments:
    """What verbs take whose work is split into shards (views, tiles, cameras, parts)."""

    jobs: Annotated[int, WORKER_COUNT] = 0
    """Shards done at once, each in a process of its own; 0: on this machine one process does all, a cluster as many as
    it has room for."""
    executor_options: Annotated[ExecutorOptions, arg(name="")] = field(default_factory=ExecutorOptions)

    def execution(self, device: str) -> ExecutionOptions:
        """Where the shards are done. Raises VdgsError for options that do not work."""
        from vdgs.distributed.sharded_job import ExecutionOptions

        self.executor_options.check()
        return ExecutionOptions(self.executor_options, self.jobs, device=device)


def parse_arguments(
    arguments_type: type[Parsed], arguments: list[str], prog: str, default: Parsed | None = None
) -> Parsed:
    """The arguments of a verb. Raises VdgsError for a number that is outside its range (`config.ranges`), and
    for an output among photographs or in a capture's inputs (`captures.output_guard`)."""
    options: dict[str, Any] = {} if default is None else {"default": default}
    parsed: Parsed = tyro.cli(arguments_type, args=arguments, prog=prog, **options)
    check_ranges(parsed)
    if outputs := list(output_paths(parsed)):
        from vdgs.captures.output_guard import check_output

        for path in outputs:
            check_output(path)
    return parsed


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
    arguments_type: type[Parsed], arguments: list[str], prog: str, defaults: Callable[[MethodConfig], Parsed]
) -> tuple[Parsed, RunFolder, MethodConfig]:
    """The arguments of a verb, the run that they name and its settings, which are the `defaults`.

    Raises what `parse_arguments` raises, RunError where the run is none, VdgsError where another option names a run.
    """

    def open_folder(path: Path) -> RunFolder:
        from vdgs.runs.run_folder import RunFolder  # --help of no run comes without it

        return RunFolder(path)

    named = next((Path(each) for each in arguments if (Path(each) / "config.yaml").is_file()), None)
    method = MethodConfig() if named is None else open_folder(named).method()
    parsed = parse_arguments(arguments_type, arguments, prog, defaults(method))
    run = open_folder(parsed.run)  # type: ignore[attr-defined]
    own = run.method()
    if named != run.path:
        raise VdgsError(f"{named}: is a run, and so is {run.path}. Name one run; --capture takes a capture's folder.")
    return parsed, run, own


def update_run_settings(run: RunFolder, method: MethodConfig, overwrite: bool, console: Console) -> None:
    """Give the run other settings for later stages, if they are other. RunError where another process drives it."""
    from vdgs.config.validation_rules import check_config

    check_config(method)
    settings = replace(run.settings(), **vars(method))
    if settings != run.settings():
        with run.drive_lock(), run.locked():
            for line in run.change_settings(settings, overwrite):
                console.print(f"[yellow]changed[/] {line}", highlight=False)


def set_up_compute(device: str, threads: int) -> str:
    """Set the number of threads; returns the device that computes. Raises VdgsError for one that cannot."""
    from vdgs.kernels import configure_threads
    from vdgs.kernels.device_selection import select_device

    selected = select_device(device).device
    configure_threads(threads)
    return selected


def make_console(quiet: bool = False) -> Console:
    """Where verbs print to; with `quiet` only notes and warnings are, on standard error."""
    from rich.console import Console

    from vdgs.system.console import escape_names

    class Names(Console):
        """Prints names with brackets as they are."""

        def print(self, *objects: Any, **options: Any) -> None:
            if options.get("markup", True):
                objects = tuple(escape_names(each) if isinstance(each, str) else each for each in objects)
            super().print(*objects, **options)

    if not quiet:
        return Names(soft_wrap=True)

    class Warnings(Names):
        """Prints what a person must know, and leaves out how work goes."""

        def print(self, *objects: Any, **options: Any) -> None:
            if objects and str(objects[0]).startswith(ALWAYS_PRINTED_PREFIXES):
                super().print(*objects, **options)

        def rule(self, *_: Any, **__: Any) -> None:
            pass

    return Warnings(soft_wrap=True, stderr=True, force_terminal=False, force_interactive=False)


def absolute_command_line(verb: str, arguments: list[str], paths: tuple[Path, ...]) -> str:
    """The command as it can be typed in any folder: with absolute paths, without `--overwrite` and `--quiet`."""
    whole = {str(path): str(path.resolve()) for path in paths}
    whole |= {f"--output={name}": f"--output={path}" for name, path in whole.items()}
    words = [whole.get(each, each) for each in arguments if each not in ("--overwrite", "--quiet")]
    return shell_line(["vdgs", verb, *words])
