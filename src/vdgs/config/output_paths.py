"""Which options name what a verb writes: marked beside the option, so that no verb can forget to have them checked."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vdgs.config.serialization import field_hints


@dataclass(frozen=True)
class Output:
    """Marks an option that names a file or folder to write: `output: Annotated[Path, Output()]`."""


def output_paths(arguments: Any) -> Iterator[Path]:
    """The files and folders that the arguments name to be written, groups of options included."""
    kind: type = type(arguments)
    hints = field_hints(kind)
    for field in dataclasses.fields(arguments):
        value = getattr(arguments, field.name)
        if dataclasses.is_dataclass(value):
            yield from output_paths(value)
        elif value is not None and is_output(hints[field.name]):
            yield from value if isinstance(value, tuple) else (value,)


def is_output(hint: Any) -> bool:
    """Whether a field's type is marked, at any depth."""
    return isinstance(hint, Output) or any(map(is_output, _parts(hint)))


def _parts(hint: Any) -> tuple[Any, ...]:
    return (*typing.get_args(hint), *getattr(hint, "__metadata__", ()))
