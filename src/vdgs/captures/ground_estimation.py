"""The ground frame: the similarity that turns a capture's own world into one with z up.

Where the up axis and the scale come from, in this order:

1. `--up`: the person says so (no georeference, arbitrary scale).
2. georef.json: the world already is ENU metres; only the origin may move.
3. GPS of the photographs: robust similarity from camera centers to ENU.
4. What the format promises about its world (Mega-NeRF, MatrixCity).
5. Estimate (`up`): drones look down on what is flat, others hold their cameras level.

Known distances (`--scale-bar`) give any of them its metres.

All arithmetic is float64. Choice: in a frame that is not georeferenced the origin is the median sparse point,
so z = 0 is the median height of the ground; where metres are unknown the median camera flies at
`NOMINAL_CAMERA_HEIGHT`, or is so far from the points where it is not above them (`heights`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vdgs.captures.camera_height import view_distance
from vdgs.captures.capture_order import natural_key
from vdgs.captures.flight_extent import LOCAL_METERS, why_no_scene
from vdgs.captures.formats.source_capture import SourceCapture, WorldPrior
from vdgs.captures.georeference import Georef, GpsPositions, match_gps, read_georef
from vdgs.captures.gps_altitudes import refuse_unit, wrong_unit
from vdgs.captures.known_distances import MOST_APART, known_scale_of_views
from vdgs.captures.odd_positions import MIN_SPREAD_M, do_not_spread
from vdgs.captures.plane_fit import mirrored
from vdgs.captures.position_adjustment import USUAL_M, PositionFit, Problem, Up
from vdgs.captures.position_fit import OTHER_COSINE, fit_positions, with_likelier_up
from vdgs.captures.position_lines import checked_on_a_line, is_nearly_collinear
from vdgs.captures.position_weights import are_told, relative_deviations, weighing_note, with_unstated
from vdgs.captures.reconstruction import by_axis, told_up
from vdgs.captures.tables_beside import position_tables, table_note
from vdgs.captures.turned_views import are_turned_over
from vdgs.captures.up_axis import (
    HINT,
    MAX_UP_DEVIATION_DEG,
    OR_CEILING,
    VIEWS_DEG,
    contradict_up,
    estimate_up,
    up_by_views,
)
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_centers
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu, median_place
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.geometry.similarity import geometric_median, rotation_to_z
from vdgs.system.units import two_digits

#: Median camera height above the ground, in units, where the capture has no metres (choice).
NOMINAL_CAMERA_HEIGHT = 10.0
#: Georeferenced worlds farther than this from their origin are shifted, so that float32 stays below 0.1 mm.
FAR_FROM_ORIGIN_M = 1000.0
#: Cameras farther than this from the origin of an ENU world are not in it: they have turned by half a degree.
MAX_ENU_DISTANCE_M = 50_000.0
#: A told up axis so far from the estimated one is worth a note even where the estimate is in doubt: what is taken for
#: ground may be a wall, 90 degrees away.
UPSIDE_DOWN_DEG = 120.0
#: Fewer positions tell no scale and no north.
MIN_POSITIONS = 3
#: Nor do cameras that differ by no more than this share of their coordinates: rounding.
ONE_PLACE = 1e-12
#: By what up is known for a fit; and views that tell it no better than to so many degrees (one standard deviation) all
#: look one way, at a slant: twice what they are off where they look down. Flat ground tells it as well as that.
BY_VIEWS, LEANING_DEG = "the views", 2 * VIEWS_DEG
#: Estimates of a fit's scale are no better than its arithmetic and rounded positions allow (share; choice).
LEAST_SCALE_ERROR = 1e-4
AXES = {
    sign + name: factor * np.eye(3)[index]
    for index, name in enumerate("xyz")
    for sign, factor in (("", 1.0), ("-", -1.0))
}


@dataclass(frozen=True, eq=False)
class _Scene:
    """What the frame is found from: camera centers, camera_from_world rotations and finite points, source world."""

    names: list[str]
    centers: np.ndarray
    rotations: np.ndarray
    points: np.ndarray


def find_ground_frame(source: SourceCapture, root: Path, options: CaptureOptions) -> tuple[GroundFrame, list[str]]:
    """The ground frame of a capture, and warnings for people.

    Raises `CaptureError` for georeferences and known distances that cannot be used.
    """
    frame, warnings = _frame_without_distances(source, root, options)
    if options.scale_bar is not None:
        frame = _scaled(frame, source, options.scale_bar)
    return frame, warnings


def _scaled(frame: GroundFrame, source: SourceCapture, file: Path) -> GroundFrame:
    """The frame in the metres of known distances; where it has a place on Earth, its middle stays."""
    factor, share = known_scale_of_views(file, source.views, source.points)
    ratio = factor / frame.scale
    if frame.metric and abs(ratio - 1) > MOST_APART:
        raise CaptureError(
            f"{file}: its distances make the scene {ratio:.3g} times as large as {frame.description} does. Are they in "
            "feet, where metres are expected? Mend them, or leave the georeference out (--up)."
        )
    middle = _middle(frame.to_ground(source.points)) if frame.origin_geo else np.zeros(3)
    scale = f"scale ±{200 * share:.2g} % (95 %)"
    return replace(
        frame, scale=factor, translation=ratio * frame.translation + (1 - ratio) * middle, metric=True,
        description=f"{frame.description.partition('; median camera height')[0]}; metres by known distances "
        f"({file.name}), {scale}",
        accuracy=f"{frame.accuracy}; {scale}" if frame.accuracy else scale,
        method=f"{frame.method}; scale by known distances ({file.name})".removeprefix("; "),
    )  # fmt: skip


def _frame_without_distances(
    source: SourceCapture, root: Path, options: CaptureOptions
) -> tuple[GroundFrame, list[str]]:
    scene = _scene(source)
    warnings: list[str] = []
    if options.up != "auto":
        if options.georef or options.gps:
            raise CaptureError("--up contradicts --georef and --gps, which fix the up axis themselves; give one.")
        if (root / "georef.json").is_file():
            warnings.append("--up is given, so georef.json is not used: the frame is not metric.")
        rotation = rotation_to_z(AXES[options.up])
        return _unscaled(scene, rotation, f"up = {options.up} as given", warnings), warnings
    if options.georef and options.gps:
        raise CaptureError("--georef and --gps both say where the world is; give one.")
    georef = _georef(source, root, options, warnings)
    if georef is not None:
        frame = _georeferenced(scene, *georef, warnings)
        _compare_up(scene, frame, warnings)
        return frame, warnings
    if options.gps:
        frame_or_none = _from_gps(scene, options.gps, warnings)
        if frame_or_none is not None:
            return frame_or_none, warnings
        if source.georef is not None:
            return _georeferenced(scene, source.georef, source.georef.method, warnings), warnings
    if source.world is not None:
        frame = _promised(scene, _with_seen_up(scene, source.world, warnings), warnings)
        _compare_up(scene, frame, warnings)
        return frame, warnings
    told = told_up(root)
    if told:
        up, how = np.array([0.0, 0.0, 1.0]), f"up by {told}"
    else:
        up, how = estimate_up(scene.centers, scene.rotations, scene.points, warnings)
    if not options.gps:
        tables = position_tables((root, root / source.images), scene.names)
        warnings += [table_note(table, len(scene.names)) for table in tables]
    return _unscaled(scene, rotation_to_z(up), how, warnings), warnings


def _scene(source: SourceCapture) -> _Scene:
    poses = np.stack([view.camera_from_world for view in source.views])
    centers = camera_centers(poses)
    points = source.points[np.isfinite(source.points).all(axis=1)]
    return _Scene([view.name for view in source.views], centers, poses[:, :3, :3], points)


# ----------------------------------------------------------------------------------------- georeference


def _georef(
    source: SourceCapture, root: Path, options: CaptureOptions, warnings: list[str]
) -> tuple[Georef, str] | None:
    """What says that the world is metres, z up, and its name: the file asked for, else the capture's own files, else
    georef.json beside it. None where nothing does, and where a table of positions was asked for instead."""
    beside = root / "georef.json"
    if source.georef is not None and options.gps is None:
        if options.georef is not None:
            raise CaptureError(
                f"--georef {options.georef}: the capture says itself where it lies ({source.georef.method}), and its "
                "world is made of that. Leave --georef out, or give --gps."
            )
        if beside.is_file():
            warnings.append(f"georef.json is not used: the capture says itself where it lies ({source.georef.method}).")
        return source.georef, source.georef.method
    file = options.georef or (beside if beside.is_file() and options.gps is None else None)
    return (read_georef(file), file.name) if file else None


def _georeferenced(scene: _Scene, georef: Georef, name: str, warnings: list[str]) -> GroundFrame:
    """Identity rotation in metres; the origin moves (by whole metres) only where float32 needs it."""
    accuracy = f"; {georef.accuracy}" if georef.accuracy else ""
    axes = "metres, z up" if georef.origin is None else "ENU metres"
    middle = np.median(scene.centers, axis=0)
    shift = np.where(np.abs(middle) > FAR_FROM_ORIGIN_M, -np.round(middle), 0.0)
    moved = f", origin moved by {np.abs(shift).max():.0f} m" if shift.any() else ""
    how = f"world is {axes} ({name}{accuracy}){moved}"
    frame = GroundFrame(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description=how, origin_geo=georef.origin,
        accuracy=georef.accuracy, method=georef.method or f"{name}, which does not say how",
    )  # fmt: skip
    if georef.origin is None:
        return replace(frame, translation=shift)
    if np.linalg.norm(middle) > MAX_ENU_DISTANCE_M:
        warnings.append(
            f"{name}: the cameras are {np.linalg.norm(middle) / 1000:,.0f} km away from the origin, where its "
            "east, north and up do not hold. Are these projected coordinates (UTM) instead of ENU? Metres and up "
            "are kept, latitude and longitude are not known."
        )
        return replace(frame, translation=shift, origin_geo=None)
    return _shifted(frame, shift, how) if shift.any() else frame


def _fit_table(problem: Problem, altitudes: np.ndarray, file: Path, warnings: list[str]) -> PositionFit:
    """The fit of a table's positions with what its altitudes [n] are good for, which it says where they do not tell up.

    Altitudes that are all one number, where the cameras' heights differ, are those of a program that knew none, or over
    the ground: they do not even say how high the place lies. Raises CaptureError where the cameras tell that altitudes
    are in feet.
    """
    fit = fit_positions(problem)
    heights = fit.placed[:, 2]
    if problem.has_altitudes and (fit.altitude == "none" or (fit.altitude != "used" and not np.ptp(altitudes))):
        about = "all" if not np.ptp(altitudes) else "all about"
        warnings.append(
            f"{file.name}: its altitudes are {about} {np.median(altitudes):g} m, but the cameras' heights differ by "
            f"{np.ptp(heights):.0f} m: left out; up is by the views, heights count from the median point."
        )
        return fit_positions(replace(problem, has_altitudes=False))
    if problem.has_altitudes:
        refuse_unit(wrong_unit(altitudes, heights, fit.placed[:, :2]), "the cameras", file)
    if fit.altitude in ("unused", "drifts"):
        warnings.append(f"{file.name}: its altitudes drift or are of no use, and were left out; up is by the views.")
    elif fit.altitude == "none":
        warnings.append(f"{file.name}: it has no altitudes; up is by the views, heights count from the median point.")
    return fit


def _shifted(frame: GroundFrame, shift: np.ndarray, how: str) -> GroundFrame:
    """The frame with its origin moved; the axes stay those of the first origin."""
    assert frame.origin_geo is not None
    moved = geodetic_from_enu(-shift[None], frame.origin_geo, frame.axes_origin)[0]
    origin = (float(moved[0]), float(moved[1]), float(moved[2]))
    return replace(
        frame, translation=frame.translation + shift, description=how, origin_geo=origin, axes_geo=frame.axes_origin
    )


def _from_gps(scene: _Scene, file: Path, warnings: list[str]) -> GroundFrame | None:
    """Similarity from camera centers to ENU, or None (with a warning) where the flight does not fix one."""
    positions = match_gps(scene.names, file)
    indices, geodetic = positions.images, positions.geodetic
    warnings += positions.notes
    centers = scene.centers[indices]
    if len(indices) < MIN_POSITIONS or np.ptp(centers, axis=0).max() <= ONE_PLACE * np.abs(centers).max():
        warnings.append(
            f"{file.name}: {len(indices)} photographs with GPS tell no scale (fewer than {MIN_POSITIONS}, or all taken "
            "from one place); the frame is estimated from the cameras instead and is not metric."
        )
        return None
    origin = median_place(geodetic)
    enu = enu_from_geodetic(geodetic, origin)
    if do_not_spread(enu):
        warnings.append(
            f"{file.name}: all {len(indices)} positions are within {MIN_SPREAD_M:g} m of each other, and tell neither "
            "scale nor north; the frame is estimated from the cameras instead and is not metric."
        )
        return None
    by_views = _problem(scene, positions, enu)
    if by_views.up.sure or (by_views.up.other is not None and by_views.up.other.doubt == OR_CEILING):
        _refuse_mirrored(by_views, file)
    problem, doubt = with_likelier_up(by_views)
    if doubt:
        warnings.append(f"{file.name}: {doubt}. If that is wrong, leave --gps out, and {HINT}")
    fit, problem = _fit_of_positions(scene, problem, geodetic[:, 2], file, warnings)
    _refuse_upside_down(scene, by_views, fit, file)
    refused = fit.why_refused(file.name)
    if refused:
        warnings.append(f"{file.name}: {refused}; it is ignored and the frame is estimated.")
        return None
    fit, is_line = _checked_on_a_line(fit, problem, file, warnings)
    if weighed := weighing_note(fit.deviations, fit.inliers):
        warnings.append(f"{file.name}: {weighed}")
    if not fit.inliers.all():
        names = ", ".join(scene.names[i] for i in indices[~fit.inliers][:5])
        warnings.append(f"{file.name}: {(~fit.inliers).sum()} GPS positions left out as outliers ({names}).")
    frame = _frame_of_fit(fit, origin, positions.datum_error_m, file, " along one line" if is_line else "")
    frame = _shifted(frame, -_middle(frame.to_ground(scene.points)), frame.description)
    if why := why_no_scene(frame.to_ground(scene.centers), 0.0):
        raise CaptureError(f"{file}: placed by it, {why}. Mend the table, or leave --gps out. {LOCAL_METERS}.")
    if fit.altitude == "none" and frame.origin_geo is not None:
        frame = replace(frame, origin_geo=(*frame.origin_geo[:2], 0.0))
    _compare_up(scene, frame, warnings)
    return frame


def _problem(scene: _Scene, positions: GpsPositions, enu: np.ndarray) -> Problem:
    """What is known for the fit of the cameras to a table's positions, which are `enu` [n, 3] in metres."""
    views = up_by_views(scene.centers, scene.rotations, scene.points)
    said = np.isfinite(positions.deviations).all(axis=1)
    usual = [USUAL_M[0], *USUAL_M]
    deviations = with_unstated(np.where(said[:, None], positions.deviations, usual), said)
    return Problem(
        centers=scene.centers[positions.images], targets=enu,
        times=_taken_in_order([scene.names[i] for i in positions.images]),
        up=Up(views.direction, views.deviation_deg, BY_VIEWS, views.sure, other=views.other),
        has_altitudes=positions.has_altitudes, stated=deviations if are_told(deviations, said) else None,
        relative=relative_deviations(deviations),
    )  # fmt: skip


