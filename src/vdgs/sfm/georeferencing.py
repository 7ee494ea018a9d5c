"""Where a model lies: by surveyed points, positions, a known distance, or none of them; and what speaks against it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vdgs.captures.flight_extent import LOCAL_METERS, why_no_scene
from vdgs.captures.plane_fit import mirrored
from vdgs.captures.position_adjustment import Up
from vdgs.captures.reconstruction import AccuracyFacts, GcpReport
from vdgs.captures.table_columns import FOOT_M
from vdgs.captures.turned_views import are_turned_over
from vdgs.config.sfm_options import SfmOptions
from vdgs.errors import CaptureError
from vdgs.geometry.similarity import Similarity, rotation_to_z
from vdgs.sfm import gcp_adjustment, georegistration
from vdgs.sfm.attitude_readings import confirmed_by_model
from vdgs.sfm.bending import bend_to_positions, tell_level
from vdgs.sfm.focal_decision import OF_LENSES
from vdgs.sfm.gcp_list import GcpList
from vdgs.sfm.georegistration import AlignmentFailure, Georegistration
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.height_units import (
    GPS_ACROSS_M,
    GPS_UP_M,
    HEIGHTS_M,
    IN_FEET,
    are_in_feet,
    in_feet,
    of_gps,
    with_height_unit,
)
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.reprojection import drop_unseen_observations
from vdgs.sfm.scale_bars import known_scale
from vdgs.sfm.up_direction import BY_ATTITUDES, model_centers, model_points, up_of
from vdgs.sfm.view_stretch import Stretch, find_stretch, stretched, with_stretch
from vdgs.system.lazy_pycolmap import pycolmap

WITHOUT = (
    "give a known distance (--scale-bar), or the same command without --georeference off: the finished capture is "
    "placed anew in seconds."
)
#: Control points and scene disagree if a fit leaves them farther off (RMS) than this share of their spread (choice).
MOST_OFF = 0.1
#: Up by control points and by the photographs may differ by so many degrees (choice).
MOST_TILTED_DEG = 60.0
#: Scales that differ by so much (share) beside what they may be wrong by contradict each other (choice).
SCALES_APART = 0.1


@dataclass(frozen=True, eq=False)
class Georeferenced:
    """A model where it belongs, its median point at height 0."""

    model: pycolmap.Reconstruction
    placed: Georegistration | AlignmentFailure
    origin: tuple[float, float, float] | None
    """Latitude and longitude in degrees, altitude in metres; None where they are not known."""
    survey: tuple[GcpReport, ...]
    control: GcpList | None
    """Surveyed points as they were read: in the unit of heights that the model tells."""
    photographs: tuple[ImageMetadata, ...]
    """Those of the plan, with attitudes by the readings that the model confirms."""
    notes: tuple[str, ...] = ()
    """Which cameras' angles are read otherwise than before."""
    focal_by: str = ""
    """What told the focal length after the photographs could not; empty where nothing did."""


