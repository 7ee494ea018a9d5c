"""Names of coordinate systems, as programs and people write them in files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache

_STARTS = re.compile(
    r"(\d{4,6}$|(EPSG|ESRI|SRID)[\s:=_-]*\d+(?!\w|\.\w)|urn:ogc:def:crs:|https?://(www\.opengis\.net/(def/crs|gml/srs)|epsg\.io)/"
    r"|WGS\s?84\b|(\w+ ?\d+[ /_]*)?UTM[\s_]*(zone[\s_:]*)?\d{1,2}[\s_]*(north|south|[A-Z])?(?!\w|\.\w)"
    r"|\w[\w() +-]* / \w|\+proj=|\+init=|(GEOG|PROJ|GEO|PROJC|COMPD|COMPOUND)[A-Z]*CRS?\[|\w*CS\[)", re.I
)  # fmt: skip
#: Codes in whatever stands around them: `EPSG:32633+5773`, `EPSG=32633`, `UTM zone 33N (EPSG::32633)`, addresses.
_CODES = re.compile(r"(?:EPSG|SRID)(?:\.io/|\.xml#|[\s:=_-]{0,3})(\d{4,6}(?:\+\d{4,6})?)(?!\d|\.)", re.I)
_WKT = re.compile(r"\w*(CS|CRS)\[", re.I)
#: What `pyproj_name` makes of codes, of WGS 84 and its zones, and definitions.
_DEFINITION = re.compile(r"(EPSG|ESRI):\d|urn:|https?://|\+|\w*(CS|CRS)\[", re.I)
#: A line that may be a name alone: no table of words, no numbers on their own.
_WORDS = re.compile(r"(?!.*(^|\s)[\d.]+\s+[\d.])[A-Za-z][^,;\t]{2,60}")
#: Lists of photographs begin so; PROJ looks half a second for a name that it does not know.
_FILE_NAME = re.compile(r"\.[A-Za-z]{2,5}$")
#: What may stand around a name: quotes, and the separators by which spreadsheets fill a line.
AROUND = " \t\r\n,;'\""
#: ODM's words for the zones of UTM, and those that people write in their place.
#: A band of latitude may stand for the half: C to M is south, N to X north, but S alone says south.
_UTM = re.compile(r"([A-Z]+ ?\d+)?[ /_]*UTM(?:[ _]ZONE)?[ _]*(\d{1,2})[ _]*(NORTH|SOUTH|[C-HJ-NP-X])", re.I)
_LONGITUDE_LATITUDE = re.compile(r"WGS[ _]?84(?:[ _]+(?:long?[ _]?lat|lat[ _]?long?))?", re.I)


def names_a_system(line: str) -> bool:
    """Whether a line is the name of a coordinate system, as far as its beginning tells, or PROJ knows the whole."""
    line = line.strip(AROUND)
    if _STARTS.match(line):
        return True
    return bool(_WORDS.fullmatch(line)) and not _FILE_NAME.search(line) and _is_name(line)


def defines_a_system(line: str) -> bool:
    """Whether a line that may as well be a remark names a system: by a code, a definition, or words that are all of the
    name, no number alone and no words that only look like one (`North / targets`)."""
    if not names_a_system(line):
        return False
    name = pyproj_name(line)
    return bool(_DEFINITION.match(name)) or ("/" in name and _is_name(name))


@cache
def _is_name(words: str) -> bool:
    """Whether PROJ knows a projected system by these words: its name, that without the datum, or one of ESRI's."""
    try:
        import pyproj
    except ImportError:
        return False
    try:
        crs = pyproj.CRS.from_user_input(words)
    except pyproj.exceptions.ProjError:
        return False
    given, known = (re.sub(r"[\W_]", "", each.lower()) for each in (words, crs.name))
    return bool(crs.is_projected and (known.endswith(given) or words.count("_") > 2))


def join_definition(lines: Sequence[str]) -> tuple[str, int]:
    """The first line and, where it opens brackets (WKT), those up to where they are closed; and how many these are."""
    text, count = (lines[0] if lines else ""), 1
    while _WKT.match(text.strip(AROUND)) and text.count("[") > text.count("]") and count < len(lines):
        text, count = f"{text} {lines[count].strip()}", count + 1
    return text, count


def is_local_system(name: str) -> bool:
    """Whether a system is one of a site, without a place on Earth."""
    return bool(re.match(r"\s*(LOCAL|ENG(INEERING)?CRS|ENGCRS|\w*LOCAL_?CS)", name, re.I))


def pyproj_name(header: str) -> str:
    """ODM's own words for systems, `WGS84`, `WGS84 longlat` and `WGS84 UTM 15N`, as codes; others as they are."""
    header = re.sub(r"(?i)^(crs|srs)\s*:|\s#.*", "", header.strip(AROUND)).strip()
    codes = [] if "[" in header or header.startswith("+") else _CODES.findall(header)
    if 0 < len(dict.fromkeys(codes)) < 3:
        return f"EPSG:{'+'.join(dict.fromkeys(codes))}"
    if _LONGITUDE_LATITUDE.fullmatch(header):
        return "EPSG:4326"
    zone = _UTM.fullmatch(header)
    if zone is not None:
        south = zone[3].upper() in ("SOUTH", *"CDEFGHJKLMS")
        if zone[1] and not re.fullmatch(r"WGS[ _]?84", zone[1], re.I):
            datum = re.sub(r"(?i)SIRGAS ?", "SIRGAS ", zone[1].upper())
            return f"{datum} / UTM zone {int(zone[2])}{'S' if south else 'N'}"
        return f"EPSG:{(32700 if south else 32600) + int(zone[2])}"
    return re.sub(r"(?i)^(EPSG|ESRI)[\s:]+", r"\1:", header)
