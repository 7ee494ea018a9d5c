"""Whether a capture can become a scene at all: what cannot work, and what is doubtful, found before any work.

Cameras and sparse points must belong together. Where the capture says in which photographs it found its points
(COLMAP's tracks) they are projected and held against that; elsewhere all that can be asked is whether they lie in front
of and inside the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape

from vdgs.captures.capture import Capture, View
from vdgs.captures.image_checks import check_images
from vdgs.errors import CaptureError
from vdgs.geometry.similarity import geometric_median, sample_points
from vdgs.system.units import some_names
from vdgs.visibility.visibility_counts import count_visibility

#: Sparse points looked at when there are more.
MAX_POINTS = 20_000
#: Choices. Shares of the points that no training camera sees: nothing could be trained; much is missing.
MAX_UNSEEN, WARN_UNSEEN = 0.95, 0.5
#: Median reprojection errors in pixels: fine detail is lost; not what any adjustment leaves (structure-from-motion
#: drops what is off by more than 4 pixels of the full size), where it also is this share of the longer side.
WARN_REPROJECTION_PX, MAX_REPROJECTION_PX, MAX_REPROJECTION_RATIO = 1.5, 3.0, 0.005
#: How far the cameras' places move the scene in their pictures, in pixels: no depth; as a share of the longer side:
#: poor depth.
MIN_PARALLAX_PX, WARN_PARALLAX_RATIO = 1.0, 0.02
#: Fewer distinct points than this span no surface; fewer than the second are hardly a model of a place.
MIN_DISTINCT_POINTS, WARN_DISTINCT_POINTS = 4, 50


@dataclass(frozen=True)
class ValidationReport:
    """What was found; `problems` make training pointless, `warnings` may be meant."""

    #: Median reprojection error in pixels of the photographs as used, where the capture has tracks; infinite where most
    #: of their points lie behind the cameras.
    reprojection_px: float | None
    #: Points in photographs that it was measured on.
    num_observations: int
    #: Share of the sparse points that at least one training camera holds in its frustum.
    seen_fraction: float
    problems: tuple[str, ...]
    warnings: tuple[str, ...]


def validate_capture(capture: Capture) -> ValidationReport:
    """Look at cameras and sparse points of a capture. O(points x cameras) on at most 20 000 points; pixels are not
    decoded."""
    points = sample_points(capture.points, MAX_POINTS)
    findings = _Findings([], [])
    cameras = [view.camera for view in capture.train_views]
    seen = count_visibility(torch.from_numpy(np.ascontiguousarray(points)), cameras).numpy() > 0
    errors = {view.name: _errors(view) for view in capture.views if view.observations is not None}
    pooled = np.concatenate(list(errors.values())) if errors else np.zeros(0)
    _judge_points(capture, findings)
    _judge_places(capture, points, findings)
    _judge_seen(capture, points, float(seen.mean()), findings)
    if len(pooled):
        _judge_reprojection(capture, errors, float(np.median(pooled)), findings)
    return ValidationReport(
        reprojection_px=float(np.median(pooled)) if len(pooled) else None, num_observations=len(pooled),
        seen_fraction=float(seen.mean()), problems=tuple(findings.problems), warnings=tuple(findings.warnings),
    )  # fmt: skip


def require_valid(capture: Capture) -> ValidationReport:
    """What `validate_capture` says of a capture. Raises `CaptureError` where it cannot become a scene."""
    report = validate_capture(capture)
    if report.problems:
        raise CaptureError(f"{capture.root}: cannot become a scene.\n  " + "\n  ".join(report.problems))
    return report


@dataclass(frozen=True)
class _Findings:
    problems: list[str]
    warnings: list[str]


def _errors(view: View) -> np.ndarray:
    assert view.observations is not None
    return view.observations.reprojection_errors_px(view.camera)


def _judge_points(capture: Capture, findings: _Findings) -> None:
    distinct = len(np.unique(capture.points, axis=0))
    if distinct < MIN_DISTINCT_POINTS:
        findings.problems.append(
            f"The model holds {distinct} distinct sparse point(s), from which no surface can start. Run the "
            "structure-from-motion again."
        )
    elif distinct < WARN_DISTINCT_POINTS:
        findings.warnings.append(
            f"there are only {distinct} distinct sparse points; the scene starts from them. Was the model cut down?"
        )


def _judge_places(capture: Capture, points: np.ndarray, findings: _Findings) -> None:
    """Depth is seen from different places only."""
    views = capture.train_views
    if len(views) < 2:
        findings.problems.append("There is 1 training photograph; a scene needs at least 2, from different places.")
        return
    centers = np.array([view.camera.position for view in views])
    distance = float(np.median(np.linalg.norm(centers - geometric_median(points), axis=1)))
    spread = 2 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    parallax = float(np.median([view.camera.fx for view in views])) * spread / max(distance, 1e-12)
    unit = capture.ground.unit
    if parallax < MIN_PARALLAX_PX:
        findings.problems.append(
            f"All {len(views)} training cameras are at one place (within {spread:.2g} {unit}, {distance:.3g} {unit} "
            "from the points): photographs that only turn about one place show no depth. Check the poses."
        )
    elif parallax < WARN_PARALLAX_RATIO * _longest_side(views):
        findings.warnings.append(
            f"all training cameras are within {spread:.2g} {unit}, {distance:.3g} {unit} from the points: the scene "
            f"moves by {parallax:.1f} px at most between the photographs, and depth will be poor."
        )


def _judge_seen(capture: Capture, points: np.ndarray, share_seen: float, findings: _Findings) -> None:
    cameras = [view.camera for view in capture.train_views]
    unseen = 1 - share_seen
    if unseen >= MAX_UNSEEN:
        behind = float(np.mean([(camera.project(points)[1] <= 0).mean() for camera in cameras]))
        findings.problems.append(
            f"No training camera sees {unseen:.0%} of the sparse points (V = 0); {behind:.0%} of the points lie behind "
            "a camera, on average. Cameras and points are not of one world, or the cameras look away from it: poses "
            "of another convention (OpenGL's axes instead of OpenCV's, world-from-camera instead of "
            "camera-from-world)? Export the model again."
        )
        return
    if unseen >= WARN_UNSEEN:
        findings.warnings.append(
            f"no training camera sees {unseen:.0%} of the sparse points (V = 0). Points of other photographs, or a "
            "model whose cameras and points do not belong together?"
        )
    places = torch.from_numpy(np.ascontiguousarray(points))
    blind = [view.name for view in capture.views if not bool(count_visibility(places, [view.camera]).any())]
    if blind:
        findings.warnings.append(
            f"{len(blind)} of {len(capture.views)} photographs show none of the sparse points ({some_names(blind)})."
        )


def _judge_reprojection(capture: Capture, errors: dict[str, np.ndarray], median: float, findings: _Findings) -> None:
    refused = max(MAX_REPROJECTION_PX, MAX_REPROJECTION_RATIO * _longest_side(capture.views))
    if median > refused:
        findings.problems.append(
            f"The sparse points do not fall where the photographs show them: the median reprojection error is "
            f"{format_reprojection(median)}. Points or poses were changed (mirrored, moved, scaled) or are of another "
            "reconstruction; export the model again."
        )
        return
    if median > WARN_REPROJECTION_PX:
        findings.warnings.append(
            f"the median reprojection error is {median:.1f} px; the scene will be blurred. Were poses or points "
            "rounded, or the model not adjusted after it was changed?"
        )
    wrong = [name for name, found in errors.items() if np.median(found) > refused]
    if wrong:
        findings.warnings.append(
            f"the poses of {len(wrong)} of {len(capture.views)} photographs are wrong: their sparse points do not fall "
            f"where the model says that they show them ({some_names(wrong)}). Remove them from the model."
        )


def format_reprojection(median_px: float) -> str:
    """A median reprojection error for people."""
    return f"{median_px:.2f} px" if np.isfinite(median_px) else "infinite: most points lie behind the cameras"


def _longest_side(views: Sequence[View]) -> float:
    return float(np.median([max(view.camera.width, view.camera.height) for view in views]))


def require_trainable(capture: Capture, console: Console) -> None:
    """Say what is doubtful about a capture and what masks leave out. Raises as `find_doubts`."""
    print_doubts(find_doubts(capture), console)


def find_doubts(capture: Capture, sample: Literal["all"] | int = "all") -> list[str]:
    """What is doubtful about a capture and what masks leave out, as lines for a console; decodes all photographs, or a
    sample of so many.

    Raises `CaptureError` for one that cannot become a scene, and for photographs or masks that are damaged.
    """
    soundness = require_valid(capture)
    checked = check_images(capture, sample)
    warnings = (*capture.warnings, *soundness.warnings, *checked.warnings)
    lines = [f"[yellow]note[/] {escape(warning)}" for warning in warnings]
    masked = checked.masked_fraction
    return lines + ([f"masks leave out {masked:.1%} of the photographs"] if masked else [])


def print_doubts(lines: Sequence[str], console: Console) -> None:
    for line in lines:
        console.print(line, highlight=False)
