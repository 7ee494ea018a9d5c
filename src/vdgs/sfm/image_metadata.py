"""What a photograph says of itself: EXIF, and the XMP of drones."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import UnidentifiedImageError

from vdgs.captures.capture_dates import exif_form
from vdgs.captures.image_files import MAX_IMAGE_PX, SUPPORTED_MODES
from vdgs.captures.image_suffixes import TIFF_SUFFIXES
from vdgs.captures.image_tags import ImageTags, read_tags
from vdgs.captures.jpeg import lacks_only_end
from vdgs.captures.tiff_channels import why_no_picture
from vdgs.errors import CaptureError
from vdgs.sfm.exif_gps import (
    Altitude,
    dilution,
    finite,
    is_measured_in_xmp,
    plain_text,
    read_altitudes,
    read_fix,
    read_place,
)
from vdgs.sfm.focal_length import Lens, read_lens, zoomed_focal_mm
from vdgs.sfm.map_datums import to_wgs84
from vdgs.sfm.spectral_bands import band_of, is_surely_of_band
from vdgs.sfm.thermal_signs import thermal_sign
from vdgs.sfm.xmp import first_number, read_xmp, text
from vdgs.system.permissions import refusal


@dataclass(frozen=True, eq=False)
class Attitude:
    """Rows of `camera_from_enu` [3, 3] are the camera's right, down and forward as east, north, up."""

    camera_from_enu: np.ndarray
    has_heading: bool = True
    """False where none was recorded, and 0 stands for it; nothing but `gravity` is known then."""

    @property
    def tilt_deg(self) -> float:
        """Angle between the view and straight down."""
        return float(np.degrees(np.arccos(np.clip(-self.camera_from_enu[2, 2], -1, 1))))

    @property
    def gravity(self) -> np.ndarray:
        """Straight down in the camera's axes, unit [3]."""
        return -self.camera_from_enu[:, 2]


