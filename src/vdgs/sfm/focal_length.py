"""The focal length that a photograph tells, as a share of its longer side: that stays when a photograph is shrunk."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vdgs.sfm.xmp import first_number

#: Width in millimetres of the sensors of cameras that do not say it in EXIF, by EXIF's model.
SENSOR_WIDTH_MM = {
    "FC300S": 6.17, "FC300X": 6.17, "FC300C": 6.17, "FC330": 6.17, "FC220": 6.17, "FC350": 6.17, "FC2103": 6.17,
    "FC550": 17.3, "FC6310": 13.2, "FC6310S": 13.2, "FC6310R": 13.2, "L1D-20C": 13.2, "FC3411": 13.2,
}  # fmt: skip
#: Half the diagonal's meaning of "35 mm equivalent": that of a 36 x 24 mm picture.
DIAGONAL_35_MM = math.hypot(36, 24)
#: Wider pictures than this are cut from a sensor of 4 x 3 (films' shape, on drones).
MAX_SENSOR_ASPECT = 1.6
#: Focal lengths over the longer side beyond these are damage.
MIN_FOCAL, MAX_FOCAL = 0.2, 20.0
_INCH, _CENTIMETRE, _MILLIMETRE = 25.4, 10.0, 1.0
_UNITS = {2: _INCH, 3: _CENTIMETRE, 4: _MILLIMETRE}


#: What says a focal length that was measured, lens by lens.
CALIBRATED_SOURCE = "the maker's calibration in XMP"


@dataclass(frozen=True)
class Lens:
    """Focal length over the longer side of the picture, and where it is from."""

    focal: float
    source: str


def read_lens(
    tags: Mapping[int, Any], details: Mapping[int, Any], xmp: Mapping[str, str], width: int, height: int
) -> Lens | None:
    """What is best known of: the maker's calibration, EXIF's sensor, a table of sensors, the 35 mm equivalent."""
    longer = max(width, height)
    original = max(_number(details.get(0xA002)) or 0.0, _number(details.get(0xA003)) or 0.0) or float(longer)
    model = _model(tags)
    focal_mm, equivalent_mm = _number(details.get(0x920A)), _number(details.get(0xA405))
    ways = (
        (_calibrated(xmp, original), CALIBRATED_SOURCE),
        (_by_sensor(focal_mm, _sensor(details, original)), "EXIF's focal length and sensor"),
        (_by_sensor(focal_mm, SENSOR_WIDTH_MM.get(model)), f"EXIF's focal length, the sensor of {model}"),
        (_by_equivalent(equivalent_mm, width, height), "EXIF's 35 mm equivalent"),
    )
    return next((Lens(focal, source) for focal, source in ways if focal and MIN_FOCAL < focal < MAX_FOCAL), None)


def _number(value: Any) -> float | None:
    try:
        result = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return result if math.isfinite(result) and result > 0 else None


def _model(tags: Mapping[int, Any]) -> str:
    value = tags.get(0x0110)
    return value.strip("\x00 ").upper() if isinstance(value, str) else ""


def _calibrated(xmp: Mapping[str, str], original: float) -> float | None:
    """DJI: DewarpData is `date;fx,fy,cx,cy,...` in pixels of the original, CalibratedFocalLength is fx alone."""
    words = xmp.get("drone-dji:DewarpData", "").partition(";")[2].split(",")
    try:
        focal = float(words[0])
    except ValueError:
        focal = first_number(xmp, "drone-dji:CalibratedFocalLength") or 0.0
    return focal / original if math.isfinite(focal) and focal > 0 else None


def _sensor(details: Mapping[int, Any], original: float) -> float | None:
    """Width of the sensor in millimetres, from EXIF's pixels per inch (centimetre, millimetre) on it."""
    density, unit = _number(details.get(0xA20E)), details.get(0xA210, 2)
    return original / density * _UNITS[unit] if density and unit in _UNITS else None


def _by_sensor(focal_mm: float | None, sensor_mm: float | None) -> float | None:
    return focal_mm / sensor_mm if focal_mm and sensor_mm and 1 < sensor_mm < 100 else None


def _by_equivalent(equivalent_mm: float | None, width: int, height: int) -> float | None:
    longer, shorter = max(width, height), min(width, height)
    if longer > MAX_SENSOR_ASPECT * shorter:
        shorter = round(longer * 3 / 4)
    return equivalent_mm / DIAGONAL_35_MM * math.hypot(longer, shorter) / longer if equivalent_mm else None
