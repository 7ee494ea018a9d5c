"""A model brought to surveyed points, and measured by them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from vdgs.captures.known_distances import MIN_OBSERVATIONS
from vdgs.captures.plane_fit import fit_plane, in_plane
from vdgs.captures.reconstruction import AccuracyFacts, GcpReport
from vdgs.errors import CaptureError
from vdgs.geometry.ray_intersection import intersect_rays
from vdgs.geometry.similarity import Similarity, fit_similarity, fit_similarity_robust, is_collinear, rotation_to_z
from vdgs.sfm.bending import bend_to_points
from vdgs.sfm.gcp_list import MIN_CONTROL_POINTS, GcpList, GcpObservation, GroundControlPoint, are_along_line
from vdgs.sfm.georegistration import transform_model
from vdgs.system.lazy_pycolmap import pycolmap

#: With so many points, one that does not fit the others is found and left out.
MIN_POINTS_FOR_OUTLIERS = 6
#: Heights, which are often worse than places, have an accuracy of their own where a plane leaves so many free.
FREE_HEIGHTS = 2
#: A mark is right to about so many pixels: what is farther off counts less.
MARK_SIGMA_PX = 2.0
#: A point that fits the others to this share of what a pixel shows on the ground is no outlier, however well these fit
#: each other: few agree by chance (choice).
FITTING_PX = 0.5
#: A mark so many pixels from where the model puts a surveyed point is wrong; points whose marks are farther off than
#: this share of a photograph's longer side are not used (choice).
MARK_WRONG_PX, MARK_USELESS = 8.0, 0.01
#: Points are on the surface: seen so many times as far as what lies nearest to their marks, or as near, they are none
#: of the places that were marked (choice); of so many features.
DEPTHS_APART, NEAREST = 1.3, 10
ANYWAY_GCP = (
    "Mend the list, place by GPS and only measure the points (--check-points all), or use it as it is "
    "(--georeference anyway)."
)


@dataclass(frozen=True, eq=False)
class TriangulatedPoint:
    """A surveyed point as a model has it."""

    position: Float[np.ndarray, "3"]
    num_images: int
    error_px: float
    """RMS distance between where photographs show it and where the model puts it there."""
    kept_px: float
    """The same of the marks that agree."""
    agreeing: tuple[GcpObservation, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Level:
    """What says how a model lies where too few points have heights."""

    up: Float[np.ndarray, "3"]
    deviation_deg: float
    gps: Similarity | None
    """From the model to metres by positions."""
    gps_up_m: float | None
    """How good heights are by that (95 %)."""


@dataclass(frozen=True, eq=False)
class Surveyed:
    """How a model was brought to surveyed points."""

    model: pycolmap.Reconstruction
    how: str
    doubtful: frozenset[str]
    """Names of points that do not fit the others, or whose marks fit nothing; they were left out."""
    accuracy: AccuracyFacts
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SurveyedFit:
    """A similarity to surveyed points [n]."""

    known: np.ndarray
    """Whose heights are known, [n] bool."""
    is_level: bool
    """Whether these are too few to level a model, which then has heights of its own."""
    aims: Float[np.ndarray, "n 3"]
    """Where they were surveyed, with heights."""
    similarity: Similarity
    trusted: np.ndarray
    """Which of them count, [n] bool."""
    accuracy: AccuracyFacts


def triangulate(model: pycolmap.Reconstruction, point: GroundControlPoint) -> TriangulatedPoint | None:
    """Where the placed photographs see a point; None where fewer than two show it from different places.

    The point nearest to all rays, then the least sum of its errors in the photographs, robustly; of many marks a third
    at most is left out, those farthest off.
    """
    images = {image.name: image for image in model.images.values() if image.has_pose}
    seen = [each for each in point.observations if each.image in images]
    first = _nearest_to_marks(model, images, seen)
    if first is None:
        return None
    kept, (place, errors) = seen, first
    while len(kept) > max(MIN_OBSERVATIONS + 1, len(seen) - len(seen) // 3) and errors.max() > MARK_WRONG_PX:
        fewer = [each for each, error in zip(kept, errors, strict=True) if error < errors.max()]
        found = _nearest_to_marks(model, images, fewer)
        if found is None:
            break
        kept, (place, errors) = fewer, found
    all_errors = _errors_px(model, images, seen, place)
    return TriangulatedPoint(
        place, len({each.image for each in seen}), _rms(all_errors), _rms(errors), tuple(kept)
    )  # fmt: skip


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).mean()))


def _nearest_to_marks(
    model: pycolmap.Reconstruction, images: Mapping[str, pycolmap.Image], seen: Sequence[GcpObservation]
) -> tuple[np.ndarray, np.ndarray] | None:
    """The place [3] that marks show, and how far each mark is from it in pixels; None where they show none."""
    from scipy.optimize import least_squares  # slow to load, and few captures have marks

    if len({each.image for each in seen}) < MIN_OBSERVATIONS:
        return None
    views = [images[each.image] for each in seen]
    poses = [np.asarray(view.cam_from_world().matrix()) for view in views]
    rays = [
        np.append(np.asarray(model.cameras[view.camera_id].cam_from_img(np.array(each.pixel))).ravel()[:2], 1)
        @ pose[:, :3]
        for each, view, pose in zip(seen, views, poses, strict=True)
    ]
    start = intersect_rays(np.array([view.projection_center() for view in views]), np.array(rays))
    if start is None or any((pose @ np.append(start, 1))[2] <= 0 for pose in poses):
        return None  # behind a camera: the marks are of different things
    found = least_squares(
        lambda place: _off_px(model, images, seen, place).ravel(),
        start,
        loss="soft_l1",
        f_scale=MARK_SIGMA_PX,
        x_scale="jac",
    ).x
    return found, _errors_px(model, images, seen, found)


def _off_px(
    model: pycolmap.Reconstruction,
    images: Mapping[str, pycolmap.Image],
    seen: Sequence[GcpObservation],
    place: np.ndarray,
) -> np.ndarray:
    shown = []
    for each in seen:
        view = images[each.image]
        there = np.asarray(view.cam_from_world().matrix()) @ np.append(place, 1)
        shown.append(np.asarray(model.cameras[view.camera_id].img_from_cam(there[None])).ravel() - each.pixel)
    return np.array(shown)


def _errors_px(
    model: pycolmap.Reconstruction,
    images: Mapping[str, pycolmap.Image],
    seen: Sequence[GcpObservation],
    place: np.ndarray,
) -> np.ndarray:
    return np.linalg.norm(_off_px(model, images, seen, place), axis=1)


def adjust_to_gcps(
    model: pycolmap.Reconstruction,
    gcps: GcpList,
    origin: tuple[float, float, float],
    fix_focal: bool,
    threads: int,
    level: Level,
    doubts: Callable[[Similarity, np.ndarray, np.ndarray], str] | None,
) -> Surveyed:
    """Move a model, in place, to the points that are not held out, metres east, north, up of `origin`; then a copy is
    bent by those with heights: a bundle adjustment in which they stay where they were surveyed. Points without heights
    have those that the model gives them, levelled by the points with heights or else by `level`.

    `doubts` says of a similarity, of where the model has the points and of where they were surveyed, what speaks
    against it. Raises CaptureError for what it says, where marks fit nothing, and where fewer than three of the points
    are seen by placed photographs, or they lie along a line.
    """
    targets, located = gcps.enu(origin), triangulate_all(model, gcps)
    control = {k: seen for k, seen in located.items() if not gcps.points[k].is_check_point}
    wrong = [k for k, seen in control.items() if seen.kept_px > _useless_px(model)]
    used = {k: seen for k, seen in control.items() if k not in wrong}
    if doubts is not None:
        _check_marks(model, gcps, used, len(wrong))
    rows = np.array(list(used), int)
    _check_enough(targets[rows], len(wrong), gcps.source)
    places = np.array([seen.position for seen in used.values()])
    fit = fit_surveyed(places, targets[rows], level, pixel_at(model, list(used.values())))
    said = doubts(fit.similarity, places[fit.trusted], fit.aims[fit.trusted]) if doubts is not None else ""
    if said:
        raise CaptureError(f"{gcps.source}: {said} {ANYWAY_GCP}")
    transform_model(model, fit.similarity)
    accuracy, notes = fit.accuracy, tuple[str, ...]()
    firm = fit.trusted & fit.known
    if fit.is_level:
        accuracy, notes = _levelled_accuracy(fit, level), (_levelled_note(fit, level),)
    elif is_collinear(fit.aims[firm]):
        notes = ("too few control points with heights fit the others to bend the model; it is not bent.",)
    else:
        aims = [(located[k].agreeing, targets[k]) for k in rows[firm].tolist()]
        model, notes = bend_to_points(model, aims, fix_focal, threads)
    kept = rows[fit.trusted].tolist()
    doubtful = frozenset(gcps.points[k].name for k in (*rows[~fit.trusted].tolist(), *wrong))
    return Surveyed(
        model=model,
        how=f"{len(kept)} control points ({gcps.source}, {gcps.crs})",
        doubtful=doubtful,
        accuracy=_accuracy_as_left(accuracy, model, gcps, kept, targets),
        notes=notes,
    )


def _check_marks(
    model: pycolmap.Reconstruction, gcps: GcpList, used: Mapping[int, TriangulatedPoint], num_wrong: int
) -> None:
    """Raise CaptureError for marks that must be read otherwise to fit, or that meet beside the surface."""
    few = num_wrong >= len(used) or len(used) < MIN_CONTROL_POINTS
    otherwise = _other_marks(model, gcps) if few else ""
    if otherwise:
        raise CaptureError(f"{gcps.source}: its marks fit the photographs only if {otherwise}. {ANYWAY_GCP}")
    depth = _depth_beside_surface(model, used.values())
    if not 1 / DEPTHS_APART < depth < DEPTHS_APART:
        raise CaptureError(
            f"{gcps.source}: its marks meet {depth:.2g} times as far from the cameras as what the photographs show "
            f"there. Are they pixels of photographs of another size, or of other points? {ANYWAY_GCP}"
        )


def _levelled_accuracy(fit: SurveyedFit, level: Level) -> AccuracyFacts:
    """The accuracy of a model that its points do not level, as far as `level` says how it lies."""
    across = fit.accuracy.place_m[:1] if fit.accuracy.place_m else ()
    up_m = () if level.gps_up_m is None or fit.known.any() else (level.gps_up_m,)
    return replace(fit.accuracy, place_m=(*across, *up_m), level_deg=2 * level.deviation_deg)


def _levelled_note(fit: SurveyedFit, level: Level) -> str:
    by = "points with heights" if fit.known.any() else "GPS" if level.gps is not None else "nothing"
    return f"too few control points have heights to level or to bend the model: heights are by {by}."


def _accuracy_as_left(
    accuracy: AccuracyFacts, model: pycolmap.Reconstruction, gcps: GcpList, kept: Sequence[int], targets: np.ndarray
) -> AccuracyFacts:
    """No better than what a finished model leaves of the points that it kept, and with the error of their datum."""
    seen = [(k, now) for k in kept if (now := triangulate(model, gcps.points[k])) is not None]
    accuracy = no_better_than_left(accuracy, np.array([now.position - targets[k] for k, now in seen]).reshape(-1, 3))
    if not accuracy.place_m:
        return accuracy
    with_datum = float(np.hypot(accuracy.place_m[0], gcps.datum_error_m))
    return replace(accuracy, place_m=(with_datum, *accuracy.place_m[1:]))


def fit_surveyed(
    places: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"], level: Level, pixel: float = 0.0
) -> SurveyedFit:
    """The similarity from places that a model has to where they were surveyed (NaN: no height), and how good it is;
    `pixel` is what one shows there, in the model's unit."""
    known = np.isfinite(targets[:, 2])
    is_level = is_collinear(places[known])
    aims = _with_heights(places, targets, is_level, level)
    similarity, trusted = fit_to_gcps(places, aims, pixel)
    measured = 0 if is_level else int(known[trusted].sum())  # those of a levelled model are its own
    accuracy = gcp_accuracy(similarity.apply(places[trusted]), aims[trusted], measured)
    return SurveyedFit(known, is_level, aims, similarity, trusted, accuracy)