def _fit_of_positions(
    scene: _Scene, problem: Problem, altitudes: np.ndarray, file: Path, warnings: list[str]
) -> tuple[PositionFit, Problem]:
    """The fit to a table, and what was known for it: where positions along one line leave open what is level across it,
    and the views lean away from what is up over flat ground, the ground tells that better than they do."""
    said = list[str]()
    fit = _fit_table(problem, altitudes, file, said)
    if problem.up.deviation_deg > LEANING_DEG and problem.up.how == BY_VIEWS and _is_on_a_line(fit, problem):
        up, _ = estimate_up(scene.centers, scene.rotations, scene.points, [])
        level = Up(up, LEANING_DEG, "flat ground", problem.up.sure, other=problem.up.other)
        problem, said = replace(problem, up=level), []
        fit = _fit_table(problem, altitudes, file, said)
    warnings += said
    return fit, problem


def _is_on_a_line(fit: PositionFit, problem: Problem) -> bool:
    return is_nearly_collinear(problem.targets[fit.inliers], fit.deviations[fit.inliers])


def _refuse_mirrored(problem: Problem, file: Path) -> None:
    """Raise CaptureError for positions that fit the cameras only as their mirror image."""
    image = problem.targets * [-1.0, 1.0, 1.0]  # of which exchanged axes are a turn
    if mirrored(problem.centers, problem.targets, problem.up.direction, {"the mirror image": image}):
        raise CaptureError(
            f"{file}: its positions fit the cameras only as their mirror image. Are lat and lon exchanged, or is the "
            "minus sign of south or west missing? Mend the table, or leave --gps out."
        )


