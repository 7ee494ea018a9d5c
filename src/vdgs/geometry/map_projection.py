"""From the ground frame to the coordinates of a map, and back, in float64.

A georeferenced ground frame is a plane tangent to the Earth (ENU), which differs from a map projection by centimetres
in height over a kilometre, by the meridian convergence and by the scale factor. Points therefore pass through
Earth-centered and geodetic coordinates (pyproj); tiles and shapes of Gaussians take the similarity that is exact at one
point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vdgs.errors import VdgsError
from vdgs.geometry.crs import CrsTransform, open_crs, utm_epsg
from vdgs.geometry.geodesy import enu_axes, enu_from_geodetic, geodetic_from_enu
from vdgs.geometry.ground_frame import UNKNOWN_UNIT, GroundFrame
from vdgs.geometry.similarity import Similarity

MapPoints = Float[np.ndarray, "n 3"]

#: What `--crs` may be, for messages and help.
CRS_CHOICES = "EPSG:n (such as EPSG:25832), enu, source or local"
#: Half the distance in metres (or units) over which a local similarity is taken from the exact map (choice).
_STEP = 20.0


@dataclass(frozen=True, eq=False, kw_only=True)
class MapProjection:
    """Coordinates of a target system for points of a ground frame. Made by `MapProjection.of`."""

    #: What `--crs` would say: "EPSG:32611", "enu", "source" or "local".
    crs: str
    #: For people: "WGS 84 / UTM zone 11N (EPSG:32611)".
    name: str
    #: What one unit of the target is called: "m", "US survey foot", "units".
    unit: str
    #: Metres per unit of the target; None where nobody knows them.
    meters_per_unit: float | None
    #: WKT 2 of a projected or geocentric system; None for the others, which no catalogue holds.
    wkt: str | None
    #: What the third coordinate counts from.
    height_reference: str
    #: What a person should know about the accuracy.
    notes: tuple[str, ...]
    #: Whether coordinates count from the middle of the Earth: no axis is east, north or up.
    is_geocentric: bool = False
    _forward: Callable[[MapPoints], MapPoints]
    _backward: Callable[[MapPoints], MapPoints]

    @classmethod
    def of(cls, ground: GroundFrame, crs: str | None = None) -> MapProjection:
        """The placement of a ground frame in the system that `crs` names (`CRS_CHOICES`).

        None: the UTM zone of the origin where the frame is georeferenced, "source" where it is a site's that was moved,
        else "local", the ground frame itself.
        Raises VdgsError for a system that is unknown, in degrees, not to the east and north, or needs a georeference
        that is not there, and where pyproj is not installed.
        """
        name = (crs or _usual_name(ground)).strip()
        if name.lower() == "local":
            return _local(ground)
        if name.lower() == "source":
            return _source(ground)
        name = f"EPSG:{name}" if name.isdecimal() else name
        if name.lower() != "enu" and not name.upper().startswith("EPSG:"):
            raise VdgsError(f"--crs {name}: is no coordinate system known here. Give {CRS_CHOICES}.")
        if ground.origin_geo is None:
            raise VdgsError(
                f"--crs {name}: the capture is not georeferenced ({ground.description}). Give --crs local, "
                "or start a run with positions: `vdgs run CAPTURE --gps TABLE.csv` or `vdgs run CAPTURE --georef JSON`."
            )
        return _enu(ground) if name.lower() == "enu" else _projected(ground, open_crs(name, ground.origin_geo))

    def project(self, points: MapPoints) -> MapPoints:
        """Points of the ground frame [n, 3] to coordinates of the target (east or x, north or y, height), exactly.

        Raises VdgsError where the target's projection does not reach.
        """
        return self._checked(self.project_if_reached(points))

    def project_if_reached(self, points: MapPoints) -> MapPoints:
        """The same, not finite where the target's projection does not reach."""
        return self._forward(np.asarray(points, np.float64))

    def to_ground(self, points: MapPoints) -> MapPoints:
        """The inverse of `project`."""
        return self._checked(self._backward(np.asarray(points, np.float64)))

    def similarity_at(self, center: Float[np.ndarray, "3"]) -> Similarity:
        """The similarity from the ground frame to the target that is right about `center`, a ground point [3].

        The rotation holds the meridian convergence and the tilt of the horizon, the scale is that of the horizontal
        plane: over a hundred metres, `project` is met to a millimetre across, and in height to the map's scale
        factor (4 cm on a house of 100 m in the middle of a UTM zone).
        """
        center = np.asarray(center, np.float64)
        steps = _STEP * np.concatenate([np.eye(3), -np.eye(3)])
        ahead, behind = np.split(self.project(center + steps), 2)
        jacobian = (ahead - behind).T / (2 * _STEP)
        left, _, right = np.linalg.svd(jacobian)
        rotation = left @ right
        # The plane's own scale: a projection scales areas of the ground, heights it passes on.
        scale = float(np.sqrt(np.linalg.norm(np.cross(jacobian[:, 0], jacobian[:, 1]))))
        return Similarity(scale, rotation, self.project(center[None])[0] - scale * rotation @ center)

    def true_north(self, ground: GroundFrame, center: Float[np.ndarray, "3"]) -> float | None:
        """Where north is at a point of the ground frame: degrees clockwise from the second axis of the target, between
        -180 and 180. None where the frame stands at no known place on Earth.

        In the middle of a UTM zone it is 0, and within 4 degrees in all of it; in a polar system any angle.
        """
        if ground.origin_geo is None:
            return None
        place = geodetic_from_enu(np.asarray(center, np.float64)[None], ground.origin_geo, ground.axes_origin)[0]
        north = enu_axes(*ground.axes_origin) @ enu_axes(float(place[0]), float(place[1]))[1]
        x, y, _ = self.similarity_at(center).rotation @ north
        return float(np.degrees(np.arctan2(x, y)))

    def stretch_at(self, center: Float[np.ndarray, "3"]) -> float:
        """How many times as long as on the ground lengths are in the target, at a point of the ground frame; 1 where
        nobody knows its unit."""
        return 1.0 if self.meters_per_unit is None else self.similarity_at(center).scale * self.meters_per_unit

    def _checked(self, found: MapPoints) -> MapPoints:
        if not np.isfinite(found).all():
            raise VdgsError(f"--crs {self.crs}: {self.name} does not reach this place. Give the system of its country.")
        return found


