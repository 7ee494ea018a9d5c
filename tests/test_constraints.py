"""Versions: whatever an installation brings along is pinned, so that two fresh machines get the same."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

CONSTRAINTS = Path(__file__).parents[1] / "constraints.txt"
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


def _pinned() -> dict[str, str]:
    pins = re.findall(r"^([\w.-]+)==(\S+)$", CONSTRAINTS.read_text(), re.MULTILINE)
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
