"""Command lines parsed once: what a person gave, option by option, to be laid over defaults that depend on it."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from vdgs.config.options import Option, Values, option_words, options_of, with_values
from vdgs.config.output_paths import is_output
from vdgs.config.ranges import check_ranges
from vdgs.errors import RunError, VdgsError
from vdgs.system.quoting import check_is_text, shell_line
from vdgs.system.similar_paths import suggest_path

HELP_FLAGS, FULL_HELP_FLAG = ("-h", "--help"), "--help-all"


#: What word processors and web pages make of two hyphens.
_LONG_DASHES = "\u2010\u2011\u2012\u2013\u2014\u2015\u2212"


class UsageError(Exception):
    """A command line that cannot be understood; the message says what is wrong with it."""


@dataclass
class GivenArguments:
    """What a command line gives for the options of a dataclass, before any default."""

    kind: type
    words: dict[tuple[str, ...], list[str]] = field(default_factory=dict)
    """Of each option, by its path, in the order in which they were given."""
    values: Values = field(default_factory=dict)
    help: str = ""
    """The option that asks for help, if any does."""

    def get(self, *path: str) -> Any:
        """The value of an option; None where it was not given."""
        return self.values.get(path)

    def over(self, defaults: Mapping[str, Any] = MappingProxyType({})) -> Any:
        """The arguments, over the values of some fields as defaults."""
        required = {each.path[0]: self.values.get(each.path) for each in options_of(self.kind) if each.is_required}
        return with_values(self.kind(**{**required, **defaults}), self.values)

    def check(self) -> None:
        """Raise UsageError where something required is missing, VdgsError for a number outside its range, for an output
        among photographs or in a capture's inputs (`captures.output_guard`) and for an input that does not exist."""
        options = options_of(self.kind)
        missing = [each for each in options if each.is_required and each.path not in self.values]
        names = " and ".join(each.metavar if each.is_positional else f"{each.flag} {each.metavar}" for each in missing)
        if missing:
            raise UsageError(f"{names} {'is' if len(missing) == 1 else 'are'} missing")
        check_ranges(self.over())
        paths = [(each, path) for each in options for path in _paths(self.values.get(each.path))]
        for option, path in paths:
            check_is_text(path)
            if not is_output(option.hint):
                _check_input(option, path)
        for option, path in paths:
            if not is_output(option.hint):
                continue
            _check_place(path)
            if not (path / "config.yaml").is_file():
                from vdgs.captures.output_guard import check_no_link, check_output

                check_output(path)
                check_no_link(path)

    def command_line(self, verb: str, without: Iterable[str] = ()) -> str:
        """The command as it can be typed in any folder: with absolute paths, and without some options."""
        line = ["vdgs", verb]
        # Arguments without a name come first: after an option of any number of words they would be taken for its own.
        for option in sorted(options_of(self.kind), key=lambda each: not each.is_positional):
            line += [] if option.flag in without else self._absolute_words(option)
        return shell_line(line)

    def _absolute_words(self, option: Option) -> list[str]:
        words, value = self.words.get(option.path), self.values.get(option.path)
        if words is None:
            return []
        words = [str(path.resolve()) for path in _paths(value)] or words
        if option.is_positional:
            return words
        if option.is_repeatable:
            return [word for each in words for word in option_words(option.flag, [each])]
        return option_words(option.off_flag if value is False else option.flag, words)


def _paths(value: Any) -> list[Path]:
    """The paths in the value of an option."""
    return [each for each in (value if isinstance(value, tuple) else (value,)) if isinstance(each, Path)]


def _check_input(option: Option, path: Path) -> None:
    is_run = option.positional is not None and option.positional.is_run
    if not path.exists():
        named = "" if option.is_positional else f"{option.flag} "
        fault = "is not a run folder, for it does not exist" if is_run else "no such file or folder"
        if path.is_symlink():
            raise VdgsError(f"{named}{path}: is a link to {path.readlink()}, which leads to no file or folder")
        raise VdgsError(f"{named}{path}: {fault}{suggest_path(path)}")
    begins = (path / "capture").is_dir()  # a run that still makes a capture of photographs
    if is_run and not begins and not (path / "config.yaml").is_file():
        above = next(
            (
                each
                for each in path.absolute().parents
                if (each / "config.yaml").is_file() and (each / "coarse").is_dir()
            ),
            None,
        )
        remedy = f"It lies in one: {above}" if above else "Train first: vdgs run CAPTURE --output RUN"
        raise RunError(f"{path}: is not a run folder (no config.yaml). {remedy}")


def _check_place(output: Path) -> None:
    """Raise VdgsError where the system can have no file or folder of this name: before any work, not after it."""
    try:
        output.stat()
    except FileNotFoundError:
        return
    except OSError as error:
        from vdgs.system.atomic_files import disk_hint

        raise VdgsError(f"{output}: cannot be written ({error.strerror}). {disk_hint(error)}.") from None


def parse_words(kind: type, words: Sequence[str]) -> GivenArguments:
    """What words give for the options of a dataclass.

    Raises UsageError for an option that is none, and for a value that is of another type.
    """
    given, free = GivenArguments(kind), list[str]()
    asked = next((each for each in words if each in (*HELP_FLAGS, FULL_HELP_FLAG)), "")
    try:
        _read_options(given, words, free)
        _read_positionals(given, free)
    except UsageError:
        if not asked:
            raise
    given.help = asked
    return given