def _usual_name(ground: GroundFrame) -> str:
    if ground.origin_geo is not None:
        return utm_epsg(*ground.origin_geo[:2])
    return "source" if ground.is_moved_site else "local"


def _local(ground: GroundFrame) -> MapProjection:
    if ground.metric:
        name, heights = "ground frame, local metres", "metres above the origin of the ground frame"
        axes = " (x east, y north)" if ground.origin_geo else ""
    else:
        name, heights = "ground frame, local units without known size", "units above the origin of the ground frame"
        axes = ""
    return MapProjection(
        crs="local", name=name + axes, unit=ground.unit, meters_per_unit=1.0 if ground.metric else None, wkt=None,
        height_reference=heights, notes=(), _forward=np.copy, _backward=np.copy,
    )  # fmt: skip


def _source(ground: GroundFrame) -> MapProjection:
    meters = ground.scale if ground.metric else None
    unit = "m" if meters is not None and abs(meters - 1) < 1e-9 else UNKNOWN_UNIT
    name, heights = "the capture's own coordinates", "the third coordinate of the capture's own world"
    return MapProjection(
        crs="source", name=name, unit=unit, meters_per_unit=meters, wkt=None, height_reference=heights, notes=(),
        _forward=ground.apply_inverse, _backward=ground.to_ground,
    )  # fmt: skip


def _enu(ground: GroundFrame) -> MapProjection:
    """East, north and up at the origin of the ground frame, whose own axes may be those of another place."""
    assert ground.origin_geo is not None
    latitude, longitude, altitude = ground.origin_geo
    turned = enu_axes(latitude, longitude) @ enu_axes(*ground.axes_origin).T
    name = f"east, north, up about latitude {latitude:.7f}, longitude {longitude:.7f}, height {altitude:.2f} m"
    heights = f"metres above the horizon plane of the origin, which has the height {altitude:.2f} m"
    return MapProjection(
        crs="enu", name=name, unit="m", meters_per_unit=1.0, wkt=None, height_reference=heights, notes=(),
        _forward=lambda points: points @ turned.T, _backward=lambda places: places @ turned,
    )  # fmt: skip


def _projected(ground: GroundFrame, projection: CrsTransform) -> MapProjection:
    origin, level_at = ground.origin_geo, ground.axes_origin
    assert origin is not None

    def forward(points: MapPoints) -> MapPoints:
        return projection.from_geodetic(geodetic_from_enu(points, origin, level_at))

    def backward(places: MapPoints) -> MapPoints:
        return enu_from_geodetic(projection.to_geodetic(places), origin, level_at)

    names = ("unit", "meters_per_unit", "wkt", "height_reference", "notes", "is_geocentric")
    shared = {name: getattr(projection, name) for name in names}
    name = f"{projection.name} ({projection.code})"
    return MapProjection(crs=projection.code, name=name, _forward=forward, _backward=backward, **shared)
