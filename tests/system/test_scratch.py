"""Scratch folders, and folders that take no files."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from vdgs.errors import VdgsError
from vdgs.system.scratch import check_takes_files, scratch_folder


def test_a_folder_that_takes_files_is_left_as_it_is(tmp_path: Path):
    check_takes_files(tmp_path)
    check_takes_files(tmp_path / "new" / "folder")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_takes_none_is_named_and_no_scratch_folder(tmp_path: Path):
    (tmp_path / "file").touch()
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    for folder in [tmp_path / "file" / "below"] + ([] if os.geteuid() == 0 else [locked]):
        said = f"^{re.escape(str(folder))}: cannot be written"
        with pytest.raises(VdgsError, match=said):
            check_takes_files(folder)
        with pytest.raises(VdgsError, match=said), scratch_folder(folder / "a.ply"):
            pass
