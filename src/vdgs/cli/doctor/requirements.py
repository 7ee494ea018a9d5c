"""The packages that vdgs requires, in which versions, and those that are installed.

Nothing outside the standard library is imported: `packaging` may be what is missing.
"""

from __future__ import annotations

import importlib.metadata
import re
import sys
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

#: A name with extras, the versions and the marker of a requirement, by PEP 508.
_REQUIREMENT = re.compile(r"\s*([A-Za-z0-9._-]+)\s*(?:\[[^\]]*\])?\s*\(?([^;()]*)\)?\s*(?:;(.*))?")
_BOUND = re.compile(r"\s*(>=|<)\s*(\S+)\s*")
_EXTRA = re.compile(r"""extra\s*==\s*['"]([^'"]+)['"]""")
_PLATFORM = re.compile(r"""sys_platform\s*(==|!=)\s*['"]([^'"]+)['"]""")
_VERSION = re.compile(r"(?:\d+!)?(\d+(?:\.\d+)*)(.*)")


@dataclass(frozen=True)
class Requirement:
    """A package that vdgs requires."""

    name: str
    versions: str = ""
    """The bounds as they are declared, such as >=13,<15; empty where any version will do."""

    def why_unfit(self, installed: str) -> str:
        """Why an installed version will not do; empty for one that will, and for what cannot be compared."""
        bounds = filter(None, map(_BOUND.fullmatch, self.versions.split(",")))
        if all(_is_within(installed, bound[1], bound[2]) for bound in bounds):
            return ""
        return f"{self.name} {installed} is installed, but {self.versions} is required"

    def pip_words(self) -> str:
        """What to write behind `pip install` for a version that will do, quoted for the shell."""
        return f"'{self.name}{self.versions}'" if self.versions else self.name


def required_packages() -> dict[str, list[Requirement]]:
    """Packages by extra ("" holds what vdgs always requires), from the installed metadata, else from the checkout's
    pyproject.toml. Left out are packages for other platforms, and the extras of vdgs that an extra includes: they have
    lines of their own."""
    try:
        declared = importlib.metadata.requires("vdgs") or []
    except importlib.metadata.PackageNotFoundError:
        declared = _checkout_requirements()
    groups: dict[str, list[Requirement]] = {"": []}
    for text in declared:
        parts = _REQUIREMENT.fullmatch(text)
        if parts is None or parts[1] == "vdgs" or not _is_for_this_platform(parts[3] or ""):
            continue
        extra = _EXTRA.search(parts[3] or "")
        groups.setdefault(extra[1] if extra else "", []).append(Requirement(parts[1], parts[2].replace(" ", "")))
    return groups


def installed_version(package: str) -> str | None:
    """None where the package is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _checkout_requirements() -> list[str]:
    import tomllib

    file = Path(__file__).parents[4] / "pyproject.toml"
    if not file.is_file():
        return []
    project: dict[str, Any] = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
    extras = project.get("optional-dependencies", {}).items()
    optional = (
        f"{package}{' and' if ';' in package else ';'} extra == '{extra}'"
        for extra, packages in extras
        for package in packages
    )
    return [*project["dependencies"], *optional]


def _is_for_this_platform(marker: str) -> bool:
    platform = _PLATFORM.search(marker)
    return platform is None or (sys.platform == platform[2]) == (platform[1] == "==")


def _is_within(installed: str, comparison: str, bound: str) -> bool:
    """Whether a version is at least (>=) or below (<) a bound; True for what is not written as a version."""
    found, wanted = _VERSION.match(installed), _VERSION.match(bound)
    if found is None or wanted is None:
        return True
    pairs = list(zip_longest(*([int(part) for part in each[1].split(".")] for each in (found, wanted)), fillvalue=0))
    release, limit = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    if comparison == "<":  # PEP 440: a preview of 15 is not below 15
        return release < limit
    is_preview = bool(re.match(r"[-_.]?(a|b|c|rc|dev|alpha|beta|pre)", found[2], re.IGNORECASE))
    return release > limit or (release == limit and not is_preview)