def georeference(model: pycolmap.Reconstruction, prepared: ReconstructionPlan, held: tuple[bool, str]) -> Georeferenced:
    """Bring a model, which may change, to metres east, north, up. `held`: whether its focal length was, and why.

    Raises CaptureError for what contradicts itself or the photographs: then nothing should be written.
    """
    drop_unseen_observations(model)
    photographs, notes = confirmed_by_model(model, prepared.image_list.images)
    prepared = replace(prepared, image_list=replace(prepared.image_list, images=photographs))
    doubts = Doubts.of(model, prepared) if prepared.gcps is not None else None
    if doubts is not None:
        prepared, of_heights = _with_height_unit(model, prepared, doubts)
        doubts, notes = replace(doubts, altitude=prepared.origin[2]), (*notes, *of_heights)
    control = prepared.gcps
    doubtful, stretch = frozenset[str](), None
    placed: Georegistration | AlignmentFailure
    if doubts is not None and control is not None and control.has_control_points:
        model, placed, doubtful = _by_control(model, prepared, held[0], doubts)
    else:
        model, stretch = _stretched(model, prepared, held)
        placed = _by_positions(model, prepared)
        if isinstance(placed, Georegistration):
            placed = with_stretch(placed, stretch, model)
            georegistration.transform_model(model, placed.similarity)
            model, placed = _bent(model, placed, prepared, held[0] or (stretch is not None and held[1] != OF_LENSES))
    if isinstance(placed, AlignmentFailure):
        return Georeferenced(model, _upright(model, photographs, placed), None, (), control, photographs, notes)
    survey: tuple[GcpReport, ...] = ()
    if control is not None and placed.is_georeferenced:
        survey = gcp_adjustment.measure_gcps(
            model, control, prepared.origin, doubtful, _knows_altitude(prepared, placed)
        )
    ground = float(np.median(model_points(model)[:, 2]))
    _refuse_no_scene(model, ground, placed, prepared)
    _refuse_upside_down(model, ground, placed, prepared)
    georegistration.transform_model(model, Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -ground])))
    latitude, longitude, altitude = prepared.origin
    altitude = altitude + ground if _knows_altitude(prepared, placed) else 0.0
    origin = (latitude, longitude, altitude) if placed.is_georeferenced else None
    focal_by = stretch.told_by if stretch is not None else ""
    return Georeferenced(model, placed, origin, survey, control, photographs, notes, focal_by)


def _upright(
    model: pycolmap.Reconstruction, photographs: Sequence[ImageMetadata], failure: AlignmentFailure
) -> AlignmentFailure:
    """Turn a model that nothing brings to metres so that z is up, where recorded attitudes tell that."""
    up, _ = up_of(model, photographs)
    if up.how != BY_ATTITUDES:
        return failure
    georegistration.transform_model(model, Similarity(1.0, rotation_to_z(up.direction), np.zeros(3)))
    return replace(failure, up=up.how)


def _knows_altitude(prepared: ReconstructionPlan, placed: Georegistration) -> bool:
    """Whether control points or positions say how high the place is."""
    control = prepared.gcps
    used = prepared.gps_priors.has_altitudes and (placed.accuracy is None or placed.accuracy.altitude != "none")
    return used or (control is not None and control.has_heights)


def _stretched(
    model: pycolmap.Reconstruction, prepared: ReconstructionPlan, held: tuple[bool, str]
) -> tuple[pycolmap.Reconstruction, Stretch | None]:
    """The model with the focal length and the heights that recorded heights and tags tell, where its own views are too
    parallel to tell them."""
    if prepared.request.options.georeference == "off":
        return model, None
    photographs, positions = prepared.image_list.images, prepared.gps_priors
    stretch = find_stretch(model, photographs, positions, held, _are_stated(prepared))
    if stretch is not None and stretch.log:
        model = stretched(model, stretch, prepared.threads)
        drop_unseen_observations(model)
    return model, stretch


def _are_stated(prepared: ReconstructionPlan) -> bool:
    """Whether a person says how good the positions of a table are."""
    request = prepared.request
    return request.gps is not None and request.options.gps_std_m != SfmOptions.gps_std_m


def _by_positions(model: pycolmap.Reconstruction, prepared: ReconstructionPlan) -> Georegistration | AlignmentFailure:
    photographs, positions, options = prepared.image_list.images, prepared.gps_priors, prepared.request.options
    scale = known_scale(model, prepared.scale_bars) if prepared.scale_bars is not None else None
    anyway = options.georeference == "anyway"
    if options.georeference == "off":
        placed: Georegistration | AlignmentFailure = AlignmentFailure("asked for: --georeference off", WITHOUT)
    else:
        stated = _are_stated(prepared)
        alone = georegistration.georegister(model, photographs, positions, None, anyway, stated)
        placed = (
            alone
            if scale is None
            else georegistration.georegister(model, photographs, positions, scale, anyway, stated)
        )
        if scale is not None and isinstance(alone, Georegistration) and not anyway:
            _refuse_another_scale(scale, alone, prepared)
    if scale is None or prepared.scale_bars is None:
        return placed
    if isinstance(placed, Georegistration):
        return replace(placed, method=f"{placed.method}; scale by a known distance ({prepared.scale_bars.source})")
    return _by_distance(model, scale, placed, prepared)


