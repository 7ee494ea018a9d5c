"""Whether a focal length is held at what photographs say of it, or fitted: before there is a model, and by it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vdgs.captures.odd_positions import places_apart
from vdgs.captures.position_lines import is_nearly_collinear
from vdgs.config.sfm_options import SfmOptions
from vdgs.geometry.geodesy import SEMI_MAJOR_M
from vdgs.sfm.capture_writer import is_impossible, placed_images
from vdgs.sfm.feature_extraction import CameraGroup
from vdgs.sfm.flights import flights_of
from vdgs.sfm.focal_information import focal_deviation
from vdgs.sfm.focal_length import AGREE, CALIBRATED_SOURCE, alike
from vdgs.sfm.gps_priors import MIN_POSITIONS, GpsPriors
from vdgs.sfm.image_metadata import FISHEYE, ImageMetadata
from vdgs.sfm.incremental_mapper import height_over_points
from vdgs.sfm.preflight import OBLIQUE_ANGLE_DEG
from vdgs.sfm.reprojection import mean_reprojection_error
from vdgs.sfm.workspace import call_cancellable
from vdgs.system.lazy_pycolmap import pycolmap

#: So many oblique views let a flight tell the focal length. Heights that differ by so much of the flying height are
#: several (choice).
MIN_OBLIQUE_SHARE, MIN_HEIGHT_SPREAD = 0.15, 0.2
#: Fewer oblique views than this may be an accident, as at take-off (choice).
LEAST_OBLIQUE = 3
#: So many positions and more tell the slope that a flight follows (choice).
MIN_FOR_SLOPE = 8
#: Steeper than this (tangent) no flight follows the ground (choice).
STEEPEST = 2.0
#: Why a focal length is held until the model shows whether it can be fitted: `release_focal`.
OF_FLIGHTS = "each flight is level within the errors of altitudes; the model will show whether flights differ in height"
OF_SLOPE = "one height over a slope, or a climb over level ground; the model will show which"
OF_LINE = "along one line, which cannot tell it while views are parallel; the model will show whether they are"
OF_HEIGHTS = "several heights, straight down as recorded, which parallel views cannot tell from another focal length"
OF_ONE_HEIGHT = "one height, straight down as far as known: the flight cannot tell it"
OF_STRIPS = "level strips over an area: the flight cannot tell it, if it looked straight down"
#: Why it is fitted or stays held then.
OF_SHAPE = "views of several directions, as the photographs themselves show, which tell it"
OF_LENSES = "several lenses, whose proportion the photographs tell, not how long all of them are"
OF_PARALLEL = "several heights, but views so parallel that the photographs cannot tell it"
#: Why a focal length is held or fitted: a person says so; it was held until `is_contradicted`; or fitted, `is_astray`.
ASKED = "asked for"
TAGS_DISAGREE = "what the photographs say of it contradicts itself"
CONTRADICTED = "one tag alone says it, and the photographs tell it better"
CONFIRMED = "tags that agree say it, and the photographs cannot tell it: fitted, it went astray"
#: A fitted focal length contradicts the held one where points lie nearer to where they are seen by this share (choice),
#: and the two are no one value as tags go (`AGREE`). Over ground that does not tell it neither is so.
CLEARLY_NEARER = 0.05
#: So does one that is off by so much less where they lie nearer by so much, if it is off by so many of the standard
#: deviations that photographs leave of it (choices).
PLAINLY_NEARER, FAR_OFF, SIGMAS_OFF = 0.1, 0.05, 5.0
#: Rays that meet under less than this (degrees) are about parallel; without their points, if so many stay, a focal
#: length that is fitted well is the same within so much (shares; choices).
FLAT_DEG, DEEP_SHARE, ONE_FIT = 5.0, 0.3, 0.02
#: Between these quantiles (5 % and 95 %) lie so many standard deviations of errors.
ERRORS_RANGE = 3.29
#: Of a way around something no tenth of the positions is nearer to the middle than this share of how far all are (RMS,
#: both axes alike); of strips over an area it is (choice).
ORBIT_RADIUS_SHARE = 0.8
#: Positions along one line spread across it by no more than this share of how far they spread along it (choice).
LINE_SHARE = 0.05
#: Of several heights photographs tell the focal length where they leave less open than this (one standard deviation, as
#: a share): half of what EXIF's is off by as a rule (`view_stretch.SAID_SHARE`; choice).
TOLD_SHARE = 0.0075
#: Parallel views along a line tell the focal length where points lie nearer by this share once it is fitted: by less
#: than 0.3 % where they do not tell it, by 2 % and more where cameras that sway by 3 degrees do (choice).
NEARER_ON_LINE = 0.02
#: So small a share of photographs that are unlike the others changes no rule for all (choice).
FEW = 0.1


def should_fix_focal(
    photographs: Sequence[ImageMetadata], positions: GpsPriors, options: SfmOptions
) -> tuple[bool, str]:
    """Whether the focal length is held at what EXIF says, and why: over level ground from one height, straight down, a
    longer lens and a lower flight look the same. Where nothing says that the flight was one like this it is fitted: a
    wrong focal length that is held bends or tears all other scenes."""
    if options.focal != "auto":
        return options.focal == "fixed", ASKED
    photographs = [photo for photo in photographs if not photo.face]
    if not photographs:
        return True, "views that are cut out of panoramas have none to fit"
    bent = any(photo.camera_model == FISHEYE for photo in photographs)  # of many terms: one may stand for a height
    told = _by_lenses(photographs) or _by_flight(photographs, bent)
    if told:
        return told
    if all(photo.lens is not None and photo.lens.source == CALIBRATED_SOURCE for photo in photographs):
        return True, "calibrated by the maker"
    return _by_positions(positions, bent) or (False, "nothing says that it was flown level, looking straight down")


def _by_lenses(photographs: Sequence[ImageMetadata]) -> tuple[bool, str] | None:
    """What tags of lenses say of holding the focal length, and why; None where they leave it open."""
    few = max(1, FEW * len(photographs))
    if sum(photo.lens is None for photo in photographs) > few:
        return False, "nothing says it for some photographs"
    if sum(bool(photo.lens and photo.lens.doubt) for photo in photographs) > few:
        return False, TAGS_DISAGREE
    return None


def _by_flight(photographs: Sequence[ImageMetadata], bent: bool) -> tuple[bool, str] | None:
    """The same by recorded attitudes, and by heights over the take-off unless lenses are `bent`."""
    tilts = np.array([photo.attitude.tilt_deg for photo in photographs if photo.attitude])
    oblique = np.mean(tilts > OBLIQUE_ANGLE_DEG) if len(tilts) else 0.0
    if oblique >= MIN_OBLIQUE_SHARE:
        return False, f"{oblique:.0%} oblique views tell it"
    known = [photo for photo in photographs if photo.relative_altitude is not None]
    heights, flights = np.array([photo.relative_altitude for photo in known], float), flights_of(known)
    if not bent and len(heights) >= 3:
        steady = MIN_HEIGHT_SPREAD * abs(np.median(heights))
        if _range(heights) > steady:
            if _range(heights - _of_flights(heights, flights)) <= steady:
                return True, OF_FLIGHTS
            if _range(_over_slope(heights, known)) <= steady:
                return True, OF_SLOPE
            if 2 * len(tilts) >= len(photographs):
                return True, OF_HEIGHTS
            return False, "flown at several heights; nothing says that all views were parallel"
    if 2 * max(len(tilts), len(heights)) >= len(photographs):
        return True, OF_ONE_HEIGHT
    return None


def _by_positions(positions: GpsPriors, bent: bool) -> tuple[bool, str] | None:
    """The same by where photographs were taken; unless lenses are `bent`, whatever altitudes of flights differ by."""
    if not bent and _is_line(positions):
        return True, OF_LINE
    if _is_survey_grid(positions):
        return True, OF_STRIPS
    if bent or not positions.usable or len(positions.flights) != len(positions):
        return None
    level = positions.enu - _of_flights(positions.enu[:, 2], positions.flights)[:, None] * [0, 0, 1]
    errors = ERRORS_RANGE * float(np.median(positions.gps_std[:, 2]))
    return (True, OF_FLIGHTS) if _is_survey_grid(replace(positions, enu=level), errors) else None


def _of_flights(heights: np.ndarray, flights: np.ndarray) -> np.ndarray:
    """For each photograph the median height of its flight [n]."""
    medians = {number: np.median(heights[flights == number]) for number in np.unique(flights)}
    return np.array([medians[number] for number in flights])


def _over_slope(heights: np.ndarray, photographs: Sequence[ImageMetadata]) -> np.ndarray:
    """Heights [n] over the plane through them that fits best; as they are where positions do not tell one, and where
    the plane is no slope: straight up over one place any plane explains heights."""
    places = np.array([photo.lat_lon or (np.nan, np.nan) for photo in photographs])
    if len(places) < MIN_FOR_SLOPE or not np.isfinite(places).all():
        return heights
    places[:, 1] = places[0, 1] + (places[:, 1] - places[0, 1] + 180) % 360 - 180  # across 180°, too
    middle = places.mean(axis=0)
    away = (places - middle) * [1.0, np.cos(np.radians(middle[0]))]
    terms = np.column_stack([np.ones(len(away)), away / max(np.abs(away).max(), 1e-12)])
    plane = np.linalg.lstsq(terms, heights, rcond=None)[0]
    rise = float(np.linalg.norm(plane[1:])) / (np.radians(np.abs(away).max()) * SEMI_MAJOR_M)
    return np.asarray(heights - terms @ plane) if rise < STEEPEST else heights


def release_focal(
    models: list[pycolmap.Reconstruction], held: tuple[bool, str], groups: Sequence[CameraGroup], threads: int
) -> tuple[bool, str]:
    """Fit the focal length of the first of models, held for OF_FLIGHTS, OF_HEIGHTS, OF_SLOPE, OF_LINE, OF_ONE_HEIGHT
    or OF_STRIPS, where the photographs alone tell it, unless it goes astray. Whether it is held then, and why. Several
    heights let photographs tell it only as far as views differ in direction (`focal_deviation`), and a few oblique
    views from one height do, too. Held lenses whose tags disagree would bend a model, from several heights."""
    if not held[0] or held[1] not in (OF_FLIGHTS, OF_HEIGHTS, OF_SLOPE, OF_LINE, OF_ONE_HEIGHT, OF_STRIPS):
        return held
    model = models[0]
    oblique, few, is_level = _looks_of(model)
    is_flat, as_held = few and is_level, pycolmap.Reconstruction(model)
    as_held.update_point_3d_errors()
    left_open = focal_deviation(as_held) if oblique >= LEAST_OBLIQUE or not is_flat else math.inf
    is_told = left_open <= TOLD_SHARE and oblique >= LEAST_OBLIQUE
    if held[1] in (OF_ONE_HEIGHT, OF_STRIPS) and not is_told:
        return held
    if is_flat and held[1] != OF_LINE and not is_told:
        return True, "level strips, as the photographs themselves show, whatever their altitudes say"
    is_open = few and not is_flat and left_open > TOLD_SHARE
    lenses = {image.camera_id for image in placed_images(model)}
    if is_open and (len(lenses) == 1 or not math.isfinite(left_open)):
        return True, OF_PARALLEL
    fit_focal(model, threads)
    best = (1 - NEARER_ON_LINE) * mean_reprojection_error(as_held)
    if is_flat and not is_told and mean_reprojection_error(model) >= best:  # views that roll and pitch would tell it
        models[0] = as_held
        return True, "one line of parallel views, as the photographs themselves show: they cannot tell it"
    if is_astray(model, (False, OF_SHAPE), groups) and is_held_as_good([as_held], models):
        models[0] = as_held
        return True, CONFIRMED
    return False, OF_LENSES if is_open else OF_SHAPE


def _looks_of(model: pycolmap.Reconstruction) -> tuple[int, bool, bool]:
    """How many views of a model are oblique, whether they are few, and whether all are of one height."""
    images = [image for image in placed_images(model) if image.num_points3D]
    heights = np.array([height_over_points(image, model) for image in images])
    views = np.array([image.cam_from_world().rotation.matrix()[2] for image in images])
    ahead = np.median(views, axis=0) / np.linalg.norm(np.median(views, axis=0))
    oblique = views @ ahead < np.cos(np.radians(OBLIQUE_ANGLE_DEG))
    is_level = _range(heights) <= MIN_HEIGHT_SPREAD * np.median(heights)
    return int(oblique.sum()), bool(oblique.mean() < MIN_OBLIQUE_SHARE), bool(is_level)


def is_contradicted(
    model: pycolmap.Reconstruction, held: tuple[bool, str], groups: Sequence[CameraGroup], threads: int
) -> bool:
    """Whether the focal length of a model was held at what one tag alone says, and the photographs plainly say another:
    programs that shrink photographs rewrite what tags count from."""
    said = focals_by_one_tag(groups)
    if not held[0] or held[1] in (ASKED, CONFIRMED) or not said:
        return False
    fitted = pycolmap.Reconstruction(model)
    fitted.update_point_3d_errors()
    as_held = mean_reprojection_error(fitted)
    fit_focal(fitted, threads)
    nearer = 1 - mean_reprojection_error(fitted) / as_held
    off = [abs(math.log(fitted.cameras[k].mean_focal_length() / f)) for k, f in said.items() if k in fitted.cameras]
    if nearer < CLEARLY_NEARER or not off:
        return False
    is_told = nearer >= PLAINLY_NEARER and max(off) >= max(FAR_OFF, SIGMAS_OFF * focal_deviation(fitted))
    return max(off) >= math.log(AGREE) or is_told


def focals_by_one_tag(groups: Sequence[CameraGroup]) -> dict[int, float]:
    """Focal lengths (pixels) that one tag alone says, by the numbers of the cameras."""
    return {k: group.focal_px for k, group in enumerate(groups, 1) if group.has_focal_prior and not group.is_confirmed}


def is_kept_by_flat_points(
    model: pycolmap.Reconstruction,
    meant: tuple[bool, str],
    held: tuple[bool, str],
    groups: Sequence[CameraGroup],
    threads: int,
) -> bool:
    """Whether a focal length that was `meant` to be held at what one tag alone says, and was fitted since photographs
    tell it, is another without the points whose rays are about parallel. Those of a camera that turns on the spot are
    such: a wrong focal length gives them a depth, and they keep it where it was, however it is fitted."""
    placed = {image.camera_id for image in placed_images(model)}
    fitted = focals_by_one_tag(groups).keys() & placed
    if not (meant[0] and meant[1] != OF_LINE and held == (False, OF_SHAPE) and fitted):
        return False
    deep = pycolmap.Reconstruction(model)
    pycolmap.ObservationManager(deep).filter_all_points3D(math.inf, FLAT_DEG)
    if deep.num_points3D() < DEEP_SHARE * model.num_points3D():
        return True  # too few are left to tell
    fit_focal(deep, threads)
    focals = [(model.cameras[k].mean_focal_length(), deep.cameras[k].mean_focal_length()) for k in fitted]
    return any(abs(math.log(other / focal)) > ONE_FIT for focal, other in focals)


def is_astray(model: pycolmap.Reconstruction, held: tuple[bool, str], groups: Sequence[CameraGroup]) -> bool:
    """Whether the focal length of a model was fitted and is none that there is, or far from what tags that confirm each
    other say: depth and focal length stretch together, from any number of heights, where views are parallel to well
    below a degree, and where they climb along a tower."""
    placed = Counter(image.camera_id for image in placed_images(model))
    said = {k: group.focal_px for k, group in enumerate(groups, 1) if k in placed and _is_confirmed(group)}
    few = max(1, FEW * placed.total())
    if held[0] or held[1] == ASKED or not said or sum(n for k, n in placed.items() if k not in said) > few:
        return False
    return any(is_impossible(model.cameras[k]) for k in placed) or any(
        not alike(model.cameras[k].mean_focal_length(), focal) for k, focal in said.items()
    )


def _is_confirmed(group: CameraGroup) -> bool:
    doubted = any(photo.lens and photo.lens.doubt for photo in group.images)
    return group.has_focal_prior and group.is_confirmed and not doubted


def is_held_as_good(held: Sequence[pycolmap.Reconstruction], fitted: Sequence[pycolmap.Reconstruction]) -> bool:
    """Whether models with the focal length held are to be taken in place of those where it went astray (the largest
    first, errors computed): they place as many photographs, whose points do not lie plainly farther from where they are
    seen; or the fitted lens is none that there is."""
    if not held:
        return False
    if any(is_impossible(fitted[0].cameras[image.camera_id]) for image in placed_images(fitted[0])):
        return True
    placed, before = len(placed_images(held[0])), len(placed_images(fitted[0]))
    allowed = (1 + CLEARLY_NEARER) * mean_reprojection_error(fitted[0])
    return placed >= before and mean_reprojection_error(held[0]) <= allowed


def fit_focal(model: pycolmap.Reconstruction, threads: int) -> None:
    """Fit the focal lengths of a model, with all else that is fitted."""
    adjust(model, threads, hold_focal=False)


def adjust(model: pycolmap.Reconstruction, threads: int, hold_focal: bool) -> None:
    """Fit all of a model that is fitted, focal lengths too unless they are held, with what lenses are else."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = not hold_focal
    options.print_summary, options.ceres.solver_options.num_threads = False, threads
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    config = pycolmap.BundleAdjustmentConfig()
    for image in placed_images(model):
        config.add_image(image.image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not `pycolmap.bundle_adjustment`, which sets COLMAP's log back to telling all.
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    call_cancellable(lambda cancellation_token: adjuster.solve())
    model.update_point_3d_errors()


def _is_survey_grid(positions: GpsPriors, errors: float = 0.0) -> bool:
    """Whether photographs were taken from one height (but for so many metres of errors) all over an area, as a survey
    is, and not around something. Of places apart that with most photographs tells."""
    here = places_apart(positions.enu) == 0
    enu = positions.enu[here]
    if len(enu) < MIN_POSITIONS or not positions.has_altitudes or is_nearly_collinear(enu, positions.gps_std[here]):
        return False
    plane = enu[:, :2] - enu[:, :2].mean(axis=0)
    axes, spread, _ = np.linalg.svd(plane, full_matrices=False)
    spread, alike = spread / np.sqrt(len(plane)), np.linalg.norm(axes, axis=1) * np.sqrt(len(plane))
    around = np.quantile(alike, 0.1) > ORBIT_RADIUS_SHARE * np.sqrt(2)
    heights, moments = enu[:, 2], np.flatnonzero(here)
    steady = heights - np.polyval(np.polyfit(moments, heights, 1), moments)  # altitudes of receivers drift
    return not around and min(_range(heights), _range(steady)) <= np.hypot(errors, MIN_HEIGHT_SPREAD * spread[1])


def _is_line(positions: GpsPriors) -> bool:
    """Whether photographs were taken along one straight line, level or not: of parallel views a longer lens and what
    is seen farther away look the same, and a focal length that is fitted bends the line."""
    enu = positions.enu[places_apart(positions.enu) == 0]
    if len(enu) < MIN_POSITIONS or not positions.usable or not positions.has_altitudes:
        return False
    spread = np.linalg.svd(enu - enu.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= LINE_SHARE * spread[0])


def _range(heights: np.ndarray) -> float:
    """Between the 5 % quantile and the 95 %."""
    return float(np.ptp(np.quantile(heights, [0.05, 0.95])))
