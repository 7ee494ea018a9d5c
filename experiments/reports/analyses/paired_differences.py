"""Differences between rows of a bench, each seed against itself: what a row gains over another, how far seeds part.

    python -m experiments.reports.analyses.paired_differences results.json [more.json ...] --pairs paper-1-on:paper-0-on

Figures of several files are put together (a run of the same row and seed counts once). Prints a table in Markdown: PSNR
over all, corrected, SSIM, and PSNR by V (groups of the truth). After ± stands the standard deviation over seeds.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from experiments.bench.statistics import Summary, paired_difference, summarize

Figures = dict[str, float | None]


def read_rows(files: list[Path], scene: str) -> tuple[dict[tuple[str, int], Figures], list[dict[str, Any]]]:
    """The figures of each row and seed of a scene, and the groups by V, which all of them share."""
    rows, groups = dict[tuple[str, int], Figures](), list[dict[str, Any]]()
    for file in files:
        for each in json.loads(file.read_text())["results"]:
            if each["state"] == "done" and each["scene"] == scene:
                rows.setdefault((each["method"], each["seed"]), each["figures"])
                groups = groups or each["groups"]
                assert groups == each["groups"], f"{file}: {each['method']} was measured on other pixels"
    return rows, groups


def as_markdown(rows: dict[tuple[str, int], Figures], groups: list[dict[str, Any]], pairs: list[str]) -> str:
    """Rows as they are, then the differences of pairs."""
    keys = ["psnr", "psnr_cc", "ssim", *(f"psnr@{index}" for index in range(len(groups)))]
    names = ["PSNR", "corrected", "SSIM", *(f"V {each['lower']:g} to {each['upper']:g}" for each in groups)]
    lines = [f"| | seeds | {' | '.join(names)} | anchors |", "|---" * (len(keys) + 3) + "|"]

    def of(method: str, key: str) -> dict[int, float | None]:
        return {seed: figures[key] for (name, seed), figures in rows.items() if name == method}

    for method in dict.fromkeys(name for name, _ in rows):
        cells = [_cell(summarize(of(method, key).values()), key) for key in keys]
        anchors = summarize(of(method, "anchors").values())
        size = "–" if anchors is None else f"{anchors.mean / 1000:.0f} k"
        lines.append(f"| {method} | {_seeds(of(method, 'psnr'))} | {' | '.join(cells)} | {size} |")
    for one, other in (pair.split(":") for pair in pairs):
        shared = of(one, "psnr").keys() & of(other, "psnr").keys()
        apart = [paired_difference(of(one, key), of(other, key)) for key in keys]
        cells = [_cell(each and summarize(each.by_seed), key, "+") for each, key in zip(apart, keys, strict=True)]
        lines.append(f"| {one} − {other} | {_seeds(shared)} | {' | '.join(cells)} | |")
    return "\n".join(lines)


def _cell(found: Summary | None, key: str, sign: str = "") -> str:
    if found is None:
        return "–"
    digits = 4 if key == "ssim" else 2
    spread = f" ± {found.spread:.{digits}f}" if found.spread is not None else ""
    return f"{found.mean:{sign}.{digits}f}{spread}".replace("-", "−")


def _seeds(of: Iterable[int]) -> str:
    return ", ".join(str(seed) for seed in sorted(of))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--pairs", nargs="*", default=[])
    parser.add_argument("--scene", default="regime-small")
    options = parser.parse_args()
    print(as_markdown(*read_rows(options.files, options.scene), options.pairs))
