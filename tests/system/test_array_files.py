"""Files of arrays: read back as they were written, and one error for whatever is wrong with their bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vdgs.errors import RunError
from vdgs.system.array_files import explain_damaged_part, load_arrays, save_arrays


def test_arrays_come_back_as_they_were_and_with_the_same_bytes(tmp_path: Path):
    arrays = {
        "part/row": np.arange(6.0).reshape(2, 3),
        "words": np.array(["à", "b"]),
        "none": np.zeros((0, 2), np.int8),
    }
    for name in ("one.npz", "two.npz"):
        save_arrays(tmp_path / name, arrays)
    found = load_arrays(tmp_path / "one.npz")
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


@pytest.mark.parametrize("damage", ["gone", "cut", "empty", "method", "marked encrypted"])
def test_a_damaged_part_says_what_to_delete(tmp_path: Path, damage: str):
    file = tmp_path / "part.npz"
    save_arrays(file, {"row": np.arange(4)})
    data = bytearray(file.read_bytes())
    listed = data.rindex(b"PK\x01\x02")  # what the file lists of its array, read first
    if damage == "method":
        data[listed + 10] = 99
    elif damage == "marked encrypted":
        data[listed + 8] |= 1
        data[6] |= 1
    file.write_bytes({"cut": data[: len(data) // 2], "empty": b""}.get(damage, data))
    if damage == "gone":
        file.unlink()
    with pytest.raises(RunError, match=f"missing or damaged .* Delete {tmp_path} and run"), explain_damaged_part(file):
        load_arrays(file)
