"""Photographs and folders that a person may not read: what is in the way is named, and what opens it."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vdgs.captures.image_files import decode_image, read_header, verify_image
from vdgs.captures.strays import walk
from vdgs.errors import CaptureError
from vdgs.sfm.image_metadata import UnusableImage, read_image_metadata
from vdgs.system.exit_codes import exit_code_of
from vdgs.system.permissions import barred_by
from vdgs.system.quoting import shell_word

NOBODY = 65534

pytestmark = pytest.mark.skipif(not hasattr(os, "setresuid"), reason="other users are of Linux")


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder of photographs, one of them below another folder, and a process that may not do all."""
    users, is_root = os.getresuid(), os.geteuid() == 0
    with tempfile.TemporaryDirectory() as made:
        around = [Path(made).resolve(), *Path(made).resolve().parents]
        if is_root and not all(each.stat().st_mode & 0o001 for each in around[1:]):
            pytest.skip(f"other users may not enter a folder around {made} (set TMPDIR to one that they may)")
        here = _photographs(Path(made) / "photographs")
        for each in (Path(made), here, *here.rglob("*")):  # whatever the umask
            each.chmod(0o755 if each.is_dir() else 0o644)
        if is_root:
            os.setresuid(NOBODY, NOBODY, 0)
        yield here
        if is_root:
            os.setresuid(*users)
        (here / "sub").chmod(0o755)


def _photographs(folder: Path) -> Path:
    pixels = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    (folder / "sub").mkdir(parents=True)
    for name in ("a.jpg", "sub/b.jpg"):
        Image.fromarray(pixels).save(folder / name)
    return folder


def set_mode(path: Path, mode: int) -> None:
    """As the owner does it."""
    mine, effective, saved = os.getresuid()
    os.setresuid(mine, saved, saved)
    path.chmod(mode)
    os.setresuid(mine, effective, saved)


@pytest.mark.parametrize("read", [read_header, decode_image, verify_image])
def test_a_photograph_that_may_not_be_read_is_not_taken_for_a_damaged_one(folder: Path, read: Callable[[Path], object]):
    photograph = folder / "a.jpg"
    set_mode(photograph, 0)
    said = f"{photograph}: cannot be read (Permission denied). Allow it: chmod +r {shell_word(photograph)}"
    with pytest.raises(CaptureError, match=f"^{re.escape(said)}$"):
        read(photograph)


def test_the_reconstruction_says_the_same(folder: Path):
    photograph = folder / "a.jpg"
    set_mode(photograph, 0)
    with pytest.raises(UnusableImage, match=re.escape(f"chmod +r {shell_word(photograph)}")):
        read_image_metadata(photograph, "a.jpg")


@pytest.mark.parametrize("mode", [0o700, 0o711, 0o744, 0])
def test_a_folder_that_may_not_be_read_is_named_not_a_file_in_it(folder: Path, mode: int):
    set_mode(folder / "sub", mode & ~0o700 if os.getuid() != NOBODY else mode)
    closed = folder / "sub"
    said = f"{closed}: the folder cannot be read (Permission denied). Allow it: chmod +rx {shell_word(closed)}"
    with pytest.raises(CaptureError, match=re.escape(said)):
        list(walk(folder))


def test_an_error_of_the_system_names_the_folder_that_is_in_the_way(folder: Path, capsys: pytest.CaptureFixture[str]):
    set_mode(folder / "sub", 0)
    missing = folder / "sub" / "map.json"
    assert barred_by(missing) == folder / "sub"
    assert barred_by(folder / "a.jpg") == folder / "a.jpg"
    assert exit_code_of("vdgs sfm", missing.stat, "") == 1
    assert capsys.readouterr().err.startswith(f"vdgs sfm: {folder}/sub: Permission denied. See whose it is")