def attitude_from_gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Attitude:
    """Yaw is clockwise from north, pitch -90 is straight down, roll turns the picture about the view."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    down = np.cross(forward, right)
    return Attitude(
        np.stack([np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward])
    )


def attitude_from_aircraft(heading_deg: float, pitch_deg: float, roll_deg: float) -> Attitude:
    """A camera fixed to an aircraft, looking down, its top forwards; pitch is nose up, roll right wing down."""
    h, p, r = np.radians([heading_deg, pitch_deg, roll_deg])
    about_down = np.array([[np.cos(h), -np.sin(h), 0], [np.sin(h), np.cos(h), 0], [0, 0, 1]])
    about_wing = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_nose = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    nose, wing, belly = (about_down @ about_wing @ about_nose).T  # in north, east, down
    enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return Attitude(np.stack([wing, -nose, belly]) @ enu)


#: What `read_attitudes` says of angles that are no measurement.
DEFAULT_ANGLES = "all angles of the camera are exactly 0: a default, no measurement; not used"
#: Without its heading a view is believed only where it looks so nearly down that the heading hardly matters (degrees).
NEARLY_DOWN_DEG = 20.0
#: In Pix4D's XMP a pitch of 0 looks down and 90 ahead. Below this (degrees) the gimbal's own angle was written there:
#: cameras do not look backwards.
_BACKWARDS_DEG = -30.0
#: Drones that write the gimbal's own angles under Pix4D's names, by EXIF's model: Autel's EVO Lite 640T.
_GIMBALS_UNDER_PIX4D = ("XL715",)
#: What three angles may be: those of a body that looks down when level, or of the gimbal, with their roll either way.
BODY, BODY_NEGATED = "those of a body that looks down when level", "those of such a body with the roll negated"
GIMBAL, GIMBAL_NEGATED = "those of the gimbal", "those of the gimbal with the roll negated"
_READINGS = {
    BODY: (attitude_from_aircraft, 1),
    GIMBAL: (attitude_from_gimbal, 1),
    BODY_NEGATED: (attitude_from_aircraft, -1),
    GIMBAL_NEGATED: (attitude_from_gimbal, -1),
}
#: XMP's names of yaw, pitch and roll, and how those who write them may mean them.
_WAYS: tuple[tuple[Any, ...], ...] = (
    (("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"), GIMBAL),
    (("CameraYawDegree", "CameraPitchDegree", "CameraRollDegree"), GIMBAL),
    (("CameraOrientationNED:Yaw", "CameraOrientationNED:Pitch", "CameraOrientationNED:Roll"), GIMBAL),
    (("drone-yuneec:GimbalYaw", "drone-yuneec:GimbalPitch", "drone-yuneec:GimbalRoll"), GIMBAL),
    (("xmp:CameraYaw", "xmp:CameraPitch", "xmp:CameraRoll"), GIMBAL),  # Yuneec's CGO3+
    (("sensefly:Heading", "sensefly:PitchAngle", "sensefly:RollAngle"), BODY, BODY_NEGATED),
    (("sensefly:Yaw", "sensefly:Pitch", "sensefly:Roll"), BODY, BODY_NEGATED),
    (("Camera:Yaw", "Camera:Pitch", "Camera:Roll"), BODY, GIMBAL, BODY_NEGATED, GIMBAL_NEGATED),
)


def looks_backwards(*photographs: Mapping[str, Attitude]) -> bool:
    """Whether angles are the gimbal's where their names define those of a body (`ImageMetadata.attitudes`): as many
    cameras would look backwards as bodies as would look up by the gimbal."""
    pitches = [each[GIMBAL].tilt_deg - 90 for each in photographs if BODY in each and GIMBAL in each]
    backwards = sum(pitch < _BACKWARDS_DEG for pitch in pitches)
    return 0 < backwards >= sum(pitch > 0 for pitch in pitches)


def likeliest_attitude(readings: Mapping[str, Attitude]) -> Attitude | None:
    """The reading that the pitch of one photograph speaks for: the first, as the names define it, mostly."""
    return readings[GIMBAL] if looks_backwards(readings) else next(iter(readings.values()), None)


def read_attitudes(xmp: Mapping[str, str]) -> tuple[dict[str, Attitude], str]:
    """Where the camera looked by all readings that the names leave open, the defined one first, one mostly; none for no
    measurement. And what people should know of it.

    By the gimbal (DJI and those who write as it does, Parrot, Skydio, Yuneec), or as a body that looks down when level:
    Pix4D's names, and the aircraft that the camera is fixed to (senseFly). Angles that are all exactly 0 are those of a
    program that knew none.
    """
    for names, *readings in _WAYS:
        yaw, pitch, roll = (first_number(xmp, name) for name in names)
        if pitch is None:
            continue
        if not yaw and not pitch and not roll:
            return {}, DEFAULT_ANGLES
        if max(abs(yaw or 0.0), abs(pitch), abs(roll or 0.0)) > 360:
            continue
        if yaw is None:
            yaw = first_number(xmp, "FlightYawDegree", "DroneYawDegree", "GPSImgDirection")
        found = {}
        for reading in readings:
            from_angles, sign = _READINGS[reading]
            angles = yaw or 0.0, pitch, sign * (roll or 0.0)
            found[reading] = replace(from_angles(*angles), has_heading=yaw is not None)
        attitude = likeliest_attitude(found)
        known = attitude is not None and (yaw is not None or attitude.tilt_deg < NEARLY_DOWN_DEG)
        return (found if known else {}), ""
    return {}, ""


#: A shorter side below this shows too little to be matched: a thumbnail.
MIN_SIDE_PX = 100
#: EXIF orientations that turn a photograph by a quarter: width and height change places.
TRANSPOSED_ORIENTATIONS = (5, 6, 7, 8)
#: A receiver that is off by more has no position.
MAX_GPS_ERROR_M = 1000.0
#: DJI's RtkFlag of no position and of one without corrections, whose error is at least so many metres.
NOT_CORRECTED, UNCORRECTED_M = (0.0, 16.0), 0.3
#: COLMAP's models of lenses that a photograph may ask for.
RADIAL, FISHEYE = "SIMPLE_RADIAL", "OPENCV_FISHEYE"
#: The model of cameras of which nothing is fitted: of views that were cut out of panoramas.
EXACT_MODEL = "SIMPLE_PINHOLE"
#: XMP's names for the height over the take-off: DJI's and its followers', senseFly's, Yuneec's, MAVLink's by FLIR.
_OVER_TAKE_OFF = ("RelativeAltitude", "sensefly:Height", "drone-yuneec:AboveHomeAltitude", "FLIR:MAVRelativeAltitude")
#: What cameras are called that do not say what they are.
UNKNOWN_CAMERA = "unknown camera"
#: What stands before the serial number in the name of a camera.
SERIAL = " no. "


class UnusableImage(Exception):
    """A file that cannot be used as a photograph; the message says why."""


@dataclass(frozen=True, kw_only=True)
class ImageMetadata:
    """One photograph; sizes are those after it was turned upright."""

    name: str
    """Its name in the capture: posix, relative."""
    path: Path
    width: int
    height: int
    orientation: int
    """As EXIF counts: 1 is upright."""
    camera: str
    """Maker, model and serial number, as far as known."""
    lens: Lens | None
    focal_mm: float | None = None
    """EXIF's FocalLength in millimetres, times its digital zoom; with an unknown sensor it tells lenses apart alone."""
    datetime: str
    """Date and time as EXIF has them, 2026:06:23 16:31:59; empty where it says none."""
    lat_lon: tuple[float, float] | None
    """Latitude and longitude in degrees."""
    place_is_lent: bool = False
    """Whether a file beside it says that, not its own tags."""
    altitude: float | None
    altitude_type: str
    gps_std: tuple[float, float, float] | None
    """Standard deviations east, north and up in metres, where the receiver says them (RTK, PPK)."""
    gps_error_m: float | None
    """How far the place may be off across, in metres, where EXIF says it (GPSHPositioningError)."""
    relative_altitude: float | None
    """In metres; all of a flight are 0 of drones that do not know it (`without_default_heights`)."""
    attitude: Attitude | None
    """Of the picture as the sensor has it; None for pictures that lay on their side."""
    file_bytes: int
    has_alpha_channel: bool = False
    """Its file has an alpha channel, whatever that says."""
    mask: Path | None = None
    """White where it counts."""
    doubts: tuple[str, ...] = ()
    """What its tags say that is not believed, and why."""
    whole: bool = True
    """False where its file lacks the end marker, but nothing of the picture."""
    kind: str = ""
    """What makes it other than 8-bit sRGB in a file that all programs read, such as HEIC; empty for what is."""
    band: str = ""
    """The one band of a multispectral camera that it shows; empty for color."""
    band_is_sure: bool = True
    """False where a name that others use, too, alone says that."""
    camera_model: str = RADIAL
    """COLMAP's, by which the lens is fitted."""
    is_panorama: bool = False
    """Whether it shows all directions, equirectangular."""
    face: str = ""
    """Which view of a panorama it is; empty for photographs."""
    whole_size: tuple[int, int] = (0, 0)
    """Of such a view, width and height of the upright panorama."""
    sensor: str = ""
    """The folder of its camera in a rig (`rig1/cam0/`); empty for cameras on their own."""
    altitudes: tuple[Altitude, Altitude] | None = None
    """EXIF's and XMP's, where these differ."""
    exposure_bias: float | None = None
    """In stops, as it was chosen (EXIF's ExposureBiasValue)."""
    exposure_stops: float | None = None
    """Light that counts, in stops: exposure time and sensitivity."""
    datum_error_m: float = 0.0
    """How far the place may be off by the datum that EXIF names."""
    fix: str = ""
    """What EXIF says against its position or altitude: `VOID`, `FLAT`; empty for nothing."""
    subsecond: float | None = None
    """The part of the second of `datetime`, where EXIF says it (SubSecTimeOriginal)."""
    attitudes: Mapping[str, Attitude] = field(default_factory=dict, hash=False)
    """By all readings of the recorded angles (`BODY`, ...), where their names leave several open."""
    thermal: str = ""
    """What its maker says that tells a thermal picture; empty for color, and where nothing does."""
    frame: str = ""
    """What was taken at one moment: the name of the panorama, or of the photograph itself."""

    @property
    def is_bare(self) -> bool:
        """Whether its own tags do not say which camera took it, through what, and where."""
        placed = self.lat_lon is not None and not self.place_is_lent
        return self.camera == UNKNOWN_CAMERA and self.lens is None and not placed

    @property
    def may_be_masked(self) -> bool:
        """Whether something may be left out of it."""
        return self.mask is not None or self.has_alpha_channel

    @property
    def size(self) -> tuple[int, int]:
        """Width and height once it is upright."""
        return self.width, self.height

    @property
    def stored_size(self) -> tuple[int, int]:
        """Width and height of the file, before EXIF's orientation."""
        turned = self.orientation in TRANSPOSED_ORIENTATIONS
        return (self.height, self.width) if turned else (self.width, self.height)

    def to_upright_pixel(self, pixel: tuple[float, float]) -> tuple[float, float]:
        """Where a pixel of the file, from its upper left corner, lies once the photograph is upright."""
        (x, y), (width, height) = pixel, self.stored_size
        return {
            1: (x, y), 2: (width - x, y), 3: (width - x, height - y), 4: (x, height - y),
            5: (y, x), 6: (height - y, x), 7: (height - y, width - x), 8: (y, width - x),
        }[self.orientation]  # fmt: skip


