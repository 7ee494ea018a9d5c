"""Where a photograph says that it was taken: EXIF's GPS block, held against the positions in XMP."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

from vdgs.captures.angles import LIMITS, SIDES, degrees_of_parts, degrees_of_text, side_of
from vdgs.captures.table_columns import FOOT_M
from vdgs.sfm.xmp import first_number, text

#: Places in EXIF and XMP that are farther apart than this (degrees, some 100 m) contradict each other.
SAME_PLACE_DEG = 1e-3
#: No land lies lower in the open (metres; the shore of the Dead Sea is at -430): the tag "below sea level" is wrong.
LOWEST_M = -450
#: Altitudes beyond this (metres) are damage.
HIGHEST_M = 20_000.0
#: Altitudes in EXIF and XMP that differ by this much (metres) are two, not one that was rounded; those that are farther
#: apart than the second are not of one reference (choice).
OTHER_M, MOST_APART_M = 1.0, 30.0
#: What the references 2 and 3 of EXIF 3.0 say. 0 and 1 are above and below the ellipsoid there, but the sea in EXIF 2,
#: and most cameras write them of either: they say nothing.
SEA_LEVEL = "above sea level (GPSAltitudeRef)"
#: Names in XMP of what altitudes are measured from.
_REFERENCES = ("AltitudeType", "VertCS", "VERTCRS")
#: What is said of altitudes that nothing more is said of.
_NOT_STATED = "as recorded, datum not stated"
#: Kinds that are one where both occur: of photographs that have both altitudes these agree, or the kind says otherwise.
IN_EXIF, BY_MAKER = f"EXIF GPSAltitude {_NOT_STATED}", f"AbsoluteAltitude in XMP {_NOT_STATED}"
#: Heights that differ by less (metres) are one number, written twice: near the sea, altitudes are nearly heights.
SAME_HEIGHT_M = 0.2
#: EXIF's tags: latitude and longitude, each behind its reference.
_TAGS = {"latitude": (1, 2), "longitude": (3, 4)}
#: XMP's names for them, the makers' (with their misspelling) before Adobe's.
_XMP = {
    "latitude": ("GpsLatitude", "GPSLatitude", "Latitude"),
    "longitude": ("GpsLongitude", "GpsLongtitude", "GPSLongitude", "Longitude"),
}  # fmt: skip

#: Altitudes that differ by less (metres) are the same number.
SAME_M = 0.01

#: A receiver's dilution of precision: above the first, errors are that many times as large as usual (choice: the usual
#: tables call it moderate to fair); from the second on there was no fix (receivers write 50 and 99.99 then).
POOR_DILUTION, NO_FIX = 6.0, 50.0
#: Fixes that are none, and those without altitude.
VOID, FLAT = "void", "flat"

Place = tuple[float, float]
#: Metres, None where they are not known, and what they are measured from.
Altitude = tuple[float | None, str]


def finite(value: Any) -> float | None:
    """A number of EXIF (a rational, mostly) as a float; None for what is none, infinite or NaN."""
    try:
        result = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return result if math.isfinite(result) else None


def plain_text(value: Any) -> str:
    """EXIF text without the zeros and control characters that it may be padded with."""
    if isinstance(value, bytes):
        value = value.decode("ascii", errors="replace")
    kept = "".join(letter for letter in value if letter.isprintable()) if isinstance(value, str) else ""
    return kept.strip()[:80]


def read_place(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> tuple[Place | None, str]:
    """Latitude and longitude in degrees, or None; and what people should know of it.

    EXIF's block comes first. XMP fills what the block lacks, a place or its side of the Earth. Where the two are
    different places neither is believed.
    """
    in_xmp = _place_in_xmp(xmp)
    if gps.get(2) is None and gps.get(4) is None:
        return in_xmp, ""
    angles = {axis: angle for axis in _TAGS if (angle := _angle(gps, axis)) is not None}
    if len(angles) < len(_TAGS):
        return in_xmp, "" if in_xmp else _not_understood(gps, angles)
    place = angles["latitude"][0], angles["longitude"][0]
    sideless = [axis for axis, (_, is_sided) in angles.items() if not is_sided]
    if in_xmp is not None and _same(_without_sides(place), _without_sides(in_xmp)):
        return _of_both(place, in_xmp, not sideless)
    if not any(place):
        return in_xmp or (0.0, 0.0), ""
    if sideless:
        return None, _without_hemisphere(place, sideless)
    if in_xmp is not None:
        return None, f"EXIF and XMP name different places ({_pair(place)}; {_pair(in_xmp)})"
    return place, ""


def _of_both(place: Place, in_xmp: Place, is_sided: bool) -> tuple[Place | None, str]:
    """The better of two places that are one but for their sides of the Earth, which EXIF may not say (`is_sided`)."""
    if is_sided and not _same(place, in_xmp):
        return None, f"EXIF and XMP name different hemispheres ({_pair(place)}, {_pair(in_xmp)})"
    return (place if is_sided and not _whole_seconds(*place) else in_xmp), ""


def _not_understood(gps: Mapping[int, Any], understood: Collection[str]) -> str:
    shown = ", ".join(
        f"{axis} {_shown(gps.get(tag))} {plain_text(gps.get(reference))}".rstrip()
        for axis, (reference, tag) in _TAGS.items()
        if axis not in understood
    )
    return f"the position in EXIF is not understood ({shown})"


def _without_hemisphere(place: Place, sideless: Collection[str]) -> str:
    sides = [f"{axis} {south} or {north}" for axis, (south, north) in SIDES.items() if axis in sideless]
    return f"the position in EXIF ({_pair(place)}) names no hemisphere ({', '.join(sides)}): say it in a table (--gps)"


def read_fix(gps: Mapping[int, Any]) -> str:
    """What EXIF says against a position: `VOID` where the receiver had none (GPSStatus V, a dilution of a receiver
    without satellites), `FLAT` where it measured no altitude (GPSMeasureMode 2); empty else."""
    status, mode = (plain_text(gps.get(tag)).strip("\x00 ").upper() for tag in (9, 10))
    if status.startswith("V") or (finite(gps.get(11)) or 0.0) >= NO_FIX:
        return VOID
    return FLAT if mode == "2" else ""


def is_measured_in_xmp(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> bool:
    """Whether XMP has a place of its own, so that what EXIF says of its fix and its datum does not count. Editors copy
    EXIF's place to `exif:`."""
    has_own = gps.get(2) is not None or gps.get(4) is not None
    return _place_in_xmp({k: v for k, v in xmp.items() if not (has_own and k.startswith("exif:"))}) is not None


