"""The verbs about this machine (`doctor`) and about the experiments of a checkout (`bench`)."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from vdgs.cli.common import parse_arguments
from vdgs.errors import VdgsError

#: The root of the checkout, where the package is used from one.
CHECKOUT = Path(__file__).parents[3]
#: Loaded by name where it is: an installation holds no experiments.
BENCH_MODULE = "experiments.bench.cli"


@dataclass(frozen=True)
class DoctorArguments:
    """Say what this machine can use, and what to install for the rest."""

    json: bool = False
    """Print JSON instead of a table."""


def doctor_command(arguments: list[str]) -> int:
    args = parse_arguments(DoctorArguments, arguments, "doctor")
    from vdgs.cli.doctor.doctor_report import print_report

    return print_report(as_json=args.json)


def bench_command(arguments: list[str]) -> None:
    """Hand over to the bench. Raises VdgsError where there is no `experiments` to import it from."""
    if (CHECKOUT / "experiments" / "bench" / "cli.py").is_file() and str(CHECKOUT) not in sys.path:
        sys.path.insert(0, str(CHECKOUT))
    try:
        bench = import_module(BENCH_MODULE)
    except ImportError as error:
        if error.name not in ("experiments", "experiments.bench", BENCH_MODULE):
            raise
        raise VdgsError(
            "the package `experiments` is missing, which an installation does not hold: clone the repository of vdgs, "
            "and run `python -m experiments.bench` in its root."
        ) from error
    bench.bench_command(arguments)