def _refuse_upside_down(scene: _Scene, problem: Problem, fit: PositionFit, file: Path) -> None:
    """Raise CaptureError for a fit that turns the world over, against what the views say of up: as tables do that are
    mirrored, for a level flight is its own mirror image from below. Views that look one way do not say for sure what is
    up, but then no fit lays them on their side and mirrors them."""
    up, cosine = problem.up, float(fit.similarity.rotation[2] @ problem.up.direction)
    turned_over = are_turned_over(scene.rotations @ fit.similarity.rotation.T)
    if turned_over or (up.other is not None and cosine < OTHER_COSINE):
        _refuse_mirrored(problem, file)
    height = float(np.median(fit.similarity.apply(scene.centers)[:, 2]))
    height -= float(np.median(fit.similarity.apply(scene.points)[:, 2]))
    if cosine < 0 and (up.sure or (height < 0 and turned_over)):
        raise CaptureError(
            f"{file}: placed by it, the cameras would be {abs(height):.3g} m {'under' if height < 0 else 'over'} the "
            "points and look up, against what they show. Are lat and lon (x and y, east and north) exchanged, or is "
            "the minus sign of south or west missing? Mend the table, or leave --gps out."
        )


def _checked_on_a_line(fit: PositionFit, problem: Problem, file: Path, warnings: list[str]) -> tuple[PositionFit, bool]:
    """The fit with what positions along one line leave open, which it says, and whether they are: across the line the
    views alone tell what is level."""
    if not _is_on_a_line(fit, problem):
        return fit, False
    fit, notes = checked_on_a_line(fit, problem)
    warnings += [f"{file.name}: {note}" for note in notes]
    warnings.append(
        f"{file.name}: its positions lie along one line: what is level across it is by {problem.up.how}, good to "
        f"{two_digits(min(180.0, fit.level_error_deg))}° (95 %)."
    )
    return fit, True


