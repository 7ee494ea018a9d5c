"""States are whole or absent; a damaged one is noticed and the one before it used."""

import errno
import json
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError

from support.full_disk import room_for
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import write_atomic
from vdgs.system.checkpoints import Checkpoint, load_latest_checkpoint, remove_partial_files, save_checkpoint


def state(iteration: int) -> Checkpoint:
    generator = torch.Generator().manual_seed(iteration)
    return Checkpoint(iteration, {"loss": "nan"}, {"a": torch.randn(50, 3, generator=generator), "b": torch.arange(4)})


def same(left: Checkpoint, right: Checkpoint) -> bool:
    return left.iteration == right.iteration and all(torch.equal(left.tensors[k], right.tensors[k]) for k in "ab")


def test_what_is_saved_is_loaded(tmp_path):
    save_checkpoint(tmp_path, state(7))
    loaded, complaints = load_latest_checkpoint(tmp_path)
    assert loaded is not None
    assert same(loaded, state(7))
    assert complaints == []


def test_the_two_newest_are_kept(tmp_path):
    for iteration in (1, 2, 3, 4):
        save_checkpoint(tmp_path, state(iteration))
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        f"{i:08d}.{e}" for i in (3, 4) for e in ("json", "safetensors")
    ]


@pytest.mark.parametrize("damage", ["truncate", "flip", "delete", "json"])
def test_a_damaged_state_falls_back_to_the_one_before(tmp_path, damage):
    save_checkpoint(tmp_path, state(1))
    save_checkpoint(tmp_path, state(2))
    newest = tmp_path / "00000002.safetensors"
    data = bytearray(newest.read_bytes())
    if damage == "truncate":
        newest.write_bytes(data[: len(data) // 2])
    elif damage == "flip":
        data[-5] ^= 4
        newest.write_bytes(data)
    elif damage == "delete":
        newest.unlink()
    else:
        newest.with_suffix(".json").write_text("{")
    loaded, complaints = load_latest_checkpoint(tmp_path)
    assert loaded is not None
    assert same(loaded, state(1))
    assert len(complaints) == 1
    assert "00000002" in complaints[0]


def test_nothing_whole_is_said(tmp_path):
    save_checkpoint(tmp_path, state(1))
    (tmp_path / "00000001.safetensors").write_bytes(b"")
    loaded, complaints = load_latest_checkpoint(tmp_path)
    assert loaded is None
    assert len(complaints) == 1


def test_leftovers_of_a_cut_off_write_are_removed(tmp_path):
    save_checkpoint(tmp_path, state(1))
    (tmp_path / ".00000002.safetensors.99.tmp").write_bytes(b"half")
    (tmp_path / "00000003.safetensors").write_bytes(b"no json yet")
    remove_partial_files(tmp_path)
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".json", ".safetensors"]
    assert json.loads((tmp_path / "00000001.json").read_text())["iteration"] == 1


def test_a_refusing_disk_is_reported_and_loses_nothing(tmp_path):
    save_checkpoint(tmp_path, state(1))
    with room_for(300), pytest.raises(VdgsError, match=r"00000002\.safetensors: cannot be written.*is kept"):
        save_checkpoint(tmp_path, state(2))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["00000001.json", "00000001.safetensors"]
    loaded, _ = load_latest_checkpoint(tmp_path)
    assert loaded is not None
    assert same(loaded, state(1))


@pytest.mark.parametrize(
    ("error", "advice"),
    [
        (OSError(errno.ENOSPC, "full"), "Free some space"),
        (OSError(errno.EROFS, "read-only"), "Allow writing"),
        (PermissionError(errno.EACCES, "denied"), "Allow writing"),
        (NotADirectoryError(errno.ENOTDIR, "no folder"), "Move away"),
        (SafetensorError("I/O error: Permission denied (os error 13)"), "Allow writing"),
        (SafetensorError("I/O error: No space left on device (os error 28)"), "Free some space"),
    ],
)
def test_the_remedy_fits_what_the_disk_refused(tmp_path, error, advice):
    def write(_: Path) -> None:
        raise error

    with pytest.raises(VdgsError, match=rf"a\.json: cannot be written .*\. {advice}"):
        write_atomic(tmp_path / "a.json", write)
