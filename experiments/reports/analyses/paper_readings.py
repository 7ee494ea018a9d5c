"""Readings of what the paper leaves open, one changed at a time from the preset `paper`, on validation views.

    python -m experiments.reports.analyses.paper_readings DATA WORK [--scenes seneca copr] [--only NAME ...] [--seed N]
        [--counts]

Of each scene one short coarse model is trained. Each reading cuts a copy of it, trains its blocks, merges and measures
them; test photographs are left out. Rows are appended to WORK/rows.jsonl and kept: the same command continues, and
prints all rows. --table FILE writes them as Markdown.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from experiments.microbench.hardware_info import describe
from vdgs.cli.main import main as vdgs
from vdgs.config.method import MethodConfig, PartitionConfig
from vdgs.config.serialization import from_dict, to_dict
from vdgs.model.anchor_model import AnchorModel
from vdgs.partition.assignment.score_file import load_scores
from vdgs.partition.blocks import load_blocks
from vdgs.partition.clustering import cluster_anchors, clustering_features, fit_principal_plane, ground_plane
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.runs.visibility_store import VISIBILITY_FILE
from vdgs.system.tensors import read_tensors

Changes = dict[str, Any]
#: Scene: options of its coarse stage, and number of blocks.
SCENES = {
    "seneca": (("--images", "images_4", "--downscale", "2"), 8),
    "copr": (("--images", "images_4"), 4),
    # of `vdgs synth DATA/corridor --flight corridor --num-images 80 --num-test-images 8 --width 160 --height 120`
    "corridor": ((), 4),
    "horizon": ((), 4),  # of `vdgs synth DATA/horizon --flight horizon --size village --truth`: photographs show sky
}
#: 1 500 steps instead of 100 000, 200 for each block instead of 50 000; growth begins and is decided sooner.
COARSE = (
    "--validation", "--preset", "paper", "--iterations", "1500", "--densify.stats-start", "100",
    "--densify.start", "300",
)  # fmt: skip
TABLE_HEAD = (
    "    python -m experiments.reports.analyses.paper_readings DATA WORK [--counts]",
    "",
    f"Validation views (`vdgs train-coarse DATA/SCENE {' '.join(COARSE)}`):",
    "test photographs are left out, and every eighth training photograph is held out. One seed. Steps are scaled:",
    "1 500 of the coarse stage instead of 100 000, 200 of each block instead of 50 000, growth in blocks decided every",
    "20 steps instead of 100. Each reading changes one thing of the preset `paper`; all of a scene begin with the same",
    "coarse model. Differences below 0.1 dB are within what seeds make.",
)
BLOCKS: Changes = {"block.steps_scaler": 0.004, "block.densify.every": 20}
#: Preset `default`'s partition, for the rows of one choice each.
CUTS: dict[str, Changes] = {
    "cut: principal axes": {"partition.cluster_axes": "principal"},
    "cut: one scale for both axes": {"partition.cluster_scale": "common"},
    "cut: clipped at 1 %": {"partition.cluster_clip": 0.01},
    "cut: own cells": {"partition.cluster_smoothing": 0.0},
    "cut: smoothed over 1.5 cells": {"partition.cluster_smoothing": 1.5},
    "cut: small blocks dropped": {"partition.min_block_share": 0.05},
    "cut: place alone": {"partition.lambda_vis": 0.0},
}
#: Readings of the coarse stage, as options of `vdgs train-coarse`.
COARSE_READINGS: dict[str, tuple[str, ...]] = {
    "coarse: the preset `paper`": (),
    "coarse: distance as an input of the decoder": ("--model.view-distance",),
    "coarse: rates of offsets times the cameras' radius": ("--lr-offsets-unit", "cameras"),
    "coarse: black behind the scene": ("--loss.background", "black", "--loss.random-background", "0"),
    "coarse: mean color behind the scene": ("--loss.background", "mean", "--loss.random-background", "0"),
    "coarse: random color behind the scene": ("--loss.background", "mean", "--loss.random-background", "1"),
    "coarse: Gaussians bounded": ("--model.bound-scales",),
    "coarse: outliers kept": ("--init.outlier-distance", "0"),
    "coarse: gaps filled": ("--init.fill-gaps",),
    "coarse: sparse Adam": ("--optimizer", "sparse-adam"),
    "coarse: blur of a photograph's pixel": ("--model.photograph-blur",),
    "coarse: compensation": ("--compensation.enabled",),
    "coarse: environment map behind the scene": ("--model.background-model", "envmap"),
}
#: Readings of both stages: options of `vdgs train-coarse`, and what follows the coarse model.
TO_THE_END: dict[str, tuple[tuple[str, ...], Changes]] = {
    f"to the end: {color}": (COARSE_READINGS[f"coarse: {color}"], {"block.random_background": share})
    for color, share in (
        ("black behind the scene", 0.0),
        ("mean color behind the scene", 0.0),
        ("random color behind the scene", 1.0),
    )
}
READINGS: dict[str, Changes] = {
    "the preset `paper`": {},
    **{f"τ = {tau:g}": {"assignment.tau": tau} for tau in (0.02, 0.05, 0.1, 0.2, 0.3)},
    "nothing drawn around": {"block.draw_outside": False},
    "margin frozen, merge by owner": {"block.margin": "frozen", "merge.rule": "owner"},
    "margin free": {"block.margin": "free"},
    "margin ramp, merge by owner": {"merge.rule": "owner"},
    "no compensation": {"block.compensation.enabled": False},
    "g of past cycles": {"block.compensation.history": "past"},
    "g to means, lower gate": {"block.compensation.target": "mean", "block.compensation.min_draws": "scaled"},
    "g to sums, lower gate": {"block.compensation.target": "sum", "block.compensation.min_draws": "scaled"},
    "g to means, one gate": {"block.compensation.target": "mean", "block.compensation.min_draws": "paper"},
    "g to sums, one gate": {"block.compensation.target": "sum", "block.compensation.min_draws": "paper"},
    "T_low = 0.05": {"block.compensation.t_low": 0.05},
    "T_low = 0.3": {"block.compensation.t_low": 0.3},
    **{f"β_g = {beta:g}": {"block.compensation.beta_g": beta} for beta in (0.1, 1, 4)},
    "γ = 0.5": {"block.compensation.gamma": 0.5},
    "rates of blocks times 0.4 and 0.8": {"block.lr_scale_offsets": 0.4, "block.lr_scale_log_scales": 0.8},
    "random color behind blocks": {"block.random_background": 1.0},
    "expansion 0": {"partition.expansion": 0.0},
    "every photograph joins its best block": {"assignment.always_best": True},
    "at least 30 cameras a block": {"assignment.min_cameras": 30},
    "cameras by `coverage`": {"assignment.mode": "coverage"},
    **CUTS,
}


def changed(method: MethodConfig, changes: Changes) -> MethodConfig:
    """The settings with some replaced, by their dotted names."""
    plain = to_dict(method)
    for name, value in changes.items():
        *groups, last = name.split(".")
        inner = plain
        for group in groups:
            inner = inner[group]
        inner[last] = value
    return from_dict(MethodConfig, plain, "")


def call(*arguments: object) -> None:
    """A command of vdgs in this process. Raises SystemExit where it fails."""
    try:
        vdgs([str(each) for each in arguments])
    except SystemExit as ended:
        if ended.code:
            raise


def coarse_run(data: Path, folder: Path, scene: str, seed: int, options: tuple[str, ...] = ()) -> RunFolder:
    """A run of the scene's coarse model, trained once."""
    options = (*SCENES[scene][0], *COARSE, "--seed", str(seed), *options)
    call("train-coarse", data / scene, *options, "--output", folder, "--quiet")
    call("visibility", folder, "--quiet")
    run = RunFolder(folder)
    if not (run.coarse.path / "evaluation").exists():
        call("eval", folder, "--model", "coarse", "--quiet")
    return run


