"""The one factor for focal lengths and heights together that parallel views leave open, by all else that is known.

Stretched along the views, with focal lengths as many times as long, a model of parallel views shows the same pixels.
What photographs, tags and recorded heights each say of the factor is weighed by what it is good for. Factors are held
as natural logarithms, deviations are shares (one standard deviation). float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vdgs.captures.plane_fit import ENOUGH_TO_DOUBT, LEAST_M
from vdgs.captures.position_adjustment import DRIFT_M, PositionFit, Problem
from vdgs.captures.position_fit import fit_positions
from vdgs.sfm.capture_writer import placed_images
from vdgs.sfm.flights import FIXED_M, flights_of
from vdgs.sfm.focal_decision import ASKED, MIN_OBLIQUE_SHARE, adjust
from vdgs.sfm.focal_information import focal_deviation
from vdgs.sfm.focal_length import CALIBRATED_SOURCE, alike
from vdgs.sfm.georegistration import Georegistration, match_positions, problem_of, viewing_distance
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_metadata import EXACT_MODEL, ImageMetadata
from vdgs.sfm.preflight import OBLIQUE_ANGLE_DEG
from vdgs.sfm.take_off_heights import recorded_heights
from vdgs.sfm.up_direction import up_of
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.units import two_digits

#: What a focal length is off by as tags say it: calibrated by the maker, by two tags that agree, by one tag (choice).
CALIBRATED_SHARE, SAID_SHARE, ONE_TAG_SHARE = 0.005, 0.015, 0.02
#: Known better than this the factor is not looked into. By less than this nothing is stretched, and by less than such a
#: share of what is left open (choice).
KNOWN_SHARE, LEAST_LOG, LEAST_SHARE = 5e-4, 5e-4, 0.25
#: A receiver may be off by so many times what it is off by across, and a barometer by so many metres, between one
#: height and another; and all heights of a barometer by such a share, in air that is not the standard one (choice).
APART_ACROSS, BAROMETER_M, BAROMETER_SHARE = 4.0, 1.0, 0.02
#: Of two deviations the smaller is plainly better below this share of the larger, and counts alone: what is left of the
#: other would make good positions disagree. What is that many deviations off agrees with nothing (choice).
PLAINLY_BETTER, APART_SIGMAS = 0.5, 3.0
#: Of positions that state what they are good for up this share is as good (choice).
NEARLY_ALL = 0.9
#: Views may be so far from straight down that recorded heights tell the factor (cosine; choice).
DOWN_COSINE = 0.9
#: Heights that leave more open (share) say nothing against a drift of altitudes (choice).
TELLING = 0.1
#: Rounds in which weights settle, and the degrees of freedom of Student's t by which errors spread.
ROUNDS, TAILS = 15, 3.0
BY_ALTITUDES, BY_BAROMETER = "recorded altitudes", "recorded heights over the take-off"
BY_TAGS, BY_PHOTOGRAPHS = "tags", "the photographs"


@dataclass(frozen=True)
class Known:
    """What something says of the factor."""

    log: float
    deviation: float
    how: str

    def joined(self, other: Known) -> Known:
        """Both, each by what it is good for; one alone where it is plainly better, and where they contradict."""
        best, rest = sorted((self, other), key=lambda each: each.deviation)
        both = math.hypot(best.deviation, rest.deviation)
        if best.deviation <= PLAINLY_BETTER * rest.deviation or abs(best.log - rest.log) > APART_SIGMAS * both:
            return best
        weight = (rest.deviation / both) ** 2
        log = weight * best.log + (1 - weight) * rest.log
        return Known(log, best.deviation * rest.deviation / both, best.how)


@dataclass(frozen=True)
class Stretch:
    """What is known of the factor, and of what it was applied."""

    axis: np.ndarray
    """The mean view, unit [3], in the model's world."""
    log: float
    """What the model is to be stretched by."""
    deviation: float
    """What is left open after that."""
    how: str
    """By what it is known best."""

    @property
    def told_by(self) -> str:
        """What the focal length was changed by, in words; empty where it was not."""
        return self.how if self.log else ""


