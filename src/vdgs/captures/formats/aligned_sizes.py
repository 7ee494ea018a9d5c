"""The size of the photographs that were aligned, where a file does not say it: by the pixels of the points they show.

Focal lengths of such files are in pixels of those photographs, and pixels count from their middle. Points are seen up
to the rims of a photograph, and not beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from enum import Enum
from pathlib import Path

import numpy as np

from vdgs.captures.formats.photograph_sizes import GIVE_ALIGNED, sizes_in_folder
from vdgs.captures.image_files import ROUNDING_PX
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

#: Programs that align photographs see few points beside them, but for those of lenses that they have undone: at most
#: this share, and this one where the points fill no rectangle (choice).
MAX_OUTSIDE, MAX_OUTSIDE_BENT = 0.01, 0.1
#: Points reach at least so far to the rims, in halves of the sides: programs look for none within some 30 pixels of
#: them. Points of whole photographs, evenly along all rims, reach so far as the latter (choice).
LEAST_REACH, WHOLE_REACH = 0.9, 0.97
#: So many points say how far they reach, and so many also which shape they fill (choice).
_FEW, _MANY = 100, 1000
#: The farthest points of so large a share may be strays.
_STRAYS = 1e-3
#: Of a photograph as a whole at least so many of the points lie in the outer tenth, which is a fifth of it (choice).
_AT_RIMS = 0.03
#: The part of a side that is its middle and that from which its ends begin; a rectangle is filled where points reach as
#: far in both, along both sides, within a share: this one of photographs that are larger, and this one of smaller ones,
#: for lenses that were undone move points at the corners by little more than those between them (choice).
_MIDDLE, _ENDS, _STRAIGHT, _STRAIGHTER = 0.4, 0.7, 0.025, 0.008


class Fit(Enum):
    """Whether points are those of photographs of a size."""

    FITS = 0
    """They reach to the rims."""
    UNCLEAR = 1
    """They end before the rims, or some lie beside them, but that may also be of lenses that were undone or are off the
    middle, of masks and of objects, or of programs that look for no points at the rims."""
    SHORT = 2
    """The photographs are larger than those that were aligned."""
    BESIDE = 3
    """The photographs are smaller than those."""


def aligned_sizes(
    root: Path, options: CaptureOptions, names: Sequence[str], seen: Sequence[np.ndarray], file: Path
) -> tuple[list[tuple[int, int]], list[str]]:
    """Width and height of each photograph as it was aligned, and a warning where they may be others: of those that
    `--images` names and those in the capture the first that fit the pixels [n, 2], from the middle, of what each shows
    (`seen`).

    A photograph that is missing is taken to be as large as most. Raises `CaptureError` where none is there, and where
    none fits: focal lengths would be misread.
    """
    unclear: tuple[list[tuple[int, int]], list[str]] | None = None
    problems: list[CaptureError] = []
    for sizes in _sizes_there(root, options, names, file, problems):
        notes = list[str]()
        for size in dict.fromkeys(sizes):
            mine = [k for k, each in enumerate(sizes) if each == size]
            pixels = np.concatenate([np.zeros((0, 2)), *(seen[k] for k in mine)])
            fit, reach = fit_of(pixels, size)
            if fit in (Fit.SHORT, Fit.BESIDE):
                problems.append(_of_another_size(fit, reach, size, names[mine[0]], len(mine), file))
                break
            if fit is Fit.UNCLEAR:
                notes.append(
                    f"{file.name}: the points that photographs of {size[0]}x{size[1]} show reach to {reach:.0%} of "
                    "their sides. If those that were aligned have another size, focal lengths are wrong: give them "
                    "(--images)."
                )
        else:
            if not notes:
                return sizes, notes
            unclear = unclear or (sizes, notes)
    if unclear is not None:
        return unclear
    raise problems[0]


def _sizes_there(
    root: Path, options: CaptureOptions, names: Sequence[str], file: Path, problems: list[CaptureError]
) -> Iterator[list[tuple[int, int]]]:
    """The sizes of the photographs that `--images` names, then of those that are found without it; errors go to
    `problems`."""
    for each in dict.fromkeys((options.images, None)):
        try:
            yield sizes_in_folder(root, replace(options, images=each), names, file)
        except CaptureError as error:
            problems.append(error)


def _of_another_size(fit: Fit, reach: float, size: tuple[int, int], name: str, count: int, file: Path) -> CaptureError:
    others = f" and {count - 1} more of this size" if count > 1 else ""
    what = "beyond" if fit is Fit.BESIDE else "only to"
    return CaptureError(
        f"{file}: the points that {name}{others} show reach {what} {min(reach, 1.0):.0%} of the sides, for the "
        f"photograph is {size[0]}x{size[1]}: it is of another size. {GIVE_ALIGNED}"
    )


def fit_of(pixels: np.ndarray, size: tuple[int, int]) -> tuple[Fit, float]:
    """Whether points at `pixels` [n, 2], from the middle, are those of photographs of a size, and how far they reach,
    in halves of the sides."""
    if not len(pixels):
        return Fit.FITS, 1.0
    is_few = len(pixels) < _FEW
    half = np.array(size) / 2
    shares = np.abs(pixels) / half
    reach = _reach(shares.max(axis=1))
    outside = float((np.abs(pixels) > half + ROUNDING_PX).any(axis=1).mean())
    if outside > MAX_OUTSIDE_BENT:
        return Fit.BESIDE, reach
    if is_few or (reach >= WHOLE_REACH and outside <= MAX_OUTSIDE):
        return Fit.FITS, reach
    if outside > MAX_OUTSIDE:
        is_smaller = _fill_a_rectangle(shares, reach, _STRAIGHTER) and not _are_shifted(pixels / half)
        return (Fit.BESIDE if is_smaller else Fit.UNCLEAR), reach
    if reach >= LEAST_REACH:
        return (Fit.UNCLEAR if _fill_a_rectangle(shares, reach, _STRAIGHTER) else Fit.FITS), reach
    return (Fit.SHORT if _fill_a_rectangle(shares, reach, _STRAIGHT) else Fit.UNCLEAR), reach


def _reach(shares: np.ndarray) -> float:
    """The farthest of shares [n] but for strays."""
    return float(np.quantile(shares, 1 - _STRAYS)) if len(shares) else 0.0


def _are_shifted(places: np.ndarray) -> bool:
    """Whether places [n, 2], in halves of the sides, reach from rim to rim of a photograph of the size, but not about
    its middle: pixels of lenses with another principal point, which COLMAP writes from there."""
    widths = [(_reach(places[:, axis]) + _reach(-places[:, axis])) / 2 for axis in (0, 1)]
    return min(widths) >= WHOLE_REACH and max(widths) <= 1


def _fill_a_rectangle(shares: np.ndarray, reach: float, straight: float) -> bool:
    """Whether places [n, 2], in halves of the sides, end alike along all rims: an object, a mask or a lens that was
    undone does not do that."""
    if len(shares) < _MANY or (shares.max(axis=1) > LEAST_REACH * reach).mean() < _AT_RIMS:
        return False
    parts = [
        _reach(shares[part(shares[:, 1 - axis] / reach), axis])
        for axis in (0, 1)
        for part in (lambda across: across < _MIDDLE, lambda across: (across > _ENDS) & (across < 1))
    ]
    return max(parts) - min(parts) < straight * reach
