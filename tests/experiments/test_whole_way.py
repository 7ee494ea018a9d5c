"""The benchmark of the whole way: its commands are the program's, its table adds up."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

import pytest

from experiments.microbench.whole_way import RESULTS, SCENES, Measured, commands, measure, table
from support.next_commands import parse


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_every_stage_is_a_command_of_the_program(scene, tmp_path):
    for folder in (tmp_path / scene.folder, tmp_path / "run", tmp_path / "capture" / "images"):
        folder.mkdir(parents=True, exist_ok=True)
    (tmp_path / "run" / "config.yaml").write_text("vdgs:\n", encoding="utf-8")
    stages = commands(scene, tmp_path, tmp_path, ["--preset", "laptop"])
    assert list(stages)[-1] == "report"
    for words in stages.values():
        parse(words)


def test_the_table_adds_up_and_compares_versions(tmp_path):
    rows = [
        Measured(scene="copr-2", stage=stage, version=version, seconds=seconds, processor_seconds=2 * seconds,
                 peak_gb=1.5, exit_code=0)
        for stage, version, seconds in [("merge", "before", 3.0), ("merge", "after", 1.5), ("eval", "before", 1.0),
                                        ("eval", "after", 0.5)]
    ]  # fmt: skip
    (tmp_path / RESULTS).write_text("".join(json.dumps(asdict(row)) + "\n" for row in rows), encoding="utf-8")
    assert "| copr-2 | all | 8.0 s (4.0 s) | 4.0 s (2.0 s) | 0.50 | 1.50 GB |" in table(tmp_path)
    evaluation = tmp_path / "copr-2" / "before" / "run" / "evaluation"
    evaluation.mkdir(parents=True)
    former = {"psnr": 33.0, "ssim": 0.91, "psnr_neutral": 32.0, "ssim_neutral": 0.9, "solid_share": 1.0}
    (evaluation / "metrics.json").write_text(json.dumps(former), encoding="utf-8")
    assert "psnr_reference_exposure 32, ssim_reference_exposure 0.9, opacity_coverage 1" in table(tmp_path)


def test_a_stage_that_fails_is_told_by_its_exit_code(tmp_path):
    seconds, processor, peak, code = measure([sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "log", None)
    assert code == 3
    assert min(seconds, processor, peak) > 0
