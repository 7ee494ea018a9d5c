"""What came out, for people: what holds, what does not, and what to do better on the next flight."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vdgs.captures.camera_height import height_range
from vdgs.captures.capture_dates import first_and_last
from vdgs.captures.formats.source_capture import format_list
from vdgs.captures.pinholes import fold_notes
from vdgs.captures.reconstruction import (
    OVER_GROUND,
    OVER_MEDIAN,
    CameraReport,
    GcpReport,
    ImageReport,
    ReconstructionReport,
)
from vdgs.captures.turned_views import tilt_of_views
from vdgs.errors import CaptureError
from vdgs.sfm.camera_rigs import describe_rigs
from vdgs.sfm.capture_writer import lens_of, placed_images
from vdgs.sfm.feature_extraction import CameraGroup
from vdgs.sfm.fisheyes import MAX_FISHEYE_MM, equivalent_mm
from vdgs.sfm.focal_decision import CONTRADICTED, TAGS_DISAGREE
from vdgs.sfm.gcp_adjustment import MARK_WRONG_PX
from vdgs.sfm.gcp_list import GcpList
from vdgs.sfm.georeferencing import Georeferenced
from vdgs.sfm.georegistration import AlignmentFailure, Georegistration
from vdgs.sfm.gps_priors import ALTITUDE_UNKNOWN, GpsPriors
from vdgs.sfm.height_units import in_feet
from vdgs.sfm.image_list import MIN_IMAGES, ExcludedImage, ImageList
from vdgs.sfm.image_metadata import RADIAL, ImageMetadata
from vdgs.sfm.incremental_mapper import refined_cameras
from vdgs.sfm.preflight import (
    LEVEL_TILT_DEG,
    MIN_OVERLAP,
    MIN_VIEWS_PER_POINT,
    OBLIQUE_ANGLE_DEG,
    PreflightReport,
)
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.reprojection import mean_reprojection_error
from vdgs.sfm.turning import only_turns
from vdgs.sfm.up_direction import model_points, tilt_from_attitudes
from vdgs.sfm.workspace import Workspace
from vdgs.system.lazy_pycolmap import pycolmap

#: What nothing tells of a model without positions, attitudes and surveyed points.
UNKNOWN = "scale, north and up are not known"
#: A fitted focal length that left EXIF's by more than this share drifted, and so did a height over the recorded one.
MAX_FOCAL_DRIFT, MAX_HEIGHT_DRIFT = 0.05, 0.15
#: What joins why a focal length was held and what told it afterwards.
THEN = "; then by "
#: Cameras follow the relief where heights over what each sees spread by less than this share of those over the median
#: point (choice).
FOLLOWS = 0.5
#: Points that a model needs, in all and in its median photograph. The mapper asks for a hundred of the first two and
#: for thirty of each other one (choices).
MIN_POINTS, MIN_POINTS_EACH = 50, 15
#: Degrees between down as the model has it and as the drone recorded it that are worth a word.
MAX_TILT_DEG = 3.0


@dataclass(frozen=True, eq=False, kw_only=True)
class ReconstructionResult:
    """What the steps of a reconstruction left beside the model, which lies where it belongs."""

    #: Kinds of camera, as the features were found with.
    camera_groups: Sequence[CameraGroup]
    #: The model where it belongs, how it was placed or why not, and surveyed points.
    found: Georeferenced
    excluded: Sequence[ExcludedImage]
    #: Photographs of each part that came out, the largest first.
    components: Sequence[int]
    #: Pairs of photographs that were compared.
    pairs: int
    #: Whether the focal lengths of EXIF were held, and why.
    focal_fixed: tuple[bool, str]
    seconds: float

    @property
    def metric(self) -> Georegistration | None:
        """How the model was brought to metres; None where it was not."""
        return self.found.placed if isinstance(self.found.placed, Georegistration) else None


def make_reconstruction_report(plan: ReconstructionPlan, result: ReconstructionResult) -> ReconstructionReport:
    """The facts of a model that lies where it belongs."""
    model, placed, held = result.found.model, result.metric, result.focal_fixed
    collection, positions, look = plan.image_list, plan.gps_priors, plan.preflight
    images = placed_images(model)
    metric = placed is not None
    heights, over = _flown_heights(model, images) if metric else (None, OVER_MEDIAN)
    height = None if heights is None else float(np.median(heights))
    tilt = tilt_of_views(np.array([image.cam_from_world().rotation.matrix() for image in images])) if metric else None
    cameras = cameras_of(model, result.camera_groups)
    turned = tilt_from_attitudes(model, result.found.photographs) if metric else None
    recorded = None if height is None or _relief_explains(model, images, look.height_m) else look.height_m
    control = result.found.control
    surveyed = control.source if control is not None and control.has_control_points else ""
    untold = {kind.camera for kind in result.camera_groups if kind.model == RADIAL}
    warnings = [
        *look.warnings,
        *result.found.notes,
        *_warnings(cameras, held, height, recorded, turned, tilt, untold, surveyed),
    ]
    if placed is not None and height is not None and placed.residuals.shape[1] == 3:  # positions with altitudes
        up = placed.residuals[:, 2]
        names = [collection.images[int(positions.image_indices[row])].name for row in placed.position_rows]
        warnings += _lens_warnings(collection.images, dict(zip(names, up.tolist(), strict=True)), height)
    warnings += _survey_warnings(result.found.survey)
    warnings += fold_notes(lens_of(model.cameras[number]) for number in sorted({image.camera_id for image in images}))
    if any(photo.sensor for photo in collection.images):
        warnings += describe_rigs(model, "m" if metric else "units of the model")
    advice = _advice(look, held[0], len(images), sum(photo.face != "up" for photo in collection.images))
    georeferenced, up_by, of_place = _words_of_place(result.found.placed)
    return ReconstructionReport(
        found=len(collection.images) + len(collection.excluded), registered=len(images),
        components=tuple(result.components), pairs=result.pairs, points=model.num_points3D(),
        track_length=float(model.compute_mean_track_length()),
        reprojection_px=mean_reprojection_error(model), georeferenced=georeferenced,
        altitude_reference=_altitudes(plan, result.found.control, placed) if placed and placed.is_georeferenced else "",
        origin=result.found.origin,
        residual_rms_m=_rms(placed), positions_rejected=int((~placed.inliers).sum()) if placed else 0,
        focal_fixed=held[0], focal_reason=focal_reason(held[1], result.found.focal_by), height_m=height,
        heights_m=None if heights is None else height_range(heights), height_over=over, recorded_height_m=look.height_m,
        tilt_deg=tilt,
        attitude_difference_deg=turned, cameras=cameras,
        photographs=_photographs(collection, positions, placed, result.excluded), warnings=(*warnings, *of_place),
        advice=tuple(advice),
        seconds=result.seconds,
        survey=result.found.survey, accuracy=placed.accuracy if placed else None,
        up=up_by,
        flown=first_and_last(photo.datetime for photo in collection.images),
    )  # fmt: skip


def focal_reason(why: str, focal_by: str = "") -> str:
    """Why a focal length is held or fitted, as a report says it, with what told it afterwards; `why` may be of a report
    itself."""
    before = why.split(THEN)[0]
    return f"{before}{THEN}{focal_by}" if focal_by else before


def _words_of_place(placed: Georegistration | AlignmentFailure) -> tuple[str, str, tuple[str, ...]]:
    """How the model was brought to metres, or why not; by what z is up where it was not; and what to know of it."""
    if isinstance(placed, Georegistration):
        return placed.method, "", placed.notes
    rest = f"scale and north are not known, z is up by {placed.up}" if placed.up else UNKNOWN
    note = f"not georeferenced ({placed.reason}): the scale of the scene is arbitrary. To mend it, {placed.remedy}"
    return f"none: {placed.reason}; {rest}", placed.up, (note,)


def exclusion_reasons(
    model: pycolmap.Reconstruction,
    others: Sequence[pycolmap.Reconstruction],
    names: Sequence[str],
    matched: Mapping[str, int],
    known: Sequence[ExcludedImage],
) -> list[ExcludedImage]:
    """Every photograph that the model does not place, with the reason."""
    placed = {image.name for image in placed_images(model)}
    reasons = {each.name: each.reason for each in known}
    for other in reversed(others):
        apart = placed_images(other)
        for image in apart:
            reasons.setdefault(
                image.name,
                f"belongs to a part of {len(apart)} photographs that nothing joins to the rest: more overlap between",
            )
    found = []
    for name in names:
        if name in placed:
            continue
        count = matched.get(name, 0)
        why = (
            "shows nothing that others show: no overlap, blurred, water or canopy"
            if count == 0
            else f"agrees with {count} others in pairs, but shows too few of the points that they have in common"
        )
        found.append(ExcludedImage(name, reasons.get(name, why)))
    return found


def check_enough_placed(
    model: pycolmap.Reconstruction, left_out: Sequence[ExcludedImage], workspace: Workspace
) -> None:
    """Raise CaptureError for a model of fewer photographs, or points, than a scene needs, and where photographs were
    taken from one place: those that it places, or all that match where it shows hardly anything."""
    placed, lines = len(placed_images(model)), format_list([each.line for each in left_out])
    is_poor = placed < MIN_IMAGES or _shows_little(model)
    if only_turns(workspace, None if is_poor else model):
        raise CaptureError(
            "the photographs were taken from one place: a camera that only turns explains what they show, so they tell "
            "no depth and no scene can be made of them. Move the camera between photographs, by a tenth of the "
            f"distance to what it sees or more, with 70 to 80 % overlap.{lines}"
        )
    if placed < MIN_IMAGES:
        raise CaptureError(
            f"only {placed} photographs could be joined; a scene needs {MIN_IMAGES} at the very least. Let photographs "
            f"overlap by 70 to 80 %, the camera moving between them.{lines}"
        )
    if is_poor:
        raise CaptureError(
            f"the {placed} photographs that could be joined show only {model.num_points3D()} points in common, too few "
            "for a scene. They overlap too little, are blurred or show little to hold on to (water, snow, sky), or the "
            f"camera hardly moved between them. Fly with 70 to 80 % overlap, the camera moving.{lines}"
        )


def _shows_little(model: pycolmap.Reconstruction) -> bool:
    """Whether a model has hardly any points, in all or in its median photograph."""
    each = [image.num_points3D for image in placed_images(model)]
    return model.num_points3D() < MIN_POINTS or bool(np.median(each) < MIN_POINTS_EACH)


def _altitudes(prepared: ReconstructionPlan, control: GcpList | None, placed: Georegistration) -> str:
    if control is not None and control.has_control_points:
        return f"heights as in {control.source} ({control.crs})"
    if placed.accuracy is not None and placed.accuracy.altitude == "none":
        return ALTITUDE_UNKNOWN
    return prepared.gps_priors.altitude_reference


def _rms(placed: Georegistration | None) -> tuple[float, ...] | None:
    if placed is None or not placed.inliers.any():
        return None
    return tuple(float(value) for value in np.sqrt((placed.residuals[placed.inliers] ** 2).mean(axis=0)))


def _heights(model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image]) -> np.ndarray:
    """Of the cameras over the median point, [n]."""
    heights = np.array([image.projection_center()[2] for image in images])
    return heights - np.median(model_points(model)[:, 2])


def _flown_heights(model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image]) -> tuple[np.ndarray, str]:
    """Heights of the cameras [n] and over what: over the median point, or, where a flight follows its relief, over the
    ground that each sees."""
    over_median = _heights(model, images)
    over_ground = np.array([_over_seen(image, model) for image in images if image.num_points3D])
    if not len(over_ground) or height_range(over_median) is None:
        return over_median, OVER_MEDIAN
    narrower = _spread(over_ground) < FOLLOWS * _spread(over_median)
    return (over_ground, OVER_GROUND) if narrower else (over_median, OVER_MEDIAN)


def _over_seen(image: pycolmap.Image, model: pycolmap.Reconstruction) -> float:
    """Height of a camera over the median of the points that it shows."""
    seen = [model.points3D[each.point3D_id].xyz[2] for each in image.points2D if each.has_point3D()]
    return float(image.projection_center()[2] - np.median(seen))


def _spread(heights: np.ndarray) -> float:
    return float(np.ptp(np.quantile(heights, (0.05, 0.95))))


def _relief_explains(model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image], recorded: float | None) -> bool:
    """Whether the take-off, by recorded heights over it, is about as high as some of the ground: then the flying height
    over another part of it says nothing of the focal length."""
    if recorded is None:
        return False
    low, high = np.quantile(model_points(model)[:, 2], (0.02, 0.98))
    take_off = float(np.median([image.projection_center()[2] for image in images])) - recorded
    about = MAX_HEIGHT_DRIFT * recorded
    return bool(low - about <= take_off <= high + about)


def cameras_of(model: pycolmap.Reconstruction, kinds: Sequence[CameraGroup]) -> tuple[CameraReport, ...]:
    """Each kind's camera before and after."""
    return tuple(
        CameraReport(
            name=kind.camera,
            photographs=len(kind.images),
            width=kind.width,
            height=kind.height,
            focal_before_px=float(kind.focal_px),
            focal_source=kind.source,
            focal_after_px=float(after.mean_focal_length()),
            radial_distortion=float(next(iter(after.params[after.extra_params_idxs()]), 0.0)),
            model=after.model_name,
        )
        for kind, after in zip(kinds, refined_cameras(model, kinds), strict=True)
        if after is not None
    )