def find_stretch(
    model: pycolmap.Reconstruction, photographs: Sequence[ImageMetadata], positions: GpsPriors, held: tuple[bool, str],
    stated: bool = False,
) -> Stretch | None:  # fmt: skip
    """The factor of a model, whose errors of points are computed; None where it is not open: the photographs look
    several ways, or nothing is known of it at all. `held`: whether its focal length was, and why; one that was asked
    for is not changed. `stated`: as for `georegister`."""
    images = placed_images(model)
    views = np.array([image.cam_from_world().rotation.matrix()[2] for image in images])
    axis = views.mean(axis=0) / max(float(np.linalg.norm(views.mean(axis=0))), 1e-12)
    is_oblique = np.mean(views @ axis < math.cos(math.radians(OBLIQUE_ANGLE_DEG))) >= MIN_OBLIQUE_SHARE
    if is_oblique or _are_bound(model):
        return None
    said = _said(model, photographs)
    if held[0]:  # for something says it
        before: Known | None = said or Known(0.0, ONE_TAG_SHARE, BY_TAGS)
    else:
        before = _joined(
            [each for each in (Known(0.0, focal_deviation(model), BY_PHOTOGRAPHS), said) if each is not None]
        )
    if before is not None and before.deviation <= KNOWN_SHARE:
        return None
    flown = _Flown.of(model, photographs, positions, axis, stated)
    heights = None if flown is None else _by_heights(flown)
    found = _joined([each for each in (before, heights) if each is not None])
    if found is None:
        return None
    if before is not None and heights is not None and flown is not None:
        found = _likelier(found, before, heights, flown)
    if held[1] == ASKED:  # what speaks against it is its error
        return Stretch(axis, 0.0, math.hypot(found.deviation, found.log), found.how)
    is_much = abs(found.log) > max(LEAST_LOG, LEAST_SHARE * found.deviation)
    return Stretch(axis, found.log if is_much else 0.0, found.deviation, found.how)


def stretched(model: pycolmap.Reconstruction, stretch: Stretch, threads: int) -> pycolmap.Reconstruction:
    """A model with focal lengths and depths along the axis as many times as large, adjusted with the focal lengths
    held: views are not quite parallel. Computes the errors of points."""
    found, factor = pycolmap.Reconstruction(model), math.exp(stretch.log)
    deeper = np.eye(3) + (factor - 1) * np.outer(stretch.axis, stretch.axis)
    for image in placed_images(found):
        turned = image.cam_from_world().rotation.matrix()
        pose = pycolmap.Rigid3d(np.column_stack([turned, -turned @ deeper @ image.projection_center()]))
        found.frames[image.frame_id].rig_from_world = pose
    for point in found.points3D.values():
        point.xyz = deeper @ point.xyz
    for camera in found.cameras.values():
        camera.params = _stretched_lens(camera, factor)
    adjust(found, threads, hold_focal=True)
    return found


def with_stretch(placed: Georegistration, stretch: Stretch | None, model: pycolmap.Reconstruction) -> Georegistration:
    """The same with the accuracy that places have along the views where the factor is open, and notes of it. `model`:
    as it was placed, before it is moved."""
    if stretch is None or placed.accuracy is None:
        return placed
    notes, accuracy = list(placed.notes), placed.accuracy
    if stretch.log:
        notes.append(
            f"the views are too parallel to tell the focal length: by {stretch.told_by} it is "
            f"{math.expm1(stretch.log):+.2%} from what it was, and so are heights."
        )
    away = 2 * stretch.deviation * placed.similarity.scale * viewing_distance(placed_images(model), model)
    place, view = accuracy.place_m, placed.similarity.rotation @ stretch.axis
    along = float(np.linalg.norm(view[:2])) * away, abs(float(view[2])) * away
    if place and math.isfinite(away):
        looks_down = bool(abs(view[2]) >= DOWN_COSINE)
        if along[looks_down] > (*place, math.inf)[looks_down]:
            what, where = ("the ground", "higher or lower") if looks_down else ("what they show", "nearer or farther")
            notes.append(
                "the views are too parallel, or all of one height, to tell the focal length, known to "
                f"±{200 * stretch.deviation:.2g} % by {stretch.how}: {what} may lie "
                f"{two_digits(away)} m {where} (95 %). Oblique views or control points tell it."
            )
        accuracy = replace(accuracy, place_m=tuple(map(math.hypot, place, along)))
    return replace(placed, accuracy=accuracy, notes=tuple(notes))


