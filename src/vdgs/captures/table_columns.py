"""Which column of a table is what, by its heading or by what it holds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import PurePosixPath
from typing import NamedTuple

from vdgs.captures.column_headings import LENGTHS, QUANTITIES, Heading, read_heading
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES

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
        "alt": "z h up zh heightz pointz geoz ellh hell hmsl hae msl amsl asl",
        "x": "x pointx geox "
        "easting east e utmeasting utmx xeasting xe eastingx coordx xm eastingm xeast rechtswert ostwert este",
        "y": "y pointy geoy northing north n utmnorthing utmy ynorthing yn northingy coordy ym northingm ynorth "
        "hochwert nordwert norte",
        "latref": "latref latituderef gpslatituderef",
        "lonref": "lonref longituderef gpslongituderef",
        "altref": "altref altituderef gpsaltituderef",
        "across": "accuracyhorizontal horizontalaccuracy hacc accuracyh hdev horizontalerror horzerror accuracyxy "
        "errorxy gpshpositioningerror accuracyhorz horizontalaccuracym hzaccuracy xyaccuracy sdh stdh hrms hstd",
        "eastwards": "rmsx stdx sdx sigmax xrms "
        "longitudeacc lonacc xacc eastingacc rmseasting eastingrms sde stddeve sigmae accuracyxeasting "
        "accuracyxlongitude accuracyx",
        "northwards": "rmsy stdy sdy sigmay yrms "
        "latitudeacc latacc yacc northingacc rmsnorthing northingrms sdn stddevn sigman accuracyynorthing "
        "accuracyylatitude accuracyy",
        "upwards": "accuracyvertical verticalaccuracy vacc accuracyv vdev verticalerror verterror accuracyz errorz "
        "verticalaccuracym zaccuracy sdv stdv vrms vstd altitudeacc altacc zacc heightacc "
        "rmsz stdz sdz sigmaz zrms rmselevation elevationrms sdu stddevu sigmau accuracyzaltitude",
        "system": "epsg crs srs epsgcode csname coordinatesystem",
    }.items()
}  # fmt: skip
#: Accuracies by the words that their headings are made of, beside the names above. Errors of x, y and z are none: they
#: are what an adjustment left (Metashape); `acc` with these may be accelerations.
_ACCURACY = (
    "accuracy|std|stdev|stddev|sigma|rms|rmse|deviation|uncertainty|precision|genauigkeit|precisione|precisao|"
    "exactitud|精度"
)
_SIDES_OF_ACCURACY = {
    "across": ("horizontal|horiz|horz|hor|hz|2d|planimetric|lage|orizzontale|水平|平面", "xy|h|en|ne"),
    "upwards": (
        "vertical|vert|ver|altitude|alt|height|hgt|hght|ht|elevation|elev|ele|hohe|hoehe|vertikal|verticale|垂直|高程",
        "z|v|u|up",
    ),
    "eastwards": ("east|easting|longitude|lon|lng", "x|e"),
    "northwards": ("north|northing|latitude|lat", "y|n"),
}
_ACCURACIES = {
    what: re.compile(
        f"(?:gps|gnss|rtk|position)?(?:(?:{_ACCURACY}|acc)(?:[xyz])?(?:{words})|(?:[xyz])?(?:{words})(?:{_ACCURACY}|acc)|"
        f"(?:{_ACCURACY})(?:{letters})|(?:{letters})(?:{_ACCURACY}))m?"
    )
    for what, (words, letters) in _SIDES_OF_ACCURACY.items()
}
#: Headings of accuracies that do not say along which axis, and of others (`stdev`) that seem to.
_BARE_ACCURACY = re.compile(f"(?:gps|gnss|rtk|position)?(?:{_ACCURACY}|acc)m?")
#: How names of pictures end.
_PICTURES = IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES
#: Names of columns of moments.
_TIMES = re.compile(r"time|date|\butc|gpst|\btow\b|gpsweek|zeit|datum|hora|fecha|heure|时间|日期", re.IGNORECASE)
FOOT_M = LENGTHS["ft"]
#: Numbers with signs between thousands: 6,292,126, 6,292,126.02 and 6.292.126,02; 350 000,12 (French) and 2'600'000.5
#: (Swiss). What `6,292` is other numbers of a table tell (`decimal_signs`).
_THOUSANDS = re.compile(
    r"[+-]?\d{1,3}(?:(?:,\d{3})+\.\d+|(?:\.\d{3})+,\d+|(?:,\d{3}){2,}|(?:\.\d{3}){2,}"
    r"|(?:[ \u00a0\u202f\u2009'’]\d{3})+(?:[.,]\d+)?)"
)
#: Signs of other columns of numbers than altitudes: angles, speeds, counts.
_OTHERS = re.compile(
    r"yaw|pitch|roll|omega|phi|kappa|head|course|gimbal|speed|sat|time|date|std|rms|acc|err|dop|iso|focal|width|lat|lon"
)
#: Words for sides, by the columns that hold them alone. O is east or west (`west_or_east`).
_SIDE_WORDS = {
    what: {word: letter for letter, words in sides.items() for word in words.split()}
    for what, sides in {
        "latref": {"N": "n north nord norte", "S": "s south sud süd sur sul"},
        "lonref": {"E": "e east est ost este", "W": "w west ovest oeste ouest", "O": "o"},
    }.items()
}
#: Headings in German, where O is east, and in languages where it is west.
_GERMAN = re.compile(r"^(?:breit|lang|laeng|hohe|hoehe|dateiname|bild)")
_ROMANCE = re.compile(
    r"^(?:longitud(?:ine)?$|latitud(?:ine)?$|altitud(?:ine)?$|nom|imagen|imagem|archivo|fichier|hauteur|cot|quota|immagine)"
)

#: Columns of minutes and of seconds beside one of degrees: lat_min, Longitude (sec), lat_m.
_ANGLE = r"(?:gps)?(lat(?:itude)?|lon(?:g(?:itude)?)?|lng)[\W_]+"
_PARTED = re.compile(_ANGLE + r"(min(?:ute)?s?|sec(?:ond)?s?|m|s)\b\W*", re.IGNORECASE)
_LARGEST = re.compile(_ANGLE + r"max", re.IGNORECASE)

#: What altitudes are not measured from.
_NO_ALTITUDES = frozenset({"ground", "undulation"})

#: What programs write where they know nothing.
UNKNOWN = frozenset({"", "nan", "none", "null", "-", "n/a", "na", "undef", "inf", "-inf"})

#: And what programs for rasters write then.
NO_DATA = frozenset({-9999.0, -99999.0, -32767.0, -32768.0})


class Row(NamedTuple):
    """The words of a line."""

    number: int
    words: list[str]


def known_columns(words: Sequence[str]) -> dict[str, int]:
    """Which of these names of columns is what. Of altitudes the first counts whose name says that it is none over the
    ground, else an elevation, else a height; those over the ground and undulations of the geoid are none."""
    found: dict[str, int] = {}
    ranks: dict[str, int] = {}
    for k, word in enumerate(words):
        heading = read_heading(word)
        names = {heading.plain, heading.stem}
        named = next((what for what, known in _COLUMNS.items() if names & known), None)
        what = named or ("alt" if heading.quantity else _accuracy(heading))
        if what is None or (what == "alt" and heading.datum in _NO_ALTITUDES):
            continue
        rank = _rank(heading) if what == "alt" else 0
        if rank < ranks.get(what, len(QUANTITIES)):
            found[what], ranks[what] = k, rank
    return found


def _accuracy(heading: Heading) -> str | None:
    """Which accuracy a heading's words say; None for other headings."""
    stem = heading.stem
    if _BARE_ACCURACY.fullmatch(stem):
        return None
    return next((what for what, words in _ACCURACIES.items() if words.fullmatch(stem)), None)


