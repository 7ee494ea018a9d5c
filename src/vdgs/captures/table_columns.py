"""What the columns of tables are called, and the units that their names say."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

from vdgs.captures.image_files import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES

#: What each column is called, once blanks, signs, accents, units and the case of letters are taken away.
_COLUMNS: dict[str, frozenset[str]] = {
    what: frozenset(names.split())
    for what, names in {
        "name": "name label image imagename imagefile imagefilename filename file sourcefile photo photoname "
        "photograph picture picturename img imgname path filepath imagepath cameraname photolabel imagelabel "
        "photofilename photofile photopath picturefile picturefilename imgfile imgfilename sourceimage sourcefilename "
        "originalname originalfilename rawfilename rawname imagenames filenames "
        "dateiname bildname bild bilddatei foto fotos fotoname nombre imagen archivo nombrearchivo nombreimagen "
        "nombrefoto fichier nomdufichier nomfichier nomimage nomphoto nomefile nomefoto immagine "
        "照片名称 照片名 照片 文件名 文件名称 名称 影像名称 影像名 图像名称 图片名称",
        "id": "imageid photoid photographid pictureid imgid picid cameraid frameid shotid bildid fotoid idphoto "
        "idimage idfoto 照片id 影像id",
        "lat": "lat latitude gpslatitude gpslat ylatitude latitudey latitudedeg latdeg wgs84lat wgs84latitude "
        "latitudewgs84 ylat cameralatitude originallatitude breite breitengrad latitud latitudine 纬度",
        "lon": "lon long lng longitude gpslongitude gpslon gpslong gpslng xlongitude longitudex longitudedeg londeg "
        "wgs84lon wgs84longitude longitudewgs84 xlon cameralongitude originallongitude lange langengrad "
        "laenge laengengrad longitud longitudine 经度",
        "alt": "alt altitude gpsaltitude gpsalt zaltitude altitudez altitudem height ellipsoidheight ellipsoidalheight "
        "heightm heightz ele elev elevation z h up absolutealtitude altm cameraaltitude gpsheight zh altitudemsl "
        "heightellipsoid ellh hell hmsl hae "
        "elevationm altft altitudeft altitudefeet heightft hohe hoehe altitud altura quota 高度 海拔",
        "x": "x pointx "
        "easting east e utmeasting utmx xeasting xe eastingx coordx xm eastingm xeast rechtswert ostwert este",
        "y": "y pointy northing north n utmnorthing utmy ynorthing yn northingy coordy ym northingm ynorth hochwert "
        "nordwert norte",
        "latref": "latref latituderef gpslatituderef",
        "lonref": "lonref longituderef gpslongituderef",
        "altref": "altref altituderef gpsaltituderef",
        "across": "accuracyhorizontal horizontalaccuracy hacc accuracyh hdev horizontalerror accuracyxy errorxy "
        "gpshpositioningerror accuracyhorz horizontalaccuracym hzaccuracy xyaccuracy sdh stdh hrms hstd",
        "eastwards": "rmsx stdx sdx sigmax xrms "
        "longitudeacc lonacc xacc eastingacc rmseasting eastingrms sde stddeve sigmae accuracyxeasting "
        "accuracyxlongitude accuracyx",
        "northwards": "rmsy stdy sdy sigmay yrms "
        "latitudeacc latacc yacc northingacc rmsnorthing northingrms sdn stddevn sigman accuracyynorthing "
        "accuracyylatitude accuracyy",
        "upwards": "accuracyvertical verticalaccuracy vacc accuracyv vdev verticalerror accuracyz errorz "
        "verticalaccuracym zaccuracy sdv stdv vrms vstd altitudeacc altacc zacc heightacc "
        "rmsz stdz sdz sigmaz zrms rmselevation elevationrms sdu stddevu sigmau accuracyzaltitude",
        "system": "epsg crs srs epsgcode csname coordinatesystem",
    }.items()
}  # fmt: skip
#: How names of pictures end.
_PICTURES = IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES
#: Names of columns of moments.
_TIMES = re.compile(r"time|date|\butc|gpst|\btow\b|gpsweek|zeit|datum|hora|fecha|heure|时间|日期", re.IGNORECASE)
_UNIT = re.compile(
    r"[\[(][^\])]*[\])]|[_ ](?:decimal degrees|dd|deg|degrees|rad(?:ians)?|[kcm]?m|met(?:er|re)s?"
    r"|(?:us[ _]?)?f(?:oo|ee)?t)$"
)
#: How the names of columns, and values, say that they are feet.
_FEET = re.compile(r"(?:[\[( _\d]|^alt|^altitude|^height)(us[ _]?(?:survey[ _]?)?)?(?:ft|feet|foot)\b", re.IGNORECASE)
FOOT_M, SURVEY_FOOT_M = 0.3048, 1200 / 3937
#: Names of columns of altitudes that others of a table give way to: heights may be those over the ground.
_ALTITUDE = re.compile(r"alt(?!ura)|elli?p|ellh|elev|海拔", re.IGNORECASE)
#: Altitudes by names that are put together: `ell_hgt`, `alt_msl`, `Orthometric elevation`, `pointz`; none over ground.
_ALTITUDES = re.compile(
    r"(?!sensorheight)(?:gps|gnss|abs|absolute|ell|ellips|ellipsoid(?:al)?|ortho|orthometric|msl|amsl|wgs84|camera|geoid|sensor)*"
    r"(?:altitude|alt|height|hgt|hght|elevation|elev)"
    r"(?:gps|abs|ell|ellips|ellipsoid(?:al)?|ortho|msl|amsl|hae|wgs84|m)*|pointz"
)
#: Numbers with signs between thousands and another one before the decimals: 6,292,126.02 and 6.292.126,02.
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:(?:,\d{3})+\.\d+|(?:\.\d{3})+,\d+)")
#: Units of columns: parts of metres, and angles.
_PARTS = re.compile(r"[\[( _](mm|cm|km)\b", re.IGNORECASE)
ANGLES = re.compile(r"°|[\[( _](?:deg|degrees|rad)\b", re.IGNORECASE)
RADIANS = re.compile(r"[\[( _]rad(?:ians)?\b", re.IGNORECASE)

#: Columns of minutes and of seconds beside one of degrees: lat_min, Longitude (sec), lat_m.
_ANGLE = r"(?:gps)?(lat(?:itude)?|lon(?:g(?:itude)?)?|lng)[\W_]+"
_PARTED = re.compile(_ANGLE + r"(min(?:ute)?s?|sec(?:ond)?s?|m|s)\b\W*", re.IGNORECASE)
_LARGEST = re.compile(_ANGLE + r"max", re.IGNORECASE)

#: What programs write where they know nothing.
UNKNOWN = frozenset({"", "nan", "none", "null", "-", "n/a", "na"})

#: And what programs for rasters write then.
NO_DATA = frozenset({-9999.0, -99999.0, -32767.0, -32768.0})


def known_columns(words: Sequence[str]) -> dict[str, int]:
    """Which of these names of columns is what."""
    found: dict[str, int] = {}
    for k, word in enumerate(words):
        letters = unicodedata.normalize("NFKD", word.lower())  # accents are signs of their own, brackets are narrow
        plain = re.sub(r"[\W_]", "", _UNIT.sub("", letters))
        what = next((what for what, names in _COLUMNS.items() if plain in names), None)
        what = "alt" if what is None and _ALTITUDES.fullmatch(plain) else what
        if what == "alt" and what in found and _ALTITUDE.search(word) and not _ALTITUDE.search(words[found[what]]):
            found[what] = k
        elif what is not None:
            found.setdefault(what, k)
    return found


def with_names(known: Mapping[str, int], rows: Sequence[Sequence[str]]) -> dict[str, int]:
    """The known columns of these rows of places, with that of photographs' names where no heading says which it is: one
    of identifiers that are no plain numbers, else the first that holds names of pictures."""
    if "name" in known or not {*known} & {"lat", "lon", "x", "y"}:
        return dict(known)
    places = {*known.values()} - {known.get("id")}
    columns = [k for k in range(max(map(len, rows), default=0)) if k not in places]
    for k in sorted(columns, key=lambda k: k != known.get("id")):
        words = [row[k].strip() for row in rows if k < len(row) and row[k].strip()]
        labels = k == known.get("id") and not all(math.isfinite(number_of(word)) for word in words)
        if words and (labels or all(PurePosixPath(word).suffix.lower() in _PICTURES for word in words)):
            return {**known, "name": k}
    return dict(known)


def parted_angles(words: Sequence[str]) -> list[str]:
    """Those of these names of columns that hold minutes or seconds of angles whose degrees have a column of their own;
    `m` and `s` alone, which may mean metres and a deviation, only where both are there."""
    found = [(word, match[2].lower()) for word in words if (match := _PARTED.fullmatch(word.strip()))]
    units = {unit for _, unit in found}
    if any(_LARGEST.match(word.strip()) for word in words):  # lat_min is the least of them then
        return []
    return [word for word, unit in found if len(unit) > 1 or {"m", "s"} <= units]


def has_time(words: Sequence[str]) -> bool:
    """Whether one of these names of columns is that of moments."""
    return any(_TIMES.search(word) for word in words)


def meters_of(word: str) -> float:
    """How many metres the unit has that a word names: feet, US survey feet, parts of metres, or metres."""
    feet = _FEET.search(word)
    if parts := _PARTS.search(word):
        return {"mm": 1e-3, "cm": 1e-2, "km": 1e3}[parts[1].lower()]
    return 1.0 if feet is None else SURVEY_FOOT_M if feet[1] else FOOT_M


def number_of(word: str) -> float:
    """The number that a word says; NaN where it says none."""
    if _THOUSANDS.fullmatch(word):  # the last sign is the decimal one
        word = re.sub(r"[.,](?=.*[.,])", "", word).replace(",", ".")
    try:
        return float(word)
    except ValueError:
        return math.nan