def _check_enough(targets: Float[np.ndarray, "n 3"], num_wrong: int, source: str) -> None:
    if len(targets) < MIN_CONTROL_POINTS or are_along_line(targets):
        bad = f", {num_wrong} more are marked where they cannot be" if num_wrong else ""
        raise CaptureError(
            f"{source}: {len(targets)} of its points are shown by two placed photographs or more, not along one "
            f"line{bad}; {MIN_CONTROL_POINTS} are needed. Mark them in more photographs, or hold them "
            "out: --check-points all"
        )


def _depth_beside_surface(model: pycolmap.Reconstruction, used: Iterable[TriangulatedPoint]) -> float:
    """How many times as far from the cameras points are as what is seen nearest to their marks, the median: marks of
    photographs of another size meet too, elsewhere. 1 where the photographs show too little there."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    ratios = []
    for seen in used:
        for each in seen.agreeing:
            view = images[each.image]
            shown = [point for point in view.points2D if point.has_point3D()]
            if len(shown) < NEAREST:
                continue
            near = np.argsort(np.linalg.norm([point.xy - each.pixel for point in shown], axis=1))[:NEAREST]
            ahead = view.cam_from_world().matrix()[2]
            depths = [ahead @ np.append(model.points3D[shown[k].point3D_id].xyz, 1) for k in near]
            ratios.append(float(ahead @ np.append(seen.position, 1) / np.median(depths)))
    return float(np.median(ratios)) if ratios else 1.0


def _useless_px(model: pycolmap.Reconstruction) -> float:
    longest = max(max(camera.width, camera.height) for camera in model.cameras.values())
    return max(MARK_WRONG_PX, MARK_USELESS * longest)


def pixel_at(model: pycolmap.Reconstruction, seen: Sequence[TriangulatedPoint]) -> float:
    """What a pixel shows at points, the median in the model's unit; 0 without points."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    sizes = [
        float(np.linalg.norm(each.position - images[mark.image].projection_center()))
        / model.cameras[images[mark.image].camera_id].mean_focal_length()
        for each in seen
        for mark in each.agreeing
    ]
    return float(np.median(sizes)) if sizes else 0.0


