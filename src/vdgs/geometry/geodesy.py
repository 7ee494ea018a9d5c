"""WGS 84: geodetic coordinates, Earth-centered coordinates and local east-north-up frames, in float64."""

from __future__ import annotations

import numpy as np

#: WGS 84 ellipsoid: semi-major axis in metres and flattening.
SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
#: No camera of a survey is higher, or lower, in metres (choice).
HIGHEST_M = 20_000.0
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


def ecef_from_geodetic(geodetic: np.ndarray) -> np.ndarray:
    """(latitude deg, longitude deg, altitude m) [n, 3] to Earth-centered, Earth-fixed metres [n, 3]."""
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    altitude = geodetic[:, 2]
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    horizontal = (normal + altitude) * np.cos(latitude)
    z = (normal * (1 - ECCENTRICITY2) + altitude) * np.sin(latitude)
    return np.stack([horizontal * np.cos(longitude), horizontal * np.sin(longitude), z], axis=1)


def geodetic_from_ecef(ecef: np.ndarray) -> np.ndarray:
    """The inverse of `ecef_from_geodetic`, by fixed-point iteration (to a micrometre near the ground)."""
    x, y, z = ecef.T
    horizontal = np.hypot(x, y)
    latitude = np.arctan2(z, horizontal * (1 - ECCENTRICITY2))
    for _ in range(8):
        sine = np.sin(latitude)
        normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * sine**2)
        latitude = np.arctan2(z + ECCENTRICITY2 * normal * sine, horizontal)
    sine = np.sin(latitude)
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * sine**2)
    # This form of the altitude stays exact at the poles, where horizontal / cos(latitude) does not.
    altitude = horizontal * np.cos(latitude) + z * sine - normal * (1 - ECCENTRICITY2 * sine**2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude], axis=1)


def is_earth_centered(places: np.ndarray) -> bool:
    """Whether coordinates [n, 3] in metres can be nothing but Earth-centred ones of places where cameras are: near the
    ellipsoid, and farther from the equator than z is high in a projected system."""
    if not np.isfinite(places).all() or np.abs(places[:, 2]).min(initial=np.inf) < HIGHEST_M:
        return False
    return bool((np.abs(geodetic_from_ecef(places)[:, 2]) < HIGHEST_M).all())


def median_place(geodetic: np.ndarray) -> tuple[float, float, float]:
    """The median latitude, longitude (-180 to 180) and altitude of places [n, 3], n > 0, on both sides of the
    antimeridian too."""
    latitude, _, altitude = np.median(geodetic, axis=0).tolist()
    away = np.median(wrap_degrees(geodetic[:, 1] - geodetic[0, 1]))
    return latitude, float(wrap_degrees(geodetic[0, 1] + away)), altitude


def wrap_degrees(angles: np.ndarray) -> np.ndarray:
    """Angles [n] in degrees, brought into the range from -180 to below 180."""
    return (angles + 180.0) % 360.0 - 180.0


def enu_axes(latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Rows: east, north, up as Earth-centered unit vectors, [3, 3]."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    return np.array([[-sin_lon, cos_lon, 0.0], north, [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]])


def enu_from_geodetic(
    geodetic: np.ndarray, origin: tuple[float, float, float], level_at: tuple[float, float] | None = None
) -> np.ndarray:
    """(lat, lon, alt) [n, 3] to east-north-up metres [n, 3] about `origin` (lat, lon, alt).

    `level_at` (lat, lon): the point whose east, north and up the axes are, where it is another one.
    """
    center = ecef_from_geodetic(np.array([origin]))
    return (ecef_from_geodetic(geodetic) - center) @ enu_axes(*(level_at or origin[:2])).T


def geodetic_from_enu(
    enu: np.ndarray, origin: tuple[float, float, float], level_at: tuple[float, float] | None = None
) -> np.ndarray:
    """The inverse of `enu_from_geodetic`."""
    center = ecef_from_geodetic(np.array([origin]))
    return geodetic_from_ecef(enu @ enu_axes(*(level_at or origin[:2])) + center)
