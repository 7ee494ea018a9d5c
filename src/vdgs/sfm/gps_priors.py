"""Where the photographs were taken, as far as they say and as far as that can be believed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from vdgs.captures.flight_extent import why_no_flight
from vdgs.captures.georeference import match_rows, unmatched_notes
from vdgs.captures.gps_altitudes import refuse_unit, with_altitudes, without_zero_altitudes, wrong_unit
from vdgs.captures.gps_tables import GpsRow, read_gps_table
from vdgs.captures.odd_positions import MIN_SPREAD_M, are_far_off, are_nowhere, do_not_spread, places_apart
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import enu_from_geodetic, median_place, wrap_degrees
from vdgs.sfm.exif_gps import BY_MAKER, IN_EXIF
from vdgs.sfm.flights import STEP_M, flights_of
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.take_off_heights import OVER_KNOWN_TAKE_OFF, OVER_TAKE_OFF, with_take_off_heights
from vdgs.system.units import first_names

#: A table whose positions are this near to those in the photographs is of the same flight (degrees).
SAME_FLIGHT_DEG = 0.05
#: Altitudes of a table that lie so far from those of the photographs (metres) are told: as far as a datum is off in few
#: places, and nearer than heights over the ground are to those over the sea (choice).
TOLD_ALTITUDE_M = 20.0
#: And positions that lie so far from them across (metres), or farther than both are stated to be good to (choice: more
#: than a receiver without corrections is off).
TOLD_OFFSET_M = 20.0
#: What altitudes are measured from where none is known.
ALTITUDE_UNKNOWN = "not recorded; 0 is that of the median point"
#: What altitudes may be rounded to (metres; feet among them), and from how many positions on that is told; their error
#: then, as a share of the step (choice: nobody says whether they were rounded or cut off).
STEPS_M, LEAST_ROUNDED, ROUNDING_ERROR = (100.0, 50.0, 30.48, 20.0, 10.0, 5.0, 3.048, 2.0, 1.0), 8, 1 / 3
#: Fewer different altitudes are rather the levels of a plan (rings, strips of a wall), unless at least so many
#: photographs differ from those before and after, which have one altitude: a drone that sways about a step (choices).
LEAST_DIFFERENT, LEAST_SWAYING = 5, 2
#: Altitudes that are this near to a step (metres) are on it.
ON_STEP_M = 0.02
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
    are_stated: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """Which of them [m] a receiver or a table states; empty where none is."""
    origin: tuple[float, float, float]
    """Latitude and longitude in degrees, altitude in metres."""
    altitude_reference: str
    source: str
    notes: tuple[str, ...]
    """What people should know: positions left out, and why."""
    has_altitudes: bool = True
    """False where most positions have none: then heights here are 0, and positions count in the plane alone."""
    over_take_off: bool = False
    """Whether some heights count from the take-off: then they say nothing of the sea."""
    flights: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Numbers [m] of the flights of the positions, whose altitudes may differ by a datum; empty where none is told."""
    datum_errors_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """How far each may be off [m] by the datum that it was of; empty where all are of WGS 84."""
    altitude_step_m: float = 0.0
    """What altitudes are rounded to; 0 where that is not seen."""
    table: Path | None = None
    """The table that their altitudes are of; None for those of the photographs themselves."""

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


@dataclass(frozen=True, eq=False)
class _Recorded:
    """What the photographs or a table say of all places."""

    geodetic: np.ndarray
    """Latitude, longitude, altitude [n, 3], NaN where unknown."""
    kinds: list[str]
    """What each altitude is measured from."""
    source: str
    notes: list[str]
    rows: Mapping[int, GpsRow]
    """Rows of a table by the photographs that they are of."""
    datum_error_m: float = 0.0
    """How far all places of a table may be off by its datum."""