def _stretched_lens(camera: pycolmap.Camera, factor: float) -> np.ndarray:
    """The parameters of a lens that shows a stretched scene as it showed it before."""
    powers = {"f": 1, "fx": 1, "fy": 1, "k": 2, "k1": 2, "k2": 4, "p1": 1, "p2": 1}
    names = [name.strip() for name in camera.params_info.split(",")]
    return np.array([value * factor ** powers.get(name, 0) for name, value in zip(names, camera.params, strict=True)])


def _are_bound(model: pycolmap.Reconstruction) -> bool:
    """Whether other things than parallel views bind focal lengths: rigs, lenses that are no perspective ones."""
    lenses = {model.cameras[image.camera_id].model_name for image in placed_images(model)}
    return any(rig.num_sensors() > 1 for rig in model.rigs.values()) or any(
        name == EXACT_MODEL or "FISHEYE" in name for name in lenses
    )


def _said(model: pycolmap.Reconstruction, photographs: Sequence[ImageMetadata]) -> Known | None:
    """What tags say: in the median, as the least certain of them. None where they say it of less than half of the
    photographs, and where it is another lens than the fitted one."""
    lenses = {photo.name: (photo.lens, max(photo.size)) for photo in photographs if photo.lens}
    logs, shares, count = list[float](), list[float](), 0
    for image in placed_images(model):
        count += 1
        lens, side = lenses.get(image.name, (None, 0))
        if lens is None or lens.doubt:
            continue
        fitted = float(model.cameras[image.camera_id].mean_focal_length())
        logs.append(math.log(lens.focal * side / fitted))
        is_calibrated = lens.source == CALIBRATED_SOURCE
        shares.append(CALIBRATED_SHARE if is_calibrated else SAID_SHARE if lens.confirmed else ONE_TAG_SHARE)
    if 2 * len(logs) < count:
        return None
    log = float(np.median(logs))
    return Known(log, max(shares), BY_TAGS) if alike(math.exp(log), 1.0) else None


@dataclass(frozen=True, eq=False)
class _Flown:
    """Positions of a model whose views look down, and what they say in the plane."""

    problem: Problem
    plane: PositionFit
    axis: np.ndarray
    taken: Sequence[ImageMetadata]
    up_std: np.ndarray
    """What altitudes are said to be good for [m], metres."""
    lenses: np.ndarray
    """Numbers of the lenses that they were taken through [m]."""

    @classmethod
    def of(
        cls, model: pycolmap.Reconstruction, photographs: Sequence[ImageMetadata], positions: GpsPriors,
        axis: np.ndarray, stated: bool,
    ) -> _Flown | None:  # fmt: skip
        """None where positions are few, and where views look elsewhere: heights tell nothing of how far walls are."""
        images = {image.name: image for image in placed_images(model)}
        rows, centers, _ = match_positions(images, photographs, positions)
        if not positions.usable or len(rows) < ENOUGH_TO_DOUBT:
            return None
        taken = [photographs[int(positions.image_indices[row])] for row in rows]
        up, _ = up_of(model, photographs)
        problem = problem_of(taken, rows, centers, up, positions, stated=stated)
        plane = fit_positions(replace(problem, has_altitudes=False))
        looks_down = up.sure and (plane.similarity.rotation @ axis)[2] <= -DOWN_COSINE
        lenses = np.array([images[photo.name].camera_id for photo in taken])
        return cls(problem, plane, axis, taken, positions.gps_std[rows, 2], lenses) if looks_down else None

    def fit(self, log: float) -> PositionFit:
        """To positions, were the model stretched by that."""
        deeper = np.eye(3) + math.expm1(log) * np.outer(self.axis, self.axis)
        return fit_positions(replace(self.problem, centers=self.problem.centers @ deeper))


