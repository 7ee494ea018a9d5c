"""What a photograph says of itself: EXIF, and the XMP of drones."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vdgs.captures.image_files import MAX_IMAGE_PX, SUPPORTED_MODES, pillow_without_limits
from vdgs.sfm.focal_length import Lens, read_lens
from vdgs.sfm.xmp import first_number, read_xmp


@dataclass(frozen=True, eq=False)
class Attitude:
    """Rows of `camera_from_enu` [3, 3] are the camera's right, down and forward as east, north, up."""

    camera_from_enu: np.ndarray

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


#: A shorter side below this shows too little to be matched: a thumbnail.
MIN_SIDE_PX = 100
#: EXIF orientations that turn a photograph by a quarter: width and height change places.
TRANSPOSED_ORIENTATIONS = (5, 6, 7, 8)
#: A receiver that is off by more has no position.
MAX_GPS_ERROR_M = 1000.0
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\x00"
#: The ends of a JPEG that may have been cut off are looked for in so many bytes at its end.
_TAIL_BYTES = 1 << 16


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
    datetime: str
    """Date and time as EXIF has them, 2026:06:23 16:31:59; empty where it says none."""
    lat_lon: tuple[float, float] | None
    """Latitude and longitude in degrees."""
    altitude: float | None
    altitude_type: str
    gps_std: tuple[float, float, float] | None
    """Standard deviations east, north and up in metres, where the receiver says them (RTK)."""
    gps_error_m: float | None
    """How far the place may be off across, in metres, where EXIF says it (GPSHPositioningError)."""
    relative_altitude: float | None
    attitude: Attitude | None
    """Of the picture as the sensor has it; None for pictures that lay on their side."""
    file_bytes: int
    has_alpha_channel: bool = False
    """Its file has an alpha channel, whatever that says."""
    mask: Path | None = None
    """White where it counts."""

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


def read_image_metadata(path: Path, name: str) -> ImageMetadata:
    """Read the head of a photograph; its pixels are not decoded, unless its end is missing.

    Raises `UnusableImage` for files that are no image, too small, of colours that are not understood, or cut off.
    """
    try:
        size = path.stat().st_size
        with pillow_without_limits(), Image.open(path) as image:
            width, height = image.size
            _check(image)
            exif = image.getexif()
            tags, details, gps = dict(exif), dict(exif.get_ifd(_EXIF_IFD)), dict(exif.get_ifd(_GPS_IFD))
            xmp = read_xmp(_xmp_packet(image))
            transparent = "A" in image.getbands() or "transparency" in image.info
            if image.format == "JPEG" and not _has_end(path, size):
                image.load()
    except UnusableImage:
        raise
    except OSError as error:
        why = "it is cut off" if "truncated" in str(error) else str(getattr(error, "strerror", None) or error)
        raise UnusableImage(f"cannot be read ({why}): copy it again") from None
    except (SyntaxError, ValueError, TypeError, KeyError, struct.error, OverflowError, MemoryError) as error:
        raise UnusableImage(f"is damaged ({error}): copy it again") from None
    orientation = tags.get(0x0112, 1)
    orientation = orientation if orientation in range(1, 9) else 1
    lens = read_lens(tags, details, xmp, width, height)
    if orientation in TRANSPOSED_ORIENTATIONS:
        width, height = height, width
    altitude, altitude_type = _altitude(gps, xmp)
    attitude = _attitude(xmp) if orientation == 1 else None
    return ImageMetadata(
        name=name,
        path=path,
        width=width,
        height=height,
        orientation=orientation,
        camera=_camera(tags, details, xmp),
        lens=lens,
        datetime=_text(details.get(0x9003)) or _text(tags.get(0x0132)),
        lat_lon=_lat_lon(gps),
        altitude=altitude,
        altitude_type=altitude_type,
        gps_std=_rtk_std(xmp),
        gps_error_m=_gps_error(gps),
        relative_altitude=first_number(xmp, "drone-dji:RelativeAltitude", "sensefly:Height"),
        attitude=attitude,
        file_bytes=size,
        has_alpha_channel=transparent,
    )


def _check(image: Image.Image) -> None:
    if image.width * image.height > MAX_IMAGE_PX:
        raise UnusableImage(f"announces {image.width} x {image.height} pixels: it is damaged")
    if min(image.size) < MIN_SIDE_PX:
        raise UnusableImage(f"has {image.width} x {image.height} pixels only: a thumbnail")
    if image.mode not in SUPPORTED_MODES or image.mode.startswith("I"):
        raise UnusableImage(f"has the colour mode {image.mode}: convert it to 8-bit RGB")


