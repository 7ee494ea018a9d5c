"""What the photographs of a flight tell of each other's tags: digital zoom, default angles, pictures without tags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from PIL import Image

from vdgs.captures.image_files import open_image
from vdgs.sfm.cut_pictures import cut_pictures
from vdgs.sfm.exif_gps import FLAT, VOID
from vdgs.sfm.flights import flights_of
from vdgs.sfm.focal_length import CUT, EQUIVALENT, Lens, unzoomed, zoomed
from vdgs.sfm.image_metadata import BODY, GIMBAL, ImageMetadata, looks_backwards
from vdgs.sfm.other_cameras import other_cameras
from vdgs.sfm.photograph_versions import versions
from vdgs.sfm.stitched_pictures import stitched
from vdgs.sfm.undistorted_copies import undistorted_copies

#: Focal lengths within this share of each other are one.
ONE_FOCAL = 0.02
#: Views whose tilt is this near to level may be those of a drone that records no angle (degrees).
LEVEL_DEG = 1.0
#: Fewer photographs do not tell a default from a measurement.
LEAST_ALIKE = 3
#: A mask by another name is black and white: this share of it lies within so many gray values of the two.
BLACK_AND_WHITE, NEAR_GRAY = 0.97, 24
_FLAT = "that the receiver measured no altitude (GPSMeasureMode 2)"
#: Sides of the small picture that tells a mask.
_LOOKED_AT = (128, 128)
#: What photographs say of the camera that took them: its name, its lens and the focal length in mm.
_Camera: TypeAlias = tuple[str, Lens | None, float | None]


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
    """Photographs that share the shorter side with most of their camera, or nearly, and lack some of the longer one
    were cut by a program or the camera, which leaves the focal length in pixels as it was."""
    known = [photo for photo in group if photo.lens is not None]
    if not known:
        return group
    usual = Counter((photo.size, photo.lens) for photo in known).most_common(1)[0][0]
    (size, usual_lens), found = usual, []
    for photo in group:
        lens, (short, longer) = photo.lens, sorted(photo.size)
        cut = usual_lens is not None and _is_cut_across((short, longer), sorted(size))
        if cut and lens and usual_lens and (lens.focal_mm, lens.source) == (usual_lens.focal_mm, usual_lens.source):
            doubt = "cut to another shape than most of its camera; the focal length in pixels is taken as theirs"
            focal = usual_lens.focal * max(size) / longer
            photo = replace(photo, lens=replace(lens, focal=focal), doubts=(*photo.doubts, doubt))
        found.append(photo)
    return found


def _is_cut_across(sides: Sequence[int], whole: Sequence[int]) -> bool:
    """Whether the sides of a picture, the shorter first, are those of a whole one, or nearly, of which some of the
    longer side was cut off. A shrunk picture has its shape."""
    shares = sides[0] / whole[0], sides[1] / whole[1]
    return shares[0] == 1 > shares[1] or (1 - CUT <= shares[0] < 1 and shares[1] < (1 - CUT) * shares[0])


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

    A picture without any tags is a stray only where most others have them and no file beside it says its place, and has
    lost its tags where half do; where fewer do, it is said what it may be.
    """
    reasons = other_cameras(photographs) | stitched(photographs)
    reasons |= versions([photo for photo in photographs if photo.name not in reasons])
    reasons |= undistorted_copies([photo for photo in photographs if photo.name not in reasons])
    reasons |= cut_pictures([photo for photo in photographs if photo.name not in reasons])
    tagged = [photo for photo in photographs if not photo.is_bare]
    bare = [photo for photo in photographs if photo.is_bare and photo.name not in reasons]
    cameras = dict[tuple[int, int], dict[_Camera, None]]()
    for photo in tagged:
        cameras.setdefault(photo.size, {})[photo.camera, photo.lens, photo.focal_mm] = None
    of_size = [(photo, list(cameras.get(photo.size, ()))) for photo in bare]
    if len(bare) > len(tagged):
        return reasons, _with_doubts(of_size)
    untaken, lent = _with_lent_cameras(of_size, len(bare) < len(tagged))
    return reasons | untaken, lent


def _with_doubts(bare: Sequence[tuple[ImageMetadata, Sequence[_Camera]]]) -> dict[str, ImageMetadata]:
    """Of pictures without tags, each with the cameras of tagged ones of its size: those that one camera with a known
    lens may have taken, which say so."""
    return {
        photo.name: replace(photo, doubts=(*photo.doubts, _may_be_by(cameras[0][0])))
        for photo, cameras in bare
        if len(cameras) == 1 and cameras[0][1] is not None
    }


def _with_lent_cameras(
    bare: Sequence[tuple[ImageMetadata, Sequence[_Camera]]], most_are_tagged: bool
) -> tuple[dict[str, str], dict[str, ImageMetadata]]:
    """Of pictures without tags, each with the cameras of tagged ones of its size: those that are no photographs, with
    the reason, and the others with that camera where it is one."""
    reasons, lent = dict[str, str](), dict[str, ImageMetadata]()
    for photo, cameras in bare:
        if not cameras and most_are_tagged and photo.lat_lon is None:
            reasons[photo.name] = (
                f"has no tags of a camera, and {photo.width} x {photo.height} pixels, unlike the photographs: no "
                "photograph of this flight? (Give it their tags if it is one.)"
            )
        elif cameras and is_black_and_white(photo):
            reasons[photo.name] = "is black and white and has no tags of a camera: a mask? Name it like its photograph"
        elif len(cameras) == 1:
            camera, lens, focal_mm = cameras[0]
            doubt = f"no tags of a camera; taken as by {camera}, as the others of its size"
            lent[photo.name] = replace(
                photo, camera=camera, lens=lens, focal_mm=focal_mm, doubts=(*photo.doubts, doubt)
            )
    return reasons, lent


def _may_be_by(camera: str) -> str:
    """Of pictures without tags that are more than those with: what to do if one camera took all."""
    return (
        f"no tags of a camera, but the size of those by {camera}: if it took this one, give it the tags (exiftool "
        "-TagsFromFile), which say the focal length that is a guess now"
    )


def is_black_and_white(photo: ImageMetadata) -> bool:
    """Whether a picture shows black and white alone, as masks do."""
    try:
        with open_image(photo.path) as image:
            image.draft("L", _LOOKED_AT)
            gray = np.asarray(image.convert("L").resize(_LOOKED_AT, Image.Resampling.NEAREST)).astype(int)
    except (OSError, SyntaxError, ValueError):
        return False
    return float(np.minimum(gray, 255 - gray).__le__(NEAR_GRAY).mean()) >= BLACK_AND_WHITE
