"""Photographs from where nobody flew, which measure what a model shows there. They never train.

A capture may bring them in its folder `off_path`:

off_path/
  SET/NAME.jpg         photographs, in a folder for each kind of view, such as `street`
  sparse/0/            a COLMAP model of their poses, in the world of the capture; needs no points
  validation.txt       those for choosing settings (`--validation`), one SET/NAME.jpg a line; the others are for testing
  truth/views/NAME.npz depth and true visibility per pixel, as in `ground_truth`; NAMEs differ between sets
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from vdgs.captures.capture import View
from vdgs.captures.formats.colmap import find_models, read_colmap
from vdgs.captures.formats.source_capture import SourceCapture
from vdgs.captures.image_matching import MatchedView, match_images
from vdgs.captures.split_lists import VALIDATION_LIST, listed_photographs
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

OFF_PATH_FOLDER = "off_path"


def off_path_set(view: View) -> str:
    """The kind of an off-path view: the folder of its name."""
    return PurePosixPath(view.name).parts[0]


def match_off_path(root: Path, options: CaptureOptions, warnings: list[str]) -> Sequence[MatchedView]:
    """The off-path photographs of a capture that are for testing, or with `--validation` those for choosing; none where
    the capture has none. Raises CaptureError as for the other photographs."""
    folder = root / OFF_PATH_FOLDER
    models = find_models(folder) if folder.is_dir() else []
    if not models:
        return ()
    model = read_colmap(models[0])
    source = SourceCapture(source="colmap", images=".", views=model.views, points=model.points, colors=model.colors)
    photographs, _ = match_images(folder, source, CaptureOptions(strict=options.strict), warnings)
    for photo in photographs:
        if photo.file.intrinsics.is_distorted:
            raise CaptureError(
                f"{folder}: {photo.view.name} is bent by its lens. Undistort these photographs first, or remove "
                f"{folder}."
            )
    own, validation = folder / VALIDATION_LIST, set[str]()
    if own.is_file():
        names = [photo.view.name for photo in photographs]
        validation, notes = listed_photographs(own, names, some=False, strict=options.strict)
        warnings += notes
    return [photo for photo in photographs if (photo.view.name in validation) == options.validation]