def _has_end(path: Path, size: int) -> bool:
    """Whether a JPEG's end marker is near its end, where only trailing data of makers may follow it."""
    with path.open("rb") as file:
        file.seek(max(0, size - _TAIL_BYTES))
        return b"\xff\xd9" in file.read()


def _xmp_packet(image: Image.Image) -> bytes:
    for marker, content in getattr(image, "applist", ()):
        if marker == "APP1" and content.startswith(_XMP_HEADER):
            return bytes(content[len(_XMP_HEADER) :])
    packet = image.info.get("xmp", b"")
    return packet if isinstance(packet, bytes) else str(packet).encode("utf-8", errors="replace")


def _text(value: Any) -> str:
    """EXIF text without the zeros and control characters that it may be padded with."""
    if isinstance(value, bytes):
        value = value.decode("ascii", errors="replace")
    kept = "".join(letter for letter in value if letter.isprintable()) if isinstance(value, str) else ""
    return kept.strip()[:80]


def _camera(tags: Mapping[int, Any], details: Mapping[int, Any], xmp: Mapping[str, str]) -> str:
    maker, model = _text(tags.get(0x010F)), _text(tags.get(0x0110))
    serial = _text(details.get(0xA431)) or xmp.get("drone-dji:CameraSerialNumber", "")
    named = model if maker and model.lower().startswith(maker.lower()) else f"{maker} {model}".strip()
    return f"{named or 'unknown camera'}{f' no. {serial}' if serial else ''}"


def finite_float(value: Any) -> float | None:
    """A number of EXIF (a rational, mostly) as a float; None for what is none, infinite or NaN."""
    try:
        result = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return result if math.isfinite(result) else None


def _lat_lon(gps: Mapping[int, Any]) -> tuple[float, float] | None:
    latitude = _degrees(gps.get(2), _text(gps.get(1)).upper() == "S")
    longitude = _degrees(gps.get(4), _text(gps.get(3)).upper() == "W")
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None
    return latitude, longitude


def _degrees(value: Any, negative: bool) -> float | None:
    if not isinstance(value, (tuple, list)) or len(value) != 3:
        return None
    parts = [finite_float(each) for each in value]
    if any(part is None for part in parts):
        return None
    degrees = sum(part / 60**power for power, part in enumerate(parts) if part is not None)
    return -degrees if negative else degrees


def _altitude(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> tuple[float | None, str]:
    """Altitude in metres and what it is measured from, as far as the file says."""
    below = gps.get(5) in (b"\x01", 1)
    value = finite_float(gps.get(6))
    if value is None:
        value = first_number(xmp, "drone-dji:AbsoluteAltitude", "sensefly:AltitudeWGS84")
    elif below:
        value = -value
    if value is None or abs(value) > 20_000:
        return None, ""
    ellipsoidal = first_number(xmp, "sensefly:AltitudeWGS84")
    if ellipsoidal is not None and abs(ellipsoidal - value) < 0.01:
        return value, "above the WGS 84 ellipsoid (AltitudeWGS84)"
    named = xmp.get("drone-dji:AltitudeType", "")
    return value, f"{named} as recorded" if named else "EXIF GPSAltitude as recorded, datum not stated"


def _rtk_std(xmp: Mapping[str, str]) -> tuple[float, float, float] | None:
    found = [first_number(xmp, f"drone-dji:RtkStd{which}") for which in ("Lon", "Lat", "Hgt")]
    east, north, up = (value if value is not None and 0 < value < 100 else None for value in found)
    return None if east is None or north is None or up is None else (east, north, up)


def _gps_error(gps: Mapping[int, Any]) -> float | None:
    """EXIF's GPSHPositioningError in metres; 0 and kilometres say nothing."""
    value = finite_float(gps.get(0x1F))
    return value if value is not None and 0 < value < MAX_GPS_ERROR_M else None


def _attitude(xmp: Mapping[str, str]) -> Attitude | None:
    """From the gimbal (DJI), or the aircraft that the camera is fixed to, which looks down when level (senseFly)."""
    yaw, pitch, roll = (first_number(xmp, f"drone-dji:Gimbal{which}Degree") for which in ("Yaw", "Pitch", "Roll"))
    if yaw is not None and pitch is not None and roll is not None:
        return attitude_from_gimbal(yaw, pitch, roll)
    yaw, pitch, roll = (first_number(xmp, f"sensefly:{which}") for which in ("Heading", "PitchAngle", "RollAngle"))
    if yaw is not None and pitch is not None and roll is not None:
        return attitude_from_aircraft(yaw, pitch, roll)
    return None