def _photographs(
    collection: ImageList, positions: GpsPriors, placed: Georegistration | None, left_out: Sequence[ExcludedImage]
) -> tuple[ImageReport, ...]:
    why = {each.name: each.reason for each in (*collection.excluded, *left_out)}
    names = sorted({*(photo.name for photo in collection.images), *why})
    residuals = {}
    if placed is not None:
        for row, residual in zip(placed.position_rows, placed.residuals, strict=True):
            residuals[collection.images[int(positions.image_indices[row])].name] = tuple(float(v) for v in residual)
    files = {each.name: each.file for each in collection.excluded}
    return tuple(ImageReport(name, residuals.get(name), why.get(name), files.get(name)) for name in names)


def _of_focal_drift(drift: float, why_fitted: str, height: float | None, recorded: float | None) -> str:
    """What to do about a fitted focal length that is off its tag by a share: nothing where the height that was flown
    is the recorded one by it, and would not be by the tag."""
    if height is not None and recorded and abs(height / recorded - 1) < abs(drift) / 2:
        return "; the flying height is the recorded one by the fitted one, which is used: the tag seems to be wrong"
    if why_fitted == TAGS_DISAGREE:
        return (
            ", and its tags contradict each other: the fitted one is used. Mend the tags if heights look wrong, and "
            "then hold it (--focal fixed)"
        )
    return "; if heights look wrong, hold it: --focal fixed"


