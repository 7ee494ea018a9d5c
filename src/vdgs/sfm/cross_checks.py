"""What the photographs of a flight tell of each other's tags: digital zoom, default angles, pictures without tags."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import PurePosixPath

import numpy as np
from PIL import Image, ImageOps

from vdgs.captures.image_files import open_image, same_aspect
from vdgs.sfm.brackets import SAME_STOPS
from vdgs.sfm.exif_gps import FLAT, VOID
from vdgs.sfm.flights import flights_of
from vdgs.sfm.focal_length import EQUIVALENT, Lens, unzoomed, zoomed
from vdgs.sfm.image_metadata import BODY, GIMBAL, UNKNOWN_CAMERA, ImageMetadata, looks_backwards
from vdgs.sfm.rig_folders import may_be_sensor

#: Focal lengths within this share of each other are one.
ONE_FOCAL = 0.02
#: Views whose tilt is this near to level may be those of a drone that records no angle (degrees).
LEVEL_DEG = 1.0
#: Fewer photographs do not tell a default from a measurement.
LEAST_ALIKE = 3
#: A smaller copy has at most this share of the longer side of the photograph of its name.
SMALLER = 0.7
#: A mask by another name is black and white: this share of it lies within so many gray values of the two.
BLACK_AND_WHITE, NEAR_GRAY = 0.97, 24
#: How DJI names what cameras of one drone take at a moment: DJI_20240329124328_0001_T, maybe with a flight behind it.
_DJI_NAME = re.compile(
    r"(?:(?P<before>.*?)(?P<time>\d{14})|)(?P<number>.*?)_(?P<camera>[TSVWZ])(?P<after>_.*)?", re.IGNORECASE
)
#: How systems and programs name what they copy or edit.
_COPY_NAME = re.compile(
    r"(.+?)(?:[ _-]+(?:copy|copie|kopie|copia)(?:[ _]?\(?\d{1,2}\)?)?"
    r"|[-_~](?:edited|edit|bearbeitet|hdr|enhanced(?:-(?:nr|sr|rd)){0,3}))",
    re.IGNORECASE,
)
#: How they count what they download again, and how cameras count photographs of one second.
_COUNTED_NAME = re.compile(r"(.+?)(?:[ _]?\(\d{1,2}\)|[-_~]\d)")
#: How iPhones name what was edited: IMG_E0001.JPG beside IMG_0001.HEIC.
_EDITED_ON_PHONE = re.compile(r"(.*\bIMG_)E(\d{4})", re.IGNORECASE)
_SAME_MOMENT = timedelta(seconds=2)
#: Programs may cut off the digits of parts of a second behind the second one.
_SAME_SUBSECOND = 0.01
#: Programs that convert photographs may round places by so much (about a metre; choice).
_ROUNDED_DEG = 1e-5
_FLAT = "that the receiver measured no altitude (GPSMeasureMode 2)"
#: Photographs show the same where the order of the gray values of their pixels correlates so well, by so many of them
#: (choice; five aerial photographs and themselves moved by 2 % of the width: 0.54 to 0.92).
SAME_PICTURE, LOOKED_AT_PAIRS = 0.95, 3
#: Sides of the small picture that tells it.
_LOOKED_AT = (128, 128)


def cross_checked(photographs: Sequence[ImageMetadata]) -> list[ImageMetadata]:
    """The photographs with what their tags say in the light of the others'."""
    groups: dict[str, list[ImageMetadata]] = {}
    for photo in photographs:
        groups.setdefault(photo.camera, []).append(photo)
    changed = {
        photo.name: photo
        for group in groups.values()
        for photo in _without_defaults(_one_convention(_one_altitude(_cropped(_zoom_once(_without_void(group))))))
    }
    return [changed[photo.name] for photo in photographs]


def _without_void(group: list[ImageMetadata]) -> list[ImageMetadata]:
    """Without positions that EXIF calls void and altitudes that it calls not measured. A receiver without them repeats
    the last: where all photographs of a camera say so and the values differ, the tag is a default."""
    found = list(group)
    for fix, tag in ((VOID, "a void position (GPSStatus V, or GPSDOP)"), (FLAT, _FLAT)):
        known = {p.name: p.lat_lon if fix == VOID else p.altitude for p in group}
        said = {p.name for p in group if p.fix == fix and known[p.name] is not None}
        values = [value for value in known.values() if value is not None]
        default = len(said) == len(values) >= LEAST_ALIKE and 2 * len(set(values)) > len(values)
        why = "but of all photographs of this camera, and the values differ: used" if default else "not used"
        for k, photo in enumerate(found):
            if photo.name not in said:
                continue
            kept = replace(photo, doubts=(*photo.doubts, f"EXIF says {tag}; {why}"))
            if not default:
                kept = replace(kept, lat_lon=None) if fix == VOID else replace(kept, altitude=None, altitudes=None)
            found[k] = kept
    return found