def dilution(gps: Mapping[int, Any]) -> float | None:
    """GPSDOP where it is poor."""
    value = finite(gps.get(11))
    return value if value is not None and POOR_DILUTION < value < NO_FIX else None


def read_altitude(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> Altitude:
    """Altitude in metres and what it is measured from, as far as the file says."""
    return read_altitudes(gps, xmp)[0]


def read_altitudes(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> tuple[Altitude, tuple[Altitude, Altitude] | None]:
    """The altitude that is taken, and EXIF's and XMP's where these differ by a metre."""
    reference = gps.get(5)
    reference = reference[0] if isinstance(reference, bytes) and len(reference) == 1 else reference
    value, source = finite(gps.get(6)), ""
    if value is None:
        value, source = _own_altitude(xmp)
        reference = None
    if value is None and (value := first_number(xmp, "exif:GPSAltitude")) is not None:
        reference, source = text(xmp, "exif:GPSAltitudeRef"), "exif:GPSAltitude in XMP"
    mark = str(int(reference)) if reference in (1, 2, 3) else str(reference).strip("\x00 ")  # a ratio, text
    if value is not None and mark in ("1", "3"):
        value = -abs(value)
    datum = SEA_LEVEL if mark in ("2", "3") else ""
    absolute = first_number(xmp, "AbsoluteAltitude")
    if value is None or not absolute:
        return _measured(value, absolute, xmp, source, datum), None
    ellipsoidal = first_number(xmp, "AltitudeWGS84")
    confirmed = bool(ellipsoidal and abs(ellipsoidal - value) < SAME_M)
    by_xmp = not confirmed and _is_absolute_otherwise(value, absolute, xmp)
    own = "AbsoluteAltitude in XMP" if abs(abs(value) - abs(absolute)) >= OTHER_M else ""
    both = _measured(value, absolute, xmp, source, datum), _measured(absolute, absolute, xmp, own)
    taken = both[by_xmp] if both[by_xmp][0] is not None else both[not by_xmp]
    return taken, both if abs(value - absolute) >= OTHER_M else None


def _own_altitude(xmp: Mapping[str, str]) -> tuple[float | None, str]:
    """The altitude that the maker wrote into XMP alone, and its name; that is empty where XMP names what it is measured
    from, as beside EXIF's."""
    for name in ("AbsoluteAltitude", "sensefly:AltitudeWGS84", "AltitudeWGS84"):
        if (value := first_number(xmp, name)) is not None:
            return value, "" if text(xmp, *_REFERENCES) else f"{name} in XMP"
    return None, ""


def _measured(
    value: float | None, absolute: float | None, xmp: Mapping[str, str], source: str, datum: str = ""
) -> Altitude:
    """An altitude with what it is measured from; `source` where that is not EXIF, `datum` where its reference says
    it."""
    if value is None or abs(value) > HIGHEST_M:
        return None, ""
    if value < LOWEST_M:
        return -value, f"{source or 'EXIF GPSAltitude'}, whose mark 'below sea level' cannot be true"
    ellipsoidal, named = first_number(xmp, "AltitudeWGS84"), text(xmp, *_REFERENCES)
    if ellipsoidal is not None and abs(ellipsoidal - value) < SAME_M:
        return value, "above the WGS 84 ellipsoid (AltitudeWGS84)"
    if absolute and abs(value - absolute) >= OTHER_M:  # what XMP names is its own
        more = f" by more than {MOST_APART_M:.0f} m" if abs(value - absolute) > MOST_APART_M else ""
        kind = f" ({named})" if named else ""
        of_exif = f"EXIF GPSAltitude{f', {datum}' if datum else ''} as recorded"
        return value, f"{of_exif}, which differs from AbsoluteAltitude in XMP{kind}{more}"
    if datum and not named:
        return value, f"{source or 'EXIF GPSAltitude'}, {datum} as recorded"
    if named and source:
        named = f"{source} ({named})"
    return value, f"{named} as recorded" if named else f"{source or 'EXIF GPSAltitude'} {_NOT_STATED}"


def _is_absolute_otherwise(value: float, absolute: float, xmp: Mapping[str, str]) -> bool:
    """Whether EXIF's altitude is the one in XMP with another reference, in feet, or a default of firmware that leaves
    it empty; or is the height over the take-off instead."""
    over_take_off = first_number(xmp, "RelativeAltitude")
    if value == 0 or (over_take_off is not None and abs(value - over_take_off) < SAME_HEIGHT_M):
        return True
    return any(abs(value - way) < 1 for way in (-absolute, absolute / FOOT_M))


def _angle(gps: Mapping[int, Any], axis: str) -> tuple[float, bool] | None:
    """Degrees, and whether the block says on which side of the equator or Greenwich they are; None for what is not
    understood, or contradicts itself."""
    reference, tag = _TAGS[axis]
    value, word = gps.get(tag), plain_text(gps.get(reference))
    written = plain_text(value) if isinstance(value, str | bytes) else ""
    if written:
        read = degrees_of_text(written, axis)
        if read is None:
            return None
        degrees, sided = read
    else:
        parts = list(value) if isinstance(value, tuple | list) else [value]
        known = degrees_of_parts([_part(part) for part in parts])
        if known is None or any(_is_infinite(part) for part in parts):
            return None
        degrees, sided = known, known < 0
    if word:
        side = side_of(word, axis)
        if side is None or (degrees < 0 < side):  # a sign against the side: neither is believed
            return None
        degrees, sided = side * abs(degrees), True
    return (degrees, sided) if abs(degrees) <= LIMITS[axis] else None


def _part(value: Any) -> float | None:
    return finite(value)


def _is_infinite(value: Any) -> bool:
    """Whether a rational has a numerator but a denominator of 0: damage, where 0/0 says nothing."""
    numerator = getattr(value, "numerator", 0)
    return getattr(value, "denominator", 1) == 0 and numerator not in (0, None) and not math.isnan(numerator)


def _place_in_xmp(xmp: Mapping[str, str]) -> Place | None:
    """Latitude and longitude in degrees."""
    read = []
    for axis, names in _XMP.items():
        angle = degrees_of_text(text(xmp, *names), axis)
        if angle is None or abs(angle[0]) > LIMITS[axis]:
            return None
        read.append(angle[0])
    return (read[0], read[1]) if any(read) else None


def _whole_seconds(latitude: float, longitude: float) -> bool:
    """Whether a place is cut off at seconds, 30 m of latitude, as some firmware of DJI writes it into EXIF alone."""
    return all(abs(3600 * angle - round(3600 * angle)) < 1e-6 for angle in (latitude, longitude))


def _same(one: Place, other: Place) -> bool:
    return all(abs(a - b) < SAME_PLACE_DEG for a, b in zip(one, other, strict=True))


def _without_sides(place: Place) -> Place:
    return abs(place[0]), abs(place[1])


def _pair(place: Place) -> str:
    return f"{place[0]:.5f}, {place[1]:.5f}"


def _shown(value: Any) -> str:
    parts = value if isinstance(value, tuple | list) else [value]
    return " ".join(str(part)[:20] for part in parts[:4]) if value is not None else "missing"
