"""The focal length that a photograph tells, as a share of its longer side: that stays when a photograph is shrunk."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vdgs.sfm.exif_gps import plain_text
from vdgs.sfm.raw_crops import USUAL_SHAPES, RawCrop, read_raw_crop
from vdgs.sfm.xmp import first_number, text

#: Sensors in millimetres across and down, of cameras that do not say it in EXIF, or say nothing else, by EXIF's model.
_SMALL, _ONE_INCH, _FOUR_THIRDS = (6.17, 4.55), (13.2, 8.8), (17.3, 13.0)
_POWERSHOT, _CANON_APS, _FULL_FRAME = (7.44, 5.58), (22.3, 14.9), (36.0, 24.0)
_EOS = "CANON EOS "
SENSOR_MM = {
    **dict.fromkeys(("FC300S", "FC300X", "FC300C", "FC330", "FC220", "FC350", "FC2103"), _SMALL),
    **dict.fromkeys(("FC6310", "FC6310S", "FC6310R", "L1D-20C", "FC3411"), _ONE_INCH),
    "FC550": _FOUR_THIRDS,
    **dict.fromkeys(("CANON POWERSHOT S100", "CANON POWERSHOT S110"), _POWERSHOT),
    **dict.fromkeys((f"{_EOS}M", f"{_EOS}100D", f"{_EOS}REBEL SL1", f"{_EOS}7D", f"{_EOS}7D MARK II"), _CANON_APS),
    **dict.fromkeys((f"{_EOS}5D{mark}" for mark in ("", *(f" MARK {n}" for n in ("II", "III", "IV")))), _FULL_FRAME),
    **dict.fromkeys((f"{_EOS}{model}" for model in ("5DS", "5DS R", "6D", "6D MARK II", "RP", "R")), _FULL_FRAME),
}
#: Half the diagonal's meaning of "35 mm equivalent": that of a 36 x 24 mm picture.
DIAGONAL_35_MM = math.hypot(36, 24)
#: Wider pictures than this are cut from a sensor of 4 x 3 (films' shape, on drones).
MAX_SENSOR_ASPECT = 1.6
#: Focal lengths in millimetres that lie apart by more than this share are of two lenses, where each has so many
#: photographs (choice).
OTHER_LENS, LEAST_OF_A_LENS = 0.1, 3
#: Focal lengths over the longer side beyond these are damage.
MIN_FOCAL, MAX_FOCAL = 0.2, 20.0
_INCH, _CENTIMETRE, _MILLIMETRE = 25.4, 10.0, 1.0
_UNITS = {2: _INCH, 3: _CENTIMETRE, 4: _MILLIMETRE}
#: What says a focal length that was measured, lens by lens.
CALIBRATED_SOURCE = "the maker's calibration in XMP"
#: What Pix4D's names say, of the lens or of its model.
PIX4D_SOURCE = "Camera:PerspectiveFocalLength in XMP"
SENSOR, EQUIVALENT = "EXIF's focal length and sensor", "EXIF's 35 mm equivalent"
#: Two ways to a focal length that differ by more than this factor contradict each other. The 35 mm equivalent is a
#: whole number, of the diagonal or of the width: up to 15 %.
AGREE = 1.25
#: Sides of a picture whose proportions differ by more than this share were cut.
CUT = 0.02
#: The optical center lies off the middle of the sensor by up to half of this share of a side. Coordinates that lie
#: beyond that by one factor, up to `EVEN`, are those of a picture that was shrunk (choice).
OFF_MIDDLE, EVEN = 0.03, 0.005
#: No sensor of a camera has pixels that are wider (millimetres; thermal ones have up to 0.05).
MAX_PIXEL_MM = 0.08
#: The shorter side of a whole picture whose pixels are not known; the shape alone counts.
WHOLE_PX = 3000.0
#: Programs that shrink photographs leave less of them than this share of the longer side (choice).
MAX_SHRUNK = 0.6
#: Programs that write photographs anew, by what they call themselves.
_EDITORS = re.compile(
    r"adobe|photoshop|lightroom|gimp|darktable|rawtherapee|capture one|affinity|magick|dxo|picasa|xnview|irfanview"
    r"|acdsee|luminar|snapseed|faststone|photoscape",
    re.IGNORECASE,
)
#: A crop whose middle is farther from that of the whole, as a share of its longer side, lies beside it (choice).
MAX_BESIDE = 0.01
#: A digital zoom beyond this is damage.
LARGEST_ZOOM = 100.0


@dataclass(frozen=True)
class Lens:
    """Focal length over the longer side of the picture, and where it is from."""

    focal: float
    source: str
    doubt: str = ""
    """What contradicts it; a focal length that is doubted is fitted."""
    zoom: float = 1.0
    """The digital zoom that `focal` is multiplied by."""
    digital_zoom: float = 1.0
    """EXIF's DigitalZoomRatio, which the 35 mm equivalent contains as a rule."""
    focal_mm: float | None = None
    """EXIF's FocalLength."""
    zoom_confirmed: bool = False
    """Whether the 35 mm equivalent has the zoom in it, where EXIF's FocalLength has not."""
    remark: str = ""
    """What is assumed of it, where that is likely enough to hold it."""
    confirmed: bool = False
    """Whether two ways say it that do not depend on each other."""


