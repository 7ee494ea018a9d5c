"""Frames as photographs: JPEG files with what is known of each in EXIF and XMP, where photographs of drones have it."""

from __future__ import annotations

import io
from datetime import datetime
from fractions import Fraction
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from vdgs.sfm.films.telemetry import Telemetry

#: JPEG's quality: features are found in these files.
QUALITY = 95
#: What cameras of films are called that do not say what they are.
UNKNOWN_FILM_CAMERA = "film"
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\x00"


def encode_frame(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """A JPEG file without tags."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return file.getvalue()


def with_tags(jpeg: bytes, film: str, camera: tuple[str, str], moment: datetime | None, known: Telemetry) -> bytes:
    """The JPEG file with EXIF and XMP. The film stands for the serial number of its camera: the lens of each is found
    on its own, as films are cut from different parts of a sensor. EXIF's text is ASCII: other names stand in XMP."""
    in_exif, in_xmp = (film, "") if film.isascii() else ("", film)
    segments = b"".join(_segment(part) for part in (_exif(in_exif, camera, moment, known), _xmp(in_xmp, known)) if part)
    return jpeg[:2] + segments + jpeg[2:]


def _segment(content: bytes) -> bytes:
    return b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content


def _exif(film: str, camera: tuple[str, str], moment: datetime | None, known: Telemetry) -> bytes:
    exif = Image.Exif()
    make, model = camera
    if make:
        exif[0x010F] = make
    exif[0x0110] = model or UNKNOWN_FILM_CAMERA
    details: dict[int, Any] = {0xA431: film} if film else {}
    if moment is not None:
        details[0x9003] = f"{moment:%Y:%m:%d %H:%M:%S}"
        details[0x9291] = f"{moment.microsecond // 1000:03d}"
    if known.focal_35mm:
        details[0xA405] = _whole_or_rational(known.focal_35mm)
    exif[_EXIF_IFD] = details
    if known.lat_lon is not None:
        exif[_GPS_IFD] = _gps(known.lat_lon, known.altitude)
    return exif.tobytes()


def _gps(lat_lon: tuple[float, float], altitude: float | None) -> dict[int, Any]:
    latitude, longitude = lat_lon
    gps: dict[int, Any] = {
        1: "S" if latitude < 0 else "N", 2: _sexagesimal(latitude), 3: "W" if longitude < 0 else "E",
        4: _sexagesimal(longitude),
    }  # fmt: skip
    if altitude is not None:
        gps |= {5: b"\x01" if altitude < 0 else b"\x00", 6: _rational(abs(altitude), 1000)}
    return gps


def _sexagesimal(degrees: float) -> tuple[IFDRational, ...]:
    minutes, seconds = divmod(abs(degrees) * 3600, 60)
    whole, minutes = divmod(int(minutes), 60)
    return IFDRational(whole), IFDRational(minutes), _rational(seconds, 100_000)


def _rational(value: float, parts: int) -> IFDRational:
    return IFDRational(Fraction(round(value * parts), parts))


def _whole_or_rational(value: float) -> int | IFDRational:
    """EXIF's FocalLengthIn35mmFilm, which is a whole number by its standard; with a fraction where it has one, which
    programs read all the same: half a millimetre is 2 % of a wide lens."""
    return int(value) if value == int(value) else _rational(value, 1000)


def _xmp(film: str, known: Telemetry) -> bytes:
    values = {} if known.relative_altitude is None else {"RelativeAltitude": known.relative_altitude}
    if known.gimbal is not None:
        values |= dict(zip(("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"), known.gimbal, strict=True))
    written = {name: f"{value:+.3f}" for name, value in values.items()}
    written |= {"CameraSerialNumber": film} if film else {}
    if not written:
        return b""
    attributes = " ".join(f"drone-dji:{name}={quoteattr(value)}" for name, value in written.items())
    return (
        _XMP_HEADER
        + (
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            f'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></rdf:RDF></x:xmpmeta>'
        ).encode()
    )
