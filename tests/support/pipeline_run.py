"""A run of two blocks by real processes, as people have it, and what is compared of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from support.captures import tiny_scene, write_colmap
from support.commands import vdgs

ITERATIONS, BLOCK_ITERATIONS = 120, 100
SETTINGS = (
    "--preset",
    "laptop",
    "--iterations",
    str(ITERATIONS),
    "--save-every",
    "20",
    "--model.num-offsets",
    "3",
    "--densify.start",
    "50",
    "--densify.every",
    "50",
    "--densify.stats-start",
    "25",
    "--densify.min-draw-fraction",
    "0.05",
    "--blocks",
    "2",
    "--jobs",
    "2",
    "--block.compensation.enabled",
    "--block.compensation.t-low-quantile",
    "0",
    "--assignment.min-cameras",
    "4",
    "--block.iterations",
    str(BLOCK_ITERATIONS),
    "--block.densify.min-draw-fraction",
    "0.05",
    "--block.densify.start",
    "25",
    "--block.densify.stats-start",
    "0",
    "--block.densify.every",
    "25",
    "--no-ortho",
)
#: What a block's model is compared by: the whole file.
MERGED = "merged/model.safetensors"


@dataclass(frozen=True)
class TwoBlocks:
    """A capture, and a finished run of it."""

    capture: Path
    run: Path


def run_two_blocks(folder: Path) -> TwoBlocks:
    made = TwoBlocks(folder / "capture", folder / "unbroken" / "run")
    write_colmap(made.capture, tiny_scene())
    origin = {"frame": "ENU", "origin_lat_deg": 47.0, "origin_lon_deg": 8.5, "origin_alt_m": 400.0}
    (made.capture / "georef.json").write_text(json.dumps(origin))
    done = vdgs("run", made.capture, "--output", made.run, *SETTINGS)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "2 at once" in done.stdout
    assert "→ merged" in done.stdout
    return made


def model(run: Path, name: str = MERGED) -> bytes:
    return (run / name).read_bytes()


def changed_files(run: Path, before: dict[str, int]) -> set[str]:
    return {name for name, moment in moments(run).items() if before.get(name) != moment}


def moments(run: Path) -> dict[str, int]:
    return {
        str(path.relative_to(run)): path.stat().st_mtime_ns
        for path in run.rglob("*")
        if path.is_file() and path.name != ".lock"
    }
