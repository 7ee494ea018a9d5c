"""Long calls of COLMAP: what they raise is explained, whether they work on a database or in memory."""

from __future__ import annotations

import pytest

from vdgs.errors import CaptureError, VdgsError
from vdgs.sfm.workspace import call_cancellable


def fail(said: str) -> None:
    raise RuntimeError(said)


def test_a_call_in_memory_that_fails_is_explained():
    with pytest.raises(CaptureError, match=r"^COLMAP could not go on \(no convergence\)\. What was done is kept\."):
        call_cancellable(lambda cancellation_token: fail("no\nconvergence"))


@pytest.mark.parametrize(
    ("said", "explained"), [("bad pairs", "COLMAP could not go on"), ("database or disk is full", "the disk is full")]
)
def test_a_call_with_a_database_names_its_folder(tmp_path, said, explained):
    with pytest.raises(VdgsError, match=explained) as refused:
        call_cancellable(lambda _, cancellation_token: fail(said), tmp_path / "database.db")
    assert str(refused.value).startswith(f"{tmp_path}: {explained}")