def _by_distance(
    model: pycolmap.Reconstruction, scale: tuple[float, float], why: AlignmentFailure, prepared: ReconstructionPlan
) -> Georegistration:
    """Metres and up alone."""
    assert prepared.scale_bars is not None
    up, notes = up_of(model, prepared.image_list.images)
    factor, share = scale
    rotation = rotation_to_z(up.direction)
    centers = model_centers(model)
    middle = np.append(np.median(centers @ rotation.T, axis=0)[:2], 0.0)
    edge = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    accuracy = AccuracyFacts(
        place_m=None, scale_percent=200 * share, scale_m=2 * share * factor * edge, north_deg=None,
        level_deg=2 * up.deviation_deg, positions_m=None, altitude="unused",
    )  # fmt: skip
    how = f"a known distance ({prepared.scale_bars.source}): metres, up by {up.how}; no place on Earth ({why.reason})"
    none = np.zeros((0, 3))
    return Georegistration(
        similarity=Similarity(factor, rotation, -factor * middle),
        method=how,
        position_rows=np.zeros(0, int),
        targets=none,
        residuals=none,
        inliers=np.zeros(0, bool),
        accuracy=accuracy,
        notes=tuple(notes),
        is_georeferenced=False,
    )


def _refuse_another_scale(scale: tuple[float, float], alone: Georegistration, prepared: ReconstructionPlan) -> None:
    assert prepared.scale_bars is not None
    assert alone.accuracy is not None
    ratio = scale[0] / alone.similarity.scale
    known = (alone.accuracy.scale_percent or 0.0) / 100 + 3 * scale[1]
    if abs(math.log(ratio)) > SCALES_APART + known:
        raise CaptureError(
            f"{prepared.scale_bars.source}: its distances make the scene {ratio:.3g} times as large as the positions "
            f"({prepared.gps_priors.source}) do, which are good to ±{alone.accuracy.scale_percent:.2g} %."
            f"{in_feet(ratio)} Mend it, or leave the positions out: --georeference off"
        )


def _bent(
    model: pycolmap.Reconstruction, placed: Georegistration, prepared: ReconstructionPlan, hold_focal: bool
) -> tuple[pycolmap.Reconstruction, Georegistration]:
    """The model bent by positions that are good for that, and how far they are from it then. What is bent fits them
    better: how large, how level and where it is comes anew of all that is known, if they plainly tell level."""
    photographs, positions = prepared.image_list.images, prepared.gps_priors
    bent = bend_to_positions(model, photographs, positions, placed, hold_focal, prepared.threads)
    if bent is model:
        return model, placed
    up, _ = up_of(model, photographs)
    anew = _by_positions(bent, prepared) if tell_level(placed, up) else None
    if isinstance(anew, Georegistration) and anew.is_georeferenced:
        georegistration.transform_model(bent, anew.similarity)
    lies = georegistration.registration_in_place(bent, photographs, positions, placed.method)
    off = lies.targets - placed.targets
    return bent, replace(placed, residuals=lies.residuals + off[:, : lies.residuals.shape[1]])


def _with_height_unit(
    model: pycolmap.Reconstruction, prepared: ReconstructionPlan, doubts: Doubts
) -> tuple[ReconstructionPlan, list[str]]:
    """The plan with surveyed heights in the unit that model and GPS tell, where the list says none, and what to say of
    that. With `--georeference anyway` the list is used as it is."""
    control = prepared.gcps
    if control is None or control.unsaid_height_unit_m is None:
        return prepared, []
    anyway = prepared.request.options.georeference == "anyway"
    seen = {} if anyway else gcp_adjustment.triangulate_all(model, control)
    located, pixel = {k: each.position for k, each in seen.items()}, gcp_adjustment.pixel_at(model, list(seen.values()))
    read, note = with_height_unit(control, located, prepared.origin, pixel, doubts.by_gps, doubts.gps)
    return replace(prepared, gcps=read), [note] if note else []