def read_gps_priors(photographs: Sequence[ImageMetadata], table: Path | None, std_m: tuple[float, float]) -> GpsPriors:
    """Positions from a table, or from the photographs themselves.

    Those at 0, 0 and those kilometres away from all others are left out with a note; all of them where they do not
    spread. Raises CaptureError for a table that cannot be read or is another flight's.
    """
    recorded = _read_geodetic(photographs, table)
    geodetic, notes = recorded.geodetic, recorded.notes
    names = [photo.name for photo in photographs]
    known = _of_one_flight(geodetic, notes) & _of_one_place(geodetic, names, notes)
    over_take_off = np.isin(recorded.kinds, (OVER_TAKE_OFF, OVER_KNOWN_TAKE_OFF))
    geodetic, kept, has_altitudes = _in_space_or_plane(geodetic, known, over_take_off, names, notes)
    index = np.flatnonzero(kept)
    origin = _origin(geodetic[index])
    enu = enu_from_geodetic(geodetic[index], origin) if len(index) else np.zeros((0, 3))
    if len(index) >= MIN_POSITIONS and do_not_spread(enu):
        radians = table is not None and (np.abs(geodetic[index, :2]) < [np.pi / 2, np.pi]).all()
        notes.append(
            f"all {len(index)} positions are within {MIN_SPREAD_M:g} m of each other: they tell neither scale nor "
            f"north; not used.{' Are they in radians? Write degrees.' if radians else ''}"
        )
        index, enu = index[:0], enu[:0]
    notes += _of_places_apart(enu)
    deviations = np.array(
        [_position_std(photographs[i], recorded.rows.get(i), table, std_m) for i in index.tolist()]
    ).reshape(-1, 3)
    step = _altitude_step(geodetic[index, 2]) if has_altitudes else 0.0
    if step:
        notes.append(f"altitudes are all multiples of {step:.4g} m: rounded; that counts as their error.")
        deviations[:, 2] = np.hypot(deviations[:, 2], ROUNDING_ERROR * step)
    of_each = [recorded.kinds[i] for i in index.tolist()]
    kinds = list(dict.fromkeys(of_each)) if has_altitudes else [ALTITUDE_UNKNOWN]
    if len(kinds) > 1:
        notes.append(f"altitudes are of several kinds ({'; '.join(kinds)}): heights may not fit together.")
    taken, heights = [photographs[i] for i in index.tolist()], None if step >= STEP_M else enu[:, 2]
    return GpsPriors(
        image_indices=index,
        enu=enu,
        gps_std=deviations,
        are_stated=np.array([_states_std(photographs[i], recorded.rows.get(i), table) for i in index.tolist()], bool),
        origin=origin,
        altitude_reference="; ".join(kinds),
        source=recorded.source,
        notes=tuple(notes),
        has_altitudes=has_altitudes,
        over_take_off=OVER_TAKE_OFF in kinds,
        flights=flights_of(taken, of_each, heights),
        altitude_step_m=step,
        table=table if any(np.isfinite(row.position[2]) for row in recorded.rows.values()) else None,
        datum_errors_m=np.array([photo.datum_error_m if table is None else recorded.datum_error_m for photo in taken]),
    )


def _of_one_flight(geodetic: np.ndarray, notes: list[str]) -> np.ndarray:
    """Which of the positions [n, 3] may be of one flight, [n] bool: all or none; a note says why none."""
    why = why_no_flight(geodetic)
    if why:
        notes.append(f"the positions cannot be of one flight: {why}; not used. Are they metres, where degrees belong?")
    return np.full(len(geodetic), not why)


def _of_one_place(geodetic: np.ndarray, names: Sequence[str], notes: list[str]) -> np.ndarray:
    """Which of the positions [n, 3] are known [n] bool, but for those at 0, 0 and far from all others; notes say so."""
    known = np.isfinite(geodetic[:, :2]).all(axis=1)
    nowhere = known & are_nowhere(geodetic)
    if nowhere.any():
        notes.append(f"{_some(names, nowhere)}: the position is 0, 0 (no satellites yet); not used.")
    known &= ~nowhere
    if not known.any():
        return known
    far = known & are_far_off(geodetic, known)
    if far.any():
        notes.append(f"{_some(names, far)}: the position is far from all others; not used.")
    return known & ~far


def _of_places_apart(enu: np.ndarray) -> list[str]:
    """What to say of positions [n, 3] that do not lie at one place."""
    counts = np.bincount(places_apart(enu))
    if len(counts) < 2:
        return []
    km = float(np.linalg.norm(np.ptp(enu[:, :2], axis=0))) / 1000
    return [
        f"the {len(enu)} positions lie in {len(counts)} places, {km:,.3g} km across ({counts[0]} in the largest, "
        "which tells what kind of flight it was). If they are several scenes, reconstruct each by itself."
    ]


def _altitude_step(altitudes: np.ndarray) -> float:
    """The largest of usual steps that all altitudes [n], in the order of photographs, are multiples of; 0 where there
    is none, or they are few levels."""
    if len(altitudes) < LEAST_ROUNDED or np.ptp(altitudes) < ON_STEP_M:
        return 0.0
    different = 1 + np.count_nonzero(np.diff(np.sort(altitudes)) > ON_STEP_M)
    before, at, after = altitudes[:-2], altitudes[1:-1], altitudes[2:]
    swaying = np.count_nonzero((np.abs(after - before) < ON_STEP_M) & (np.abs(at - before) > ON_STEP_M))
    if different < LEAST_DIFFERENT and swaying < LEAST_SWAYING:
        return 0.0
    return next((s for s in STEPS_M if np.abs(altitudes - s * np.round(altitudes / s)).max() < ON_STEP_M), 0.0)


