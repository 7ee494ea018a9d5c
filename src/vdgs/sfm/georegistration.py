"""A model brought to metres, east, north and up by positions, and how good that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vdgs.captures.gps_altitudes import refuse_unit, wrong_reading, wrong_unit
from vdgs.captures.plane_fit import mirrored
from vdgs.captures.position_adjustment import DRIFT_COSTS, STATED_TIMES, PositionFit, Problem, Up
from vdgs.captures.position_fit import OTHER_COSINE, fit_positions, with_likelier_up
from vdgs.captures.position_lines import are_along_a_line, checked_on_a_line
from vdgs.captures.position_weights import are_told, relative_deviations, weighing_note, with_unstated
from vdgs.captures.reconstruction import AccuracyFacts
from vdgs.captures.turned_views import are_turned_over
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu, median_place
from vdgs.geometry.similarity import Similarity
from vdgs.sfm.barometer_fit import fit_by_barometer
from vdgs.sfm.flights import FIXED_M, AltitudeOffsets, altitude_offsets, time_order, untrusted_offsets
from vdgs.sfm.gps_priors import MIN_POSITIONS, GpsPriors
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.recorded_headings import checked_by_headings
from vdgs.sfm.take_off_heights import recorded_heights
from vdgs.sfm.up_direction import camera_rotation, up_of
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.units import two_digits

#: So many positions far from where the photographs put them are worth a note, each by more than the cameras see; that
#: distance is found of about so many photographs.
MIN_ELSEWHERE, VIEWS_LOOKED_AT = 3, 20
ADVICE_WRITE_GPS = (
    "let the drone write GPS into the photographs, or give a table of positions (--gps), surveyed points (--gcp) or a "
    "known distance (--scale-bar) now: the finished capture is placed anew in seconds."
)
ADVICE_BETTER_POSITIONS = (
    "give a known distance (--scale-bar), surveyed points (--gcp) or a table of better positions (--gps) now: the "
    "finished capture is placed anew in seconds. --georeference anyway uses the positions as they are, off leaves "
    "them out; next time take photographs over many times more than positions are wrong by."
)
ADVICE_UP = "surveyed points (--gcp), altitudes or recorded attitudes tell it."
ANYWAY = "Mend them, or say --georeference off (without them) or anyway (as they are)."


@dataclass(frozen=True, eq=False, kw_only=True)
class Georegistration:
    """How a model was brought to metres, and to its place on Earth where that is known."""

    similarity: Similarity
    """From the model's own world to metres east, north, up of the positions' origin."""
    method: str
    position_rows: np.ndarray
    """Which positions have a placed photograph, [m] rows of `GpsPriors`."""
    targets: np.ndarray
    """Those positions as they are used [m, 3], where altitudes are corrected."""
    residuals: np.ndarray
    """Of them, placed minus recorded, metres [m, 3]; [m, 2] where no altitudes are recorded."""
    inliers: np.ndarray
    """Which of them the placing trusts, [m] bool."""
    deviations: np.ndarray | None = None
    """What each of them was found to be good for [m, 3], metres; None where that was not found."""
    accuracy: AccuracyFacts | None = None
    notes: tuple[str, ...] = ()
    is_georeferenced: bool = True
    """Whether east, north and the origin are known; metres and up alone where not."""


@dataclass(frozen=True)
class AlignmentFailure:
    """Why a model was not brought to metres, and what to do about it."""

    reason: str
    remedy: str
    up: str = ""
    """By what its z is up all the same; empty where nothing tells."""


def georegister(
    model: pycolmap.Reconstruction, images_metadata: Sequence[ImageMetadata], positions: GpsPriors,
    scale: tuple[float, float] | None = None, anyway: bool = False, stated: bool = False,
) -> Georegistration | AlignmentFailure:  # fmt: skip
    """The similarity that brings the model to its positions, or why they do not tell one: they are too few, or wrong by
    too much of how far they spread. `scale` is the factor to metres where it is known otherwise, and its standard
    deviation as a share; `stated` whether the deviations of the positions are more than a default. Does not change the
    model.

    Raises CaptureError, unless `anyway`, for positions that fit only once they are mirrored or exchanged.
    """
    images = {image.name: image for image in model.images.values() if image.has_pose}
    rows, centers, targets = match_positions(images, images_metadata, positions)
    if not positions.usable or len(rows) < MIN_POSITIONS:
        few = f"{len(rows)} positions of placed photographs are too few, {MIN_POSITIONS} are needed"
        return AlignmentFailure(few if len(positions) else "no positions that can be used", ADVICE_WRITE_GPS)
    up, notes = up_of(model, images_metadata)
    taken = [images_metadata[int(positions.image_indices[row])] for row in rows]
    problem = problem_of(taken, rows, centers, up, positions, scale, stated)
    problem, in_doubt = with_likelier_up(problem)
    far = viewing_distance(list(images.values()), model)
    levelled, offsets = _without_offsets(problem, positions, rows, far)
    fit, barometer, over_ground = _best_fit(levelled, taken)
    wrong = _mirrored(fit, replace(problem, up=up), images, positions)
    if wrong and not anyway:
        raise CaptureError(
            f"the positions ({positions.source}) fit the photographs only once {wrong}: as they are, the world would "
            "be its own mirror image, or upside down. Are latitude and longitude exchanged, or is a hemisphere (S, W, "
            f"a minus sign) missing?{up.doubt} {ANYWAY}"
        )
    if over_ground:
        positions = replace(positions, has_altitudes=False)
    elsewhere = _elsewhere(fit, far)
    if offsets is None and fit.altitude == "used" and len(positions.flights) == len(positions):
        offsets = untrusted_offsets(-fit.residuals[:, 2], fit.inliers | elsewhere, positions.flights[rows])
    fit = replace(fit, place_error_m=_place_error(fit, offsets, positions, rows))
    if positions.table is not None and positions.has_altitudes and not anyway:
        refuse_unit(_unit(fit, problem, positions), "the cameras", positions.table)
    fit, of_reading = _checked_reading(fit, problem, positions)
    on_a_line = are_along_a_line(*(each[fit.inliers] for each in (targets, positions.gps_std[rows], fit.deviations)))
    fit, of_line = checked_on_a_line(fit, problem) if on_a_line and not barometer else (fit, [])
    fit, of_north = checked_by_headings(fit, images, taken, problem.times)
    refused = fit.why_refused(positions.source)
    if refused and not anyway:
        return AlignmentFailure(refused, ADVICE_BETTER_POSITIONS)
    notes += _of_doubts(in_doubt, refused, wrong)
    notes += _of_elsewhere(fit, elsewhere, fit.similarity.scale * far)
    notes += _of_offsets(offsets, fit) if offsets is not None else []
    notes += [_over_ground(fit)] if over_ground else _of_altitudes(fit, barometer)
    notes += of_reading + of_line + of_north + list(filter(None, [weighing_note(fit.deviations, fit.inliers)]))
    accuracy = accuracy_of(fit, positions, offsets, in_doubt)
    return Georegistration(
        similarity=fit.similarity,
        method=_method(fit, barometer, on_a_line, positions.source, problem.up.how),
        position_rows=rows,
        targets=fit.placed - fit.residuals,
        residuals=_recorded(fit.placed - levelled.targets, positions),
        inliers=fit.inliers,
        deviations=fit.deviations,
        accuracy=accuracy,
        notes=tuple(notes),
    )


def problem_of(
    taken: Sequence[ImageMetadata], rows: np.ndarray, centers: np.ndarray, up: Up, positions: GpsPriors,
    scale: tuple[float, float] | None = None, stated: bool = False,
) -> Problem:  # fmt: skip
    """What is to be solved for photographs at centers [m, 3] that have the positions in `rows` [m]."""
    deviations, are_known = _deviations(positions, rows, stated)
    return Problem(
        centers=centers,
        targets=positions.enu[rows],
        times=_moments(taken),
        flights=positions.flights[rows] if len(positions.flights) == len(positions) else None,
        up=up,
        scale=scale,
        stated=deviations if are_known else None,
        relative=relative_deviations(deviations),
        has_altitudes=positions.has_altitudes,
    )


def _of_doubts(in_doubt: str, refused: str, wrong: str) -> list[str]:
    """What up is in doubt of, and what of the positions would be refused had they not been asked for."""
    notes = [f"{in_doubt}. If that is wrong, up is off by a right angle: {ADVICE_UP}"] if in_doubt else []
    notes += [f"{refused}; used all the same, as asked for."] if refused else []
    return notes + ([f"the positions fit only once {wrong}; used all the same, as asked for."] if wrong else [])


def _deviations(positions: GpsPriors, rows: np.ndarray, stated: bool) -> tuple[np.ndarray, bool]:
    """What each of the positions in `rows` [m] is said to be good for [m, 3], and whether enough of them say so."""
    said = positions.are_stated[rows] if len(positions.are_stated) and not stated else np.full(len(rows), stated)
    deviations = with_unstated(positions.gps_std[rows], said)
    return deviations, are_told(deviations, said)


def _mirrored(fit: PositionFit, problem: Problem, images: Mapping[str, pycolmap.Image], positions: GpsPriors) -> str:
    """Which other reading of the positions alone fits the photographs (`plane_fit.mirrored`); "" where they fit. Up
    that is not sure counts where views that look one way lie on their side by the positions."""
    views = np.array([camera_rotation(image) for image in images.values()]) @ fit.similarity.rotation.T
    is_doubted = problem.up.other is not None and fit.similarity.rotation[2] @ problem.up.direction < OTHER_COSINE
    if not (problem.up.sure or is_doubted or are_turned_over(views)):
        return ""
    readings = _other_readings(problem.targets, positions.origin)
    return mirrored(problem.centers, problem.targets, problem.up.direction, readings)


def _method(fit: PositionFit, barometer: bool, on_a_line: bool, source: str, up: str) -> str:
    """How a model was placed, in words."""
    line = " along one line" if on_a_line else ""
    how = f"positions of {int(fit.inliers.sum())} photographs{line} ({source})"
    how += f"; up by {up}" if line or fit.altitude != "used" else ""
    return how + ("; heights by the barometer" if barometer else "")


def _recorded(values: np.ndarray, positions: GpsPriors) -> np.ndarray:
    """Of values [n, 3] those along axes that the positions record: without up where no position has an altitude."""
    return values if positions.has_altitudes else values[..., :2]


def accuracy_of(
    fit: PositionFit, positions: GpsPriors, offsets: AltitudeOffsets | None = None, in_doubt: str = ""
) -> AccuracyFacts:
    """The accuracy of a fit, for people; the edge of the flight is where photographs are, not stray positions. Where up
    is `in_doubt` it may be off by a right angle."""
    place = fit.place_error_m if positions.has_altitudes else fit.place_error_m[:1]
    away = np.linalg.norm(fit.placed[:, :2] - fit.placed[:, :2].mean(axis=0), axis=1)
    return AccuracyFacts(
        place_m=place, scale_percent=100 * fit.scale_error, scale_m=float(fit.scale_error * away.max()),
        north_deg=min(180.0, fit.north_error_deg),
        level_deg=min(180.0, max(fit.level_error_deg, 90.0 if in_doubt else 0.0)),
        positions_m=tuple(_recorded(fit.gps_std, positions).tolist()),
        altitude=fit.altitude if positions.has_altitudes else "none", altitude_drift_m=fit.drift_m,
        altitude_offsets_m=tuple(offsets.different) if offsets is not None else (),
    )  # fmt: skip


def viewing_distance(images: Sequence[pycolmap.Image], model: pycolmap.Reconstruction) -> float:
    """How far from the cameras lies what they see, in the model's unit: the median of some photographs."""
    depths = []
    for image in images[:: max(1, len(images) // VIEWS_LOOKED_AT)]:
        seen = [model.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
        if seen:
            depths.append(float(np.median(np.linalg.norm(np.array(seen) - image.projection_center(), axis=1))))
    return float(np.median(depths)) if depths else float("inf")


def _elsewhere(fit: PositionFit, far: float) -> np.ndarray:
    """Which positions lie farther across from where the photographs put them than the cameras see, [n] bool: if the
    positions are right, the photographs show another place."""
    return ~fit.inliers & (np.linalg.norm(fit.residuals[:, :2], axis=1) > fit.similarity.scale * far)


def _of_elsewhere(fit: PositionFit, elsewhere: np.ndarray, far_m: float) -> list[str]:
    if elsewhere.sum() < MIN_ELSEWHERE:
        return []
    off = float(np.median(np.linalg.norm(fit.residuals[elsewhere, :2], axis=1)))
    return [
        f"{elsewhere.sum()} of {len(elsewhere)} positions lie about {two_digits(off)} m from where the photographs put "
        f"them, {two_digits(off / far_m)} times as far as the cameras see; these positions are not used. Either they "
        "are wrong, or places that look alike were taken for one and the scene is wrong there: look at "
        "reconstruction.png, and reconstruct such flights one by one."
    ]


def _without_offsets(
    problem: Problem, positions: GpsPriors, rows: np.ndarray, far: float = float("inf")
) -> tuple[Problem, AltitudeOffsets | None]:
    """The problem with all altitudes from one datum, and what was left out, where flights differ and one datum explains
    the photographs better. Places in the plane alone tell it, but none that is farther from its position than cameras
    see (`far`, in the model's unit)."""
    if not problem.has_altitudes or len(positions.flights) != len(positions) or not np.ptp(positions.flights[rows]):
        return problem, None
    plane = fit_positions(replace(problem, has_altitudes=False))
    none = -1 - np.arange(len(rows))  # a flight of its own
    flights, up = np.where(_elsewhere(plane, far), none, positions.flights[rows]), positions.gps_std[rows, 2]
    offsets = altitude_offsets(plane.placed, problem.targets, flights, problem.up.deviation_deg, up)
    if offsets is None or np.abs(offsets.different).max() <= positions.altitude_step_m:
        return problem, None
    levelled = replace(problem, targets=problem.targets - offsets.by_position[:, None] * [0, 0, 1])
    costs = DRIFT_COSTS * len(offsets.different) * (1 if problem.stated is None else STATED_TIMES)
    better = fit_positions(levelled).score + costs < fit_positions(problem).score
    return (levelled, offsets) if better else (problem, None)


def _place_error(
    fit: PositionFit, offsets: AltitudeOffsets | None, positions: GpsPriors, rows: np.ndarray
) -> tuple[float, float]:
    """Place across and up: positions move it by the error of their datums as far as they are used, and all altitudes
    may be rounded the same way. Of two flights nothing says whose altitudes are right, unless one alone states the
    accuracy of RTK."""
    datums = positions.datum_errors_m[rows][fit.inliers] if len(positions.datum_errors_m) else np.zeros(1)
    across, up = np.hypot(fit.place_error_m, (datums.mean(), positions.altitude_step_m)).tolist()
    if offsets is None:
        return across, up
    up_std = positions.gps_std[rows, 2]
    here, others = (np.median(up_std[which]) for which in (offsets.reference, ~offsets.reference))
    if here <= FIXED_M < others:
        return across, up
    return across, float(np.hypot(up, np.abs(offsets.different).max()))


def _of_offsets(offsets: AltitudeOffsets, fit: PositionFit) -> list[str]:
    over = ", ".join(
        f"{two_digits(off, '+')} m ({int((offsets.by_position == off).sum())} photographs)" for off in offsets.different
    )
    up, others = fit.place_error_m[1], int(offsets.reference.sum())
    fixed = up < min(map(abs, offsets.different))  # by RTK alone (`_place_error`)
    good = (
        f"±{two_digits(up)} m above their own zero, be it the ellipsoid (RTK) or the sea"
        if fixed
        else f"±{two_digits(up)} m"
    )
    is_explained = fit.inliers[offsets.by_position != 0].any()
    or_focal = "" if is_explained else ", or, flown at another height, by a focal length that is off"
    return [
        f"the altitudes of flights differ by their datum (sea level, ellipsoid, take-off?){or_focal}: {over} over "
        f"those of the other {others}. That is left out; heights above the sea are those of the latter, good to {good}."
        " A table of positions (--gps) with one datum mends it."
    ]


def _best_fit(problem: Problem, taken: Sequence[ImageMetadata]) -> tuple[PositionFit, bool, bool]:
    """The fit; whether its heights are the barometer's: over the take-off, where altitudes drift against them; and
    whether what is recorded as altitudes are heights over the ground, and counts as none."""
    fit = fit_positions(problem)
    over_ground = problem.has_altitudes and fit.altitude == "none"
    problem = replace(problem, has_altitudes=problem.has_altitudes and not over_ground)
    steady = None if fit.altitude == "used" else fit_by_barometer(problem, fit, recorded_heights(taken))
    return (fit, False, over_ground) if steady is None else (steady, True, over_ground)


def _unit(fit: PositionFit, problem: Problem, positions: GpsPriors) -> str:
    """The unit of altitudes that are taken for another, as the photographs tell; empty where they do not."""
    altitudes = problem.targets[:, 2] + positions.origin[2]
    return wrong_unit(altitudes, fit.placed[:, 2], fit.placed[:, :2])


def _checked_reading(fit: PositionFit, problem: Problem, positions: GpsPriors) -> tuple[PositionFit, list[str]]:
    """The fit with altitudes as uncertain as they are where they differ as those in feet or of the wrong sign do from
    heights by the photographs, and a note."""
    if not positions.has_altitudes:
        return fit, []
    altitudes = problem.targets[:, 2] + positions.origin[2]
    what, off = wrong_reading(altitudes, fit.placed[:, 2], fit.placed[:, :2])
    if not what:
        return fit, []
    across, up = fit.place_error_m
    note = (
        f"the altitudes ({positions.source}) differ between the photographs as altitudes do that are {what}: heights "
        f"above the sea may be off by {two_digits(off)} m. "
        + ("A table of positions (--gps) mends it." if positions.source == "EXIF" else "Mend the table.")
    )
    return replace(fit, place_error_m=(across, up + off)), [note]


def _over_ground(fit: PositionFit) -> str:
    return (
        "the recorded altitudes are nearly one for all photographs, which themselves show a flight that rises and "
        f"falls by {two_digits(float(np.ptp(fit.placed[:, 2])))} m as along a slope: heights over the ground? They are "
        "not used, and heights above the sea are not known."
    )


def _of_altitudes(fit: PositionFit, barometer: bool) -> list[str]:
    good = f"heights above the sea are only good to ±{two_digits(fit.place_error_m[1])} m."
    if barometer:
        return [f"altitudes drift against the heights over the take-off, which are used in their place: {good}"]
    if fit.altitude == "drifts":
        drift = two_digits(fit.drift_m, "+")
        return [
            f"the recorded altitudes drift by {drift} m from the first photograph to the last: that is left out, and "
            f"{good}"
        ]
    if fit.altitude == "unused":
        return [
            f"the recorded altitudes are off by {two_digits(fit.gps_std[2])} m from photograph to photograph: scale, "
            f"north and up are found without them; {good}"
        ]
    return []


def _other_readings(targets: np.ndarray, origin: tuple[float, float, float]) -> dict[str, np.ndarray]:
    """Positions as they would lie if they were written otherwise than they should be."""
    geodetic = geodetic_from_enu(targets, origin)
    exchanged = geodetic[:, [1, 0, 2]]
    found = {"they are mirrored": targets * np.array([-1.0, 1.0, 1.0])}
    if np.abs(exchanged[:, 0]).max() < 90:
        found["latitude and longitude change places"] = enu_from_geodetic(exchanged, median_place(exchanged))
    return found


def _moments(taken: Sequence[ImageMetadata]) -> np.ndarray:
    """The order in which photographs were taken, from 0 to 1 [n]."""
    moments = np.empty(len(taken))
    moments[time_order(taken)] = np.linspace(0, 1, len(taken))
    return moments


def registration_in_place(
    model: pycolmap.Reconstruction,
    photographs: Sequence[ImageMetadata],
    positions: GpsPriors,
    method: str,
    accuracy: AccuracyFacts | None = None,
    notes: tuple[str, ...] = (),
) -> Georegistration:
    """A model that was brought to its place by other things than positions, and how far those are from it."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    rows, centers, targets = match_positions(images, photographs, positions)
    stays = Similarity(1.0, np.eye(3), np.zeros(3))
    return Georegistration(
        similarity=stays,
        method=method,
        position_rows=rows,
        targets=targets,
        residuals=_recorded(centers - targets, positions),
        inliers=np.ones(len(rows), bool),
        accuracy=accuracy,
        notes=notes,
    )


def transform_model(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Bring a model into another world, in place."""
    rotation = pycolmap.Rotation3d(np.ascontiguousarray(similarity.rotation))
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))


def match_positions(
    images: Mapping[str, pycolmap.Image], photographs: Sequence[ImageMetadata], positions: GpsPriors
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [m] of the positions whose photographs are placed, where those were placed [m, 3], and the positions."""
    rows = np.array([row for row, i in enumerate(positions.image_indices) if photographs[int(i)].name in images], int)
    names = [photographs[int(positions.image_indices[row])].name for row in rows]
    centers = np.array([images[name].projection_center() for name in names]).reshape(-1, 3)
    return rows, centers, positions.enu[rows]