def _read_head(path: Path) -> tuple[int, ImageTags, dict[str, str], bool]:
    """The bytes of a photograph, its tags, its XMP and whether it is a panorama."""
    try:
        size, found = path.stat().st_size, read_tags(path)
        if path.suffix.lower() in TIFF_SUFFIXES and (why := why_no_picture(path)):
            raise UnusableImage(why)
        _check(found)
        xmp = read_xmp(found.xmp_packet)
        return size, found, xmp, _is_panorama(found, xmp)
    except UnusableImage:
        raise
    except CaptureError as error:
        raise UnusableImage(str(error).removeprefix(f"{path}: ")) from None
    except UnidentifiedImageError:
        raise UnusableImage(_not_an_image(path)) from None
    except PermissionError as error:
        raise UnusableImage(refusal(path, error)) from None
    except OSError as error:
        why = "it is cut off" if "truncated" in str(error) else str(getattr(error, "strerror", None) or error)
        raise UnusableImage(f"cannot be read ({why}): copy it again") from None
    except (SyntaxError, ValueError, TypeError, KeyError, struct.error, OverflowError, MemoryError) as error:
        raise UnusableImage(f"is damaged ({error}): copy it again") from None


def read_image_metadata(path: Path, name: str) -> ImageMetadata:
    """Read the head of a photograph; its pixels are not decoded, unless its end is missing.

    Raises `UnusableImage` for files that are no image, too small, of colors that are not understood, or cut off.
    """
    size, found, xmp, panorama = _read_head(path)
    tags, details, gps, width, height = found.tags, found.details, found.gps, found.width, found.height
    orientation = tags.get(0x0112, 1)
    orientation = orientation if orientation in range(1, 9) else 1
    if not found.whole:
        _check_pixels(path)
    lens = read_lens(tags, details, xmp, width, height)
    if orientation in TRANSPOSED_ORIENTATIONS:
        width, height = height, width
    place, unclear = read_place(gps, xmp)
    in_xmp = is_measured_in_xmp(gps, xmp)
    datum, datum_error_m = "", 0.0
    if place is not None and not in_xmp:
        place, datum, datum_error_m = to_wgs84(place, gps)
    (altitude, altitude_type), both = read_altitudes(gps, xmp)
    attitudes, default = read_attitudes(xmp)
    if orientation != 1:
        attitudes = {}
    if GIMBAL in attitudes and plain_text(tags.get(0x0110)).upper() in _GIMBALS_UNDER_PIX4D:
        attitudes = {GIMBAL: attitudes[GIMBAL]}
    return ImageMetadata(
        name=name,
        path=path,
        width=width,
        height=height,
        orientation=orientation,
        camera=_camera(tags, details, xmp),
        lens=lens,
        focal_mm=zoomed_focal_mm(details),
        datetime=exif_form(plain_text(details.get(0x9003)) or plain_text(tags.get(0x0132))),
        subsecond=_subsecond(details),
        lat_lon=place,
        altitude=altitude,
        altitude_type=altitude_type,
        altitudes=both,
        gps_std=_stated_std(xmp),
        gps_error_m=_gps_error(gps),
        datum_error_m=datum_error_m,
        fix="" if in_xmp else read_fix(gps),
        relative_altitude=first_number(xmp, *_OVER_TAKE_OFF),
        attitude=likeliest_attitude(attitudes),
        attitudes=attitudes if len(attitudes) > 1 else {},
        file_bytes=size,
        has_alpha_channel=found.has_alpha_channel,
        doubts=tuple(filter(None, (unclear, datum, default, *((lens.doubt, lens.remark) if lens else ())))),
        whole=found.whole,
        kind=found.kind,
        band=band_of(path, found.mode, xmp),
        band_is_sure=is_surely_of_band(path, xmp),
        camera_model=FISHEYE if _is_fisheye(details, xmp) else RADIAL,
        is_panorama=panorama,
        exposure_bias=finite(details.get(0x9204)),
        exposure_stops=_exposure_stops(details),
        thermal=thermal_sign(found, xmp),
        frame=name,
    )


