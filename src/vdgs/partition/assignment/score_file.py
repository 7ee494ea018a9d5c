"""The score matrix and the assignment as one file, from which `--explain` reads why a view was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vdgs.errors import RunError
from vdgs.partition.assignment.assign_cameras import REASONS, Assignment
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.system.array_files import DAMAGED_FILE_ERRORS, explain_damaged_part, load_arrays, save_arrays

FILE_FORMAT = "vdgs-scores-1"
#: The arrays of the file over cameras and blocks, with their types.
MATRICES = {"scores": np.float32, "visible_anchors": np.int32, "coverage": np.float32, "reasons": np.int8}


class ScoreFile(NamedTuple):
    """What a scores file holds. `names` are those of the training views, in the order of the rows."""

    names: list[str]
    scores: ScoreMatrix
    assignment: Assignment


def save_scores(path: Path, names: Sequence[str], scores: ScoreMatrix, assignment: Assignment) -> None:
    """Write an .npz file (without pickle; the same bytes for the same content), atomically."""
    if len(names) != len(scores.scores):
        raise ValueError(f"{len(names)} names for {len(scores.scores)} cameras")
    texts = {"names": np.array(names, np.str_), "warnings": np.array(assignment.warnings, np.str_)}
    save_arrays(
        path, {
            "format": np.array(FILE_FORMAT), "mode": np.array(scores.mode), **texts, "scores": scores.scores,
            "visible_anchors": scores.visible_anchors, "coverage": scores.coverage, "anchors": scores.anchors,
            "nadir_block": scores.nadir_block, "reasons": assignment.reasons,
        },
    )  # fmt: skip


def save_score_rows(path: Path, scores: ScoreMatrix) -> None:
    """Write the rows of some cameras, to be joined later (.npz without pickle), atomically."""
    save_arrays(path, {name: np.array(value) for name, value in vars(scores).items()})


def load_score_rows(path: Path) -> ScoreMatrix:
    """The inverse of `save_score_rows`. Raises RunError if the file is missing or damaged."""
    with explain_damaged_part(path):
        arrays = load_arrays(path)
        return ScoreMatrix(mode=str(arrays.pop("mode")), **arrays)


def load_scores(path: Path) -> ScoreFile:
    """The inverse of `save_scores`. Raises RunError if the file is missing or damaged."""
    try:
        arrays = load_arrays(path)
        _check(arrays)
    except FileNotFoundError as error:
        raise RunError(f"{path}: is not there. Assign the cameras first: vdgs partition RUN") from error
    except DAMAGED_FILE_ERRORS as error:
        raise RunError(f"{path}: is damaged ({error}). Assign the cameras again: vdgs partition RUN") from error
    scored = {name: arrays[name] for name in ("scores", "visible_anchors", "coverage", "anchors", "nadir_block")}
    scores = ScoreMatrix(mode=str(arrays["mode"]), **scored)
    warnings = [str(line) for line in arrays["warnings"]]
    assignment = Assignment(arrays["reasons"] != 0, arrays["reasons"], warnings)
    return ScoreFile([str(name) for name in arrays["names"]], scores, assignment)


def _check(arrays: dict[str, np.ndarray]) -> None:
    """Raise ValueError or KeyError unless all arrays are there and agree with each other."""
    if str(arrays["format"]) != FILE_FORMAT:
        raise ValueError(f"it is not a {FILE_FORMAT} file")
    (cameras,), (blocks,) = arrays["names"].shape, arrays["anchors"].shape
    expected: dict[str, tuple[tuple[int, ...], type]]
    expected = {"anchors": ((blocks,), np.int64), "nadir_block": ((cameras,), np.int64)}
    expected |= {name: ((cameras, blocks), kind) for name, kind in MATRICES.items()}
    for name, (shape, kind) in expected.items():
        if arrays[name].shape != shape or arrays[name].dtype != kind:
            raise ValueError(f"{name} is {arrays[name].dtype} {arrays[name].shape}, not {np.dtype(kind)} {shape}")
    for name in ("names", "warnings", "mode"):
        if arrays[name].dtype.kind != "U":
            raise ValueError(f"{name} is not text")
    if arrays["reasons"].size and not (arrays["reasons"].min() >= 0 and arrays["reasons"].max() < len(REASONS)):
        raise ValueError("reasons holds unknown numbers")