def _rank(heading: Heading) -> int:
    return 0 if heading.datum or heading.quantity == "altitude" else 1 if heading.quantity == "elevation" else 2


def with_sides(known: Mapping[str, int], rows: Sequence[Sequence[str]]) -> dict[str, int]:
    """The known columns of these rows, with those of N or S and of E or W alone, where both are there."""
    found: dict[str, int] = {}
    for k in {*range(max(map(len, rows), default=0))} - {*known.values()}:
        values = {row[k].strip().lower() for row in rows if k < len(row)} - UNKNOWN
        found |= {
            what: k
            for what in _SIDE_WORDS
            if what not in found and values and all(side_letter(value, what) for value in values)
        }
    return {**found, **known} if len(found) == len(_SIDE_WORDS) else dict(known)


def side_letter(word: str, what: str) -> str:
    """The letter (N, S, E, W, or O) of a word for a side in a column of sides of latitudes (`latref`) or longitudes
    (`lonref`); nothing for other words."""
    return _SIDE_WORDS[what].get(word.strip(" .").lower(), "")


def with_units(rows: list[Row]) -> list[Row]:
    """The rows, where the second one names nothing but units these as the headings' own."""
    if len(rows) < 2:
        return rows
    units = [word.strip("[]() ").replace("-", "") for word in rows[1].words]
    headings = list(map(read_heading, (f"({unit})" for unit in units)))
    if not any(heading.units for heading in headings) or any(heading.unread for heading in headings):
        return rows
    names = [f"{word} [{unit}]" if unit else word for word, unit in zip_longest(rows[0].words, units, fillvalue="")]
    return [Row(rows[0].number, names), *rows[2:]]