def _frame_of_fit(
    fit: PositionFit, origin: tuple[float, float, float], datum_error_m: float, file: Path, layout: str
) -> GroundFrame:
    """The frame that a fit to positions in ENU of the origin makes, and how good it is in words; `layout` is how the
    positions lie, in words, where that matters."""
    inliers, has_altitudes = fit.inliers, fit.altitude != "none"
    axes = slice(3 if has_altitudes else 2)
    rms = float(np.sqrt((fit.residuals[inliers, axes] ** 2).sum(axis=1).mean()))
    across, *up_m = fit.place_error_m
    across = float(np.hypot(across, datum_error_m))
    place = by_axis(
        (across, *up_m) if has_altitudes else (across,),
        ("across", "up"),
        lambda good: f"±{two_digits(good)}",
    )
    method = f"GPS of {inliers.sum()} photographs{layout}, RMS {rms:.2f} m"
    accuracy = f"place {place}, scale ±{max(fit.scale_error, LEAST_SCALE_ERROR):.2%} (95 %)"
    return GroundFrame(
        scale=fit.similarity.scale,
        rotation=fit.similarity.rotation,
        translation=fit.similarity.translation,
        metric=True,
        description=f"{method}; {accuracy}",
        origin_geo=origin,
        accuracy=accuracy,
        method=f"{method} ({file.name})",
    )