def read_lens(
    tags: Mapping[int, Any], details: Mapping[int, Any], xmp: Mapping[str, str], width: int, height: int
) -> Lens | None:
    """What is best known of: the maker's calibration, EXIF's sensor, a table of sensors, the 35 mm equivalent.

    Each is held against the others, and what contradicts most of them is not taken.
    """
    longer, frame = max(width, height), _framing(details, xmp, width, height)
    original, part = frame.original, frame.part
    model, zoom = _model(tags), _zoom(details)
    kept = zoom * frame.kept
    focal_mm, equivalent_mm = _number(details.get(0x920A)), _number(details.get(0xA405))
    in_table = _by_sensor(focal_mm, _used_width(model, *frame.sides))
    equivalent = _by_equivalent(equivalent_mm, *frame.sides)
    likely = None if equivalent_mm == focal_mm else _times(equivalent, 1 / zoom)
    hints = _Hints(min(frame.sides) / max(frame.sides), in_table, likely)
    measured = [
        (_times(_calibrated(xmp, original, part, hints), kept), CALIBRATED_SOURCE),
        (_times(_by_sensor(focal_mm, _sensor(details, original)), kept), SENSOR),
        (_times(in_table, kept / part), f"EXIF's focal length, the sensor of {model}"),
        (_times(_by_pix4d(xmp, _sensor(details, original), original, part, hints), kept), PIX4D_SOURCE),
    ]
    equivalent = as_written = _times(equivalent, frame.kept / part)
    equivalent = _zoomed_equivalent(equivalent, [focal for focal, _ in measured], zoom)
    ways = [*measured, (equivalent, EQUIVALENT)]
    known = [(focal, source) for focal, source in ways if focal and MIN_FOCAL < focal < MAX_FOCAL]
    if not known:
        return None
    focal, source, doubt = _agreed(known, longer, copied=equivalent_mm == focal_mm)
    agreeing = {_witness(how) for other, how in known if alike(focal, other)}
    alone = len(agreeing) == 1
    remark = _joined(frame.remark, _rewritten(tags, xmp, source, original, longer) if alone else "")
    zoom_confirmed = as_written is not None and alike(as_written, focal) and not alike(as_written, focal / zoom)
    doubt = _joined(frame.doubt, _coarse_pixels(details) if alone and source == SENSOR else "", doubt)
    counted = 1.0 if source == EQUIVALENT else zoom
    return Lens(focal, source, doubt, counted, zoom, focal_mm, zoom_confirmed, remark, confirmed=not alone)


@dataclass(frozen=True)
class _Framing:
    """What of the picture that the camera took is left."""

    original: float
    """Pixels of the longer side of what is left, as the camera took them."""
    sides: tuple[float, float]
    """Of the picture that the size of the sensor and the 35 mm equivalent are of."""
    kept: float = 1.0
    """Pixels of the original over those that are left."""
    part: float = 1.0
    """The longer side of what is left over that of the picture that the tags are of, where a program cropped it."""
    remark: str = ""
    doubt: str = ""


def _framing(details: Mapping[int, Any], xmp: Mapping[str, str], width: int, height: int) -> _Framing:
    """By the crop that a program says; else by EXIF's size."""
    longer = max(width, height)
    original, cut, unclear = _original(details, width, height)
    whole = _calibrated_width(xmp) or (original if original > longer else None)
    crop, odd = read_raw_crop(xmp, width, height, whole)
    if crop is not None:
        original *= crop.part if abs(crop.part * original / longer - 1) < CUT else 1.0
        said = f"cropped by a program (crs:HasCrop in XMP), to {crop.part:.0%} of the longer side"
        sides = crop.shape * WHOLE_PX, WHOLE_PX
        remark = f"{said}; the focal length is counted for that"
        return _Framing(original, sides, part=crop.part, remark=remark, doubt=_beside_middle(crop))
    if cut:  # a picture that was cut has fewer pixels, of the same size
        sides = _number(details.get(0xA002)) or 0.0, _number(details.get(0xA003)) or 0.0
        return _Framing(original, sides, original / longer, remark=unclear, doubt=odd)
    return _Framing(original, (width, height), doubt=_joined(unclear, odd))


