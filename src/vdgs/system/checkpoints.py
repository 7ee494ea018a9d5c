"""Checkpoints of a stage: whole or absent, checked when read, the last two kept.

A checkpoint is `NNNNNNNN.safetensors` and, written after it, `NNNNNNNN.json` (iteration, metadata, size and CRC-32 of
the tensors' file). One without its JSON, or with another CRC, is skipped for the one before it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from vdgs.system.atomic_files import write_atomic, write_json
from vdgs.system.tensors import file_size_and_crc32, read_tensors_unchecked, write_tensors

NUM_CHECKPOINTS = 2


@dataclass(frozen=True)
class Checkpoint:
    """What a state holds: the iteration after which it was taken, small facts, tensors."""

    iteration: int
    metadata: Mapping[str, Any]
    tensors: Mapping[str, Tensor]


def save_checkpoint(folder: Path, state: Checkpoint) -> None:
    """Write a state and remove all but the newest two. Raises VdgsError if the disk refuses."""
    path = state_file(folder, state.iteration)
    write_atomic(path, lambda temporary: write_tensors(temporary, state.tensors))
    # Of the file as read back, not of the tensors in memory.
    size, crc = file_size_and_crc32(path)
    sidecar = {"iteration": state.iteration, "bytes": size, "crc32": crc, "facts": dict(state.metadata)}
    write_json(path.with_suffix(".json"), sidecar)
    for old in sidecars(folder)[:-NUM_CHECKPOINTS]:
        old.unlink()
        old.with_suffix(".safetensors").unlink(missing_ok=True)
    remove_partial_files(folder)


def state_file(folder: Path, iteration: int) -> Path:
    """The tensors of the state that is saved after an iteration."""
    return folder / f"{iteration:08d}.safetensors"


def sidecars(folder: Path) -> list[Path]:
    """The files that make states count, oldest first."""
    return sorted(folder.glob("*.json"))


def load_latest_checkpoint(folder: Path) -> tuple[Checkpoint | None, list[str]]:
    """The newest state that is whole, and one sentence for each newer one that is not."""
    complaints: list[str] = []
    for sidecar in reversed(sidecars(folder)):
        try:
            return _read(sidecar), complaints
        except (OSError, ValueError, KeyError, TypeError) as error:
            complaints.append(f"{sidecar.with_suffix('.safetensors')}: is damaged ({error}); using the state before it")
    return None, complaints


def delete_checkpoints_after(folder: Path, iteration: int) -> None:
    """Delete checkpoints beyond `iteration`: damaged ones, which would count among those that are kept."""
    for sidecar in folder.glob("*.json"):
        if sidecar.stem.isdecimal() and int(sidecar.stem) > iteration:
            sidecar.unlink()
            sidecar.with_suffix(".safetensors").unlink(missing_ok=True)


def _read(sidecar: Path) -> Checkpoint:
    record = json.loads(sidecar.read_text(encoding="utf-8"))
    path = sidecar.with_suffix(".safetensors")
    size, crc = file_size_and_crc32(path)
    if size != record["bytes"]:
        raise ValueError(f"{size} bytes instead of {record['bytes']}")
    if crc != record["crc32"]:
        raise ValueError("its checksum does not agree")
    return Checkpoint(int(record["iteration"]), record["facts"], read_tensors_unchecked(path))


def remove_partial_files(folder: Path) -> None:
    """Delete what interrupted writes left behind: temporary files, tensors without their JSON."""
    for temporary in folder.glob(".*.tmp"):
        temporary.unlink(missing_ok=True)
    for tensors in folder.glob("*.safetensors"):
        if not tensors.with_suffix(".json").exists():
            tensors.unlink()