def _taken_in_order(names: Sequence[str]) -> np.ndarray:
    """When photographs were taken, 0 to 1 [n], as far as their names tell: frame_2 before frame_10, in whatever order a
    capture lists them."""
    times = np.empty(len(names))
    times[sorted(range(len(names)), key=lambda k: natural_key(names[k]))] = np.linspace(0, 1, len(names))
    return times


def _compare_up(scene: _Scene, frame: GroundFrame, warnings: list[str]) -> None:
    """Warn where the up axis that was told and the one that the cameras suggest contradict each other."""
    doubts: list[str] = []
    up, _ = estimate_up(scene.centers, scene.rotations, scene.points, doubts)
    angle = float(np.degrees(np.arccos(np.clip(frame.rotation[2] @ up, -1, 1))))
    if angle > (UPSIDE_DOWN_DEG if doubts else MAX_UP_DEVIATION_DEG):
        warnings.append(
            f"up is {angle:.0f} degrees away from what cameras and points suggest (used: {frame.description}). "
            "If the scene looks tilted, give --up."
        )


# ------------------------------------------------------------------------------------------------ frames


def _unscaled(scene: _Scene, rotation: np.ndarray, how: str, warnings: list[str]) -> GroundFrame:
    """A frame without metres: the median camera flies at `NOMINAL_CAMERA_HEIGHT` above the median point."""
    length, is_height = view_distance(scene.centers, scene.points, rotation[2])
    if not is_height:
        warnings.append(
            "the cameras are not above the points; the scale is set by their distance instead. "
            "If the scene is upside down, give --up."
        )
    if not length > 0:
        raise CaptureError("all cameras and points lie in one place; this is no scene. Check the sparse model.")
    return _centered(scene, rotation, NOMINAL_CAMERA_HEIGHT / length, False, f"{how}; median camera height = 10 units")