def _beside_middle(crop: RawCrop) -> str:
    """What speaks against a lens whose view is assumed to meet the picture in its middle."""
    if crop.beside <= MAX_BESIDE:
        return ""
    return (
        f"cropped beside the middle (crs:HasCrop in XMP), by {crop.beside:.0%} of the longer side: the view does not "
        "meet it in its middle, as is assumed; export the photographs without crop"
    )


def _joined(*said: str) -> str:
    return "; ".join(filter(None, said))


def unzoomed(lens: Lens) -> Lens:
    """The lens where EXIF's focal length has the digital zoom in it already."""
    return replace(lens, focal=lens.focal / lens.zoom, zoom=1.0)


def zoomed(lens: Lens) -> Lens:
    """The lens where the 35 mm equivalent lacks the digital zoom."""
    return replace(lens, focal=lens.focal * lens.digital_zoom, zoom=lens.digital_zoom)


def _agreed(known: list[tuple[float, str]], longer: int, copied: bool) -> tuple[float, str, str]:
    """The first of the ways that most others agree with, its source, and what contradicts it.

    The calibrations and EXIF's sensor are one witness: they count pixels of the original, whose size a program that
    shrinks a photograph may rewrite. Of witnesses that contradict each other the 35 mm equivalent is the likelier:
    it stays right then; but not where it merely repeats the focal length. After it comes the table of sensors.
    """
    support = [len({_witness(how) for other, how in known if alike(one, other)}) for one, _ in known]
    most = [k for k, count in enumerate(support) if count == max(support)]
    chosen = most[0]
    if max(support) == 1:
        trust = {EQUIVALENT: 0 if not copied else 4, CALIBRATED_SOURCE: 2, SENSOR: 3}
        chosen = min(most, key=lambda k: trust.get(known[k][1], 1))
    focal, source = known[chosen]
    others = [f"{other * longer:.0f} px by {how}" for other, how in known if not alike(other, focal)]
    if not others:
        return focal, source, ""
    return (
        focal,
        source,
        (
            f"two ways to the focal length contradict each other: {', '.join(others)}, but {focal * longer:.0f} px by "
            f"{source}, which is taken"
        ),
    )


def _witness(source: str) -> str:
    return SENSOR if source in (CALIBRATED_SOURCE, PIX4D_SOURCE) else source


def _rewritten(tags: Mapping[int, Any], xmp: Mapping[str, str], source: str, original: float, longer: float) -> str:
    """What speaks against a focal length that counts pixels of the original and that nothing confirms: a program wrote
    the photograph, and EXIF's size is that of the file."""
    programs = plain_text(tags.get(0x0131)), text(xmp, "xmp:CreatorTool")
    program = next((each for each in programs if _EDITORS.search(each)), "")
    if not program or _witness(source) != SENSOR or original > longer:
        return ""
    return (
        f"{source} alone says its focal length, and {program} wrote it: if that shrank it and rewrote its size, the "
        "focal length is too long; not held where the photographs plainly contradict it"
    )


def alike(one: float, other: float) -> bool:
    """Whether two focal lengths may be one, as far as tags say it."""
    return 1 / AGREE < one / other < AGREE


def _zoom(details: Mapping[int, Any]) -> float:
    """EXIF's DigitalZoomRatio; 0 and nothing mean that none was used."""
    zoom = _number(details.get(0xA404)) or 1.0
    return zoom if 1 <= zoom <= LARGEST_ZOOM else 1.0


def zoomed_focal_mm(details: Mapping[int, Any]) -> float | None:
    """EXIF's FocalLength in millimetres, times its DigitalZoomRatio."""
    return _times(_number(details.get(0x920A)), _zoom(details))


def _zoomed_equivalent(equivalent: float | None, others: Sequence[float | None], zoom: float) -> float | None:
    """Most cameras count the digital zoom in their 35 mm equivalent; where the others say that this one does not, it is
    multiplied."""
    known = next((other for other in others if other), None)
    if not equivalent or known is None:
        return equivalent
    return min((equivalent, equivalent * zoom), key=lambda each: abs(math.log(each / known)))


