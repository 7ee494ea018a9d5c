"""The folders of the figures of models, and the record of how figures were measured. Imports nothing heavy."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json_or_empty
from vdgs.system.documents import MeasuredAs

#: What to measure on. A model that is good on training views and not on test views overfits.
EvaluationSplit = Literal["test", "training", "off-path"]


def evaluation_folder(
    run: RunFolder, name: str, views: EvaluationSplit = "test", lod_error: float | None = None
) -> Path:
    """Where the figures of a model ("coarse" or "merged") are: RUN/evaluation, RUN/coarse/evaluation; of other views
    beside them, in `evaluation_training` and `evaluation_off_path`, and of levels of detail in `evaluation_lod_1.5` or
    the like."""
    folder = run.evaluation if name == "merged" else run.coarse.path / "evaluation"
    suffix = "" if views == "test" else f"_{views.replace('-', '_')}"
    return folder.with_name(f"{folder.name}{suffix}{'' if lod_error is None else f'_lod_{lod_error:g}'}")


def is_evaluated(run: RunFolder, name: str, lpips_weights: Path | None, bins: int) -> bool:
    """Whether there are figures on disk, of the present model, measured in this way."""
    expected, folder = measured_as(run, name, lpips_weights, bins), evaluation_folder(run, name)
    record, figures = (read_json_or_empty(folder / file) for file in ("status.json", "metrics.json"))
    return bool(figures) and {key: record.get(key) for key in expected} == expected


def measured_as(run: RunFolder, name: str, lpips_weights: Path | None, bins: int) -> MeasuredAs:
    """The record of an evaluation of a model, measured in this way."""
    keys = run.keys()
    stage, key = (run.merged, keys.merge) if name == "merged" else (run.coarse, keys.coarse)
    return {
        "key": key, "model": stage.status().model_id, "lpips_weights": str(lpips_weights), "bins": bins,
        "exposed": exposure_mode(run),
    }  # fmt: skip


def exposure_mode(run: RunFolder) -> str | None:
    """How views are exposed, if training fitted exposures; None in neutral colors."""
    return "interpolated and metered" if run.method().training.exposure_compensation else None