def _warnings(
    cameras: Sequence[CameraReport],
    held: tuple[bool, str],
    height: float | None,
    recorded: float | None,
    turned: float | None,
    tilt: float | None,
    untold: Collection[str] = (),
    surveyed: str = "",
) -> list[str]:
    """`surveyed`: the list of control points that places the cameras; empty where none does."""
    found = []
    for camera in cameras:
        if camera.is_fisheye and camera.name in untold:
            found.append(
                f"{camera.name}: a fisheye, as the photographs tell; no tag says it. If it is none: --camera-model "
                "simple-radial"
            )
        drift = camera.focal_after_px / camera.focal_before_px - 1
        if not held[0] and camera.focal_source != "a guess" and abs(drift) > MAX_FOCAL_DRIFT:
            remedy = _of_focal_drift(drift, held[1], height, recorded)
            if not camera.is_fisheye and _is_short(camera):
                remedy = (
                    ". Lenses so short may be fisheyes: say it (--camera-model opencv-fisheye). Or did a program "
                    "shrink them and rewrite their size (PixelXDimension)? Mend EXIF"
                )
            elif held[1] == CONTRADICTED:
                remedy = (
                    ", which the photographs contradict. Did a program shrink them and rewrite their size "
                    "(PixelXDimension)? Mend EXIF, or hold what it says: --focal fixed"
                )
            found.append(
                f"{camera.name}: the fitted focal length is {drift:+.0%} off what {camera.focal_source} says{remedy}"
            )
    if height is not None and height < 0 and tilt is not None and tilt > 180 - LEVEL_TILT_DEG:
        flown = f", the drone recorded {recorded:.1f} m over its take-off" if recorded else ""
        found.append(
            f"the cameras are {-height:.1f} m under the median point and look up ({tilt:.0f}° from straight down)"
            f"{flown}: unless they did (under a roof or a bridge), the scene is upside down. Are latitude and "
            "longitude exchanged, or is a hemisphere missing?"
        )
    sees_ground = tilt is not None and tilt < LEVEL_TILT_DEG
    if sees_ground and height is not None and recorded and abs(height / recorded - 1) > MAX_HEIGHT_DRIFT:
        found.append(
            f"the cameras are {height:.1f} m over the median point, the drone recorded {recorded:.1f} m over its "
            "take-off: another level of ground, or a focal length that is not right."
            + (f" {surveyed}:{in_feet(height / recorded)}" if surveyed and in_feet(height / recorded) else "")
        )
    if turned is not None and turned > MAX_TILT_DEG:
        found.append(f"down differs by {turned:.1f}° from what the drone recorded: the model may be tilted or bent.")
    return found