def _by_control(
    model: pycolmap.Reconstruction, prepared: ReconstructionPlan, hold_focal: bool, doubts: Doubts
) -> tuple[pycolmap.Reconstruction, Georegistration, frozenset[str]]:
    photographs, control = prepared.image_list.images, prepared.gcps
    assert control is not None
    anyway = prepared.request.options.georeference == "anyway"
    gps = doubts.by_gps
    place = gps.accuracy.place_m if gps is not None and gps.accuracy is not None else None
    level = gcp_adjustment.Level(
        up=doubts.up.direction, deviation_deg=doubts.up.deviation_deg, gps=None if gps is None else gps.similarity,
        gps_up_m=place[1] if place is not None and len(place) > 1 else None,
    )  # fmt: skip
    found = gcp_adjustment.adjust_to_gcps(
        model, control, prepared.origin, hold_focal, prepared.threads, level, None if anyway else doubts
    )
    notes = found.notes
    if prepared.scale_bars is not None:
        factor, _ = known_scale(found.model, prepared.scale_bars)
        notes += (f"the distances of {prepared.scale_bars.source} are {1 / factor:.2%} of what they should be.",)
    positions = prepared.gps_priors
    if positions.over_take_off and control.has_heights:  # which tell nothing of heights over the sea
        positions = replace(positions, has_altitudes=False)
    placed = georegistration.registration_in_place(
        found.model, photographs, positions, found.how, found.accuracy, notes
    )
    placed = replace(placed, notes=(*notes, *of_gps(placed, gps, control.source, doubts.gps)))
    return found.model, placed, found.doubtful


@dataclass(frozen=True, eq=False, kw_only=True)
class Doubts:
    """What photographs and positions say against a similarity to control points."""

    up: Up
    centers: np.ndarray
    """Of the cameras, in the model's world."""
    by_gps: Georegistration | None
    gps: str
    altitude: float
    """Of the origin that metres up count from."""

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, prepared: ReconstructionPlan) -> Doubts:
        photographs, positions = prepared.image_list.images, prepared.gps_priors
        try:
            by_gps = georegistration.georegister(model, photographs, positions)
        except CaptureError:  # positions that are mirrored say nothing of control points
            by_gps = AlignmentFailure("", "")
        return cls(
            up=up_of(model, photographs)[0],
            centers=model_centers(model),
            by_gps=_at_sea(by_gps, positions) if isinstance(by_gps, Georegistration) else None,
            gps=positions.source,
            altitude=prepared.origin[2],
        )

    def __call__(self, similarity: Similarity, places: np.ndarray, targets: np.ndarray) -> str:
        """What speaks against a similarity from places [n, 3] to surveyed ones, in words; empty where nothing does."""
        return (
            self._of_hands(similarity, places, targets)
            or self._of_fit(similarity, places, targets)
            or self._of_gps(similarity, targets)
        )

    def _of_hands(self, similarity: Similarity, places: np.ndarray, targets: np.ndarray) -> str:
        up = similarity.rotation @ self.up.direction
        tilted = float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))
        others = {"x": targets[:, [1, 0, 2]]} if self.up.sure else {}
        exchanged = mirrored(places, targets, self.up.direction, others)
        if exchanged or (self.up.sure and tilted > MOST_TILTED_DEG):
            return (
                f"placed by it the world would be turned by {tilted:.0f}° from what the photographs say of up"
                f"{', its own mirror image' if exchanged or tilted > 90 else ''}. Are x (east) and y (north) exchanged?"
                f"{self.up.doubt}"
            )
        return ""

    def _of_fit(self, similarity: Similarity, places: np.ndarray, targets: np.ndarray) -> str:
        off = float(np.sqrt(((similarity.apply(places) - targets) ** 2).sum(axis=1).mean()))
        spread = float(np.sqrt(np.var(targets, axis=0).sum()))
        if off <= MOST_OFF * spread:
            return ""
        return (
            f"its points and where the photographs show them disagree by {off:.3g} m over {spread:.3g} m. Are names, "
            "marks and the system right, and x, y and z in the same unit?"
        )

    def _of_gps(self, similarity: Similarity, targets: np.ndarray) -> str:
        if self.by_gps is None or self.by_gps.accuracy is None or self.by_gps.accuracy.place_m is None:
            return ""
        accuracy, gps = self.by_gps.accuracy, self.by_gps.similarity
        error_across, *error_up = self.by_gps.accuracy.place_m
        ratio = similarity.scale / gps.scale
        if abs(math.log(ratio)) > SCALES_APART + (accuracy.scale_percent or 0.0) / 100:
            return (
                f"its points make the scene {ratio:.3g} times as large as GPS ({self.gps}) does, which is good to "
                f"±{accuracy.scale_percent:.2g} %.{in_feet(ratio)}"
            )
        off = np.median(similarity.apply(self.centers) - gps.apply(self.centers), axis=0)
        across = float(np.hypot(off[0], off[1]))
        if across > GPS_ACROSS_M + error_across:
            return (
                f"its points lie {_distance(across)} from where GPS ({self.gps}) has them, which is good to "
                f"±{error_across:.2g} m. Is it the right system and zone, x (east) before y (north)?"
            )
        height = float(np.median(targets[:, 2]))
        level = float(np.median(targets[:, 2]) - off[2])
        if error_up and abs(off[2]) > GPS_UP_M + error_up[0]:
            feet = are_in_feet(float(off[2]), self._altitude_off_in_feet(height, level), error_up[0])
            if feet or abs(off[2]) > HEIGHTS_M:
                return (
                    f"its heights are {_distance(abs(float(off[2])))} {'over' if off[2] > 0 else 'under'} those of GPS "
                    f"({self.gps}).{IN_FEET if feet else ' Are they metres?'}"
                )
        return ""

    def _altitude_off_in_feet(self, height: float, level: float) -> float:
        """How far heights would be from those of GPS if they were in feet; heights here count from the origin."""
        return FOOT_M * (height + self.altitude) - (level + self.altitude)