def _with_seen_up(scene: _Scene, world: WorldPrior, warnings: list[str]) -> WorldPrior:
    """The world with the up axis that cameras and points tell, where it has no metres, which a format's own sets have,
    and they contradict the promised one without a doubt; that is said."""
    doubts: list[str] = []
    up, how = estimate_up(scene.centers, scene.rotations, scene.points, doubts)
    if world.metric or doubts or not contradict_up(scene.rotations, world.rotation[2], up):
        return world
    angle = float(np.degrees(np.arccos(np.clip(world.rotation[2] @ up, -1, 1))))
    warnings.append(
        f"{world.how}, but cameras and points tell another up, {angle:.0f} degrees away, which is used ({how}). If "
        "that is wrong, --up z."
    )
    return replace(world, rotation=rotation_to_z(up), how=how)


def _promised(scene: _Scene, world: WorldPrior, warnings: list[str]) -> GroundFrame:
    """The frame that a format promises; its scale is chosen where the format knows no metres."""
    if world.metric:
        return _centered(scene, world.rotation, world.scale, True, world.how)
    return _unscaled(scene, world.rotation, world.how, warnings)


def _centered(scene: _Scene, rotation: np.ndarray, scale: float, metric: bool, how: str) -> GroundFrame:
    middle = _middle(scale * scene.points @ rotation.T)
    return GroundFrame(scale=scale, rotation=rotation, translation=-middle, metric=metric, description=how)


def _middle(points: np.ndarray) -> np.ndarray:
    """The place [3] that becomes the origin: geometric median across, plain median in height."""
    return np.array([*geometric_median(points)[:2], np.median(points[:, 2])])


def transform_pose(camera_from_world: np.ndarray, frame: GroundFrame) -> np.ndarray:
    """The pose [4, 4] of the same camera in the ground frame: rotation re-orthonormalized, center scaled."""
    rotation, translation = camera_from_world[:3, :3], camera_from_world[:3, 3]
    left, _, right = np.linalg.svd(rotation @ frame.rotation.T)
    center = frame.to_ground((-rotation.T @ translation)[None])[0]
    pose = np.eye(4)
    pose[:3, :3] = left @ right
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose
