"""In which coordinates an exported scene stands: local ones about an origin that each file keeps in full precision."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from vdgs.export.formats.export_scene import ExportMetadata
from vdgs.export.formats.gaussian_store import even_rows
from vdgs.geometry.geodesy import enu_axes, geodetic_from_enu
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.geometry.map_projection import MapProjection
from vdgs.geometry.similarity import Similarity
from vdgs.model.gaussian_transform import transform_gaussians
from vdgs.model.gaussians import Gaussians

#: Coordinates up to here (m or units) keep a millimetre in float32: they need no origin of their own.
MAX_LOCAL_COORDINATE = 10_000.0
#: A similarity that is taken from a map of space onto itself is off by rounding.
IDENTITY_TOLERANCE = 1e-9
#: Origins are whole multiples of this, so that people can type them.
ORIGIN_STEP = 100.0
#: Where Gaussians stand farther than this (m) from where the map has them, it is said.
MAX_SILENT_DEPARTURE = 0.01
#: So many Gaussians, evenly taken, and so many of the outermost tell how far.
_DEPARTURE_SAMPLE, _OUTERMOST = 10_000, 1000


@dataclass(frozen=True, eq=False)
class LocalFrame(Similarity):
    """From the ground frame to local coordinates, and what a file says of these."""

    facts: ExportMetadata
    #: The map, where it is curved against the ground frame; None where the similarity is exact.
    projection: MapProjection | None = None
    #: The system, for people.
    name: str = ""
    #: What the third coordinate counts from.
    height_reference: str = ""
    #: What a person should know of the system: how it is reached, and whether it is made for this place.
    notes: tuple[str, ...] = ()
    #: Whether x, y and z go from the middle of the Earth, so that no axis is east, north or up.
    is_geocentric: bool = False

    @property
    def is_identity(self) -> bool:
        """Nothing moves: local coordinates are those of the ground frame, to the last bit."""
        apart = np.abs(self.rotation - np.eye(3)).max(), abs(self.scale - 1), np.abs(self.translation).max()
        return bool(max(apart) < IDENTITY_TOLERANCE)

    def to_local(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the ground frame in local coordinates."""
        return (
            gaussians
            if self.is_identity
            else transform_gaussians(gaussians, self.scale, self.rotation, self.translation)
        )

    def points_to_local(self, gaussians: Gaussians) -> Gaussians:
        """The same with their means where the map has them exactly: for files of points, which have no shapes."""
        if self.projection is None:
            return self.to_local(gaussians)
        points = gaussians.means.cpu().double().numpy()
        mapped = self._map_points(points)
        means = np.where(np.isfinite(mapped), mapped, self.apply(points)).astype(np.float32)
        return replace(gaussians, means=torch.from_numpy(means))

    def departure_note(self, means: Float[np.ndarray, "n 3"]) -> str | None:
        """How far Gaussians of these means (ground frame) stand from where the map has them, for people; None where
        that is next to nothing."""
        if self.projection is None:
            return None
        evenly = means[even_rows(len(means), _DEPARTURE_SAMPLE)]
        usual, largest = np.quantile(self._departures(evenly), 0.99), self._departures(_outermost(means)).max()
        if max(usual, largest) <= MAX_SILENT_DEPARTURE:
            return None
        return (
            f"one similarity, right in the middle of the scene, puts all Gaussians on the curved map: they stand up to "
            f"{max(usual, largest):.2f} m from their places (99 of 100 within {usual:.2f} m), mostly in height. Exact "
            "are .laz, .las, .points.ply and, in --crs enu, all files"
        )

    def _departures(self, means: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Metres between where the similarity and the map put points of the ground frame."""
        assert self.projection is not None
        points = means.astype(np.float64)
        mapped = self._map_points(points)
        apart: np.ndarray = np.linalg.norm(np.nan_to_num(self.apply(points) - mapped, posinf=0, neginf=0), axis=1)
        return apart * (self.projection.meters_per_unit or 1.0)

    def _map_points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points of the ground frame in local coordinates, by the map; not finite where it does not reach."""
        assert self.projection is not None
        return self.projection.project_if_reached(points) - self.facts.origin

    def to_ground(self, gaussians: Gaussians) -> Gaussians:
        """The inverse of `to_local`."""
        back = self.rotation.T
        return (
            gaussians
            if self.is_identity
            else transform_gaussians(gaussians, 1 / self.scale, back, -back @ self.translation / self.scale)
        )


def make_local_frame(
    ground: GroundFrame, crs: str | None, center: Float[np.ndarray, "3"], max_coordinate: float = MAX_LOCAL_COORDINATE
) -> LocalFrame:
    """The local coordinates of a system (`MapProjection.of`) about a scene whose middle is `center` (ground frame).

    Gaussians take the similarity that is right about the center: a projection departs from it, mostly in height (the
    Earth is round), by centimetres a kilometre away and by metres at five (`departure_note`). A middle that is more
    than `max_coordinate` from the origin of the system gets an origin of its own; in `enu` that is a place on Earth,
    about which x is east, y north and z up again, so that what says of the file where it stands is one thing, its
    latitude, longitude and height. Raises VdgsError for a system that cannot be had.
    """
    placement = MapProjection.of(ground, crs)
    similarity = placement.similarity_at(center)
    middle = similarity.apply(center[None])[0]
    origin = np.round(middle / ORIGIN_STEP) * ORIGIN_STEP if np.abs(middle).max() > max_coordinate else np.zeros(3)
    unit = "metre" if placement.unit == "m" else placement.unit
    if placement.crs == "enu" and ground.origin_geo is not None:
        geodetic, turn = _geodetic_at(origin, ground.origin_geo)
        rotation, translation = turn @ similarity.rotation, turn @ (similarity.translation - origin)
        about = replace(ground, origin_geo=geodetic)
        named = MapProjection.of(about, "enu")
        facts = ExportMetadata(unit=unit, geodetic=geodetic, has_compass=True)
        return LocalFrame(
            similarity.scale, rotation, translation, facts, None, named.name, named.height_reference,
        )  # fmt: skip
    facts = ExportMetadata(
        (float(origin[0]), float(origin[1]), float(origin[2])), placement.wkt, unit,
        has_compass=placement.wkt is not None or ground.origin_geo is not None,
    )  # fmt: skip
    curved = placement if placement.wkt is not None else None
    return LocalFrame(
        similarity.scale, similarity.rotation, similarity.translation - origin, facts, curved, placement.name,
        placement.height_reference, placement.notes, placement.is_geocentric,
    )  # fmt: skip


def _outermost(means: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Those farthest from the middle."""
    if len(means) <= _OUTERMOST:
        return means
    squares = ((means - np.median(means, axis=0)) ** 2).sum(1)
    return means[np.argpartition(squares, -_OUTERMOST)[-_OUTERMOST:]]


def _geodetic_at(
    origin: Float[np.ndarray, "3"], about: tuple[float, float, float]
) -> tuple[tuple[float, float, float], Float[np.ndarray, "3 3"]]:
    """Latitude, longitude (deg) and ellipsoidal height (m) of what lies `origin` east, north and up of `about`, and
    the rotation from the axes there to those at that place."""
    if not origin.any():
        return about, np.eye(3)
    latitude, longitude, height = (float(each) for each in geodetic_from_enu(origin[None], about)[0])
    return (latitude, longitude, height), enu_axes(latitude, longitude) @ enu_axes(*about[:2]).T


def default_crs(ground: GroundFrame, path: Path) -> str | None:
    """The system that people expect of a file: point clouds for maps in map coordinates, the globe for 3D Tiles,
    east, north and up (or those of maps, without a georeference) for what is only looked at."""
    if path.suffix.lower() in (".laz", ".las") or ground.origin_geo is None:
        return None
    return "enu"
