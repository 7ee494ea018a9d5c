"""Pictures that a program cut from photographs, and perhaps shrunk, so that nothing says their focal length."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from vdgs.sfm.focal_length import CUT
from vdgs.sfm.image_metadata import UNKNOWN_CAMERA, ImageMetadata

#: Shapes of sensors and films: programs and cameras shrink pictures to them over the whole width.
_SHAPES = (256 / 135, 16 / 9, 3 / 2, 4 / 3)
#: Where more of a camera's photographs (share) would be left out, they may be of another mode of it (choice).
_MOST = 1 / 3


def cut_pictures(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Pictures of a shape of no sensor and no film that are shorter on both sides than most photographs of their
    camera, with the reason; none of a camera that has many of them, nor where tags say how they were cut."""
    cameras: dict[str, list[ImageMetadata]] = {}
    for photo in photographs:
        if not (photo.camera.startswith(UNKNOWN_CAMERA) or photo.is_bare or photo.is_panorama):
            cameras.setdefault(photo.camera, []).append(photo)
    found = dict[str, str]()
    for members in cameras.values():
        usual = Counter(photo.size for photo in members).most_common(1)[0][0]
        cut = [photo for photo in members if _is_cut(photo.size, usual) and not _is_explained(photo)]
        if len(cut) <= _MOST * len(members):
            found |= {photo.name: _reason(photo, usual) for photo in cut}
    return found


def _is_cut(size: tuple[int, int], usual: tuple[int, int]) -> bool:
    """Whether a picture lacks both sides of photographs of the usual size, and is no mode of their camera: the whole
    width or height, or nearly (2992 x 2992 px of 4000 x 3000), at a whole part of the pixels."""
    (short, longer), (usual_short, usual_longer) = sorted(size), sorted(usual)
    shares = short / usual_short, longer / usual_longer
    whole = max(shares)  # how much it was shrunk if nothing but its shape was cut
    side, usual_side = (short, usual_short) if shares[0] == whole else (longer, usual_longer)
    if whole >= 1 - CUT or usual_side % side == 0 or 1 - min(shares) / whole < CUT:
        return False
    return not any(abs(longer / short / shape - 1) < CUT / 2 for shape in _SHAPES)


def _is_explained(photo: ImageMetadata) -> bool:
    return photo.lens is not None and bool(photo.lens.doubt or photo.lens.remark)


def _reason(photo: ImageMetadata, usual: tuple[int, int]) -> str:
    return (
        f"is of another shape than most by its camera, and smaller ({photo.width} x {photo.height} px, others "
        f"{usual[0]} x {usual[1]}): it was cut, and perhaps shrunk, so that nothing says its focal length. Give it as "
        "the camera took it"
    )