def copy_with(coarse: RunFolder, folder: Path, changes: Changes) -> RunFolder:
    """A copy of the coarse run with other settings of what follows it."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(coarse.path, folder, ignore=shutil.ignore_patterns("checkpoint*", "evaluation"))
    run = RunFolder(folder)
    settings, method = run.settings(), changed(run.method(), BLOCKS | changes)
    run.change_settings(RunSettings.create(settings.capture_path, settings.capture, method), overwrite=True)
    return run


def own_cluster_share(run: RunFolder, visibility: np.ndarray) -> float:
    """The share of the anchors that the block owns which most anchors of their cluster joined."""
    config: PartitionConfig = run.method().partition
    positions = AnchorModel.load(run.coarse.model).anchors.positions.double().numpy()[:, :2]
    plane = fit_principal_plane(positions) if config.cluster_axes == "principal" else ground_plane()
    assert config.blocks != "auto"
    points = plane.to_plane(positions)
    features = clustering_features(points, visibility, config)
    order = np.lexsort((visibility, points[:, 1], points[:, 0]))
    labels = cluster_anchors(features[order], config.blocks, run.method().training.seed, config.balanced)
    owner = load_blocks(run.partition / "blocks.geojson").owner(positions[order])
    pairs = np.zeros((owner.max() + 1, config.blocks), int)
    np.add.at(pairs, (owner, labels), 1)
    return float(pairs[linear_sum_assignment(-pairs)].sum() / len(labels))


def counts(run: RunFolder) -> dict[str, Any]:
    """Cameras and anchors of a cut."""
    call("partition", run.path, "--quiet")
    blocks = run.partition_record().blocks
    scored = load_scores(run.partition / "scores.npz")
    teaches = scored.assignment.cameras & (scored.scores.visible_anchors > 0)
    visibility = read_tensors(run.visibility / VISIBILITY_FILE)[0]["visibility"].numpy().astype(np.int64)
    owned = np.array([each.anchors_core for each in blocks])
    deviations = np.array([each.std_v or 0.0 for each in blocks])
    return {
        "cameras": [each.cameras for each in blocks], "idle": int((~teaches.any(axis=1)).sum()),
        "photographs": len(teaches), "own_cluster": round(own_cluster_share(run, visibility), 4),
        "std_v": round(float(np.sqrt((deviations**2 * owned).sum() / owned.sum())), 3),
        "std_v_all": round(float(visibility.std()), 3), "owned": owned.tolist(),
    }  # fmt: skip


def measured(run: RunFolder, coarse: RunFolder) -> dict[str, Any]:
    """The merged scene on validation views, beside the coarse model that its blocks began with."""
    for block in run.partition_record().blocks:  # in this process: a start costs as much as a few dozen steps
        call("train-blocks", run.path, "--block", block.block, "--quiet")
    call("merge", run.path, "--quiet")
    call("eval", run.path, "--model", "merged", "--quiet")
    return {"now": metrics(run.evaluation), "before": metrics(coarse.coarse.path / "evaluation")}


def metrics(evaluation: Path) -> dict[str, Any]:
    """Of what `vdgs eval` has written: means over the views, and quarters of the pixels by V."""
    found = json.loads((evaluation / "metrics.json").read_text())
    quarters = [each["psnr"] for each in found["by_visibility"] if each["lower"] is not None]
    names = (
        "psnr", "ssim", "psnr_cc", "psnr_covered_own_background", "opacity_coverage", "n_anchors", "train_seconds"
    )  # fmt: skip
    return {name: found[name] for name in names} | {"quarters": quarters}


def rows(
    data: Path, work: Path, scenes: list[str], only: list[str], train: bool, seed: int
) -> Iterator[dict[str, Any]]:
    """Every reading of every scene that is not done yet with this seed."""
    file = work / "rows.jsonl"
    done = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    yield from done
    names = {(each["scene"], each["reading"], each["trained"]) for each in done if each.get("seed", 0) == seed}
    readings = [
        *((name, arguments, None) for name, arguments in COARSE_READINGS.items() if name in only),
        *((name, *reading) for name, reading in TO_THE_END.items() if name in only),
        *((name, (), changes) for name, changes in READINGS.items() if not only or name in only),
    ]
    for scene in scenes:
        for reading, arguments, changes in readings:
            if (scene, reading, train) in names or not (train or is_of_cut(arguments, changes)):
                continue
            folder = work / (f"coarse-{os.getpid()}" if arguments else f"{scene}-coarse-{seed}")
            coarse = coarse_run(data, folder, scene, seed, arguments)
            row: dict[str, Any] = {"scene": scene, "reading": reading, "trained": train, "seed": seed}
            if changes is None:
                yield write_row(file, row | {"now": metrics(coarse.coarse.path / "evaluation")})
            elif arguments or not changes or changed(coarse.method(), changes) != coarse.method():  # else the preset
                run = copy_with(
                    coarse, work / f"reading-{os.getpid()}", {"partition.blocks": SCENES[scene][1]} | changes
                )
                row |= {"changes": changes} | counts(run)
                yield write_row(file, row | (measured(run, coarse) if train else {}))
            if arguments:
                shutil.rmtree(folder)


def is_of_cut(arguments: tuple[str, ...], changes: Changes | None) -> bool:
    """Whether a reading may change cuts and cameras of the preset's coarse model."""
    return not arguments and changes is not None and not any(name.startswith(("block", "merge")) for name in changes)