def _zoom_once(group: list[ImageMetadata]) -> list[ImageMetadata]:
    """Lenses whose EXIF focal length has the digital zoom in it, as the others of the camera tell, without a second;
    doubted where nothing tells, because all are zoomed."""
    whole = {photo.lens.focal_mm for photo in group if photo.lens and photo.lens.focal_mm and photo.lens.zoom == 1}
    found = []
    for photo in group:
        lens = photo.lens
        if lens is not None and lens.zoom > 1 and lens.focal_mm:
            already = any(_near(lens.focal_mm / lens.zoom, focal) for focal in whole)
            if already and not any(_near(lens.focal_mm, focal) for focal in whole):
                photo = replace(photo, lens=unzoomed(lens))
            elif not whole and not lens.zoom_confirmed and lens.zoom > 1 + ONE_FOCAL:
                photo = _doubted(photo, lens)
        elif lens is not None and _lacks_zoom(lens, group):
            doubt = "the 35 mm equivalent is that of photographs without digital zoom; multiplied by DigitalZoomRatio"
            photo = replace(photo, lens=zoomed(lens), doubts=(*photo.doubts, doubt))
        found.append(photo)
    return found


def _lacks_zoom(lens: Lens, group: list[ImageMetadata]) -> bool:
    """Whether the 35 mm equivalent that a focal length is from lacks the digital zoom: others of the camera say the
    same without zoom, and none says what would be left without it."""
    zoom, focal_mm = lens.digital_zoom, lens.focal_mm or 0.0
    if lens.source != EQUIVALENT or zoom <= 1 + ONE_FOCAL:
        return False
    others = [each.lens for each in group if each.lens and each.lens.digital_zoom == 1]
    others = [each for each in others if any(_near_or_none(each.focal_mm, mm) for mm in (focal_mm, focal_mm / zoom))]
    return any(_near(each.focal, lens.focal) for each in others) and not any(
        _near(each.focal, lens.focal / zoom) for each in others
    )


def _doubted(photo: ImageMetadata, lens: Lens) -> ImageMetadata:
    """The photograph, whose focal length is fitted because EXIF may count the digital zoom twice."""
    pixels = lens.focal * max(photo.size)
    doubt = (
        f"all photographs of this camera are zoomed digitally, and nothing tells whether EXIF's focal length has that "
        f"in it already ({lens.zoom:g} times: {pixels:.0f} px if not, as taken, {pixels / lens.zoom:.0f} px if so); it "
        "is fitted. If heights look wrong, add a photograph without zoom, or mend DigitalZoomRatio"
    )
    return replace(photo, lens=replace(lens, doubt=doubt), doubts=(*photo.doubts, doubt))


def _cropped(group: list[ImageMetadata]) -> list[ImageMetadata]:
    """Photographs that share one side with most of their camera and lack some of the longer one were cut by a program,
    which leaves the focal length in pixels as it was."""
    known = [photo for photo in group if photo.lens is not None]
    if not known:
        return group
    usual = Counter((photo.size, photo.lens) for photo in known).most_common(1)[0][0]
    (size, usual_lens), found = usual, []
    for photo in group:
        lens, (short, longer) = photo.lens, sorted(photo.size)
        cut = usual_lens is not None and min(size) == short and longer < max(size)
        if cut and lens and usual_lens and (lens.focal_mm, lens.source) == (usual_lens.focal_mm, usual_lens.source):
            doubt = "cut to another shape than most of its camera; the focal length in pixels is taken as theirs"
            focal = usual_lens.focal * max(size) / longer
            photo = replace(photo, lens=replace(lens, focal=focal), doubts=(*photo.doubts, doubt))
        found.append(photo)
    return found


def _near(one: float, other: float) -> bool:
    return abs(one / other - 1) < ONE_FOCAL


def _near_or_none(one: float | None, other: float) -> bool:
    return not one or not other or _near(one, other)


