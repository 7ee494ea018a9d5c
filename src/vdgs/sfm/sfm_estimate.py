"""How long a reconstruction takes: three photographs are searched and matched, the rest follows from their number."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from vdgs.sfm import feature_extraction, feature_matching, mask_files
from vdgs.sfm.flights import time_order
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.pair_selection import SEQUENTIAL_OVERLAP
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.workspace import SfmStep, Workspace, silence_colmap
from vdgs.system.processor_time import NO_COST, Cost, Moment, describe_cost

#: Processor seconds of a machine that searches a megapixel for features in `FEATURE_SECONDS`: of an observation (a
#: feature that the model holds, in one photograph) mapped, growing with the number of photographs (bundle adjustment
#: takes all that are placed), of a megapixel written, of georeferencing and figures. Measured: docs/sfm.md.
FEATURE_SECONDS, MAPPING_SECONDS, WRITING_SECONDS, FIXED_SECONDS = 0.25, 5.2e-5, 0.03, 1.5
#: With so many photographs one takes twice as long to be mapped as the first, and what share of mapping is parallel.
MAPPING_SCALE, PARALLEL_MAPPING = 36, 0.3
#: A photograph's pairs match as many of its features as so many pairs do that match them by chance, each on its own;
#: the photographs that observe a point, for the root of those that show its place; and where positions do not tell
#: these. Measured: 70, 61 and 19 % of the features where a pair matches 20, 18 and 4 %; 4.6 and 2.3 of 17 and 4.5.
INDEPENDENT_PAIRS, TRACK_LENGTH, TYPICAL_VIEWS = 5, 1.1, 8.0
#: Features that a pair matches where those that were tried match none, as a share (the least that was measured, above);
#: and points that a photograph brings at least, so that there is a scene to time.
LEAST_MATCHED, LEAST_POINTS = 0.04, 10


@dataclass(frozen=True, kw_only=True)
class SfmEstimate:
    """What a reconstruction takes and brings by estimate."""

    steps: Mapping[SfmStep, Cost]
    slowdown: float
    """How many times as long it takes as busy as the machine is now."""
    points: int
    probed: tuple[str, ...]
    """The photographs that were searched and matched."""

    @property
    def total(self) -> Cost:
        return sum(self.steps.values(), NO_COST)

    @property
    def expected_seconds(self) -> dict[str, float]:
        """By the clock, as busy as the machine is now."""
        return {step: cost.seconds * self.slowdown for step, cost in self.steps.items()}

    def text(self, threads: int) -> str:
        """How long it takes, and what says so."""
        return f"{describe_cost(self.total, threads, self.slowdown)}, by {' and '.join(self.probed)}"


def estimate_sfm(plan: ReconstructionPlan) -> SfmEstimate:
    """Search and match three photographs in a temporary folder. Raises what these steps raise."""
    silence_colmap()
    photographs, threads = plan.image_list.images, max(1, plan.threads)
    chosen = _probed_photographs(plan)
    together = len(chosen) / -(-len(chosen) // threads)  # threads that have work, on average
    with tempfile.TemporaryDirectory(prefix="vdgs-") as folder:
        workspace, before = Workspace(Path(folder)), Moment.now()
        groups = feature_extraction.group_by_camera(chosen)
        feature_extraction.create_database(workspace, groups)
        feature_extraction.write_upright_images(workspace, chosen, threads)
        mask_files.write_upright_masks(workspace, chosen, threads)
        feature_extraction.extract_groups(workspace, groups, plan.request.options, len(photographs), threads)
        searched = Moment.now()
        counts = feature_extraction.count_features(workspace)
        names = [photo.name for photo in chosen]
        matching, inliers = (0.0, 0.0), 0.0
        if len(counts) == len(chosen):
            matching = _time_matching(workspace, names, threads)
            inliers = sum(feature_matching.count_inliers(workspace)) / (4 * (len(names) - 1))
    feature = searched.cost_since(before).processor_seconds / len(chosen)
    features = sum(counts.values()) / max(1, len(counts))
    share = min(1.0, inliers / max(1.0, features)) or LEAST_MATCHED  # flights overlap little: a far pair may not
    observations = len(photographs) * features * (1 - (1 - share) ** INDEPENDENT_PAIRS)
    track = max(2.0, TRACK_LENGTH * (plan.preflight.views_per_point or TYPICAL_VIEWS) ** 0.5)
    return SfmEstimate(
        steps=_steps(plan, feature, matching, observations),
        slowdown=searched.slowdown_since(before, together),
        points=max(round(observations / track), LEAST_POINTS * len(photographs)),
        probed=tuple(names),
    )


def _time_matching(workspace: Workspace, names: Sequence[str], threads: int) -> tuple[float, float]:
    """Processor seconds of preparing the features of a photograph, which a call does once for each, and of comparing a
    pair, by the pairs of the first with the others: once, and three times with copies of them all."""
    first, *others = names
    for name in names:
        feature_matching.copy_features(workspace, name, _copy(name))
    pairs = [(first, other) for other in others]
    moments = [Moment.now()]
    for chunk in (pairs, [(a, b) for one, other in pairs for a, b in _other_pairs(one, other)]):
        feature_matching.match_chunk(workspace, chunk, threads)
        moments.append(Moment.now())
    once, thrice = (after.process - before.process for before, after in pairwise(moments))
    prepared = max(0.0, (3 * once - thrice) / len(names))  # the second call prepares twice as many
    return prepared, max(once - len(names) * prepared, 0.1 * once) / len(pairs)


def _copy(name: str) -> str:
    return f"{name}.copy"


def _other_pairs(one: str, other: str) -> list[tuple[str, str]]:
    """The pairs of two photographs and copies of them that show the same as the two."""
    return [(_copy(one), other), (one, _copy(other)), (_copy(one), _copy(other))]


def _pair_seconds(plan: ReconstructionPlan, prepared: float, compared: float) -> float:
    """Processor seconds of a pair among all: a call prepares the photographs of its pairs, which share some."""
    chunk = min(plan.pairs, feature_matching.PAIRS_PER_THREAD * max(1, plan.threads))
    partners = max(1.0, plan.pairs / len(plan.image_list.images))
    photographs = min(chunk + 1, len(plan.image_list.images), chunk / partners + 1.2 * partners)
    return compared + prepared * photographs / max(1, chunk)


def _steps(
    plan: ReconstructionPlan, feature: float, matching: tuple[float, float], observations: float
) -> dict[SfmStep, Cost]:
    """The steps from what one photograph and one pair took."""
    photographs, threads = plan.image_list.images, max(1, plan.threads)
    count = len(photographs)
    megapixels = sum(photo.width * photo.height for photo in photographs) / 1e6
    searched = feature_extraction.searched_megapixels(plan.image_list.images, plan.request.options)
    speed = feature * count / (FEATURE_SECONDS * searched)
    mapping = speed * MAPPING_SECONDS * observations * (1 + count / MAPPING_SCALE)
    mapping_threads = 1 / (1 - PARALLEL_MAPPING + PARALLEL_MAPPING / threads)
    written = speed * (WRITING_SECONDS * megapixels + FIXED_SECONDS)
    parallel = {
        "features": feature * count,
        "matching": _pair_seconds(plan, *matching) * plan.pairs,
        "writing": written,
    }
    steps = {name: Cost(seconds / threads, seconds) for name, seconds in parallel.items()}
    steps["mapping"] = Cost(mapping / mapping_threads, mapping)
    return steps  # type: ignore[return-value]


def _probed_photographs(plan: ReconstructionPlan) -> list[ImageMetadata]:
    """A photograph from the middle of the flight, and a near and a far one of those that it is matched with: how long a
    pair takes to be verified depends on how much the two overlap."""
    photographs = plan.image_list.images
    order = time_order(photographs)
    first = order[len(order) // 2]
    if plan.gps_priors.usable:
        places = plan.gps_priors.all_positions(len(photographs))
        away = np.linalg.norm(places - places[first], axis=1)
        pairs = feature_matching.spatial_candidates(photographs, plan.gps_priors, plan.request.options)
        partners = {i + j - first for i, j in pairs if first in (i, j)}
        partners = {other for other in partners if np.isfinite(away[other])}
    else:
        away = np.abs(np.argsort(order) - len(order) // 2).astype(float)
        few = len(photographs) > plan.request.options.exhaustive_max
        partners = {i for i in range(len(photographs)) if i != first and (not few or away[i] <= SEQUENTIAL_OVERLAP)}
    partners = partners or {order[len(order) // 2 - 1]}
    by_distance = sorted(partners, key=lambda i: away[i])
    others = {by_distance[len(partners) * quarter // 4] for quarter in (1, 3)}
    return [photographs[k] for k in (first, *sorted(others))]
