"""In which coordinates an exported scene stands: local ones about an origin that each file keeps in full precision."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vdgs.export.formats.export_scene import ExportMetadata
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


@dataclass(frozen=True, eq=False)
class LocalFrame(Similarity):
    """From the ground frame to local coordinates, and what a file says of these."""

    facts: ExportMetadata

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

    Gaussians take the similarity that is right about the center: over a kilometre a projection departs from it by
    centimetres, mostly in height (the Earth is round). A middle that is more than `max_coordinate` from the origin of
    the system gets an origin of its own; in `enu` that is a place on Earth, about which x is east, y north and z up
    again, so that what says of the file where it stands is one thing, its latitude, longitude and height. Raises
    VdgsError for a system that cannot be had.
    """
    placement = MapProjection.of(ground, crs)
    similarity = placement.similarity_at(center)
    middle = similarity.apply(center[None])[0]
    origin = np.round(middle / ORIGIN_STEP) * ORIGIN_STEP if np.abs(middle).max() > max_coordinate else np.zeros(3)
    unit = "metre" if placement.unit == "m" else placement.unit
    if placement.crs == "enu" and ground.origin_geo is not None:
        geodetic, turn = _geodetic_at(origin, ground.origin_geo)
        rotation, translation = turn @ similarity.rotation, turn @ (similarity.translation - origin)
        return LocalFrame(similarity.scale, rotation, translation, ExportMetadata(unit=unit, geodetic=geodetic))
    facts = ExportMetadata((float(origin[0]), float(origin[1]), float(origin[2])), placement.wkt, unit)
    return LocalFrame(similarity.scale, similarity.rotation, similarity.translation - origin, facts)


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