def _other_marks(model: pycolmap.Reconstruction, control: GcpList) -> str:
    """How marks must be read so that most points fit, where they do not as they are; empty where no way is known."""
    sizes = {image.name: model.cameras[image.camera_id] for image in model.images.values() if image.has_pose}
    limit = _useless_px(model)

    def fitting(change: Callable[[tuple[float, float], pycolmap.Camera], tuple[float, float]]) -> int:
        count = 0
        for point in control.points:
            seen = [each for each in point.observations if each.image in sizes]
            changed = tuple(replace(each, pixel=change(each.pixel, sizes[each.image])) for each in seen)
            found = triangulate(model, replace(point, observations=changed))
            count += found is not None and found.kept_px <= limit
        return count

    as_they_are = fitting(lambda pixel, _: pixel)
    for said, change in (
        ("px and py change places", lambda pixel, _: (pixel[1], pixel[0])),
        ("py counts from the lower edge", lambda pixel, camera: (pixel[0], camera.height - pixel[1])),
        ("px counts from the right edge", lambda pixel, camera: (camera.width - pixel[0], pixel[1])),
    ):
        if fitting(change) > max(as_they_are, len(control.points) / 2):
            return said
    return ""


def _with_heights(
    places: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"], is_level: bool, level: Level
) -> Float[np.ndarray, "n 3"]:
    """Targets of which those without a height have the model's: levelled by those with heights, or else by `level`."""
    known = np.isfinite(targets[:, 2])
    if known.all():
        return targets
    if is_level:
        upright = places @ rotation_to_z(level.up).T
        heights = abs(fit_plane(in_plane(upright), in_plane(targets))[0]) * upright[:, 2]
        if known.any():
            heights += np.median(targets[known, 2] - heights[known])
        elif level.gps is not None:
            heights += np.median(level.gps.apply(places)[:, 2] - heights)
    else:
        heights = fit_to_gcps(places[known], targets[known])[0].apply(places)[:, 2]
    measured = targets if not is_level else np.full_like(targets, np.nan)  # all heights there are by one plane
    return np.column_stack([targets[:, :2], np.where(np.isfinite(measured[:, 2]), targets[:, 2], heights)])