def _read_options(given: GivenArguments, words: Sequence[str], free: list[str]) -> None:
    """Read the options among the words; what has no name goes into `free`."""
    known = _named(given.kind)
    index = 0
    while index < len(words):
        word, index = words[index], index + 1
        name, joined, value = word.partition("=")
        name = _spelled(name)
        if word == "--":
            free += words[index:]
            return
        if word in (*HELP_FLAGS, FULL_HELP_FLAG):
            continue
        if name not in known:
            typed = f"--{name.lstrip(_LONG_DASHES)}"
            if name.startswith(tuple(_LONG_DASHES)) and typed in known:
                raise UsageError(f"{name} begins with a long dash, as texts have them; type {typed}")
            if word.startswith("-") and Path(word).exists():
                raise UsageError(f"{word} is read as an option; write the path as ./{word}")
            if word.startswith("-") and not _is_number(word):
                raise UsageError(f"there is no option {name}{_suggestion(name, known, given.kind)}")
            free.append(word)
            continue
        option = known[name]
        taken = [value] if joined else []
        count = 1 if option.is_repeatable else option.num_words
        while index < len(words) and len(taken) != count and not _ends_values(words[index], count, known):
            taken.append(words[index])
            index += 1
        if option.num_words == 0 and index < len(words) and words[index].lower() in _ON_OR_OFF:
            taken = [] if Path(words[index]).exists() else [words[index]]
        _give(given, option, taken, name)


def _give(given: GivenArguments, option: Option, words: list[str], name: str) -> None:
    if option.num_words == 0:
        if words:
            raise UsageError(f"{name} takes no value; {option.flag} switches it on, {option.off_flag} off")
        given.values[option.path], given.words[option.path] = name != option.off_flag, []
        return
    if option.is_repeatable:
        words = [*given.words.get(option.path, []), *words]
    try:
        given.values[option.path] = option.read(words)
    except ValueError as error:
        raise UsageError(f"{option.metavar if option.is_positional else option.flag} {error}") from None
    given.words[option.path] = words


def _read_positionals(given: GivenArguments, free: list[str]) -> None:
    for option in options_of(given.kind):
        if option.is_positional and free and option.path not in given.values:
            count = len(free) if option.num_words is None else option.num_words
            words, free = free[:count], free[count:]
            _give(given, option, words, option.flag)
    if free:
        raise UsageError(f"{free[0]!r} belongs to no option")


def _named(kind: type) -> dict[str, Option]:
    """Every option by each of its names."""
    named = {name: option for option in options_of(kind) for name in option.flags}
    switches = {option.off_flag: option for option in options_of(kind) if option.num_words == 0}
    return named | switches | dict.fromkeys((*HELP_FLAGS, FULL_HELP_FLAG), _HELP)


_HELP = Option(path=("help",), flag="--help", hint=bool, help="")


def _ends_values(word: str, count: int | None, known: dict[str, Option]) -> bool:
    """Whether a word does not belong to the option before it, which takes so many; those that take any number also take
    options of other programs."""
    return word == "--" or _spelled(word.partition("=")[0]) in known or (count is not None and word.startswith("--"))


def _spelled(name: str) -> str:
    """An option as it is spelled here: with hyphens."""
    return name.replace("_", "-") if name.startswith("--") else name


def _is_number(word: str) -> bool:
    """Whether a word is a negative number, such as -5, -.5 and -1,5."""
    return re.match(r"-\.?\d|-(inf(inity)?|nan)$", word, re.IGNORECASE) is not None


#: What other programs call options of ours; the first that a verb has is meant.
_ELSEWHERE = {
    "epsg": "crs", "srs": "crs", "t-srs": "crs", "resolution": "gsd downscale", "r": "downscale", "d": "downscale",
    "data-factor": "downscale", "steps": "iterations", "max-steps": "iterations", "max-num-iterations": "iterations",
    "model-path": "output", "m": "output", "output-path": "output", "output-dir": "output", "result-dir": "output",
    "project-path": "output", "i": "images", "size": "width", "format": "for",
}  # fmt: skip
#: What they call what is given without an option here.
_WITHOUT_NAME = {
    "source-path",
    "s",
    "data",
    "data-dir",
    "data-path",
    "input",
    "input-path",
    "image-path",
    "load-config",
}
#: Words behind an option that takes none.
_ON_OR_OFF = {"true", "false", "yes", "no", "on", "off"}


def _suggestion(name: str, known: dict[str, Option], kind: type) -> str:
    """A question about the option that may be meant: by another program's name for it, by its whole name, or by that
    within its group or another one."""
    plain = name.lstrip("-")
    for ours in _ELSEWHERE.get(plain, "").split():
        if f"--{ours}" in known:
            return f"; did you mean --{ours}?"
    if plain in _WITHOUT_NAME and (first := next((each for each in options_of(kind) if each.is_positional), None)):
        return f"; {first.metavar} is given without one"
    within = {f"--{each.rpartition('.')[2]}": each for each in reversed(known) if "." in each}
    candidates = within | {each: each for each in known}
    for sought in (name, f"--{name.removeprefix('--').rpartition('.')[2]}"):
        if like := difflib.get_close_matches(sought, list(candidates), n=1, cutoff=0.7):
            return f"; did you mean {candidates[like[0]]}?"
    return ""
