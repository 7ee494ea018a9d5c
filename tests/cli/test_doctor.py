"""The doctor: true on this machine, calm on a broken one."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from vdgs.cli.doctor import SystemCheck
from vdgs.cli.doctor import doctor_report as doctor_report
from vdgs.cli.doctor import system_checks as doctor
from vdgs.cli.doctor.doctor_report import is_healthy, print_report, run_checks
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
    groups = doctor._required()
    assert {"synth", "lpips", "tensorboard", "test"} <= set(groups)
    assert "torch" in groups[""]
    assert "vdgs" not in groups["test"]
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


def test_a_missing_dependency_has_its_command(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "_required", lambda: {"": ["torch", "no-such-package"]})
    (check,) = doctor._dependencies()
    assert not check.is_ok
    assert check.remedy == "pip install no-such-package"


def test_it_imports_nothing_heavy_before_it_looks():
    code = (
        "import sys, vdgs.cli.doctor.doctor_report; print(sorted({'torch', 'numpy', 'cv2', 'rich'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
