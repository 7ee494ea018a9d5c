"""The preset `paper` on one capture to its end, on validation views, with steps scaled down.

    python -m experiments.reports.analyses.paper_schedule DATA WORK             # three values of tau, eight blocks
    python -m experiments.reports.analyses.paper_schedule DATA WORK --crossed [--seed 1]   # cut x compensation, four blocks

One coarse model of seneca is trained for each seed; each row cuts a copy of it into blocks, trains, merges and measures
them. Rows are kept in WORK/schedule.jsonl with their seed: the same command continues, and seeds may share WORK. Test
photographs are left out.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from experiments.microbench.hardware_info import describe
from experiments.reports.analyses.paper_readings import Changes, call, copy_with, counts, measured, write_row
from vdgs.runs.run_folder import RunFolder

#: 2 000 of 100 000 steps, 300 of 50 000 for each block; decisions about growth in blocks every 30 steps, five in all.
COARSE = (
    "--images", "images_4", "--downscale", "2", "--validation", "--preset", "paper", "--iterations", "2000",
    "--densify.stats-start", "10", "--densify.start", "30",
)  # fmt: skip
CHANGES: Changes = {"partition.blocks": 8, "block.steps_scaler": 0.006, "block.densify.every": 30}


#: Rows by name. Crossed factors have half as many blocks, of 200 steps and five decisions each.
BY_TAU: dict[str, Changes] = {f"τ = {tau:g}": CHANGES | {"assignment.tau": tau} for tau in (0.05, 0.1, 0.2)}
CROSSED: dict[str, Changes] = {
    f"λ_vis = {lambda_vis}, compensation {'on' if on else 'off'}": {
        "partition.blocks": 4, "block.steps_scaler": 0.004, "block.densify.every": 20,
        "partition.lambda_vis": float(lambda_vis), "block.compensation.enabled": on,
    }
    for lambda_vis in (0, 1)
    for on in (False, True)
}  # fmt: skip


def row_of(coarse: RunFolder, folder: Path, name: str, changes: Changes) -> dict[str, Any]:
    """The run to its end: cameras and growth of each block, and the merged scene."""
    run = copy_with(coarse, folder, changes)
    row = {"row": name} | counts(run) | measured(run, coarse)
    blocks = [each.status() for each in run.block_folders()]
    return row | {
        "anchors": [each.anchors for each in blocks], "seconds": [each.seconds for each in blocks],
        "memory": max(each.peak_memory_bytes or 0 for each in blocks),
    }  # fmt: skip


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as two tables: the scene, and its blocks."""
    scene = ["| | PSNR | SSIM | corrected PSNR | quarters by V, least seen first | opaque | anchors | training s |", "|---" * 8 + "|"]
    blocks = [
        "| | cameras of each block | photographs that train no core | anchors of each block at its end | longest block s | block memory GB |",
        "|---" * 6 + "|",
    ]
    named = [("coarse stage", rows[0]["before"], rows[0]["before"]["train_seconds"])]
    named += [(f"blocks, merged, {row['row']}", row["now"], sum(row["seconds"])) for row in rows]
    for name, found, seconds in named:
        quarters = ", ".join(f"{each:.2f}" for each in found["quarters"])
        scene.append(
            f"| {name} | {found['psnr']:.2f} | {found['ssim']:.3f} | {found['psnr_cc']:.2f} | {quarters} | {found['opacity_coverage']:.1%} "
            f"| {found['n_anchors']:,} | {seconds:.0f} |"
        )
    for row in rows:
        blocks.append(
            f"| {row['row']} | {', '.join(map(str, row['cameras']))} | {row['idle']} of {row['photographs']} "
            f"| {', '.join(f'{each:,}' for each in row['anchors'])} | {max(row['seconds']):.0f} "
            f"| {row['memory'] / 1e9:.2f} |"
        )
    return "\n".join([*scene, "", *blocks]) + "\n"


def main(data: Path, work: Path, wanted: dict[str, Changes], seed: int) -> list[dict[str, Any]]:
    """The rows of these names and this seed; those that are there are kept."""
    work.mkdir(parents=True, exist_ok=True)
    file, coarse = work / "schedule.jsonl", RunFolder(work / f"coarse-{seed}")
    done = map(json.loads, file.read_text().splitlines()) if file.exists() else ()
    rows = {row["row"]: row for row in done if row.get("seed") == seed}
    if wanted.keys() - rows:
        call("train-coarse", data / "seneca", *COARSE, "--seed", str(seed), "--output", coarse.path, "--quiet")
        call("visibility", coarse.path, "--quiet")
        call("eval", coarse.path, "--model", "coarse", "--quiet")
    for name, changes in wanted.items():
        if name not in rows:
            rows[name] = write_row(file, {"seed": seed} | row_of(coarse, work / "row", name, changes))
    return [rows[name] for name in wanted]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--crossed", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(describe())
    print(as_markdown(main(options.data, options.work, CROSSED if options.crossed else BY_TAU, options.seed)))
