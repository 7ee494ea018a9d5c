"""Long calls of COLMAP: what they raise is explained, whether they work on a database or in memory."""

from __future__ import annotations

import ctypes.util
import subprocess
import sys

import pytest

from vdgs.errors import CaptureError, VdgsError
from vdgs.sfm.workspace import call_cancellable


def fail(said: str) -> None:
    raise RuntimeError(said)


def test_a_call_in_memory_that_fails_is_explained():
    with pytest.raises(CaptureError, match=r"^COLMAP could not go on \(no convergence\)\. What was done is kept\."):
        call_cancellable(lambda cancellation_token: fail("no\nconvergence"))


@pytest.mark.parametrize(
    ("said", "explained"),
    [
        ("bad pairs", "COLMAP could not go on"),
        ("image was not successfully registered", "COLMAP could not go on"),
        ("matrix is not of full rank", "COLMAP could not go on"),
        ("database or disk is full", "the disk is full"),
        ("write: No space left on device", "the disk is full"),
    ],
)
def test_a_call_with_a_database_names_its_folder(tmp_path, said, explained):
    with pytest.raises(VdgsError, match=explained) as refused:
        call_cancellable(lambda _, cancellation_token: fail(said), tmp_path / "database.db")
    assert str(refused.value).startswith(f"{tmp_path}: {explained}")


@pytest.mark.skipif(sys.platform != "linux" or not ctypes.util.find_library("stdc++"), reason="the library of C++")
def test_an_exception_in_a_thread_of_colmap_ends_in_an_error_and_not_in_an_abort(tmp_path):
    """COLMAP's threads throw where their database finds no room; C++ calls std::terminate then."""
    program = """
import ctypes, sys
from vdgs.errors import VdgsError
from vdgs.sfm import workspace
workspace.is_disk_full = lambda _: True
try:
    workspace.call_cancellable(lambda *_, **__: ctypes.CDLL("libstdc++.so.6")._ZSt9terminatev(), sys.argv[1])
except VdgsError as error:
    sys.exit(str(error))
"""
    command = [sys.executable, "-c", program, tmp_path / "database.db"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"{tmp_path}: the disk is full")
    assert "the same command then goes on" in ended.stderr
