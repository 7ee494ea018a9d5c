"""Where the photographs were taken, as far as they say and as far as that can be believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vdgs.captures.georeference import match_gps, read_gps
from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.sfm.image_metadata import ImageMetadata

#: Positions nearer than this to 0, 0 (degrees) are a receiver without satellites.
NULL_POSITION_DEG = 0.01
#: A position so many times farther from the middle than the median one, and so many metres, is another flight's.
OUTLIER_FACTOR, OUTLIER_DISTANCE_M = 10.0, 1000.0
#: Positions that spread less than this (metres) say nothing: the receiver kept the first, or nobody moved.
MIN_SPREAD_M = 2.0
#: Fewer positions fix no scale and no directions.
MIN_POSITIONS = 3
#: No receiver is better than this, whatever it writes (metres).
MIN_STD_M = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class GpsPriors:
    """Positions in metres east, north, up of an origin, for those photographs that have one."""

    image_indices: np.ndarray
    """Which photographs, [m] int."""
    enu: np.ndarray
    """[m, 3] float64."""
    gps_std: np.ndarray
    """Standard deviations [m, 3] in metres."""
    origin: tuple[float, float, float]
    """Latitude and longitude in degrees, altitude in metres."""
    altitude_reference: str
    source: str
    notes: tuple[str, ...]
    """What people should know: positions left out, and why."""

    def __len__(self) -> int:
        return len(self.image_indices)

    @property
    def usable(self) -> bool:
        """Whether they can place a reconstruction."""
        return len(self) >= MIN_POSITIONS

    def all_positions(self, count: int) -> np.ndarray:
        """Positions of all photographs [count, 3], NaN where there is none."""
        rows = np.full((count, 3), np.nan)
        rows[self.image_indices] = self.enu
        return rows


def read_gps_priors(photographs: Sequence[ImageMetadata], table: Path | None, std_m: tuple[float, float]) -> GpsPriors:
    """Positions from a table (name, lat, lon, alt), or from the photographs themselves.

    Those at 0, 0 and those kilometres away from all others are left out with a note; all of them where they do not
    spread. Raises CaptureError for a table that cannot be read or is another flight's.
    """
    geodetic, source, notes = _read_geodetic(photographs, table)
    names = [photo.name for photo in photographs]
    known = np.isfinite(geodetic[:, :2]).all(axis=1)
    nowhere = known & (np.abs(geodetic[:, :2]) < NULL_POSITION_DEG).all(axis=1)
    if nowhere.any():
        notes.append(f"{_some(names, nowhere)}: the position is 0, 0 (no satellites yet); not used.")
    known &= ~nowhere
    if known.any():
        far = known & _outliers(geodetic, known)
        if far.any():
            notes.append(f"{_some(names, far)}: the position is far from all others; not used.")
        known &= ~far
    flat = known & ~np.isfinite(geodetic[:, 2])
    if flat.any():
        notes.append(f"{_some(names, flat)}: the position has no altitude; not used.")
    known &= ~flat
    index = np.flatnonzero(known)
    origin = _origin(geodetic[index])
    enu = enu_from_geodetic(geodetic[index], origin) if len(index) else np.zeros((0, 3))
    if len(index) >= MIN_POSITIONS and np.ptp(enu[:, :2], axis=0).max() < MIN_SPREAD_M:
        notes.append(
            f"all {len(index)} positions are within {MIN_SPREAD_M:g} m of each other: they tell neither scale nor "
            "north; not used."
        )
        index, enu = index[:0], enu[:0]
    deviations = np.array([_position_std(photographs[i], table, std_m) for i in index.tolist()]).reshape(-1, 3)
    kinds = (
        list(dict.fromkeys(photographs[i].altitude_type for i in index.tolist()))
        if table is None
        else [f"as in {table.name}"]
    )
    if len(kinds) > 1:
        notes.append(f"altitudes are of several kinds ({'; '.join(kinds)}): heights may not fit together.")
    return GpsPriors(
        image_indices=index,
        enu=enu,
        gps_std=deviations,
        origin=origin,
        altitude_reference="; ".join(kinds),
        source=source,
        notes=tuple(notes),
    )


def _read_geodetic(photographs: Sequence[ImageMetadata], table: Path | None) -> tuple[np.ndarray, str, list[str]]:
    """Latitude, longitude, altitude [n, 3], NaN where unknown."""
    geodetic = np.full((len(photographs), 3), np.nan)
    if table is None:
        for row, photo in zip(geodetic, photographs, strict=True):
            row[:2] = photo.lat_lon if photo.lat_lon is not None else np.nan
            row[2] = photo.altitude if photo.altitude is not None else np.nan
        return geodetic, "EXIF", []
    index, given = match_gps([photo.name for photo in photographs], read_gps(table), table)
    geodetic[index] = given
    return geodetic, table.name, []


def _outliers(geodetic: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Positions that cannot be of this flight, [n] bool."""
    middle = np.median(geodetic[known], axis=0)
    level = geodetic.copy()
    level[:, 2] = np.where(np.isfinite(geodetic[:, 2]), geodetic[:, 2], 0.0)
    altitudes = level[known, 2]
    enu = enu_from_geodetic(level, (float(middle[0]), float(middle[1]), float(np.median(altitudes))))
    across = np.linalg.norm(enu[:, :2], axis=1)
    up = np.abs(level[:, 2] - np.median(altitudes))
    with np.errstate(invalid="ignore"):
        return (across > max(OUTLIER_DISTANCE_M, OUTLIER_FACTOR * float(np.median(across[known])))) | (
            up > max(OUTLIER_DISTANCE_M, OUTLIER_FACTOR * float(np.median(up[known])))
        )


def _origin(geodetic: np.ndarray) -> tuple[float, float, float]:
    if not len(geodetic):
        return 0.0, 0.0, 0.0
    latitude, longitude, altitude = (float(value) for value in np.median(geodetic, axis=0))
    return latitude, longitude, altitude


def _position_std(photo: ImageMetadata, table: Path | None, std_m: tuple[float, float]) -> tuple[float, float, float]:
    """A table has `deviation_m` across and upwards; photographs have what a receiver with RTK says, or what EXIF says
    across and as much worse upwards as `deviation_m` is."""
    across, up = std_m
    if table is None and photo.gps_std is not None:
        east, north, height = (max(value, MIN_STD_M) for value in photo.gps_std)
        return east, north, height
    if table is None and photo.gps_error_m is not None:
        error = max(photo.gps_error_m, MIN_STD_M)
        return error, error, error * up / across
    return across, across, up


def _some(names: Sequence[str], which: np.ndarray) -> str:
    chosen = [name for name, take in zip(names, which, strict=True) if take]
    more = len(chosen) - 3
    return ", ".join(chosen[:3]) + (f" and {more} more" if more > 0 else "")
