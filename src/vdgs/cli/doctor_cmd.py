"""The verb about this machine: `doctor_command`."""

from __future__ import annotations

from dataclasses import dataclass

from vdgs.cli.common import parse_arguments


@dataclass(frozen=True)
class DoctorArguments:
    """Say what this machine can use, and what to install for the rest."""

    json: bool = False
    """Print JSON instead of a table."""


def doctor_command(arguments: list[str]) -> int:
    asked = parse_arguments(DoctorArguments, arguments, "vdgs doctor")
    from vdgs.cli.doctor.doctor_report import print_report

    return print_report(as_json=asked.json)