def _at_sea(placed: Georegistration, positions: GpsPriors) -> Georegistration:
    """The same without an accuracy up where heights count from the take-off: they say nothing against heights over the
    sea."""
    if not positions.over_take_off or placed.accuracy is None or placed.accuracy.place_m is None:
        return placed
    return replace(placed, accuracy=replace(placed.accuracy, place_m=placed.accuracy.place_m[:1]))


def _distance(meters: float) -> str:
    return f"{meters / 1000:.3g} km" if meters >= 1000 else f"{meters:.3g} m"


def _refuse_no_scene(
    model: pycolmap.Reconstruction, ground: float, placed: Georegistration, prepared: ReconstructionPlan
) -> None:
    """Raise CaptureError for a placed world that is larger than any, whatever made it so."""
    if why := why_no_scene(model_centers(model), ground):
        raise CaptureError(
            f"placed by {placed.method} ({prepared.gps_priors.source}), {why}. Are metres or feet read as degrees or "
            "kilometres? Mend them, or say --georeference off (without positions). " + LOCAL_METERS + "."
        )


def _refuse_upside_down(
    model: pycolmap.Reconstruction, ground: float, placed: Georegistration, prepared: ReconstructionPlan
) -> None:
    """Raise CaptureError for a placed world whose cameras look at the sky from under the ground, though none did: by
    what is known of up, or, where that is in doubt, by how far up they look."""
    if prepared.request.options.georeference == "anyway":
        return
    images = [image for image in model.images.values() if image.has_pose]
    height = float(np.median([image.projection_center()[2] for image in images])) - ground
    up, _ = up_of(model, prepared.image_list.images)
    views = np.array([image.cam_from_world().rotation.matrix() for image in images])
    is_doubted = not up.sure and height < 0 and are_turned_over(views)
    if up.direction[2] < 0 and (up.sure or is_doubted):
        raise CaptureError(
            f"placed by {placed.method}, the cameras would be {abs(height):.3g} m "
            f"{'under' if height < 0 else 'over'} the "
            f"ground and look up, against what the photographs show. Are east and north (x and y, latitude and "
            f"longitude) exchanged, or is a hemisphere missing?{up.doubt} {georegistration.ANYWAY}"
        )
