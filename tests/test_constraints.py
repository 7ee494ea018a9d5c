"""Versions: whatever an installation brings along is pinned, so that two fresh machines get the same."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]
CONSTRAINTS, LOWEST = ROOT / "constraints.txt", ROOT / "constraints-lowest.txt"
#: The CUDA whose packages the index's build of a torch needs, in versions that it names.
CUDA_OF_TORCH = {"2.13.0": "13.0"}


def _brought_along(package: str, extras: frozenset[str], seen: set[tuple[str, frozenset[str]]]) -> None:
    """Collect what a package needs on this machine, and what that needs; what is not installed here has no needs."""
    name = canonicalize_name(package)
    if (name, extras) in seen:
        return
    seen.add((name, extras))
    try:
        needs = map(Requirement, requires(name) or ())
    except PackageNotFoundError:
        return
    for need in needs:
        if need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in extras or {""}):
            _brought_along(need.name, frozenset(need.extras), seen)


def _pinned(file: Path = CONSTRAINTS) -> dict[str, str]:
    pins = re.findall(r"^([\w.-]+)==(\S+)$", file.read_text(), re.MULTILINE)
    return {canonicalize_name(name): version for name, version in pins}


def test_every_package_that_an_installation_brings_along_is_pinned():
    seen = set[tuple[str, frozenset[str]]]()
    _brought_along("vdgs", frozenset({"test", "demo"}), seen)
    pinned = _pinned().keys()
    needed = {name for name, _ in seen} - {"vdgs"}
    assert {"torch", "scikit-learn", "joblib"} <= needed  # the walk went somewhere
    assert needed - pinned == set()


def test_nvrtc_is_the_one_that_torch_for_gpus_needs():
    """With another one pip finds no solution where the index gives that torch, and `make setup` fails. The metadata of
    a torch for processors do not tell."""
    pinned = _pinned()
    assert pinned["nvidia-cuda-nvrtc"].startswith(CUDA_OF_TORCH[pinned["torch"]] + ".")


def test_the_lowest_versions_are_those_that_are_declared():
    """But for the tools of the tests, of which any that passes them will do."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {name: needs for name, needs in project["optional-dependencies"].items() if name not in ("test", "demo")}
    declared = map(Requirement, [*project["dependencies"], *(need for needs in extras.values() for need in needs)])
    minima = {
        canonicalize_name(need.name): [a.version for a in need.specifier if a.operator == ">="] for need in declared
    }
    assert minima == {name: [version] for name, version in _pinned(LOWEST).items()}


def test_the_pinned_versions_are_those_that_are_declared_or_later():
    pinned, lowest = _pinned(), _pinned(LOWEST)
    assert all(Version(pinned[name]) >= Version(lowest[name]) for name in lowest.keys() & pinned.keys())