def _is_short(camera: CameraReport) -> bool:
    """Whether a lens may be a fisheye by its focal length, as tags say it or as it was fitted."""
    shorter = min(camera.focal_before_px, camera.focal_after_px)
    return equivalent_mm(shorter, camera.width, camera.height) <= MAX_FISHEYE_MM


def _lens_warnings(photographs: Sequence[ImageMetadata], off_m: Mapping[str, float], height: float) -> list[str]:
    """Of photographs of one camera that say another focal length than most, and come out at another height than their
    positions have (metres above these, by name): a wrong tag does that where the focal length is held."""
    cameras: dict[tuple[str, tuple[int, int]], dict[float, list[float]]] = {}
    for photo in photographs:
        if photo.lens is not None and photo.name in off_m:
            lenses = cameras.setdefault((photo.camera, photo.size), {})
            lenses.setdefault(round(photo.lens.focal * max(photo.size)), []).append(off_m[photo.name])
    found = []
    for (camera, _), lenses in cameras.items():
        usual = max(lenses, key=lambda focal: len(lenses[focal]))
        for focal, offs in lenses.items():
            away = float(np.median(offs) - np.median(lenses[usual]))
            if focal != usual and len(offs) > 1 and abs(away) > MAX_HEIGHT_DRIFT * height:
                found.append(
                    f"{camera}: the {len(offs)} photographs with a focal length of {focal} px come out "
                    f"{abs(away):.1f} m {'higher' if away > 0 else 'lower'} than their positions say, compared with "
                    f"those with {usual} px. Is EXIF's FocalLength of these right? Mend it, or leave them out."
                )
    return found