def west_or_east(words: Sequence[str]) -> str:
    """What O stands for in a table of these headings: E for Ost, W for oeste, ouest, ovest; nothing where they do not
    tell."""
    plain = [read_heading(word).plain for word in words]
    if any(map(_GERMAN.match, plain)):
        return "E"
    return "W" if any(map(_ROMANCE.match, plain)) else ""


def heading_notes(words: Sequence[str], known: Mapping[str, int], rows: Sequence[Sequence[str]]) -> list[str]:
    """What to say of headings whose brackets are not understood, and of columns that are not read though they may be
    altitudes."""
    notes = _unit_notes(words, known) + _accuracy_notes(words, known)
    if "alt" in known:
        return notes
    ground = [word for word in words if _is_other_height(read_heading(word))]
    if ground:
        notes.append(
            f"{', '.join(map(repr, ground))}: over the ground, the take-off or the geoid, no altitude; not read."
        )
    columns = [(k, word, [row[k] for row in rows if k < len(row)]) for k, word in enumerate(words)]
    spare = [
        f"{word!r} ({values[0]})"
        for k, word, values in columns
        if k not in {*known.values()} and word not in ground and not _OTHERS.search(word.lower())
        if _are_altitudes(values)
    ]
    if spare:
        notes.append(
            f"no column is known as the altitude; not read: {', '.join(spare[:6])}. If one is it, call it `alt`."
        )
    return notes


def _unit_notes(words: Sequence[str], known: Mapping[str, int]) -> list[str]:
    """What to say of headings whose units are not understood, or are none of angles (of lengths for altitudes)."""
    notes = []
    for what in ("lat", "lon", "x", "y", "alt", "across", "upwards", "eastwards", "northwards"):
        if what not in known or known[what] >= len(words):
            continue
        heading, is_angle = read_heading(words[known[what]]), what in ("lat", "lon")
        wrong = any((each in LENGTHS) == is_angle for each in heading.units)
        if heading.unread or (wrong and (is_angle or what == "alt")):
            unit = "degrees" if is_angle else "metres"
            notes.append(f"the unit of the column {words[known[what]]!r} is not understood; read as {unit}.")
    return notes


