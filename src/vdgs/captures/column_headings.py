"""What the headings of columns mean: quantity, unit and datum, from one table of words in several languages.

A heading is taken apart into these words, whatever stands between them: `Altitude (AMSL) [m]`, `alt_msl_m`, `海拔高度`.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from typing import NamedTuple

#: Kinds of words; of quantities the former are above the sea or the ellipsoid, heights may be over the ground.
QUANTITIES = ("altitude", "elevation", "height")
DATUMS = frozenset({"sea", "ellipsoid", "ground", "undulation"})
#: Units: metres in one, or degrees in one.
LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "sft": 1200 / 3937, "us": 1200 / 3937}
ANGLES = {"deg": 1.0, "rad": 57.29577951308232, "gon": 0.9}
#: English, German, Spanish, French, Italian, Portuguese and Chinese; without accents and blanks.
_WORDS = {
    word: meaning
    for meaning, words in {
        "altitude": "alt altitude altitud altitudine cota quota cote zaltitude altitudez "
        "sensoraltitude sensorelevation 海拔",
        "elevation": "ele elev elevation elevacion elevacao elevazione 高程",
        "height": "height hgt hght ht hoehe hohe altura hauteur altezza 高度 高",
        "sea": "sea mar mare mer meer meeresspiegel meereshohe msl amsl asl slm snm snmm um udm sealevel "
        "meansealevel absolute abs absolut absoluta absolu absolue assoluta orthometric ortho orthometrisch "
        "orthometrische orthometrique ortometrica geoid geoide nn nhn unn unhn ngf ngvd navd navd88 egm egm96 egm2008 "
        "海平面 绝对 正",
        "ellipsoid": "ellipsoid ellipsoidal ellipsoidic ellipsoide ellipsoidale ellipsoidisch ellipsoidische elipsoide "
        "elipsoidal ellissoide ellissoidica ell ellips hae wgs wgs84 etrs89 grs80 椭球 大地",
        "ground": "agl ground relative rel takeoff home launch terrain ato boden grund gelande start startpunkt "
        "relativ sol suelo terreno tierra relativa relativo despegue decollage suolo terra decollo solo decolagem "
        "flughohe 相对 地面 离地 对地 起飞 起飞点 航",
        "undulation": "undulation geoidheight geoidheights geoidhgt geoidhght geoidalheight geoidht geoidseparation "
        "geoidsep geoidundulation geoidhohe geoidhoehe ondulation ondulacion ondulazione ondulacao hauteurdugeoide "
        "alturadelgeoide alturageoidal 大地水准面高 高程异常",
        "m": "m meter meters metre metres metro metros metri mt mts 米 公尺",
        "mm": "mm millimeter millimeters millimetre millimetres milimetros millimetri 毫米",
        "cm": "cm centimeter centimeters centimetre centimetres zentimeter centimetros centimetri 厘米",
        "km": "km kilometer kilometers kilometre kilometres kilometros chilometri 公里 千米",
        "ft": "ft ift feet foot fuss fuß pie pies pied pieds piede piedi 英尺",
        "sft": "sft",
        "us": "us survey ussurvey",
        "deg": "deg degree degrees grad grados grado degres degre gradi graus 度",
        "rad": "rad radian radians radianes radianti radianten radiant 弧度",
        "gon": "gon gons grads gradian gradians grade grades",
        "format": "dd decimal decimals decimales dezimal decimali dms int intl international",
        "": "gps gnss rtk camera drone uav photo above over below under level mean the of from and to at uber ub u auf "
        "sobre sob sopra el la le lo il del de da do du dela au dessus audessus nivel niveau livello sul dal al "
        "超 以上 以 上 的 面 点 距",
    }.items()
    for word in words.split()
}  # fmt: skip
_LONGEST = max(map(len, _WORDS))
_SIDES = {
    "n": "N", "north": "N", "nord": "N", "norte": "N", "s": "S", "south": "S", "sud": "S", "sur": "S", "sul": "S",
    "e": "E", "east": "E", "est": "E", "este": "E", "ost": "E", "w": "W", "west": "W", "ovest": "W", "oeste": "W",
    "ouest": "W",
}  # fmt: skip
_BRACKET = re.compile(r"[\[(]([^\])]*)[\])]?")
#: Angles with minutes (and seconds) in one number: DDMMSS.sss, dd.mmss, ddmm.mmmm.
_PACKED = re.compile(r"d{1,3}m{1,9}s*")


class Heading(NamedTuple):
    """What a heading says."""

    plain: str
    """Its letters outside brackets."""
    stem: str
    """The same without a unit behind."""
    meanings: tuple[str, ...]
    """Meanings of its words, those in brackets too; none where words outside brackets are in no table."""
    unread: tuple[str, ...]
    """What brackets say that is in no table."""
    side: str = ""
    """S or W, where brackets say it; N and E only say which way counts up."""
    packed: bool = False
    """Whether brackets say that degrees and minutes (and seconds) are written together."""
    units: tuple[str, ...] = ()

    @property
    def meters(self) -> float:
        """Metres in one of its values; 1 where it names no length."""
        return 1.0 if self.told_meters is None else self.told_meters

    @property
    def told_meters(self) -> float | None:
        """Metres in one of its values; None where it names no length."""
        if "us" in self.units and "ft" in self.units:
            return LENGTHS["us"]
        return next((LENGTHS[each] for each in self.units if each in LENGTHS and each != "us"), None)

    @property
    def degrees(self) -> float | None:
        """Degrees in one of its values; None where it names no angle."""
        return next((ANGLES[each] for each in self.units if each in ANGLES), None)

    @property
    def datum(self) -> str:
        """What an altitude is measured from; the ground and undulations count before what they are beside."""
        found = {*self.meanings} & DATUMS
        return next((each for each in ("undulation", "ground", "ellipsoid", "sea") if each in found), "")

    @property
    def quantity(self) -> str:
        """One of `QUANTITIES`, or nothing."""
        return next((each for each in QUANTITIES if each in self.meanings), "")


def read_heading(text: str) -> Heading:
    """What a heading says, word by word."""
    text = _plain_letters(text)
    words = _tokens(_BRACKET.sub(" ", text))
    count = _count_without_unit(words)
    brackets = [_read_bracket(bracket) for bracket in filter(None, map(str.strip, _BRACKET.findall(text)))]
    inside = _joined(bracket.meanings for bracket in brackets)
    outside = meanings_of("".join(words))
    behind = _joined(map(meanings_of, words[count:]))
    return Heading(
        plain="".join(words),
        stem="".join(words[:count]),
        meanings=() if outside is None else (*outside, *inside),
        unread=tuple(each.text for each in brackets if each.meanings is None and not each.packed),
        side=next((each.side for each in reversed(brackets) if each.side), ""),
        packed=any(each.packed for each in brackets),
        units=tuple(each for each in (*inside, *(outside or behind)) if each in LENGTHS or each in ANGLES),
    )


def _plain_letters(text: str) -> str:
    """Text in lower case without accents, the signs of degrees and feet as words."""
    text = re.sub(r"[\[(]\s*['′’]\s*[\])]", "(ft)", re.sub("[°º]", " deg ", text))
    text = unicodedata.normalize("NFKD", text.casefold())  # accents are signs of their own, brackets are narrow
    return "".join(sign for sign in text if not unicodedata.combining(sign))


def _joined(meanings: Iterable[list[str] | None]) -> list[str]:
    return [meaning for each in meanings for meaning in each or ()]


def _tokens(text: str) -> list[str]:
    return [word for word in re.split(r"[\W_]+", text) if word]


def _count_without_unit(words: list[str]) -> int:
    """How many of the words of a heading stand before its unit; the first is none."""
    count = len(words)
    while count > 1 and (tail := meanings_of(words[count - 1])) and {*tail} <= {*LENGTHS, *ANGLES, "format"}:
        count -= 1
    return count


class _Bracket(NamedTuple):
    """What a bracket of a heading says, as `Heading` has it."""

    text: str
    meanings: list[str] | None
    """None where a word is in no table."""
    side: str
    packed: bool


def _read_bracket(text: str) -> _Bracket:
    tokens = _tokens(text)
    packed = bool(_PACKED.fullmatch("".join(tokens)))
    if (meanings := meanings_of("".join(tokens))) is not None:
        return _Bracket(text, meanings, "", packed)
    sides = [_SIDES[token] for token in tokens if token in _SIDES]
    each = [meanings_of(token) for token in tokens if token not in _SIDES]
    if None in each or len(sides) > 1:
        return _Bracket(text, None, "", packed)
    side = next((letter for letter in sides if letter in ("S", "W")), "")
    return _Bracket(text, _joined(each), side, packed)


def meanings_of(letters: str) -> list[str] | None:
    """The meanings of the words that letters are made of, the longest first; None where they are made of others."""
    behind: list[list[str] | None] = [None] * len(letters) + [[]]  # what the letters from each place on mean
    for start in reversed(range(len(letters))):
        for end in range(min(start + _LONGEST, len(letters)), start, -1):
            meaning, rest = _WORDS.get(letters[start:end]), behind[end]
            if meaning is not None and rest is not None:
                behind[start] = [meaning, *rest]
                break
    return behind[0]
