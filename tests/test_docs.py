"""The documentation names files, links, verbs and modules that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from vdgs.cli.main import COMMANDS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "vdgs"
#: All but the glossary, which names what there was before.
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.name != "glossary.md"),
]
#: Endings of files of the repository; others that pages name belong to a run or to a capture.
SOURCE_FILE = re.compile(r"`((?:[\w.-]+/)*\w+\.(?:py|cpp|cu|h))`")
CODE = re.compile(r"`([^`]+)`|^ {4}(.+)$", re.M)


def is_there(name: str) -> bool:
    """A file by its path from the root or from the package, or by its last parts where the text says of which room."""
    if any((root / name).exists() for root in (ROOT, PACKAGE)):
        return True
    return any(
        next(root.rglob(name), None) for root in (PACKAGE, ROOT / "experiments", ROOT / "tests", ROOT / "native")
    )


def headings(page: Path) -> set[str]:
    """The names by which links reach the headings of a page, as GitHub forms them."""
    lines = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}


def mistakes(page: Path) -> list[str]:
    text = page.read_text(encoding="utf-8")
    wrong = [f"file {name}" for name in SOURCE_FILE.findall(text) if not is_there(name)]
    for target, _, heading in re.findall(r"\]\(([^)#\s]*)(#([^)\s]*))?[^)]*\)", text):
        file = page.parent / target if target else page
        if target.startswith("http"):
            continue
        if not file.exists():
            wrong.append(f"link {target}")
        elif heading and heading not in headings(file):
            wrong.append(f"link {target}#{heading}")
    for module in re.findall(r"-m ((?:vdgs|experiments)[\w.]*)", text):
        path = (ROOT if module.startswith("experiments") else ROOT / "src") / module.replace(".", "/")
        if not (path.is_dir() or path.with_suffix(".py").exists()):
            wrong.append(f"module {module}")
    code = "\n".join(" ".join(found) for found in CODE.findall(text))
    verbs = re.findall(r"(?<![\w.'/-])vdgs ([a-z][a-z-]+)", code)
    return wrong + [f"verb {verb}" for verb in verbs if verb not in COMMANDS]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_exists(page):
    assert mistakes(page) == []


@pytest.mark.parametrize("page", ["README.md", "CHANGELOG.md", "docs/benchmarks.md"])
def test_a_page_that_is_read_first_is_short(page):
    assert len((ROOT / page).read_text(encoding="utf-8").splitlines()) <= 70


def test_a_mistake_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "## A heading\n`runs/keys.py`, [there](gone.md), [here](#a-heading), [no](#other), "
        "`python -m vdgs.executors.work`:\n\n    vdgs coarse CAPTURE\n"
    )
    assert mistakes(page) == [
        "file runs/keys.py",
        "link gone.md",
        "link #other",
        "module vdgs.executors.work",
        "verb coarse",
    ]