def _survey_warnings(survey: Sequence[GcpReport]) -> list[str]:
    found = []
    for each in survey:
        if each.residual_m is None:
            found.append(f"the surveyed point {each.name} is shown by too few placed photographs; not used.")
        elif each.role == "not used":
            found.append(f"the control point {each.name} does not fit the others; not used. Right place, right marks?")
        if each.error_px is not None and each.error_px > MARK_WRONG_PX:
            away = f"{each.error_px:.0f} px from where it must be seen"
            found.append(f"the surveyed point {each.name} is marked {away}. Look at its marks again.")
    return found


def _advice(look: PreflightReport, held: bool, registered: int, found: int) -> list[str]:
    """What to do better next flight."""
    advice = []
    if look.forward_overlap is not None and look.forward_overlap < MIN_OVERLAP:
        advice.append("fly slower or take photographs more often: 75 to 80 % overlap along the flight.")
    if look.views_per_point is not None and look.views_per_point < 2 * MIN_VIEWS_PER_POINT:
        advice.append(
            "fly the strips closer together, or a second grid across the first, until 8 photographs or more show every "
            "place."
        )
    if held and look.oblique is not None and look.oblique == 0:
        advice.append(
            f"add oblique views (camera {OBLIQUE_ANGLE_DEG + 10:.0f}° or more from straight down): walls come out, and "
            "the photographs tell the focal length. A second height of parallel views tells it by the recorded heights "
            "alone, as good as these are (RTK)."
        )
    if registered < 0.9 * found:
        advice.append("see why photographs were left out: overlap, motion blur (faster shutter), water at the edges.")
    return advice
