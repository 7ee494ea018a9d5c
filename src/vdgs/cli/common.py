"""What verbs have in common: arguments, presets, the settings that a run recorded, the console."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from vdgs.cli.advice import MESSAGE_FIT
from vdgs.cli.argument_parser import FULL_HELP_FLAG, GivenArguments, UsageError, parse_words
from vdgs.config.commands import RunPath
from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.method import MethodConfig
from vdgs.config.ranges import WORKER_COUNT, FlagName, check_ranges
from vdgs.errors import VdgsError

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
    """Print nothing but notes, warnings, errors and dry runs."""


@dataclass(frozen=True, kw_only=True)
class CaptureArguments:
    """What verbs take that read the capture of a run."""

    capture: Path | None = None
    """Where the capture lies now, if it was moved; the run remembers it."""


@dataclass(frozen=True, kw_only=True)
class StageArguments(RunPath, QuietArguments, CaptureArguments):
    """What the stages of a run take."""


@dataclass(frozen=True, kw_only=True)
class ShardArguments:
    """What verbs take whose work is split into shards (views, tiles, cameras, parts)."""

    jobs: Annotated[int, WORKER_COUNT] = 0
    """Shards done at once; 0: one, or what a cluster has room for. Each has a process of its own."""
    executor_options: Annotated[ExecutorOptions, FlagName("")] = field(default_factory=ExecutorOptions)

    def execution(self, device: str) -> ExecutionOptions:
        """Where the shards are done. Raises VdgsError, before anything is written, for options that do not work and an
        executor that is not there."""
        from vdgs.distributed.backend_selection import check_backend_reachable
        from vdgs.distributed.sharded_job import ExecutionOptions

        check_backend_reachable(self.executor_options)
        return ExecutionOptions(self.executor_options, self.jobs, device=device)


#: Defaults of some fields of the arguments, which may depend on what was given.
Defaults = Callable[[GivenArguments], Mapping[str, Any]]


def read_arguments(kind: type, words: list[str], verb: str, defaults: Defaults = lambda _: {}) -> GivenArguments:
    """What a command line gives for a verb. Prints the help with the `defaults` and ends the process where it is asked
    for, or with the code for it where the command line cannot be understood.

    Raises VdgsError for an input that does not exist, before anything heavy is imported.
    """
    try:
        given = parse_words(kind, words)
        if not given.help:
            given.check()
            return given
    except UsageError as error:
        print(
            f"vdgs {verb}: {error}\n`vdgs {verb} --help` shows the options, `vdgs {verb} --help-all` all of them.",
            file=sys.stderr,
        )
        sys.exit(2)
    from vdgs.cli.help_text import help_text

    try:
        shown = given.over(defaults(given))
    except VdgsError:  # of no run, or of none that can be read
        shown = given.over()
    print(help_text(verb, kind, shown, full=given.help == FULL_HELP_FLAG), end="")
    sys.exit(0)


def parse_arguments(kind: type[Parsed], words: list[str], verb: str, defaults: Defaults = lambda _: {}) -> Parsed:
    """The arguments of a verb over its defaults. Raises what `read_arguments` and `defaults` raise, and VdgsError for a
    number outside its range (`config.ranges`) and for an output among photographs."""
    given = read_arguments(kind, words, verb, defaults)
    parsed: Parsed = given.over(defaults(given))
    check_ranges(parsed)
    return parsed


def parse_for_run(
    kind: type[Parsed], words: list[str], verb: str, defaults: Callable[[MethodConfig], Mapping[str, Any]]
) -> tuple[Parsed, RunFolder, MethodConfig]:
    """The arguments of a verb, the run that they name and its settings, which are the `defaults`.

    Raises what `parse_arguments` raises, and RunError where the run is none.
    """
    from vdgs.runs.run_folder import RunFolder

    def own(given: GivenArguments) -> Mapping[str, Any]:
        path = given.get("run")
        return {} if path is None else defaults(RunFolder(path).method())

    parsed = parse_arguments(kind, words, verb, own)
    run = RunFolder(parsed.run)  # type: ignore[attr-defined]
    return parsed, run, run.method()


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
    """Where the verb that runs prints to; with `quiet` only notes and warnings are, on standard error."""
    from rich.console import Console

    from vdgs.system.console import escape_names

    fit = MESSAGE_FIT.get()

    class Fitted(Console):
        """Prints texts as they are for the verb, and names with brackets as they are."""

        def print(self, *objects: Any, **options: Any) -> None:
            def shown(text: str) -> str:
                return fit(escape_names(text) if options.get("markup", True) else text)

            super().print(*(shown(each) if isinstance(each, str) else each for each in objects), **options)

    if not quiet:
        return Fitted(soft_wrap=True)

    class Warnings(Fitted):
        """Prints what a person must know, and leaves out how work goes."""

        def print(self, *objects: Any, **options: Any) -> None:
            if objects and str(objects[0]).startswith(ALWAYS_PRINTED_PREFIXES):
                super().print(*objects, **options)

        def rule(self, *_: Any, **__: Any) -> None:
            pass

    return Warnings(soft_wrap=True, stderr=True, force_terminal=False, force_interactive=False)
