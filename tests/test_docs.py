"""The documentation names files, links, verbs, options, modules and imports that exist, and each page is reached."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

from experiments.bench.cli import BenchArguments
from vdgs.cli.advice import COMMAND, OPTION, flags_of
from vdgs.cli.main import COMMANDS, verb_arguments

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
CODE = re.compile(r"```\w*\n([\s\S]*?)```|`([^`]+)`|^ {4}(.+)$", re.M)
IMPORT = re.compile(r"^from (vdgs[\w.]*) import (\w+(?:, \w+)*)", re.M)
FLAGS = {verb: flags_of(kind) for verb, kind in (verb_arguments() | {"bench": BenchArguments}).items()}


def is_there(name: str) -> bool:
    """A file by its path from the root or from the package, or by its last parts where the text says of which room."""
    if any((root / name).exists() for root in (ROOT, PACKAGE)):
        return True
    return any(next(root.rglob(name), None) for root in (PACKAGE, ROOT / "experiments", ROOT / "tests"))


def can_be_imported(module: str, name: str) -> bool:
    if not hasattr(import_module(module), name):
        try:
            import_module(f"{module}.{name}")
        except ModuleNotFoundError:
            return False
    return True


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
    wrong += [f"verb {verb}" for verb in verbs if verb not in COMMANDS]
    for command in COMMAND.finditer(re.sub(r"&&|\"", "\n", code.replace("\\\n", " "))):
        flags = FLAGS.get(command.group(1))
        options = OPTION.findall(command.group()) if flags is not None else []
        wrong += [f"option {option} of {command.group(1)}" for option in options if option not in (flags or ())]
    for module, names in IMPORT.findall(text):
        wrong += [f"import {module}.{name}" for name in names.split(", ") if not can_be_imported(module, name)]
    return wrong


def test_every_page_is_reached_from_the_first_one():
    found, queue = set(), [ROOT / "docs" / "README.md"]
    while queue:
        page = queue.pop().resolve()
        if page not in found and page.suffix == ".md" and page.is_file():
            found.add(page)
            links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
            queue += [page.parent / link for link in links if not link.startswith("http")]
    assert set((ROOT / "docs").rglob("*.md")) <= found


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
        "    vdgs merge RUN --block 2 \\\n        --rule owner --jobs 2\n"
        "from vdgs.errors import VdgsError, Oops\n"
    )
    assert mistakes(page) == [
        "file runs/keys.py",
        "link gone.md",
        "link #other",
        "module vdgs.executors.work",
        "verb coarse",
        "option --block of merge",
        "option --jobs of merge",
        "import vdgs.errors.Oops",
    ]


def test_the_glossary_gives_options_that_there_are():
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `--[\w.-]+`(?: \(of vdgs (\w+)\))? \| `(--[\w.-]+)` \|$", text, re.M)
    assert len(rows) > 90
    everywhere = set().union(*FLAGS.values())
    assert [new for verb, new in rows if new not in (FLAGS[verb] if verb else everywhere)] == []
