"""The whole pipeline in this process, as short as lets its results say something."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from support.captures import tiny_scene, write_colmap
from support.commands import small_figures
from vdgs.cli.main import main

#: As few and as small as lets anchors grow, blocks train and PSNR say something. A named size is not looked for.
SETTINGS = (
    "--preset", "laptop", "--images", "images", "--iterations", "24", "--model.num-offsets", "2",
    "--init.voxel-size", "0.8", "--lr.features", "0.05", "0.05", "--densify.start", "10", "--densify.stats-start", "0",
    "--densify.min-draw-fraction", "0.05", "--densify.every", "10", "--densify.max-anchors", "200",
)  # fmt: skip


CUT = ("--blocks", "2", "--assignment.min-cameras", "3")


BLOCK = (
    "--block.iterations", "10", "--block.densify.start", "4", "--block.densify.stats-start", "0",
    "--block.densify.every", "4", "--block.densify.min-draw-fraction", "0.05",
)  # fmt: skip


def vdgs(*arguments: object) -> None:
    """A verb in this process; its exit code must be 0."""
    with small_figures(), pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    assert not ended.value.code


def train_coarse(capture: Path, run: Path, *device: str) -> None:
    vdgs("train-coarse", capture, "--output", run, "--up", "z", *SETTINGS, *device)


def after_the_coarse_stage(run: Path, *device: str) -> None:
    vdgs("visibility", run)
    vdgs("partition", run, *CUT)
    for block in (0, 1):
        vdgs("train-blocks", run, "--block", block, *BLOCK, *device)
    vdgs("merge", run)
    vdgs("eval", run, "--model", "coarse", *device)
    vdgs("eval", run, "--model", "merged", *device)


@dataclass(frozen=True)
class NativeRun:
    """A capture, a run of it by the native operations, and what that run was after its coarse stage."""

    capture: Path
    whole: Path
    coarse: Path


def native_run(folder: Path) -> NativeRun:
    found = NativeRun(folder / "capture", folder / "native", folder / "coarse")
    write_colmap(found.capture, tiny_scene(columns=3, rows=2, width=32, height=24, points=80))
    train_coarse(found.capture, found.whole)
    shutil.copytree(found.whole, found.coarse)
    after_the_coarse_stage(found.whole)
    return found


#: Where the coarse and the merged model of a run are measured.
COARSE, MERGED = "coarse/evaluation", "evaluation"


def psnr(run: Path, measured: str) -> float:
    return float(json.loads((run / measured / "metrics.json").read_text())["psnr"])
