"""docs/paper.md lists every choice of the presets, and a table that decided one was made of validation views."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

from vdgs.config.method import MethodConfig
from vdgs.config.presets import PRESETS
from vdgs.config.serialization import diff_settings, to_dict

ROOT = Path(__file__).parents[2]
PAGE, REPORTS = ROOT / "docs" / "paper.md", ROOT / "experiments" / "reports"
#: What a row may say that has no table.
WITHOUT_TABLE = ("not measured", "without a kept table", "**test views**, before this rule")


def section(heading: str) -> str:
    """The text below a heading of the page, up to the next."""
    return PAGE.read_text(encoding="utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]


def rows(text: str) -> list[list[str]]:
    """The cells of the rows of a section's table."""
    lines = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("|---")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:]]


def departures(preset: str) -> set[str]:
    """The settings that a preset has otherwise than `default`."""
    changed = diff_settings(to_dict(PRESETS["default"]), to_dict(PRESETS[preset]))
    return {line.split(":")[0] for line in changed}


def settings() -> set[str]:
    """All settings of the method, by their dotted names."""
    found, queue = set[str](), list(to_dict(MethodConfig()).items())
    while queue:
        name, value = queue.pop()
        found.add(name)
        queue += [(f"{name}.{key}", each) for key, each in value.items()] if isinstance(value, dict) else []
    return found


def is_of_validation_views(table: str) -> bool:
    """Whether a committed table says that it was made of validation views, and of no test views."""
    said = "--validation" in table or "Validation views" in table
    return said and not re.search(r"^#.*test views", table, re.M | re.I)


@pytest.mark.parametrize("preset", ["paper", "laptop"])
def test_every_departure_of_a_preset_is_listed_with_what_decided_it(preset: str) -> None:
    listed = {name for row in rows(section("What decided the defaults")) for name in re.findall(r"`([\w.]+)`", row[0])}
    assert departures(preset) - listed == set()
    assert listed <= settings()


def test_every_choice_of_the_paper_has_a_row_and_a_setting() -> None:
    named = {name for row in rows(section("Choices")) for name in re.findall(r"`([a-z]+\.[\w.]+)`", row[2])}
    assert departures("paper") - named == set()
    listed = set(re.findall(r"`([a-z]+\.[\w.]+)`", section("Choices"))) & settings()
    leaves = {name for name in settings() if not any(other.startswith(f"{name}.") for other in settings())}
    assert {name for name in leaves if not any(f"{name}.".startswith(f"{each}.") for each in listed)} == set()
    assert named <= settings()


def test_a_table_that_decided_a_default_was_made_of_validation_views() -> None:
    for names, _, evidence in rows(section("What decided the defaults")):
        tables = re.findall(r"\]\((\S+/tables/[\w-]+\.\w+)\)", evidence)
        assert tables or any(words in evidence for words in WITHOUT_TABLE), names
        for table in tables:
            assert is_of_validation_views((PAGE.parent / table).read_text(encoding="utf-8")), table


def test_a_table_of_test_views_is_found() -> None:
    tables = PAGE.parents[1] / "experiments" / "reports" / "tables"
    assert is_of_validation_views((tables / "choices.md").read_text(encoding="utf-8"))
    assert not is_of_validation_views((tables / "few.md").read_text(encoding="utf-8"))
    assert not is_of_validation_views("## Test views, raw\n\n    vdgs bench choices --validation")


@pytest.mark.parametrize("analysis", sorted((REPORTS / "analyses").glob("*.py")), ids=lambda file: file.stem)
def test_analyses_that_are_here_can_be_imported(analysis):
    """Pages give commands of them; those that a change of the package would break go, with the commit that has them."""
    for package in ("rasterio", "pycolmap"):
        if f"import {package}" in analysis.read_text(encoding="utf-8"):
            pytest.importorskip(package)
    module = import_module(f"experiments.reports.analyses.{analysis.stem}")
    assert re.search(rf"python .*analyses[./]{analysis.stem}\b", module.__doc__), "says no command"