def _not_an_image(path: Path) -> str:
    """Why Pillow knows no format for a file."""
    if why := why_no_picture(path):
        return why
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp":
        return f"is no {path.suffix.lower().lstrip('.')} inside, and damaged: copy it again, or convert it to JPEG"
    return "cannot be read (no image format that is known): copy it again, or convert it to 8-bit RGB"


def _is_panorama(found: ImageTags, xmp: Mapping[str, str]) -> bool:
    """Whether a photograph shows all directions, equirectangular, by Google's XMP. Raises UnusableImage for
    panoramas of other projections, and for parts."""
    projection = text(xmp, "GPano:ProjectionType")
    if not projection:
        return False
    whole, cropped = (first_number(xmp, f"GPano:{which}Pixels") for which in ("FullPanoWidth", "CroppedAreaImageWidth"))
    if projection.lower() != "equirectangular" or not is_twice_as_wide(found.width, found.height):
        raise UnusableImage(f"is a panorama ({projection}), but not equirectangular and twice as wide as high")
    if whole and cropped and cropped < whole:
        raise UnusableImage("is a part of a panorama: export the whole of it, 360° by 180°")
    return True


def _is_fisheye(details: Mapping[int, Any], xmp: Mapping[str, str]) -> bool:
    """By the name of the lens, or by Pix4D's camera model."""
    words = plain_text(details.get(0xA434)), text(xmp, "Camera:ModelType")
    return any("fisheye" in word.lower().replace("-", "") for word in words)