def _one_altitude(group: list[ImageMetadata]) -> list[ImageMetadata]:
    """Altitudes of a flight all from EXIF or all from XMP, as most of its photographs have it in which these differ: in
    a single one tags agree by chance. An altitude of 0 among EXIF's is a default: XMP's is taken, by as much off as the
    others."""
    flights = flights_of(group)
    found = list(group)
    for number in np.unique(flights):
        members = [k for k in np.flatnonzero(flights == number).tolist() if group[k].altitudes is not None]
        pairs = [group[k].altitudes or ((None, ""), (None, "")) for k in members]
        by_xmp = [group[k].altitude == in_xmp[0] for k, (_, in_xmp) in zip(members, pairs, strict=True)]
        if not 0 < sum(by_xmp) < len(by_xmp):
            continue
        most = 2 * sum(by_xmp) >= len(by_xmp)
        kind = Counter(group[k].altitude_type for k, each in zip(members, by_xmp, strict=True) if each == most)
        apart = [a[0] - b[0] for (a, b), each in zip(pairs, by_xmp, strict=True) if not each and a[0] and b[0]]
        for k, (in_exif, in_xmp), each in zip(members, pairs, by_xmp, strict=True):
            if each != most:
                altitude = (in_exif, in_xmp)[most][0]
                if not altitude and in_xmp[0] is not None:
                    altitude = in_xmp[0] + float(np.median(apart or [0.0]))
                found[k] = replace(group[k], altitude=altitude, altitude_type=kind.most_common(1)[0][0])
    return found


def _one_convention(group: list[ImageMetadata]) -> list[ImageMetadata]:
    """Attitudes under Pix4D's names all as Pix4D defines them, or all as gimbals measure them, as the photographs of
    the camera tell together: pitches above -30 degrees may be either."""
    reading = GIMBAL if looks_backwards(*(photo.attitudes for photo in group)) else BODY
    return [
        replace(photo, attitude=photo.attitudes[reading]) if reading in photo.attitudes else photo for photo in group
    ]


def _without_defaults(group: list[ImageMetadata]) -> list[ImageMetadata]:
    """Without attitudes that are one and the same level view in all photographs of a camera: nobody flies so."""
    attitudes = [photo.attitude for photo in group if photo.attitude is not None]
    if len(attitudes) < LEAST_ALIKE or abs(attitudes[0].tilt_deg - 90) > LEVEL_DEG:
        return group
    if any(not np.array_equal(each.camera_from_enu, attitudes[0].camera_from_enu) for each in attitudes):
        return group
    doubt = "all angles of the camera are the same level view in every photograph: a default; not used"
    return [
        replace(photo, attitude=None, doubts=(*photo.doubts, doubt)) if photo.attitude else photo for photo in group
    ]


def strays(photographs: Sequence[ImageMetadata]) -> tuple[dict[str, str], dict[str, ImageMetadata]]:
    """Pictures among the photographs that are none of the flight, with the reason; and photographs whose tags were
    lost, with the camera of the others of their size.

    A picture without any tags is a stray only where most others have them, and has lost its tags where half do; where
    fewer do, it is said what it may be.
    """
    reasons = _smaller_copies(photographs) | _other_cameras(photographs) | _later_copies(photographs)
    reasons |= _versions_elsewhere([photo for photo in photographs if photo.name not in reasons])
    tagged = [photo for photo in photographs if not is_bare(photo)]
    bare = [photo for photo in photographs if is_bare(photo) and photo.name not in reasons]
    lent = dict[str, ImageMetadata]()
    kinds = Counter((photo.size, photo.camera, photo.lens) for photo in tagged)
    for photo in bare:
        alike = [(camera, lens) for size, camera, lens in kinds if size == photo.size]
        if len(bare) > len(tagged):
            if len(alike) == 1 and alike[0][1] is not None:
                lent[photo.name] = replace(photo, doubts=(*photo.doubts, _may_be_by(alike[0][0])))
        elif not alike and len(bare) < len(tagged):
            reasons[photo.name] = (
                f"has no tags of a camera, and {photo.width} x {photo.height} pixels, unlike the photographs: no "
                "photograph of this flight? (Give it their tags if it is one.)"
            )
        elif alike and is_black_and_white(photo):
            reasons[photo.name] = "is black and white and has no tags of a camera: a mask? Name it like its photograph"
        elif len(alike) == 1:
            camera, lens = alike[0]
            doubt = f"no tags of a camera; taken as by {camera}, as the others of its size"
            lent[photo.name] = replace(photo, camera=camera, lens=lens, doubts=(*photo.doubts, doubt))
    return reasons, lent