def gcp_accuracy(placed: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"], heights: int) -> AccuracyFacts:
    """What 95 % stay below, from what a similarity to the points leaves, of which so many have measured heights.

    `placed` [n, 3] are the points as the similarity has them, `targets` [n, 3] as they were surveyed.
    """
    off, count = placed - targets, len(targets)
    free = max(1, 2 * count + heights - (7 if heights >= MIN_CONTROL_POINTS else 4))
    times = float(stdtrit(free, 0.975))
    deviation = float(np.sqrt((off**2).sum() / free))
    spread = np.linalg.svd(targets - targets.mean(axis=0), compute_uv=False)
    scale = times * deviation / float(np.sqrt((spread**2).sum()))
    across = float(np.hypot(spread[0], spread[1]))
    middle = times * deviation / np.sqrt(count)
    up, upright = middle, times * deviation
    if heights - 3 >= FREE_HEIGHTS:
        alone = float(stdtrit(heights - 3, 0.975)) * float(np.sqrt((off[:, 2] ** 2).sum() / (heights - 3)))
        up, upright = max(up, alone / np.sqrt(count)), max(upright, alone)
    edge = float(np.linalg.norm(targets - targets.mean(axis=0), axis=1).max())
    return AccuracyFacts(
        place_m=(float(np.sqrt(2) * middle), float(up)), scale_percent=100 * scale, scale_m=scale * edge,
        north_deg=float(np.degrees(times * deviation / across)),
        level_deg=float(np.degrees(upright / max(float(spread[1]), 1e-9))), positions_m=None,
    )  # fmt: skip


def no_better_than_left(accuracy: AccuracyFacts, left: Float[np.ndarray, "n 3"]) -> AccuracyFacts:
    """A place that is no better known than by what a finished model leaves of its control points (NaN: no height).

    Points that agree by chance, or were taken from a model, say nothing of their marks, which bend the model.
    """
    if not accuracy.place_m or not len(left):
        return accuracy
    counts = np.isfinite(left).sum(axis=0)
    times = stdtrit(np.maximum(1, counts - 1), 0.975) / np.sqrt(np.maximum(1, counts))
    east, north, up = times * np.sqrt(np.nansum(left**2, axis=0) / np.maximum(1, counts))
    across_and_up = (float(np.hypot(east, north)), float(up))
    return replace(accuracy, place_m=tuple(map(max, accuracy.place_m, across_and_up)))


def measure_gcps(
    model: pycolmap.Reconstruction,
    gcps: GcpList,
    origin: tuple[float, float, float],
    outliers: frozenset[str],
    knows_altitude: bool,
) -> tuple[GcpReport, ...]:
    """What a placed model makes of all points: seen minus surveyed, metres east, north, and up unless nothing says how
    high the model lies."""
    targets, located = gcps.enu(origin), triangulate_all(model, gcps)
    if not knows_altitude:
        targets[:, 2] = np.nan
    facts = []
    for k, point in enumerate(gcps.points):
        seen = located.get(k)
        used_as = "check" if point.is_check_point else "not used" if point.name in outliers or not seen else "control"
        if seen is None:
            facts.append(GcpReport(point.name, used_as, 0))
        else:
            off = tuple(float(value) for value in seen.position - targets[k] if np.isfinite(value))
            facts.append(GcpReport(point.name, used_as, seen.num_images, off, seen.error_px))
    return tuple(facts)


def triangulate_all(model: pycolmap.Reconstruction, gcps: GcpList) -> dict[int, TriangulatedPoint]:
    """The points that placed photographs show (`triangulate`), by their number in the list."""
    found = ((k, triangulate(model, point)) for k, point in enumerate(gcps.points))
    return {k: seen for k, seen in found if seen is not None}


def fit_to_gcps(
    points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"], pixel: float = 0.0
) -> tuple[Similarity, np.ndarray]:
    """The similarity from points of a model to where they were surveyed, and which of them it counts, [n] bool: those
    too that fit to a part of a `pixel`, in the unit of the model."""
    if len(points) < MIN_POINTS_FOR_OUTLIERS:
        return fit_similarity(points, targets), np.ones(len(points), bool)
    similarity, trusted = fit_similarity_robust(points, targets)
    off = np.linalg.norm(similarity.apply(points) - targets, axis=1)
    fitting = trusted | (off <= FITTING_PX * pixel * similarity.scale)
    return (similarity if (fitting == trusted).all() else fit_similarity(points[fitting], targets[fitting])), fitting
