"""The score matrix and what was decided from it, as one file: anyone can ask why a view was chosen."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vdgs.errors import RunError
from vdgs.partition.assignment.assign_cameras import REASONS, Assignment
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.system.atomic_files import write_bytes

FILE_FORMAT = "vdgs-scores-1"
#: The arrays of the file over cameras and blocks, with their types.
MATRICES = {"scores": np.float32, "held": np.int32, "covered": np.float32, "why": np.int8}

#: What zipfile and numpy raise on damaged bytes has no common base.
DAMAGED_FILE_ERRORS = (
    OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError, NotImplementedError,
    RuntimeError, SyntaxError, MemoryError, zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip


class ScoreFile(NamedTuple):
    """What a scores file holds. `names` are those of the training views, in the order of the rows."""

    names: list[str]
    scores: ScoreMatrix
    assignment: Assignment


def save_scores(path: Path, names: Sequence[str], scores: ScoreMatrix, assignment: Assignment) -> None:
    """Write an .npz file (without pickle; the same bytes for the same content), atomically."""
    if len(names) != len(scores.scores):
        raise ValueError(f"{len(names)} names for {len(scores.scores)} cameras")
    buffer = io.BytesIO()
    np.savez(
        buffer, format=np.array(FILE_FORMAT), mode=np.array(scores.mode),
        names=np.array(names, np.str_), complaints=np.array(assignment.warnings, np.str_),
        scores=scores.scores, held=scores.visible_anchors, covered=scores.coverage, anchors=scores.anchors,
        beneath=scores.nadir_block, why=assignment.reasons,
    )  # fmt: skip
    write_bytes(path, buffer.getvalue())


def save_score_rows(path: Path, scores: ScoreMatrix) -> None:
    """Write the rows of some cameras, to be joined later (.npz without pickle), atomically."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{name: np.array(value) for name, value in vars(scores).items()})
    write_bytes(path, buffer.getvalue())


def load_score_rows(path: Path) -> ScoreMatrix:
    """The inverse of `save_score_rows`. Raises RunError if the file is missing or damaged."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return ScoreMatrix(mode=str(arrays.pop("mode")), **arrays)
    except DAMAGED_FILE_ERRORS as error:
        raise RunError(
            f"{path}: is missing or damaged ({error}). Delete {path.parent} and run the same command again."
        ) from error


def load_scores(path: Path) -> ScoreFile:
    """The inverse of `save_scores`. Raises RunError if the file is missing or damaged."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        _check(arrays)
    except FileNotFoundError as error:
        raise RunError(f"{path}: is not there. Assign the cameras first: vdgs partition RUN") from error
    except DAMAGED_FILE_ERRORS as error:
        raise RunError(f"{path}: is damaged ({error}). Assign the cameras again: vdgs partition RUN") from error
    scored = {name: arrays[name] for name in ("scores", "held", "covered", "anchors", "beneath")}
    scores = ScoreMatrix(mode=str(arrays["mode"]), **scored)
    complaints = [str(line) for line in arrays["complaints"]]
    assignment = Assignment(arrays["why"] != 0, arrays["why"], complaints)
    return ScoreFile([str(name) for name in arrays["names"]], scores, assignment)


def _check(arrays: dict[str, np.ndarray]) -> None:
    """Raise ValueError or KeyError unless all arrays are there and agree with each other."""
    if str(arrays["format"]) != FILE_FORMAT:
        raise ValueError(f"it is not a {FILE_FORMAT} file")
    (cameras,), (blocks,) = arrays["names"].shape, arrays["anchors"].shape
    expected: dict[str, tuple[tuple[int, ...], type]] = {
        name: ((cameras, blocks), kind) for name, kind in MATRICES.items()
    }
    expected |= {"anchors": ((blocks,), np.int64), "beneath": ((cameras,), np.int64)}
    for name, (shape, kind) in expected.items():
        if arrays[name].shape != shape or arrays[name].dtype != kind:
            raise ValueError(f"{name} is {arrays[name].dtype} {arrays[name].shape}, not {np.dtype(kind)} {shape}")
    for name in ("names", "complaints", "mode"):
        if arrays[name].dtype.kind != "U":
            raise ValueError(f"{name} is not text")
    if arrays["why"].size and not (arrays["why"].min() >= 0 and arrays["why"].max() < len(REASONS)):
        raise ValueError("why holds unknown reasons")