def _original(details: Mapping[int, Any], width: int, height: int) -> tuple[float, bool, str]:
    """The longer side in pixels as the camera took it; whether the picture was cut from it, not shrunk; and what leaves
    that open: a picture of another shape, shorter on both sides, may be both cut and shrunk. One of a usual shape was
    exported, over the whole width or height. Of others, one that is nearly as long as it was is taken as cut only."""
    sides = sorted(_number(details.get(tag)) or 0.0 for tag in (0xA002, 0xA003))
    shorter, longer = sorted((width, height))
    if not sides[1]:
        return float(longer), False, ""
    other_shape = sides[0] > 0 and abs(sides[1] / sides[0] * shorter / longer - 1) > CUT
    if not other_shape or {*sides} & {shorter, longer} or shorter > sides[0] or longer > sides[1]:
        return sides[1], other_shape and bool({*sides} & {shorter, longer}), ""
    if any(abs(longer / shorter / shape - 1) < CUT / 2 for shape in USUAL_SHAPES):
        return sides[1], False, ""
    cut = longer > MAX_SHRUNK * sides[1]
    return sides[1], cut, (
        f"of another shape than EXIF says ({width} x {height} px of {sides[1]:.0f} x {sides[0]:.0f}): it was cut, and "
        f"perhaps shrunk; the focal length is taken as if it was {'cut only' if cut else 'shrunk'}"
    )  # fmt: skip


def _times(focal: float | None, factor: float) -> float | None:
    return focal * factor if focal else None


def _number(value: Any) -> float | None:
    try:
        result = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return result if math.isfinite(result) and result > 0 else None


def _model(tags: Mapping[int, Any]) -> str:
    value = tags.get(0x0110)
    return value.strip("\x00 ").upper() if isinstance(value, str) else ""


def _calibrated_width(xmp: Mapping[str, str]) -> float | None:
    """The pixels across that a maker's calibration is of: it meets the sensor near its middle."""
    return _times(first_number(xmp, "CalibratedOpticalCenterX", "CalibratedOpticalCenter:X"), 2)


@dataclass(frozen=True)
class _Hints:
    """What tells whether a program that shrank a photograph rewrote its size, too."""

    shape: float
    """The shorter side of the picture over the longer one."""
    in_table: float | None
    """The focal length over the longer side, by the table of sensors."""
    equivalent: float | None
    """And by the 35 mm equivalent."""


def _whole_side(side: float, center: Sequence[float], focal: float, hints: _Hints) -> float:
    """The longer side that a measured focal length is of: `side`, as EXIF's size says it, or what the optical center of
    the measurement lies in the middle of. All are in pixels, or all in millimeters.

    A photograph that was shrunk has the whole width or height of that, so that the smaller of two factors counts. One
    that a camera cuts out of its sensor may have the center of either: the nearer to the table of sensors is taken. A
    center whose coordinates both say the same factor is believed more than the 35 mm equivalent, a whole number.
    """
    sides = sorted(2 * each for each in center if each > 0)[::-1]
    if not sides:
        return side
    factors = [whole / present for whole, present in zip(sides, (side, side * hints.shape), strict=False)]
    whole = min(factors) * side
    if abs(whole / side - 1) < OFF_MIDDLE:
        return side
    if max(factors) / min(factors) < 1 + OFF_MIDDLE:  # the smaller is that of the side where the center is farther off
        whole = factors[0] * side
    if not 1 / AGREE < whole / side < AGREE:
        return whole
    tolerance = EVEN if abs(whole / side - 1) < 2 * OFF_MIDDLE else OFF_MIDDLE  # so far off the middle lies no center
    is_even = len(factors) > 1 and max(factors) / min(factors) < 1 + tolerance
    likely = hints.in_table or (None if is_even else hints.equivalent)
    if likely is None:
        return whole if is_even else side
    return min((side, whole), key=lambda each: abs(math.log(focal / each / likely)))


def _calibrated(xmp: Mapping[str, str], original: float, part: float, hints: _Hints) -> float | None:
    """DJI: DewarpData is `date;fx,fy,cx,cy,...` in pixels of the original, CalibratedFocalLength is fx alone (Skydio: a
    structure). Pix4D's matrix of fisheyes counts angles in quarter turns. Of the original a `part` was left."""
    words = text(xmp, "DewarpData").partition(";")[2].split(",")
    try:
        focal = float(words[0])
    except ValueError:
        focal = (
            first_number(xmp, "CalibratedFocalLength", "CalibratedFocalLength:X")
            or 2 / math.pi * _numbers(xmp, "Camera:FisheyeAffineMatrix")[0]
        )
    if not math.isfinite(focal) or focal <= 0:
        return None
    width = _calibrated_width(xmp)
    if width and part < 1:
        return focal / (width * part)
    centers = (first_number(xmp, f"CalibratedOpticalCenter{axis}", f"CalibratedOpticalCenter:{axis}") for axis in "XY")
    return focal / _whole_side(original, [each for each in centers if each] if width else [], focal, hints)


