"""Which options name what a verb writes: marked beside the option, so that no verb can forget to have them checked."""

from __future__ import annotations

import typing
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Output:
    """Marks an option that names a file or folder to write: `output: Annotated[Path, Output()]`."""


def is_output(hint: Any) -> bool:
    """Whether a field's type is marked, at any depth."""
    return isinstance(hint, Output) or any(map(is_output, typing.get_args(hint)))
