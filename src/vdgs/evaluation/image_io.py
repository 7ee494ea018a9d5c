"""Files of an evaluation: whole or absent, and never two views under one name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from jaxtyping import UInt8

from vdgs.errors import VdgsError
from vdgs.system.atomic_files import write_bytes

_MAX_NAME_LENGTH = 120


def write_png(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Lossless RGB, atomically."""
    done, content = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not done:
        raise VdgsError(f"{path} cannot be encoded as PNG from an image of size {list(image.shape)}.")
    write_bytes(path, content.tobytes())


def unique_file_stems(names: Sequence[str]) -> list[str]:
    """One file name (without suffix) for each view name, in order, unique even where case is ignored.

    `a/b.jpg` becomes `a__b`; where that name is taken the suffix joins it (`a__b_jpg`), then a number.
    """
    taken: set[str] = set()
    stems = []
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        parts = [*path.parent.parts, path.stem]
        plain = "__".join(_safe(part) for part in parts if part.strip("/."))[-_MAX_NAME_LENGTH:] or "view"
        stem, number = plain, 2
        if stem.casefold() in taken and path.suffix:
            plain = stem = f"{plain}_{_safe(path.suffix[1:])}"
        while stem.casefold() in taken:
            stem, number = f"{plain}_{number}", number + 1
        taken.add(stem.casefold())
        stems.append(stem)
    return stems


def _safe(part: str) -> str:
    """Letters, digits and a few marks: no separators, drive letters or hidden files."""
    return re.sub(r"[^\w.\- ]", "_", part).strip(". ") or "_"