def _by_pix4d(
    xmp: Mapping[str, str], sensor_mm: float | None, original: float, part: float, hints: _Hints
) -> float | None:
    """Pix4D's names: millimetres, unless the unit is another (pixels), and where the view meets the sensor, near the
    middle of its sides, of which a `part` was left."""
    focal = _numbers(xmp, "Camera:PerspectiveFocalLength")[0]
    if text(xmp, "Camera:PerspectiveFocalLengthUnits").lower() not in ("", "mm"):
        return focal / original
    center = _numbers(xmp, "Camera:PrincipalPoint")
    if not sensor_mm:
        return _by_sensor(focal, 2 * part * center[0])
    whole_mm = _whole_side(sensor_mm, center[:2], focal, hints) if part == 1 and focal > 0 else sensor_mm
    return _by_sensor(focal, whole_mm) or _by_sensor(focal, sensor_mm)


def _numbers(xmp: Mapping[str, str], name: str) -> list[float]:
    """The numbers of a value, parted by commas; a zero for nonsense."""
    try:
        found = [float(word) for word in text(xmp, name).split(",")]
    except ValueError:
        return [0.0]
    return found if all(map(math.isfinite, found)) else [0.0]


def _sensor(details: Mapping[int, Any], original: float) -> float | None:
    """Width of the sensor in millimetres, from EXIF's pixels per inch (centimetre, millimetre) on it."""
    density, unit = _number(details.get(0xA20E)), details.get(0xA210, 2)
    if not density or unit not in _UNITS:
        return None
    return density * _UNITS[unit] if _is_width(details) else original / density * _UNITS[unit]


def _is_width(details: Mapping[int, Any]) -> bool:
    """Whether EXIF's density of pixels is the size of the sensor (FLIR's Duo Pro R: 10.88 and 8.704 mm): no pixel is so
    wide, and none is so far from square."""
    across, down = _number(details.get(0xA20E)), _number(details.get(0xA20F))
    return bool(_coarse_pixels(details)) and not (across and down and abs(across / down - 1) < CUT)


def _coarse_pixels(details: Mapping[int, Any]) -> str:
    """What to say of a density that no sensor has."""
    density, unit = _number(details.get(0xA20E)), details.get(0xA210, 2)
    if not density or unit not in _UNITS or _UNITS[unit] / density <= MAX_PIXEL_MM:
        return ""
    return (
        f"EXIF's FocalPlaneXResolution ({density:g}) would be pixels of {1000 * _UNITS[unit] / density:.0f} \u00b5m, "
        "which no sensor has; the focal length is a guess"
    )


def _used_width(model: str, width: float, height: float) -> float | None:
    """Of a known sensor, the longer side in millimetres that a camera takes for pictures of a shape: a picture that is
    less wide than the sensor has its whole height."""
    if model not in SENSOR_MM:
        return None
    across, down = SENSOR_MM[model]
    used = down * max(width, height) / min(width, height)
    return used if used < (1 - CUT) * across else across


def lens_numbers(focals_mm: Sequence[float | None]) -> list[int]:
    """Which of a camera's focal lengths in millimetres are of one lens, as numbers from 0: those that lie apart by
    `OTHER_LENS` from all others, and are of `LEAST_OF_A_LENS` photographs, are lenses; others are of the nearest lens.

    A zoom that was turned from photograph to photograph, and a lens whose focal length follows the focus, are one.
    """
    known = np.log(sorted(focal for focal in focals_mm if focal))
    groups = np.split(known, np.flatnonzero(np.diff(known) > math.log1p(OTHER_LENS)) + 1)
    lenses = np.array([group.mean() for group in groups if len(group) >= LEAST_OF_A_LENS])
    if len(lenses) < 2:
        return [0] * len(focals_mm)
    return [int(np.abs(lenses - math.log(focal)).argmin()) if focal else 0 for focal in focals_mm]


def _by_sensor(focal_mm: float | None, sensor_mm: float | None) -> float | None:
    return focal_mm / sensor_mm if focal_mm and sensor_mm and 1 < sensor_mm < 100 else None


def _by_equivalent(equivalent_mm: float | None, width: float, height: float) -> float | None:
    longer, shorter = max(width, height), min(width, height)
    if longer > MAX_SENSOR_ASPECT * shorter:
        shorter = round(longer * 3 / 4)
    return equivalent_mm / DIAGONAL_35_MM * math.hypot(longer, shorter) / longer if equivalent_mm else None
