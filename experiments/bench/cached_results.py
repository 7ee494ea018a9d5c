"""Figures of runs that another bench trained, perhaps on another machine: its results.json (`--reuse-results`).

A run is the same where its key is: the same settings, seed, scene and way of measuring. Its figures then stand in the
table as if it had been trained here, and the table says where they are from. So a table of many hours is the work of
several machines, or of several nights, and can be written again without training anything.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from experiments.bench.plan import BenchPlan
from experiments.bench.results import BenchResult, without_old_seconds
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json


def read_cached_results(files: Iterable[Path]) -> dict[str, BenchResult]:
    """Key -> result of every finished run in the files; of several with one key the first.

    Runs that failed, were stopped or have no PSNR are left out, and so trained. Raises VdgsError for a file that cannot
    be read or is no results.json of a bench.
    """
    results_by_key: dict[str, BenchResult] = {}
    for file in files:
        content = read_json(file)
        try:
            results = [_result(each) for each in content["results"] if each["state"] == "done"]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise VdgsError(
                f"--reuse-results {file}: is not what `vdgs bench` writes as results.json, or of an earlier version "
                f"({type(error).__name__}: {error})"
            ) from error
        for each in results:
            if each.figures["psnr"] is not None:
                results_by_key.setdefault(each.key, each)
    return results_by_key


def _result(plain: Mapping[str, Any]) -> BenchResult:
    """A finished run, or renders of another program that were measured, whose costs nobody knows."""
    plain = {"clock": 1, **plain}  # what is older says no clock
    result = BenchResult(**{each.name: plain[each.name] for each in fields(BenchResult)})
    if not result.key or not isinstance(result.figures["psnr"], float | None):
        raise ValueError("a run without key or figures")
    # Without them its seconds would stand beside others of another meaning.
    if "seconds" in result.figures and "preparation_seconds" not in result.figures:
        raise ValueError("a run whose seconds are those of its steps alone")
    return without_old_seconds(replace(result, groups=tuple(result.groups), frusta=tuple(result.frusta)))


def drop_cached_runs(plan: BenchPlan, keys: Mapping[str, str], cached: Mapping[str, BenchResult]) -> BenchPlan:
    """The plan without the runs that are known and without coarse stages that nothing else needs.

    `keys`: name of a run -> its key.
    """
    runs = tuple(run for run in plan.runs if keys[run.name] not in cached)
    wanted = {run.coarse_from for run in runs}
    coarse = tuple(run for run in plan.coarse if run.folder in wanted)
    scenes = tuple(scene for scene in plan.scenes if any(run.scene == scene.name for run in runs))
    return replace(plan, runs=runs, coarse=coarse, scenes=scenes)


def match_pixel_groups(results: Sequence[BenchResult], cached: Mapping[str, BenchResult]) -> list[BenchResult]:
    """The results, known ones without their groups by visibility where these hold other pixels than those of the runs
    that were trained here (of captures without truth, a model of each bench says what its groups are)."""
    reference: dict[str, BenchResult] = {}
    for each in sorted(results, key=lambda result: result.key in cached):  # those trained here first
        if each.groups:
            reference.setdefault(each.scene, each)
    return [each if _grouped_alike(each, reference.get(each.scene)) else _ungrouped(each) for each in results]


def _grouped_alike(result: BenchResult, reference: BenchResult | None) -> bool:
    if reference is None or not result.groups:
        return True
    return (result.visibility_source, list(result.groups)) == (reference.visibility_source, list(reference.groups))


def _ungrouped(result: BenchResult) -> BenchResult:
    figures = {name: value for name, value in result.figures.items() if "@" not in name}
    reason = "Its groups by visibility are of other pixels than those of the runs here: it has none in this table."
    return replace(result, figures=figures, groups=(), frusta=(), reason=f"{result.reason} {reason}".strip())