def is_twice_as_wide(width: int, height: int) -> bool:
    """Whether a picture has the shape of a whole equirectangular panorama."""
    return abs(width - 2 * height) <= 2


def _check(found: ImageTags) -> None:
    if found.width * found.height > MAX_IMAGE_PX:
        raise UnusableImage(f"announces {found.width} x {found.height} pixels: it is damaged")
    if min(found.width, found.height) < MIN_SIDE_PX:
        raise UnusableImage(f"has {found.width} x {found.height} pixels only: a thumbnail")
    if found.mode not in SUPPORTED_MODES:
        raise UnusableImage(f"has the color mode {found.mode}: convert it to 8-bit RGB")


def _check_pixels(path: Path) -> None:
    """Raise UnusableImage unless all pixels of a JPEG without its end are there."""
    try:
        complete = lacks_only_end(path)
    except (OSError, MemoryError):
        complete = False
    if not complete:
        raise UnusableImage("cannot be read (it is cut off): copy it again")


def _camera(tags: Mapping[int, Any], details: Mapping[int, Any], xmp: Mapping[str, str]) -> str:
    maker, model = plain_text(tags.get(0x010F)), plain_text(tags.get(0x0110))
    serial = plain_text(details.get(0xA431)) or text(xmp, "CameraSerialNumber")
    named = model if maker and model.lower().startswith(maker.lower()) else f"{maker} {model}".strip()
    return f"{named or UNKNOWN_CAMERA}{f'{SERIAL}{serial}' if serial else ''}"


def _subsecond(details: Mapping[int, Any]) -> float | None:
    """EXIF's SubSecTimeOriginal: the digits behind the seconds of DateTimeOriginal; without that, those of DateTime."""
    digits = plain_text(details.get(0x9291 if plain_text(details.get(0x9003)) else 0x9290))
    return float(f"0.{digits}") if digits.isascii() and digits.isdigit() else None


def _stated_std(xmp: Mapping[str, str]) -> tuple[float, float, float] | None:
    """What the receiver says: DJI's RTK, Pix4D's names, which makers of wings and of multispectral cameras write,
    senseFly's older ones, Skydio's. Centimetres of a receiver without corrections are those of an earlier moment."""
    across = "Camera:GPSXYAccuracy", "sensefly:GPSXYAccuracy", "GpsHorizontalAccuracy"
    upwards = "Camera:GPSZAccuracy", "sensefly:GPSZAccuracy", "GpsVerticalAccuracy"
    names = (("RtkStdLon", *across), ("RtkStdLat", *across), ("RtkStdHgt", *upwards))
    found = [first_number(xmp, *each) for each in names]
    least = UNCORRECTED_M if first_number(xmp, "RtkFlag") in NOT_CORRECTED else 0.0
    east, north, up = (value if value is not None and least < value < 100 else None for value in found)
    return None if east is None or north is None or up is None else (east, north, up)


def _gps_error(gps: Mapping[int, Any]) -> float | None:
    """EXIF's GPSHPositioningError in metres, of which 0 and kilometres say nothing; else a poor dilution of precision:
    metres, of a receiver that is good to a metre, as is assumed where nothing is stated."""
    value = finite(gps.get(0x1F))
    return value if value is not None and 0 < value < MAX_GPS_ERROR_M else dilution(gps)


def _exposure_stops(details: Mapping[int, Any]) -> float | None:
    """Exposure time and sensitivity in stops; the aperture of drones stays as it is within seconds."""
    sensitivity = details.get(0x8827)
    sensitivity = sensitivity[0] if isinstance(sensitivity, tuple | list) and sensitivity else sensitivity
    seconds, iso = finite(details.get(0x829A)), finite(sensitivity) or 100.0
    return math.log2(seconds * iso) if seconds and seconds > 0 and iso > 0 else None
