"""Safetensors files without a second copy of the tensors in memory, which the safetensors library makes.

The bytes are those that `safetensors.torch.save_file` writes: length of the header (8 bytes, little endian), the header
(JSON, padded with spaces to a multiple of 8 bytes), then the tensors one after the other.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from vdgs.errors import VdgsError
from vdgs.system.permissions import refusal

#: The types that are written, in the order in which the format's library lays tensors out: wide ones first.
DTYPES = {
    "I64": torch.int64, "F64": torch.float64, "F32": torch.float32, "I32": torch.int32, "F16": torch.float16,
    "U8": torch.uint8, "BOOL": torch.bool,
}  # fmt: skip
_NAMES = {dtype: name for name, dtype in DTYPES.items()}
_CHUNK = 1 << 20
#: What to do about a file of a run that cannot be used.
REBUILD_HINT = "Delete it and run `vdgs run`, or the verb that made it, again: it is rebuilt."


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write tensors, with at most one extra copy of a tensor that is not contiguous.

    Raises OSError if the disk refuses (what was written so far stays: see `write_atomic`), TypeError for a
    type outside DTYPES.
    """
    for name, tensor in tensors.items():
        if tensor.dtype not in _NAMES:
            raise TypeError(f"{name} is {tensor.dtype}; only {', '.join(DTYPES)} can be written")
    rank = list(DTYPES.values()).index
    names = sorted(tensors, key=lambda name: (rank(tensors[name].dtype), name))
    entries: dict[str, Any] = {"__metadata__": dict(metadata)} if metadata else {}
    end = 0
    for name in names:
        begin, end = end, end + tensors[name].nbytes
        entries[name] = {
            "dtype": _NAMES[tensors[name].dtype], "shape": list(tensors[name].shape), "data_offsets": [begin, end],
        }  # fmt: skip
    header = json.dumps(entries, separators=(",", ":"), ensure_ascii=False).encode()
    header += b" " * (-len(header) % 8)
    with path.open("wb") as file:
        file.write(len(header).to_bytes(8, "little") + header)
        for name in names:
            file.write(_bytes_of(tensors[name].detach().contiguous()))


def read_tensors(path: Path, remedy: str = REBUILD_HINT) -> tuple[dict[str, Tensor], dict[str, str]]:
    """All tensors and the header of a safetensors file; VdgsError if it cannot be read. `remedy` is what to do about
    one that is damaged or of another kind: of a file that no run wrote, not to delete it."""
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except FileNotFoundError as error:
        raise VdgsError(f"{path}: is not there. Train first, or point to the right run.") from error
    except PermissionError as error:
        raise VdgsError(f"{path}: {refusal(path, error)}") from error
    except (OSError, SafetensorError, ValueError) as error:
        raise VdgsError(f"{path}: cannot be read ({error}). {remedy}") from error


def read_tensors_unchecked(path: Path) -> dict[str, Tensor]:
    """All tensors of a file that `write_tensors` wrote and whose checksum is known to agree; raises OSError, ValueError
    or KeyError for others."""
    with path.open("rb") as file:
        entries = json.loads(file.read(int.from_bytes(file.read(8), "little")))
        entries.pop("__metadata__", None)
        tensors = {}
        for name, entry in sorted(entries.items(), key=lambda item: item[1]["data_offsets"]):
            tensor = torch.empty(entry["shape"], dtype=DTYPES[entry["dtype"]], device="cpu")
            begin, end = entry["data_offsets"]
            if end - begin != tensor.nbytes or file.readinto(_bytes_of(tensor)) != tensor.nbytes:
                raise ValueError(f"{name} has not the {tensor.nbytes} bytes of its shape")
            tensors[name] = tensor
    return tensors


def map_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """All tensors and the metadata of a file that `write_tensors` wrote, mapped into memory in place of read: nothing
    is copied, and the system takes pages back where memory is short. Changes to the tensors do not reach the file.
    A file may be renamed, replaced or removed meanwhile, but whoever makes it shorter ends this process (SIGBUS).
    Raises OSError, RuntimeError where it cannot be mapped, and ValueError, LookupError, TypeError or AttributeError for
    other files."""
    size = path.stat().st_size
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if not 2 <= length <= size - 8:
            raise ValueError("it has no header")
        entries = json.loads(file.read(length))
    metadata = entries.pop("__metadata__", {})
    if max((entry["data_offsets"][1] for entry in entries.values()), default=0) != size - 8 - length:
        raise ValueError("it is not as long as its header says")
    content = torch.from_file(str(path), shared=False, size=size, dtype=torch.uint8)
    return {name: _part(content[8 + length :], name, entry) for name, entry in entries.items()}, metadata


def _part(content: Tensor, name: str, entry: dict[str, Any]) -> Tensor:
    """A tensor of a file, of whose bytes behind the header it takes some."""
    dtype, shape, (begin, end) = DTYPES[entry["dtype"]], torch.Size(entry["shape"]), entry["data_offsets"]
    if end - begin != shape.numel() * dtype.itemsize or content[begin:].storage_offset() % dtype.itemsize:
        raise ValueError(f"{name} has not the bytes of its shape")
    return content[begin:end].view(dtype).reshape(shape)


def file_size_and_crc32(path: Path) -> tuple[int, int]:
    """Bytes and CRC-32 of a file, read piece by piece: states are large."""
    size = crc = 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            size, crc = size + len(chunk), zlib.crc32(chunk, crc)
    return size, crc


def file_id(path: Path) -> str:
    """What tells this file from any other."""
    size, checksum = file_size_and_crc32(path)
    return f"{size}-{checksum:08x}"


def tensors_crc32(tensors: Mapping[str, Tensor]) -> int:
    """CRC-32 over the bytes of all tensors, in the order of their names."""
    crc = 0
    for name in sorted(tensors):
        crc = zlib.crc32(_bytes_of(tensors[name].detach().contiguous()), crc)
    return crc


def _bytes_of(tensor: Tensor) -> memoryview:
    """The memory of a contiguous tensor; of a copy of it where it is not in main memory."""
    tensor = tensor if tensor.device.type == "cpu" else tensor.cpu()
    # An empty array has no memory to view; and numpy's types do not say that an array is a buffer.
    return memoryview(tensor.reshape(-1).view(torch.uint8).numpy() if tensor.numel() else bytearray())  # type: ignore[arg-type]
