"""What files beside a photograph say of where and when it was taken, whose own tags were stripped."""

from __future__ import annotations

import json
import os
import re
import unicodedata
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from vdgs.captures.image_suffixes import AVIF_SUFFIXES, HEIF_SUFFIXES, IMAGE_SUFFIXES
from vdgs.sfm.edited_names import EDITED_WORDS
from vdgs.sfm.exif_gps import finite, read_altitude, read_place
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.xmp import read_xmp

#: Google Takeout cuts names at so many letters, before the number of a double and `.json`.
_TAKEOUT_LETTERS = 46
_DOUBLE = re.compile(rf"(.*?)(?:-(?:{EDITED_WORDS}))?(\(\d+\))?", re.IGNORECASE)
#: What Google Photos keeps under a name of which a photograph may have been converted, the likeliest first.
_CONVERTED = (*sorted(HEIF_SUFFIXES), *sorted(AVIF_SUFFIXES), ".dng", *sorted(IMAGE_SUFFIXES))
#: Larger files are none (bytes).
_LARGEST = 1 << 20


def list_folder(folder: Path) -> Mapping[str, Path]:
    """The files of a folder by their names, composed as Unicode's NFC."""
    with suppress(OSError):
        return {unicodedata.normalize("NFC", name): folder / name for name in os.listdir(folder)}
    return {}


def with_sidecars(photo: ImageMetadata, listed: Callable[[Path], Mapping[str, Path]] = list_folder) -> ImageMetadata:
    """A photograph without a position with the one of Google Takeout's JSON, or of an XMP file, beside it; `listed` is
    `list_folder`, which may be cached."""
    if photo.lat_lon is not None:
        return photo
    for file in _takeout_files(photo.path, listed(photo.path.parent)):
        content = _read_json(file)
        geo = [content.get(key) for key in ("geoDataExif", "geoData")]  # the camera's before what people set
        for place in (each for each in geo if isinstance(each, dict)):
            latitude, longitude, altitude = (finite(place.get(key)) for key in ("latitude", "longitude", "altitude"))
            if latitude is None or longitude is None or not (latitude or longitude):
                continue
            if abs(latitude) > 90 or abs(longitude) > 180:
                continue
            kind = f"{file.suffix} of Google Takeout as recorded, datum not stated"
            return replace(
                photo, lat_lon=(latitude, longitude), altitude=altitude or None, altitude_type=kind,
                place_is_lent=True, datetime=photo.datetime or _moment(content), doubts=(*photo.doubts, _beside(file)),
            )  # fmt: skip
    for file in (photo.path.with_suffix(".xmp"), photo.path.with_name(f"{photo.path.name}.xmp")):
        if file.is_file() and file.stat().st_size < _LARGEST:
            xmp = read_xmp(file.read_bytes())
            position, _ = read_place({}, xmp)
            if position is not None:
                altitude, kind = read_altitude({}, xmp)
                doubts = (*photo.doubts, _beside(file))
                return replace(
                    photo, lat_lon=position, altitude=altitude, altitude_type=kind, place_is_lent=True, doubts=doubts
                )
    return photo


def _beside(file: Path) -> str:
    return f"says no position; that of the {file.suffix} beside it is used ({file.name})"


def _takeout_files(path: Path, beside: Mapping[str, Path]) -> list[Path]:
    """Takeout's JSON of a photograph, as it is called today and was until 2024; of another ending, that of what the
    photograph was converted from, unless that is used, too: beside a JPEG, what phones take is not."""
    stem = unicodedata.normalize("NFC", path.stem)
    if own := [beside[name] for name in _json_names(stem, path.suffix) if name in beside]:
        return own
    replaces = path.suffix.lower() in IMAGE_SUFFIXES
    endings = [
        each
        for suffix in _CONVERTED
        for each in (suffix, suffix.upper())
        if f"{stem}{each}" not in beside or (replaces and suffix not in IMAGE_SUFFIXES)
    ]
    return [beside[name] for ending in endings for name in _json_names(stem, ending) if name in beside]


def _json_names(stem: str, suffix: str) -> list[str]:
    match = _DOUBLE.fullmatch(stem)
    first, double = (match[1], match[2] or "") if match else (stem, "")
    name = f"{first}{suffix}"
    whole = (f"{name}.supplemental-metadata", name)
    return [f"{each[:_TAKEOUT_LETTERS]}{double}.json" for each in whole]


def _read_json(file: Path) -> dict[str, Any]:
    with suppress(OSError, ValueError, RecursionError):
        if file.stat().st_size < _LARGEST:
            content = json.loads(file.read_text(encoding="utf-8-sig"))
            return content if isinstance(content, dict) else {}
    return {}


def _moment(content: dict[str, Any]) -> str:
    """EXIF's form of the moment, in UTC."""
    taken = content.get("photoTakenTime")
    with suppress(TypeError, ValueError, OverflowError, OSError):
        if isinstance(taken, dict):
            return f"{datetime.fromtimestamp(int(taken['timestamp']), UTC):%Y:%m:%d %H:%M:%S}"
    return ""