def _in_space_or_plane(
    geodetic: np.ndarray, known: np.ndarray, over_take_off: np.ndarray, names: Sequence[str], notes: list[str]
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Positions [n, 3], which are used [n] bool, and whether with their altitudes (0 where not); says so in notes.
    Heights of 0 `over_take_off` [n] bool are no defaults: on the ground."""
    believed = without_zero_altitudes(geodetic, known & ~over_take_off)
    geodetic = np.where(over_take_off[:, None], geodetic, believed)
    kept, has_altitudes = with_altitudes(geodetic[:, 2], known)
    if not has_altitudes:
        without = known & ~np.isfinite(geodetic[:, 2])
        others = int((known & ~without).sum())
        said = f"; those of {others} more are not used" if others else ""
        notes.append(
            f"{_some(names, without)}: the positions have no altitudes{said}. Positions give scale "
            "and north, views or attitudes give up; heights above the sea are not known."
        )
        return np.where([True, True, False], geodetic, 0.0), kept, False
    if (kept != known).any():
        notes.append(f"{_some(names, known & ~kept)}: the position has no altitude; not used.")
    return geodetic, kept, True


def _read_geodetic(photographs: Sequence[ImageMetadata], table: Path | None) -> _Recorded:
    if table is None:
        geodetic = np.array([(*(photo.lat_lon or (np.nan, np.nan)), _or_nan(photo.altitude)) for photo in photographs])
        kinds = [photo.altitude_type for photo in photographs]
        kinds = [IN_EXIF if kind == BY_MAKER and IN_EXIF in kinds else kind for kind in kinds]
        return _with_heights(_Recorded(geodetic.reshape(-1, 3), kinds, "EXIF", [], {}), photographs)
    read = read_gps_table(table)
    names = [photo.name for photo in photographs]
    rows = match_rows(names, read.rows, table, read.numbered)
    geodetic, kinds = np.full((len(photographs), 3), np.nan), [""] * len(photographs)
    for index, row in rows.items():
        geodetic[index], kinds[index] = row.position, f"as in {table.name}"
        if not np.isfinite(row.position[2]):
            geodetic[index, 2], kinds[index] = _or_nan(photographs[index].altitude), photographs[index].altitude_type
    notes = [*read.notes, *unmatched_notes(read.rows, rows, table), *_far_off(geodetic, photographs, table)]
    notes += _beside(rows, photographs, table, read.datum_error_m)
    notes += _other_altitudes(rows, photographs, table)
    without = [index for index, row in rows.items() if not np.isfinite(row.position[2])]
    if without:
        chosen = np.isin(np.arange(len(names)), without)
        notes.append(f"{table.name} gives no altitude for {_some(names, chosen)}; as the photographs say it.")
    found = _Recorded(geodetic, kinds, table.name, notes, rows, read.datum_error_m)
    return _with_heights(found, photographs) if without else found


def _with_heights(recorded: _Recorded, photographs: Sequence[ImageMetadata]) -> _Recorded:
    """With heights over the take-off for flights without altitudes (`with_take_off_heights`)."""
    if np.isfinite(recorded.geodetic[:, :2]).all(axis=1).sum() < MIN_POSITIONS:
        return recorded
    geodetic, kinds, notes = with_take_off_heights(recorded.geodetic, recorded.kinds, photographs)
    return replace(recorded, geodetic=geodetic, kinds=kinds, notes=[*recorded.notes, *notes])


def _far_off(geodetic: np.ndarray, photographs: Sequence[ImageMetadata], table: Path) -> list[str]:
    """What to say of a table whose positions are not near those in the photographs. Raises CaptureError where they
    become those once exchanged or mirrored."""
    own = np.array([photo.lat_lon or (np.nan, np.nan) for photo in photographs])
    both = np.isfinite(own).all(axis=1) & np.isfinite(geodetic[:, :2]).all(axis=1)
    if both.sum() < MIN_POSITIONS:
        return []
    given, own = geodetic[both, :2], own[both]

    def fits(places: np.ndarray) -> bool:
        return bool(np.abs(np.median(wrap_degrees(places - own), axis=0)).max() < SAME_FLIGHT_DEG)

    if fits(given):  # metres are `_beside`'s
        return []
    ways = {
        "latitude and longitude are exchanged": given[:, ::-1],
        "south is north": given * [-1, 1], "west is east": given * [1, -1],
        "south and west are north and east": -given,
    }  # fmt: skip
    wrong = next((what for what, places in ways.items() if fits(places)), None)
    if wrong is not None:
        raise CaptureError(
            f"{table}: {wrong}, as the positions in the photographs tell ({own[0][0]:.5f}, {own[0][1]:.5f}; here "
            f"{given[0][0]:.5f}, {given[0][1]:.5f}). Mend its columns or their names."
        )
    away = _meters_apart(given, own)
    return [
        f"{table.name}: its positions lie {np.median(away) / 1000:,.0f} km from those in the photographs, and are used "
        "all the same. Another system or zone, or x and y exchanged?"
    ]


def _beside(
    rows: Mapping[int, GpsRow], photographs: Sequence[ImageMetadata], table: Path, datum_error_m: float
) -> list[str]:
    """What to say of a table of this flight whose positions lie farther from those in the photographs, in the median,
    than both state (`datum_error_m` of the table's system among it)."""
    pairs = [(row, photographs[index]) for index, row in rows.items() if photographs[index].lat_lon is not None]
    if len(pairs) < MIN_POSITIONS:
        return []
    given, own = np.array([row.position[:2] for row, _ in pairs]), np.array([photo.lat_lon for _, photo in pairs])
    if np.abs(np.median(wrap_degrees(given - own), axis=0)).max() >= SAME_FLIGHT_DEG:
        return []
    stated = [math.hypot(_stated_m(row, photo), datum_error_m, photo.datum_error_m) for row, photo in pairs]
    away = float(np.median(_meters_apart(given, own)))
    if away < max(TOLD_OFFSET_M, float(np.median(stated))):
        return []
    return [
        f"{table.name}: its positions lie {away:,.0f} m from those in the photographs (median), and are used all the "
        "same. Of another datum, or of other photographs?"
    ]


def _stated_m(row: GpsRow, photo: ImageMetadata) -> float:
    """How far the positions of a row and of its photograph may lie apart across by what both state."""
    own = max(photo.gps_std[:2]) if photo.gps_std is not None else photo.gps_error_m or 0.0
    return math.hypot(row.gps_std[0] if row.gps_std is not None else 0.0, own)


def _meters_apart(given: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Metres [n] between places and others [n, 2] in degrees, pair by pair."""
    return np.array(
        [
            np.linalg.norm(enu_from_geodetic(np.array([[*place, 0.0]]), (*other, 0.0)))
            for place, other in zip(given.tolist(), own.tolist(), strict=True)
        ]
    )


def _other_altitudes(rows: Mapping[int, GpsRow], photographs: Sequence[ImageMetadata], table: Path) -> list[str]:
    """What to say of a table whose altitudes are not near those in the photographs. Raises CaptureError where they are
    those in feet."""
    pairs = np.array([(row.position[2], _or_nan(photographs[index].altitude)) for index, row in rows.items()])
    given, own = pairs.reshape(-1, 2)[np.isfinite(pairs.reshape(-1, 2)).all(axis=1)].T
    if len(own) < MIN_POSITIONS or not given.any() or not own.any():
        return []
    if wrong_unit(given, own) == "feet":  # EXIF may be in feet itself: of metres the cameras tell
        refuse_unit("feet", "those of the photographs", table)
    off = float(np.median(given - own))
    if abs(off) < TOLD_ALTITUDE_M:
        return []
    way = "above" if off > 0 else "below"
    return [
        f"{table.name}: its altitudes lie {abs(off):,.0f} m {way} those in the photographs, "
        "and are used all the same. Over the ground, in feet, or over another zero (the ellipsoid's)?"
    ]


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _origin(geodetic: np.ndarray) -> tuple[float, float, float]:
    if not len(geodetic):
        return 0.0, 0.0, 0.0
    return median_place(geodetic)


def _position_std(
    photo: ImageMetadata, row: GpsRow | None, table: Path | None, std_m: tuple[float, float]
) -> tuple[float, float, float]:
    """A table has its own columns of accuracy, else `std_m` across and upwards; photographs have what a
    receiver with RTK says, or what EXIF says across and as much worse upwards as `std_m` is."""
    across, up = std_m
    if row is not None and row.gps_std is not None:
        across, up = (max(value, MIN_STD_M) for value in row.gps_std)
    if table is None and photo.gps_std is not None:
        east, north, height = (max(value, MIN_STD_M) for value in photo.gps_std)
        return east, north, height
    if table is None and photo.gps_error_m is not None:
        error = max(photo.gps_error_m, MIN_STD_M)
        return error, error, error * up / across
    return across, across, up


def _states_std(photo: ImageMetadata, row: GpsRow | None, table: Path | None) -> bool:
    return photo.gps_std is not None if table is None else row is not None and row.gps_std is not None


def _some(names: Sequence[str], which: np.ndarray) -> str:
    return first_names([name for name, take in zip(names, which, strict=True) if take])