def _accuracy_notes(words: Sequence[str], known: Mapping[str, int]) -> list[str]:
    """What to say of accuracies that are not read: across without upwards, one side of two, of no axis."""
    have_across = "across" in known or {"eastwards", "northwards"} <= {*known}
    if have_across and "upwards" in known:
        return []
    spare = [words[known[what]] for what in ("across", "eastwards", "northwards", "upwards") if what in known]
    spare += [word for word in words if _BARE_ACCURACY.fullmatch(read_heading(word).stem)]
    if not spare:
        return []
    missing = " and ".join(
        name for name, is_there in (("accuracy_horizontal", have_across), ("accuracy_vertical", "upwards" in known))
        if not is_there
    )  # fmt: skip
    return [f"{', '.join(map(repr, spare))}: not read, for accuracies need columns across and upwards; add {missing}."]


def _is_other_height(heading: Heading) -> bool:
    """Whether it is a height over the ground or an undulation."""
    is_height = heading.quantity or heading.plain == "agl" or heading.datum == "undulation"
    return bool(is_height) and heading.datum in _NO_ALTITUDES


def _are_altitudes(words: Sequence[str]) -> bool:
    values = [number_of(word.strip()) for word in words if word.strip().lower() not in UNKNOWN]
    return bool(values) and all(-450 < value < 9000 for value in values)  # False for NaN


def with_names(words: Sequence[str], known: Mapping[str, int], rows: Sequence[Sequence[str]]) -> dict[str, int]:
    """The known columns of these rows of places below the headings `words`, with that of photographs' names: of several
    that headings say hold names the first of pictures, else the first; where no heading says which it is one of
    identifiers that are no plain numbers, else the first that holds names of pictures."""
    if "name" in known:
        named = (k for k, word in enumerate(words) if "name" in known_columns([word]) and _holds_pictures(rows, k))
        return {**known, "name": next(named, known["name"])}
    if not {*known} & {"lat", "lon", "x", "y"}:
        return dict(known)
    places = {*known.values()} - {known.get("id")}
    columns = [k for k in range(max(map(len, rows), default=0)) if k not in places]
    for k in sorted(columns, key=lambda k: k != known.get("id")):
        labels = k == known.get("id") and not all(math.isfinite(number_of(word)) for word in _words_in(rows, k))
        if labels or _holds_pictures(rows, k):
            return {**known, "name": k}
    return dict(known)


def _words_in(rows: Sequence[Sequence[str]], k: int) -> list[str]:
    return [row[k].strip() for row in rows if k < len(row) and row[k].strip()]


def _holds_pictures(rows: Sequence[Sequence[str]], k: int) -> bool:
    """Whether all words of a column are names of pictures."""
    words = _words_in(rows, k)
    return bool(words) and all(PurePosixPath(word).suffix.lower() in _PICTURES for word in words)


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
    """How many metres the unit has that a heading names: feet, US survey feet, parts of metres, or metres."""
    return read_heading(word).meters


def told_meters(word: str) -> float | None:
    """The same of a heading that names a length; None of one that names none."""
    return read_heading(word).told_meters


def number_of(word: str) -> float:
    """The number that a word says; NaN where it says none."""
    try:
        return float(plain_number(word))
    except ValueError:
        return math.nan


def plain_number(word: str) -> str:
    """A word without the signs between thousands where it is such a number, of which the last sign is the decimal
    one."""
    if not _THOUSANDS.fullmatch(word.strip()):
        return word
    signs = re.sub(r"[^.,]", "", word)
    if len(signs) > 1 and len({*signs}) == 1:  # 6,292,126
        return re.sub(r"[.,]", "", word)
    return re.sub(r"[.,](?=.*[.,])|[^\d.,+-]", "", word).replace(",", ".")
