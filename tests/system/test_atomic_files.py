"""Files are whole or absent, whatever part of them the disk refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.full_disk import room_for
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import write_array, write_image

NOISE = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)
WRITERS: dict[str, Callable[[Path], None]] = {
    "a.npy": lambda path: write_array(path, NOISE),
    "a.jpg": lambda path: write_image(path, Image.fromarray(NOISE), "JPEG", quality=95),
    "a.tif": lambda path: write_image(path, Image.fromarray(NOISE), "TIFF"),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("short", [1, 2000, 9000])
def test_a_file_for_which_the_disk_has_no_room_is_reported_and_absent(tmp_path, name, short):
    """Also where its last bytes alone are refused, which `numpy.save` and Pillow do not report."""
    WRITERS[name](tmp_path / name)
    size = (tmp_path / name).stat().st_size
    (tmp_path / name).unlink()
    with room_for(size - short), pytest.raises(VdgsError, match=rf"{name}: cannot be written .*Free some space"):
        WRITERS[name](tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "values",
    [
        np.float32(2.5) * np.ones(()), np.zeros((0, 3), np.float16), np.array(["à", "bc"]), np.array([True, False]),
        np.arange(24.0).reshape(2, 3, 4)[:, ::2], np.arange(6).reshape(2, 3).T, np.arange(4, dtype=">i2"),
        np.array([(1, 2.0)], [("a", "i4"), ("b", "f8")]),
    ],
    ids=["scalar", "empty", "text", "bool", "strided", "Fortran", "big-endian", "record"],
)  # fmt: skip
def test_arrays_come_back_as_they_were(tmp_path, values):
    write_array(tmp_path / "a.npy", values)
    found = np.load(tmp_path / "a.npy", allow_pickle=False)
    assert (found.dtype, found.shape) == (values.dtype, values.shape)
    np.testing.assert_array_equal(found, values)


def test_python_objects_are_refused(tmp_path):
    with pytest.raises(ValueError, match="Python objects"):
        write_array(tmp_path / "a.npy", np.array([{}]))
    assert not list(tmp_path.iterdir())