def _may_be_by(camera: str) -> str:
    """Of pictures without tags that are more than those with: what to do if one camera took all."""
    return (
        f"no tags of a camera, but the size of those by {camera}: if it took this one, give it the tags (exiftool "
        "-TagsFromFile), which say the focal length that is a guess now"
    )


def is_bare(photo: ImageMetadata) -> bool:
    """Whether nothing says which camera took a picture, through what, and where."""
    return photo.camera == UNKNOWN_CAMERA and photo.lens is None and photo.lat_lon is None


def _other_cameras(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Pictures of a thermal camera and of the screen beside those that the same drone took (DJI: `_T` and `_S` beside
    `_V`, `_W` or `_Z` of the same moment, of which the cameras' clocks differ by a second or two)."""
    moments: dict[tuple[str, str], list[tuple[datetime, str, ImageMetadata]]] = {}
    for photo in photographs:
        name = PurePosixPath(photo.name)
        match = _DJI_NAME.fullmatch(name.stem)
        if match:
            with suppress(ValueError):
                taken = datetime.strptime(match["time"], "%Y%m%d%H%M%S") if match["time"] else datetime.min
                key = str(name.parent), f"{match['before']} {match['number']} {match['after']}".upper()
                moments.setdefault(key, []).append((taken, match["camera"].upper(), photo))
    found = {}
    for shots in moments.values():
        for taken, camera, photo in shots:
            beside = [other for when, which, other in shots if which in "VWZ" and abs(when - taken) <= _SAME_MOMENT]
            if camera == "T" and any(photo.width * photo.height < each.width * each.height for each in beside):
                found[photo.name] = (
                    f"is the thermal picture beside {beside[0].name}: give a folder of those alone to use them"
                )
            elif camera == "S" and beside:
                found[photo.name] = f"is the picture of the screen beside {beside[0].name}"
    return found


def taken_apart(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether two photographs were taken at other moments or places, as far as both say it."""
    moments = photo.datetime, other.datetime
    apart = all(moments) and (moments[0] != moments[1] or _are_of_other_parts(photo, other))
    return apart or _are_of_other_places(photo, other)


def _are_of_other_parts(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether both say the part of their second, and these differ."""
    if photo.subsecond is None or other.subsecond is None:
        return False
    return abs(photo.subsecond - other.subsecond) >= _SAME_SUBSECOND


def _are_of_other_places(photo: ImageMetadata, other: ImageMetadata) -> bool:
    if photo.lat_lon is None or other.lat_lon is None:
        return False
    return bool(np.abs(np.subtract(photo.lat_lon, other.lat_lon)).max() > _ROUNDED_DEG)


def _is_copy(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether two photographs of one name and shape are one. Programs rewrite dates: where those alone differ, what the
    photographs show tells."""
    if _are_of_other_places(photo, other):
        return False
    return not taken_apart(photo, other) or _show_the_same([(photo, other)])


def _smaller_copies(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Previews and thumbnails: of the name and shape of a larger photograph, in another folder, and not of another
    flight, whose files count from 1 again."""
    stems: dict[str, list[ImageMetadata]] = {}
    for photo in photographs:
        stems.setdefault(PurePosixPath(photo.name).stem.lower(), []).append(photo)
    usual = Counter(photo.size for photo in photographs).most_common(1)[0][0] if photographs else (0, 0)
    reasons = {}
    for alike in stems.values():
        for photo in alike:
            larger = [
                other
                for other in alike
                if max(photo.size) <= SMALLER * max(other.size)
                and same_aspect(photo.size, other.size)
                and _is_copy(photo, other)
            ]
            if larger and photo.size != usual:
                largest = max(larger, key=lambda other: other.width * other.height)
                reasons[photo.name] = f"is a smaller copy of {largest.name}"
    return reasons


def _later_copies(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Photographs that were edited or downloaded twice, beside the first: of its moment and place, named after it. A
    name that merely counts may be that of the next photograph of the same second: there both must show the same."""
    names = {PurePosixPath(photo.name).with_suffix("").as_posix().lower(): photo for photo in photographs}
    found = {}
    for photo in photographs:
        stem = PurePosixPath(photo.name).with_suffix("").as_posix()
        edited = _COPY_NAME.fullmatch(stem) or _EDITED_ON_PHONE.fullmatch(stem)
        match = edited or _COUNTED_NAME.fullmatch(stem)
        first = names.get("".join(match.groups()).lower()) if match else None
        if first is None or not photo.datetime or photo.camera != first.camera:
            continue
        same = (photo.datetime, photo.lat_lon) == (first.datetime, first.lat_lon) and not taken_apart(photo, first)
        if same and (edited or _show_the_same([(first, photo)])):
            shown = "" if edited else ", and what it shows"
            found[photo.name] = f"is a copy or another version of {first.name}, by its name, moment and place{shown}"
    return found


def _versions_elsewhere(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Photographs that another folder has too, edited or as raw files: of one name, moment, place and shape, and they
    show the same. The folder of more photographs is used. Folders of the cameras of a rig are not compared with each
    other: they share names, moments and places, and may show nearly the same."""
    folders: dict[str, dict[str, ImageMetadata]] = {}
    for photo in photographs:
        path = PurePosixPath(photo.name)
        folders.setdefault(str(path.parent), {})[path.stem.lower()] = photo
    found, kept = dict[str, str](), list[tuple[str, dict[str, ImageMetadata]]]()
    for folder in sorted(folders, key=lambda each: (_are_raw(folders[each]), -len(folders[each]), len(each), each)):
        for name, other in kept:
            if may_be_sensor(folder) and may_be_sensor(name):
                continue
            shared = sorted(folders[folder].keys() & other.keys())
            pairs = [(other[stem], folders[folder][stem]) for stem in shared]
            pairs = [(one, photo) for one, photo in pairs if one.name not in found and _is_one_exposure(one, photo)]
            if pairs and _show_the_same(pairs):
                for one, photo in pairs:
                    found[photo.name] = (
                        f"is another version of {one.name}, by its name, moment, place and what it shows"
                    )
        kept.append((folder, folders[folder]))
    return found


def _are_raw(folder: Mapping[str, ImageMetadata]) -> bool:
    return all(photo.kind == "raw" for photo in folder.values())


def _is_one_exposure(one: ImageMetadata, other: ImageMetadata) -> bool:
    known = bool(one.datetime and other.datetime) and not taken_apart(one, other)
    stops = one.exposure_stops, other.exposure_stops
    if stops[0] is not None and stops[1] is not None:  # of a bracket whose exposures were sorted into folders?
        known &= abs(stops[0] - stops[1]) < SAME_STOPS
    return known and ("raw" in (one.kind, other.kind) or same_aspect(one.size, other.size))


def _show_the_same(pairs: Sequence[tuple[ImageMetadata, ImageMetadata]]) -> bool:
    """Whether the photographs of each pair show the same in any brightness and contrast, by a few of them. A raw file
    and a picture of one exposure do."""
    chosen = [pairs[k] for k in sorted({len(pairs) * part // LOOKED_AT_PAIRS for part in range(LOOKED_AT_PAIRS)})]
    for one, other in chosen:
        if (one.kind == "raw") == (other.kind == "raw"):
            ranks = _gray_ranks(one), _gray_ranks(other)
            if not all(np.any(each) for each in ranks) or np.corrcoef(ranks)[0, 1] < SAME_PICTURE:
                return False
    return True


def _gray_ranks(photo: ImageMetadata) -> np.ndarray:
    """Which place each pixel [n] of a small upright picture has by its brightness, from the middle one; zeros for a
    picture of one gray value, and for one that Pillow does not read."""
    try:
        with open_image(photo.path) as image:
            image.draft("L", (2 * _LOOKED_AT[0], 2 * _LOOKED_AT[1]))
            small = ImageOps.exif_transpose(image).convert("L").resize(_LOOKED_AT, Image.Resampling.BOX)
            gray = np.asarray(small).ravel()
    except (OSError, SyntaxError, ValueError):
        return np.zeros(_LOOKED_AT[0] * _LOOKED_AT[1])
    ordered = np.sort(gray)
    ranks = np.searchsorted(ordered, gray) + np.searchsorted(ordered, gray, side="right")
    return np.asarray(ranks - ranks.mean())


def is_black_and_white(photo: ImageMetadata) -> bool:
    """Whether a picture shows black and white alone, as masks do."""
    try:
        with open_image(photo.path) as image:
            image.draft("L", _LOOKED_AT)
            gray = np.asarray(image.convert("L").resize(_LOOKED_AT, Image.Resampling.NEAREST)).astype(int)
    except (OSError, SyntaxError, ValueError):
        return False
    return float(np.minimum(gray, 255 - gray).__le__(NEAR_GRAY).mean()) >= BLACK_AND_WHITE
