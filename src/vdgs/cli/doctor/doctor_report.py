"""The report of `vdgs doctor`, as a table or as JSON.

Nothing outside the standard library is imported at the top: the report also appears where a dependency is broken.
"""

from __future__ import annotations

import json
from dataclasses import asdict

from vdgs.cli.doctor import SystemCheck
from vdgs.cli.doctor.system_checks import CHECKS, hidden_packages
from vdgs.system.broken_packages import broken_packages, import_reason, reinstall_command


def run_checks() -> list[SystemCheck]:
    """Look at the machine; takes a few seconds (torch is imported), changes nothing and never raises."""
    if hidden := hidden_packages():
        return hidden
    checks: list[SystemCheck] = []
    for check in CHECKS:
        try:
            checks += check()
        except Exception as error:  # the report must stand on a machine where anything may be broken
            name = getattr(check, "__name__", "check").strip("_")
            packages = broken_packages(error)
            remedy = reinstall_command(packages) if packages else "Reinstall vdgs."
            checks.append(SystemCheck(name, "broken", f"{type(error).__name__}: {import_reason(error)}", remedy, True))
    return checks


def is_healthy(checks: list[SystemCheck]) -> bool:
    """Whether everything essential works."""
    return all(check.is_ok for check in checks)


def print_report(as_json: bool = False, checks: list[SystemCheck] | None = None) -> int:
    """Print the report as a table, or as JSON; returns the exit code, 0 if everything essential works."""
    checks = run_checks() if checks is None else checks
    if as_json:
        print(json.dumps({"healthy": is_healthy(checks), "checks": [asdict(check) for check in checks]}, indent=2))
    else:
        _print_checks(checks)
    return 0 if is_healthy(checks) else 1


def _print_checks(checks: list[SystemCheck]) -> None:
    """As a table on a terminal; else, and where rich is missing, as a line for each, which can be searched and sent."""
    broken = [check.name for check in checks if not check.is_ok]
    verdict = f"Not usable yet: {', '.join(broken)}. See what to do there." if broken else "Everything essential works."
    try:
        from rich import box
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text
    except ImportError:
        console = None
    else:
        console = Console()
    if console is None or not console.is_terminal:
        for check in checks:
            print(f"{check.state:8} {check.name}: {check.value}{check.remedy and f' -> {check.remedy}'}")
        print(verdict)
        return
    signs = {"ok": ("✓", "green"), "note": ("•", "cyan"), "missing": ("–", "yellow"), "broken": ("✗", "red")}
    table = Table(box=box.SIMPLE_HEAD)
    for column in ("", "", "found", "what to do"):
        table.add_column(column, overflow="fold")
    for check in checks:
        sign, color = signs[check.state] if check.is_ok else ("✗", "bold red")
        table.add_row(Text(sign, color), Text(check.name), Text(check.value), Text(check.remedy))
    console.print(table)
    console.print(Text(verdict, "bold red" if broken else "green"))