def _by_heights(flown: _Flown) -> Known | None:
    """What recorded altitudes, and heights over the take-off, say of the factor: by how many times more they differ
    than heights by the photographs, where positions in the plane tell the scale. Heights are compared through one lens:
    those through another are as far off as the proportion of the two."""
    inside, heights = flown.plane.inliers, flown.plane.placed[:, 2]
    places, tilt = flown.plane.placed[inside], math.tan(math.radians(flown.problem.up.deviation_deg))
    flights, found = _parted(flights_of(flown.taken), flown.lenses), list[Known]()
    if flown.problem.has_altitudes:
        of_flight = flown.lenses if (flown.up_std <= FIXED_M).all() else flights
        stated = flown.problem.stated
        said = 0.0 if stated is None else float(np.quantile(stated[:, 2], NEARLY_ALL))  # one height may be worse
        apart = min(DRIFT_M, max(said, APART_ACROSS * float(flown.plane.gps_std[:2].mean())))
        off = flown.problem.targets[:, 2] - heights
        found.append(factor_of_heights(places, off[inside], of_flight[inside], tilt, apart))
    relative = recorded_heights(flown.taken)
    recorded = np.isfinite(relative)
    if 2 * recorded.sum() >= len(recorded) and np.ptp(relative[recorded]):
        which = inside & recorded
        known = factor_of_heights(
            flown.plane.placed[which], (relative - heights)[which], flights[which], tilt, BAROMETER_M
        )
        found.append(Known(known.log, math.hypot(known.deviation, BAROMETER_SHARE), BY_BAROMETER))
    return _joined(found)


def _parted(flights: np.ndarray, lenses: np.ndarray) -> np.ndarray:
    """Numbers [n] of flights that were also flown with one lens each."""
    return np.unique(np.column_stack([flights, lenses]), axis=0, return_inverse=True)[1].ravel()


def _likelier(found: Known, before: Known, heights: Known, flown: _Flown) -> Known:
    """What is found, or the factor of heights alone where altitudes would drift or be of no use by the former, are not
    by the latter, and that is likelier. What is left open is no less for that."""
    if heights.how != BY_ALTITUDES or heights.deviation > TELLING or found.log == heights.log:
        return found
    fits = {log: flown.fit(log) for log in (found.log, heights.log)}
    costs = {log: fit.score + 0.5 * ((log - before.log) / before.deviation) ** 2 for log, fit in fits.items()}
    is_needed = fits[found.log].altitude != "used" and fits[heights.log].altitude == "used"
    if not is_needed or costs[heights.log] >= costs[found.log]:
        return found
    return Known(heights.log, math.hypot(found.deviation, (heights.log - found.log) / 2), BY_ALTITUDES)


def _joined(known: Sequence[Known]) -> Known | None:
    """At most two things that are known, joined; None of none. What is infinitely uncertain says nothing."""
    known = [each for each in known if math.isfinite(each.deviation)]
    return known[0].joined(known[1]) if len(known) == 2 else known[0] if known else None


def factor_of_heights(places: np.ndarray, off: np.ndarray, flights: np.ndarray, tilt: float, apart_m: float) -> Known:
    """By how many times more recorded heights differ than those of places [n, 3], which they exceed by `off` [n]. Each
    flight may count from another zero, level may be off by `tilt` (tangent), and heights of one level against those
    of another by `apart_m`. An infinite deviation where they do not tell it."""
    none = Known(0.0, math.inf, BY_ALTITUDES)
    zeros = flights[:, None] == np.unique(flights)
    level = places[:, :2] - places[:, :2].mean(axis=0)
    height = places[:, 2] - places[:, 2].mean()
    rows = np.column_stack([zeros, level, height])
    if len(rows) <= rows.shape[1]:
        return none
    prior = np.zeros((rows.shape[1], rows.shape[1]))
    prior[-3, -3] = prior[-2, -2] = 1 / tilt**2
    prior[-1, -1] = 1.0  # by a factor of e at most: holds what nothing tells
    weights, sigma = np.ones(len(rows)), max(LEAST_M, float(np.std(off)))
    for _ in range(ROUNDS):
        normal = (rows.T * (weights / sigma**2)) @ rows + prior
        gains = np.linalg.solve(normal, rows.T * (weights / sigma**2))
        left = off - rows @ (gains @ off)
        free = max(1, len(rows) - rows.shape[1])
        sigma = max(LEAST_M, float(np.sqrt((weights * left**2).sum() / free)))
        weights = (TAILS + 1) / (TAILS + (left / sigma) ** 2)
    slope, gain = float(gains[-1] @ off), gains[-1]
    if slope <= -0.5 or math.sqrt(np.linalg.inv(normal)[-1, -1]) >= PLAINLY_BETTER:
        return none
    # The gains sum up to 0, as one zero is fitted: those above it take half of what two levels differ by.
    deviation = math.hypot(sigma * float(np.linalg.norm(gain)), apart_m * float(np.abs(gain).sum()) / 2)
    return Known(math.log1p(slope), deviation / (1 + slope), BY_ALTITUDES)
