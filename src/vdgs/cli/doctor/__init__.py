"""`vdgs doctor`: what works on this machine, and what to install for the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

CheckState = Literal["ok", "note", "missing", "broken"]


@dataclass(frozen=True)
class SystemCheck:
    """One line of the report. Only an essential check that is missing or broken makes the exit code 1."""

    name: str
    state: CheckState
    value: str
    #: What to do, empty where nothing need be done.
    remedy: str = ""
    essential: bool = False

    @property
    def is_ok(self) -> bool:
        return not (self.essential and self.state in ("missing", "broken"))