def write_row(file: Path, row: dict[str, Any]) -> dict[str, Any]:
    """Append a row to the file."""
    with file.open("a") as out:
        out.write(json.dumps(row) + "\n")
    return row


#: Heading of a column, and its cell of a row.
COUNT_COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {
    "reading": lambda row: row["reading"] + (f", seed {row['seed']}" if row.get("seed") else ""),
    "cameras of each block": lambda row: ", ".join(map(str, row["cameras"])),
    "photographs that train no core": lambda row: f"{row['idle']} of {row['photographs']}",
    "anchors owned by their cluster's block": lambda row: f"{row['own_cluster']:.1%}",
    "standard deviation of V in blocks, in all": lambda row: f"{row['std_v']:.2f}, {row['std_v_all']:.2f}",
}
RESULT_COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {
    "reading": lambda row: row["reading"] + (f", seed {row['seed']}" if row.get("seed") else ""),
    "PSNR": lambda row: f"{row['now']['psnr']:.2f}",
    "corrected": lambda row: f"{row['now']['psnr_cc']:.2f}",
    "SSIM": lambda row: f"{row['now']['ssim']:.3f}",
    "PSNR where 3 cameras look": lambda row: f"{row['now']['psnr_covered_own_background']:.2f}",
    "least seen, best seen quarter": lambda row: f"{row['now']['quarters'][0]:.2f}, {row['now']['quarters'][-1]:.2f}",
    "opaque": lambda row: f"{row['now']['opacity_coverage']:.1%}",
    "anchors": lambda row: f"{row['now']['n_anchors']:,}",
}


