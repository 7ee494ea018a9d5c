"""Files of tensors are those of the format's own library, and are written and read without a second copy."""

import sys
import zlib
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from support.commands import python
from vdgs.system.tensors import (
    DTYPES,
    file_size_and_crc32,
    map_tensors,
    read_tensors_unchecked,
    tensors_crc32,
    write_tensors,
)

SHAPES = st.lists(st.integers(0, 4), max_size=3)


def tensor(seed: int, dtype: torch.dtype, shape: list[int]) -> torch.Tensor:
    values = torch.randn(shape, generator=torch.Generator().manual_seed(seed)) * 100
    return (values > 0) if dtype == torch.bool else values.abs().to(dtype)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("files")


@settings(max_examples=25)
@given(
    kinds=st.dictionaries(st.text(max_size=8), st.tuples(st.sampled_from(list(DTYPES.values())), SHAPES), max_size=6),
    note=st.none() | st.dictionaries(st.just("key"), st.text(max_size=9), min_size=1),
)
def test_the_bytes_are_those_of_the_library(folder, kinds, note):
    kinds.pop("__metadata__", None)
    tensors = {name: tensor(i, *kind) for i, (name, kind) in enumerate(kinds.items())}
    write_tensors(folder / "ours", tensors, note)
    save_file(tensors, folder / "theirs", metadata=note)
    assert (folder / "ours").read_bytes() == (folder / "theirs").read_bytes()
    mapped, metadata = map_tensors(folder / "ours")
    assert metadata == (note or {})
    for ours in (read_tensors_unchecked(folder / "ours"), mapped):
        assert ours.keys() == tensors.keys()
        for name, expected in tensors.items():
            assert ours[name].dtype == expected.dtype
            assert torch.equal(ours[name], expected)


def test_rows_out_of_order_and_the_decoder_are_written_as_they_read(tmp_path):
    rows = torch.arange(12.0).reshape(3, 4)
    tensors = {"turned": rows.t(), "every_other": rows[::2], "weights": rows.clone().requires_grad_(True)}
    write_tensors(tmp_path / "t.safetensors", tensors, {"a": "b"})
    with safe_open(tmp_path / "t.safetensors", framework="pt") as file:
        assert file.metadata() == {"a": "b"}
    read = load_file(tmp_path / "t.safetensors")
    for name, expected in tensors.items():
        assert torch.equal(read[name], expected)


def test_other_types_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(TypeError, match="bfloat16"):
        write_tensors(tmp_path / "t", {"half": torch.zeros(2, dtype=torch.bfloat16)})
    assert not (tmp_path / "t").exists()


@pytest.mark.parametrize("spoil", ["cut", "shape", "header"])
def test_a_damaged_file_is_an_error(tmp_path, spoil):
    path = tmp_path / "t"
    write_tensors(path, {"a": torch.arange(6.0)})
    data = path.read_bytes()
    changed = {"cut": data[:-4], "shape": data.replace(b"[6]", b"[7]"), "header": data.replace(b"{", b"!", 1)}
    path.write_bytes(changed[spoil])
    for read in (read_tensors_unchecked, map_tensors):
        with pytest.raises(ValueError, match=r"a has not|Expecting value|not as long as its header says"):
            read(path)


def test_changes_to_mapped_tensors_do_not_reach_the_file_which_may_be_removed(tmp_path):
    path = tmp_path / "t"
    write_tensors(path, {"a": torch.arange(6.0)})
    before = path.read_bytes()
    first, second = (map_tensors(path)[0]["a"] for _ in range(2))
    first += 1
    assert path.read_bytes() == before
    path.unlink()
    assert torch.equal(second, torch.arange(6.0))


def test_a_file_that_is_no_tensors_is_not_mapped(tmp_path):
    for content in (b"", b"short", (9).to_bytes(8, "little") + b"{}", (1 << 40).to_bytes(8, "little") + b"{}" * 9):
        (tmp_path / "t").write_bytes(content)
        with pytest.raises(ValueError, match="it has no header"):
            map_tensors(tmp_path / "t")


def test_checksums_are_crc_32(tmp_path):
    tensors = {"b": torch.arange(5.0), "a": torch.arange(12).reshape(3, 4).t()}
    path = tmp_path / "t"
    write_tensors(path, tensors)
    assert file_size_and_crc32(path) == (path.stat().st_size, zlib.crc32(path.read_bytes()))
    raw = tensors["a"].contiguous().numpy().tobytes() + tensors["b"].numpy().tobytes()
    assert tensors_crc32(tensors) == zlib.crc32(raw)


TRANSIENT = """
import ctypes, os
from pathlib import Path
import torch
from vdgs.system.checkpoints import Checkpoint, load_latest_checkpoint, save_checkpoint

def memory(key):
    with open("/proc/self/status") as status:
        return next(1024 * int(line.split()[1]) for line in status if line.startswith(key))

def rise(work):
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")  # the largest resident size is taken from here on
    before = memory("VmRSS")
    result = work()
    print(memory("VmHWM") - before)
    return result

folder = Path(os.environ["SAVED"])
assert ctypes.CDLL(None).mallopt(-3, 128 * 1024)  # what is large is asked of the system, not taken from what is free
save_checkpoint(folder, Checkpoint(1, {}, {"a": torch.zeros(9)}))
tensors = {f"{i}": torch.full((5_000_000,), float(i)) for i in range(4)}
rise(lambda: save_checkpoint(folder, Checkpoint(2, {}, tensors)))
state, _ = rise(lambda: load_latest_checkpoint(folder))
assert all(torch.equal(state.tensors[name], tensor) for name, tensor in tensors.items())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the largest resident size is reset through /proc")
def test_80_mb_are_saved_and_loaded_without_a_second_copy(tmp_path):
    done = python(TRANSIENT, SAVED=str(tmp_path))
    assert done.returncode == 0, done.stderr
    saving, loading = map(int, done.stdout.split())
    assert saving < 10e6
    assert loading < 95e6  # the tensors themselves
