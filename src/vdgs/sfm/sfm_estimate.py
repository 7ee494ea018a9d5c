"""How long a reconstruction takes: two photographs are searched and matched, and the rest follows from their number."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from vdgs.sfm import feature_extraction, feature_matching, mask_files
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.pair_selection import SEQUENTIAL_OVERLAP
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.workspace import SfmStep, Workspace, silence_colmap
from vdgs.system.processor_time import NO_COST, Cost, Moment, describe_cost

#: Processor seconds of a machine that searches a megapixel for features in `FEATURE_SECONDS`: of a photograph mapped,
#: growing with the number of photographs (bundle adjustment takes all that are placed), of a megapixel written, of
#: georeferencing and figures. Measured: docs/sfm.md.
FEATURE_SECONDS, MAPPING_SECONDS, WRITING_SECONDS, FIXED_SECONDS = 0.25, 0.09, 0.03, 1.5
#: With so many photographs one takes twice as long to be mapped as the first, and what share of mapping is parallel.
MAPPING_SCALE, PARALLEL_MAPPING = 16, 0.3
#: Points of a photograph that the model holds, for each of its features.
POINTS_PER_FEATURE = 0.07


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
    """Search and match two photographs in a temporary folder. Raises what these steps raise."""
    silence_colmap()
    photographs, threads = plan.image_list.images, max(1, plan.threads)
    pair = _probed_pair(plan)
    with tempfile.TemporaryDirectory(prefix="vdgs-") as folder:
        workspace, before = Workspace(Path(folder)), Moment.now()
        groups = feature_extraction.group_by_camera(pair)
        feature_extraction.create_database(workspace, groups)
        feature_extraction.write_upright_images(workspace, pair)
        mask_files.write_upright_masks(workspace, pair, threads)
        feature_extraction.extract_groups(workspace, groups, plan.request.options, len(photographs), threads)
        searched = Moment.now()
        counts = feature_extraction.count_features(workspace)
        matching = _time_matching(workspace, pair[0].name, pair[1].name, threads) if len(counts) == len(pair) else None
    feature = searched.cost_since(before, min(2, threads)).processor_seconds / 2
    slowdown = searched.slowdown_since(before, min(2, threads))
    features = sum(counts.values()) / max(1, len(counts))
    return SfmEstimate(
        steps=_steps(plan, feature, matching or (0.0, 0.0), features),
        slowdown=slowdown,
        points=round(POINTS_PER_FEATURE * features * len(photographs)),
        probed=tuple(photo.name for photo in pair),
    )


def _time_matching(workspace: Workspace, one: str, other: str, threads: int) -> tuple[float, float]:
    """Processor seconds of preparing the features of a photograph, which a call does once for each, and of comparing a
    pair: from one pair, and from four of two photographs and copies of them."""
    copies = [f"{one}.copy", f"{other}.copy"]
    for name, copy in zip((one, other), copies, strict=True):
        feature_matching.copy_features(workspace, name, copy)
    moments = [Moment.now()]
    for pairs in ([(one, other)], [(copies[0], other), (one, copies[1]), (copies[0], copies[1])]):
        feature_matching.match_chunk(workspace, pairs, threads)
        moments.append(Moment.now())
    single, three = (after.process - before.process for before, after in pairwise(moments))
    prepared = max(0.0, (3 * single - three) / 2)  # 2 and 4 photographs are prepared, 1 and 3 pairs compared
    return prepared, max(single - 2 * prepared, 0.1 * single)


def _pair_seconds(plan: ReconstructionPlan, prepared: float, compared: float) -> float:
    """Processor seconds of a pair among all: a call prepares the photographs of its pairs, which share some."""
    chunk = min(plan.pairs, feature_matching.PAIRS_PER_THREAD * max(1, plan.threads))
    partners = max(1.0, plan.pairs / len(plan.image_list.images))
    photographs = min(chunk + 1, len(plan.image_list.images), chunk / partners + 1.2 * partners)
    return compared + prepared * photographs / max(1, chunk)


def _steps(
    plan: ReconstructionPlan, feature: float, matching: tuple[float, float], features: float
) -> dict[SfmStep, Cost]:
    """The steps from what one photograph and one pair took."""
    photographs, threads = plan.image_list.images, max(1, plan.threads)
    count = len(photographs)
    megapixels = sum(photo.width * photo.height for photo in photographs) / 1e6
    searched = feature_extraction.searched_megapixels(plan.image_list.images, plan.request.options)
    speed = feature * count / (FEATURE_SECONDS * searched)
    mapping = speed * MAPPING_SECONDS * count * (1 + count / MAPPING_SCALE) * features / 8000
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


def _probed_pair(plan: ReconstructionPlan) -> list[ImageMetadata]:
    """A photograph from the middle of the flight, and the one in the middle of those that it is matched with: near ones
    take longer to be verified than those that hardly overlap."""
    photographs = plan.image_list.images
    order = feature_matching.time_order(photographs)
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
    other = sorted(partners, key=lambda i: away[i])[len(partners) // 2]
    return [photographs[first], photographs[other]]
