"""The size of the photographs that a lens is told for, where a file does not say it: by the principal point."""

from __future__ import annotations

from pathlib import Path

from vdgs.captures.formats.source_capture import CENTERED
from vdgs.captures.image_files import same_aspect
from vdgs.errors import CaptureError

#: By whole numbers photographs are shrunk, or the file is; principal points lie in the middle, or near it, as a share
#: of it: those of DTU are 3.7 % off.
_SHRUNK, _EXACT, _MIDDLE = (1, *range(2, 17), *(1 / many for many in range(2, 17))), 0.01, 0.06
#: Doubled, the middle of an image is a whole number of pixels, but for what files round.
_ROUNDED = 1e-3
#: Sides of photographs, as cameras and people make them, are multiples of this number of pixels. Others whose middle a
#: principal point is are chance, where it is near the middle of the photograph itself, or of a multiple: files round it
#: to whole pixels.
_USUAL_PX = 4


def told_size(
    size: tuple[int, int], center: tuple[float, float], file: Path, label: str, remedy: str
) -> tuple[int, int]:
    """Width and height of the photograph that a lens with a principal point, in pixels from the corner, is told for;
    `size` is that of the photograph that is there, which may be shrunk, or larger.

    It is the size whose middle the principal point is exactly, if that has the shape of the photograph (and is a usual
    one, where a multiple is likely too); else the whole multiple, or part, whose middle is near it and clearly nearer
    than that of the next, the photograph itself among them; else the size whose middle it is, whole or not, if that has
    the shape. A principal point that is no middle of such a shape, or is near that of the photograph, is one off the
    middle, as that of a part of a photograph (choice).
    Raises `CaptureError`, which ends in the remedy, where none can be told: the focal length is of that size too.
    """
    across, down = (2 * c / side for c, side in zip(center, size, strict=True))
    if across > 0 and down > 0:
        off = {many: max(abs(across / many - 1), abs(down / many - 1)) for many in _SHRUNK}
        nearest, second = sorted(off, key=lambda many: off[many])[:2]
        is_multiple = off[nearest] <= _MIDDLE and off[second] > 2 * off[nearest]
        whole = (round(2 * center[0]), round(2 * center[1]))
        is_middle = max(abs(a - 2 * b) for a, b in zip(whole, center, strict=True)) < _ROUNDED
        is_middle &= not is_multiple or all(side % _USUAL_PX == 0 for side in whole)
        if off[nearest] > _EXACT and same_aspect(whole, size) and (is_middle or off[nearest] > _MIDDLE):
            return whole
        if is_multiple:
            return round(size[0] * nearest), round(size[1] * nearest)
        if _is_off_the_middle(across, down):
            return size
    raise CaptureError(
        f"{file}: {label} has its principal point at {center[0]:.0f}, {center[1]:.0f} pixels, and the photograph is "
        f"{size[0]}x{size[1]}: it is of another size. {remedy}"
    )


def _is_off_the_middle(across: float, down: float) -> bool:
    """Whether a principal point, in halves of both sides, is not near the middle, but cannot be near that of the
    photograph in another size either, or only of nearly the same."""
    low, high = CENTERED
    if not all(2 * low < each < 2 * high for each in (across, down)):
        return False
    uneven = max(across, down) / min(across, down) > (1 + _MIDDLE) / (1 - _MIDDLE)
    return uneven or abs((across * down) ** 0.5 - 1) <= _MIDDLE