def as_markdown(found: list[dict[str, Any]]) -> str:
    """The rows as tables: cuts and cameras, coarse models, merged scenes."""
    lines = ["# Readings of what the paper leaves open", "", *TABLE_HEAD]
    order = [*COARSE_READINGS, *TO_THE_END, *READINGS]
    found = sorted(found, key=lambda each: order.index(each["reading"]))
    for scene in sorted({each["scene"] for each in found}):
        of_scene = [each for each in found if each["scene"] == scene]
        trained = [each for each in of_scene if each["trained"]]
        before = [each["before"] for each in trained if "before" in each][:1]
        results = [{"reading": "the coarse model, as blocks begin", "now": each} for each in before] + trained
        for title, columns, rows_of in (
            ("cuts and cameras", COUNT_COLUMNS, [each for each in of_scene if not each["trained"]]),
            ("validation views, raw", RESULT_COLUMNS, results),
        ):
            if rows_of:
                lines += [
                    "",
                    f"## {scene}: {title}",
                    "",
                    "| " + " | ".join(columns) + " |",
                    "|---" * len(columns) + "|",
                ]
                lines += ["| " + " | ".join(cell(row) for cell in columns.values()) + " |" for row in rows_of]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["seneca", "copr"], choices=list(SCENES))
    parser.add_argument("--only", nargs="+", default=[])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--counts", action="store_true", help="cuts and cameras alone, without training blocks")
    parser.add_argument("--table", type=Path, help="only write the rows that are done as Markdown")
    options = parser.parse_args()
    if options.table:
        done = [json.loads(line) for line in (options.work / "rows.jsonl").read_text().splitlines()]
        options.table.write_text(as_markdown(done), encoding="utf-8")
        raise SystemExit
    options.work.mkdir(parents=True, exist_ok=True)
    print(describe())
    for each in rows(options.data, options.work, options.scenes, options.only, not options.counts, options.seed):
        print(json.dumps(each)[:300])
