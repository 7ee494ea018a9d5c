"""What a capture holds and where it looks thin, in numbers, before anyone trains.

The visibility V of a sparse point is the number of *training* cameras whose frustum holds it (z > near,
projected center on the image; no occlusion), as in section IV-B of the VDGS paper. Where V is small, a
scene trains badly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vdgs.captures.capture import Capture
from vdgs.captures.image_checks import ImageCheckReport
from vdgs.captures.place_facts import measure_place
from vdgs.captures.place_record import PlaceFacts
from vdgs.captures.validation import ValidationReport
from vdgs.visibility.visibility_counts import LOW_VISIBILITY_LIMITS, visibility_stats


@dataclass(frozen=True, kw_only=True)
class CaptureReport:
    """Numbers about a capture; lengths are in `unit` of the ground frame."""

    #: What the report of a run and `vdgs status` begin with.
    place: PlaceFacts
    source: str
    images: str
    unit: str
    num_images: int
    train: int
    test: int
    #: Distinct image sizes, (width, height) in pixels, most frequent first.
    image_sizes: list[tuple[int, int]]
    #: Median horizontal focal length in pixels and field of view in degrees.
    focal_px: float
    field_of_view_deg: float
    points: int
    #: Median distance of a sparse point to its nearest neighbor.
    point_spacing: float
    ground: str
    metric: bool
    #: Latitude, longitude (deg) and altitude (m) of the origin, where known.
    origin_geo: tuple[float, float, float] | None
    #: Minimum, median, maximum height of the cameras above the median sparse point.
    camera_height: tuple[float, float, float]
    tilt_deg: float
    #: V of the points: quantiles by percent, mean, and Gini coefficient (0 = all seen alike).
    visibility_quantiles: dict[int, float]
    visibility_mean: float
    visibility_gini: float
    #: Share of points that fewer than 3, 5, 10 training cameras see.
    fraction_below: dict[int, float]
    #: Bytes that all images take in memory, as uint8.
    image_bytes: int
    #: Photographs with a mask, and the share of all pixels that masks and transparency leave out; None: not decoded.
    masks: int
    masked_fraction: float | None
    #: Median reprojection error in pixels as used, on so many sightings; None where the capture has no tracks, or where
    #: most of their points lie behind the cameras.
    reprojection_px: float | None
    num_observations: int
    #: Share of the points that at least one training camera sees.
    seen_fraction: float
    #: What makes training pointless, and what a person should know but need not mend.
    problems: list[str]
    warnings: list[str]
    figures: list[str]


def measure_capture(
    capture: Capture,
    points: np.ndarray,
    visibility: np.ndarray,
    validation: ValidationReport,
    image_check: ImageCheckReport | None,
) -> CaptureReport:
    """The report on a capture, given (a sample of) its points and their V; `image_check` None: nothing was decoded."""
    cameras = [view.camera for view in capture.views]
    ground_height = float(np.median(points[:, 2]))
    heights = np.array([camera.position[2] for camera in cameras]) - ground_height
    sizes, counts = np.unique([(c.width, c.height) for c in cameras], axis=0, return_counts=True)
    spacing = _nearest_distances(points, capture.points)
    focal = float(np.median([camera.fx for camera in cameras]))
    fields = [2 * np.degrees(np.arctan(camera.width / 2 / camera.fx)) for camera in cameras]
    tilts = [np.degrees(np.arccos(np.clip(-camera.forward[2], -1, 1))) for camera in cameras]
    masked = sum(view.camera.width * view.camera.height for view in capture.views if view.mask_path)
    origin = capture.ground.origin_geo
    seen, image_warnings = visibility_stats(visibility), image_check.warnings if image_check else ()
    return CaptureReport(
        place=measure_place(capture),
        source=capture.source,
        images=capture.images,
        unit=capture.ground.unit,
        num_images=len(cameras),
        train=len(capture.train_views),
        test=len(capture.test_views),
        image_sizes=[(int(w), int(h)) for w, h in sizes[np.argsort(-counts, kind="stable")]],
        focal_px=focal,
        field_of_view_deg=float(np.median(fields)),
        points=len(capture.points),
        point_spacing=float(np.median(spacing)),
        ground=capture.ground.description,
        metric=capture.ground.metric,
        origin_geo=None if origin is None else (float(origin[0]), float(origin[1]), float(origin[2])),
        camera_height=(float(heights.min()), float(np.median(heights)), float(heights.max())),
        tilt_deg=float(np.median(tilts)),
        visibility_quantiles=seen.quantiles,
        visibility_mean=seen.mean,
        visibility_gini=seen.gini,
        fraction_below=seen.fraction_below,
        image_bytes=sum(3 * camera.width * camera.height for camera in cameras) + masked,
        masks=sum(view.mask_path is not None for view in capture.views),
        masked_fraction=None if image_check is None else image_check.masked_fraction,
        reprojection_px=validation.reprojection_px,
        num_observations=validation.num_observations,
        seen_fraction=float((visibility > 0).mean()),
        problems=list(validation.problems),
        warnings=[*capture.warnings, *image_warnings, *validation.warnings, *_findings(visibility)],
        figures=[],
    )


def _nearest_distances(some: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far `some` of the points lie from the nearest other one of all: those of a sample lie farther apart."""
    if len(points) < 2:
        return np.zeros(1)
    tree = cKDTree(points, compact_nodes=False, balanced_tree=False)  # a fifth of the time; places are asked once
    return np.asarray(tree.query(some, k=2)[0][:, 1])


def _findings(visibility: np.ndarray) -> list[str]:
    """What the visibility says that a person should know."""
    thin = float((visibility < LOW_VISIBILITY_LIMITS[0]).mean())
    if thin <= 0.05:
        return []
    return [
        f"{thin:.0%} of the points are seen by fewer than {LOW_VISIBILITY_LIMITS[0]} training cameras; "
        "expect these parts to come out poorly (see the map)."
    ]
