"""The doctor: true on this machine, calm on a broken one."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from importlib.metadata import version

import packaging.requirements
import pytest
from packaging.specifiers import SpecifierSet

from vdgs.cli.doctor import SystemCheck, requirements
from vdgs.cli.doctor import doctor_report as doctor_report
from vdgs.cli.doctor import system_checks as doctor
from vdgs.cli.doctor.doctor_report import is_healthy, print_report, run_checks
from vdgs.cli.doctor.requirements import Requirement, required_packages
from vdgs.kernels.cpu import extension

pytestmark = pytest.mark.xdist_group("doctor")


@pytest.fixture(scope="module")
def checks() -> list[SystemCheck]:
    return run_checks()


def by_name(checks: list[SystemCheck]) -> dict[str, SystemCheck]:
    return {check.name: check for check in checks}


def test_every_subject_is_reported(checks: list[SystemCheck]):
    names = by_name(checks)
    for name in ("vdgs", "python", "dependencies", "processor", "native kernels", "threads"):
        assert name in names
    for name in ("memory", "torch", "OMP_WAIT_POLICY", "LPIPS", "film", "disk"):
        assert name in names
    assert names["python"].state == "ok"
    assert names["dependencies"].is_ok
    for check in checks:
        assert check.state != "broken", check
        assert check.state in ("ok", "note") or check.remedy


def test_extras_come_from_the_metadata(checks: list[SystemCheck]):
    names = by_name(checks)
    groups = required_packages()
    assert {"synth", "lpips", "tensorboard", "test"} <= set(groups)
    assert "torch" in [each.name for each in groups[""]]
    assert "vdgs" not in [each.name for each in groups["test"]]
    for extra in set(groups) - {""}:
        check = names[f"extra {extra}"]
        assert check.is_ok  # an extra is never essential
        if check.state == "missing":
            assert check.remedy == f"pip install 'vdgs[{extra}]'"
    assert names["extra test"].value.startswith("pytest")


def test_the_exit_code_follows_what_is_essential(capsys: pytest.CaptureFixture):
    fine = [SystemCheck("torch", "ok", "2.13", essential=True), SystemCheck("extra synth", "missing", "lacks x", "pip")]
    broken = [*fine, SystemCheck("native kernels", "missing", "not built", "build them", essential=True)]
    assert is_healthy(fine)
    assert print_report(checks=fine) == 0
    lines = capsys.readouterr().out.splitlines()  # no terminal: a line for each
    assert lines == ["ok       torch: 2.13", "missing  extra synth: lacks x -> pip", "Everything essential works."]
    assert print_report(checks=broken) == 1
    out = capsys.readouterr().out
    assert "Not usable yet: native kernels" in out
    assert "build them" in out


def test_as_json(checks: list[SystemCheck], capsys: pytest.CaptureFixture):
    code = print_report(as_json=True, checks=checks)
    content = json.loads(capsys.readouterr().out)
    assert content["healthy"] == (code == 0)
    assert [each["name"] for each in content["checks"]] == [check.name for check in checks]


def set_builds(monkeypatch: pytest.MonkeyPatch, **builds: object) -> None:
    """Let these builds of the kernels be there: each loads, or raises what is given."""

    def load(name: str) -> object:
        if isinstance(builds[name], Exception):
            raise builds[name]
        return name

    monkeypatch.setattr(extension, "INSTRUCTION_SETS", tuple(builds))
    monkeypatch.setattr(extension, "load_extension", load)
    monkeypatch.setattr(extension, "active_isa", lambda: "avx2")
    monkeypatch.setattr(extension, "supported_isas", lambda: ("avx512", "avx2", "portable"))


def test_kernels_in_use_and_missing(monkeypatch: pytest.MonkeyPatch):
    unbuilt = ImportError("not built: pip install -e .")
    set_builds(monkeypatch, avx512=unbuilt, avx2=1, portable=1)
    (check,) = doctor._kernels()
    assert check.state == "note"
    assert check.is_ok
    assert check.value == "avx2 in use; available: avx2, portable"
    assert "avx512" in check.remedy
    set_builds(monkeypatch, avx2=unbuilt, portable=unbuilt)
    (check,) = doctor._kernels()
    assert not check.is_ok
    assert "pip install -e ." in check.remedy


def test_a_broken_part_is_reported_not_raised(monkeypatch: pytest.MonkeyPatch):
    def explode() -> list[SystemCheck]:
        raise OSError("no such device")

    monkeypatch.setattr(doctor_report, "CHECKS", (explode, doctor._disk))
    first, disk = run_checks()
    assert (first.name, first.state, first.is_ok) == ("explode", "broken", False)
    assert "no such device" in first.value
    assert disk.state in ("ok", "note")


def require(monkeypatch: pytest.MonkeyPatch, **packages: list[Requirement]) -> None:
    """Let vdgs always need what is given as `always`, and other groups for extras."""
    groups = {"" if extra == "always" else extra: needed for extra, needed in packages.items()}
    monkeypatch.setattr(doctor, "required_packages", lambda: {"": [], **groups})


def test_a_missing_dependency_has_its_command(monkeypatch: pytest.MonkeyPatch):
    require(monkeypatch, always=[Requirement("torch", ">=2"), Requirement("no-such-package")])
    (check,) = doctor._dependencies()
    assert not check.is_ok
    assert check.value == "no-such-package is not installed"
    assert check.remedy == "pip install no-such-package"


def test_a_dependency_that_is_too_old_has_its_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    """pip leaves it in place where what needs it was installed before."""
    require(monkeypatch, always=[Requirement("numpy", ">=1.26"), Requirement("pillow", ">=99.1,<100")])
    (check,) = doctor._dependencies()
    assert check.value == f"pillow {version('pillow')} is installed, but >=99.1,<100 is required"
    assert check.remedy == "pip install 'pillow>=99.1,<100'"
    assert print_report(checks=[check]) == 1
    assert "Not usable yet: dependencies" in capsys.readouterr().out


def test_what_may_be_left_out_may_be_too_old(monkeypatch: pytest.MonkeyPatch):
    require(
        monkeypatch, always=[Requirement("pycolmap", ">=99")], geo=[Requirement("numpy", ">=99"), Requirement("no")]
    )
    (check,) = doctor._removable_packages()
    assert (check.state, check.is_ok, check.remedy) == ("missing", True, "pip install 'pycolmap>=99'")
    assert "but >=99 is required" in check.value or "No module named" in check.value
    (check,) = doctor._extras()
    assert (check.state, check.is_ok, check.remedy) == ("missing", True, "pip install 'vdgs[geo]'")
    assert check.value.startswith(f"lacks no, numpy {version('numpy')} is installed, but >=99 is required: ")


def test_versions_are_compared_as_packaging_compares_them():
    versions = [
        "1",
        "1.26",
        "1.26.0",
        "1.26.1",
        "1.3",
        "1.4rc1",
        "1.4.dev2",
        "1.4",
        "1.4.post1",
        "1.4+cpu",
        "2.13.0+cpu",
    ]
    versions += ["13.10.0", "14.9", "15.0a1", "15"]
    for bounds in (">=1.26", ">=1.4", ">=1.4.0", ">=2.7", ">=13,<15", "<15", "<15.0.0", ""):
        for installed in versions:
            fits = SpecifierSet(bounds).contains(installed, prereleases=True)
            assert (Requirement("a", bounds).why_unfit(installed) == "") == fits, (installed, bounds)
    assert Requirement("a", ">=1").why_unfit("unknown") == ""


def test_every_declared_requirement_is_understood(monkeypatch: pytest.MonkeyPatch):
    """From the metadata and from the checkout: the same, by extra, as `packaging` reads them."""
    checkout = requirements._checkout_requirements()
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: checkout)
    found = required_packages()
    wanted: dict[str, list[tuple[str, SpecifierSet]]] = {extra: [] for extra in found}
    for each in map(packaging.requirements.Requirement, checkout):
        extra = next(extra for extra in (*found, "demo") if not each.marker or each.marker.evaluate({"extra": extra}))
        if each.name != "vdgs":
            wanted[extra].append((each.name, each.specifier))
    assert {extra: [(a.name, SpecifierSet(a.versions)) for a in needed] for extra, needed in found.items()} == wanted
    compared = [spec.operator for needed in wanted.values() for _, bounds in needed for spec in bounds]
    assert set(compared) == {">=", "<"}  # others are not compared


def test_it_imports_nothing_heavy_before_it_looks():
    code = (
        "import sys, vdgs.cli.doctor.doctor_report; print(sorted({'torch', 'numpy', 'cv2', 'rich'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
