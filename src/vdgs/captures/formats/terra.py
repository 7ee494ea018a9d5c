"""What DJI Terra keeps beside its BlocksExchange files: the names of photographs, and the origin of its models."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from vdgs.captures.formats.project import ProjectView
from vdgs.captures.formats.xml_documents import read_xml, root_element, xml_numbers
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

#: Terra's list of photographs: `id` is what it calls a photograph, `origin_path` what the camera did.
_LISTS = ("image_list.json", "images/survey/image_list.json", "original_image_list.json")
#: Where the models that Terra makes, and their origin, lie beside or below the project.
_METADATA = ("metadata.xml", "terra_ply/metadata.xml", "terra_pnts/metadata.xml", "models/pc/0/terra_ply/metadata.xml")
MAX_LIST_BYTES = 1 << 28


def original_names(file: Path, options: CaptureOptions) -> dict[str, str]:
    """Paths on the card by what Terra calls the photographs, in lower case; none where there is no list beside the
    file, above it or in the folder of photographs."""
    folders = [file.parent, file.parent.parent]
    if options.images is not None:  # beside the file or, of a whole project, above it, or from here
        folders = [*(folder / options.images for folder in folders), Path(options.images), *folders]
    lists = [folder / name for folder in folders for name in _LISTS]
    found = next((each for each in lists if each.is_file()), None)
    if found is None:
        return {}
    try:
        if found.stat().st_size > MAX_LIST_BYTES:
            raise ValueError("it is too long")
        content = json.loads(found.read_text(encoding="utf-8-sig"))
        return {str(each["id"]).lower(): str(each["origin_path"]) for each in content}
    except OSError as error:
        raise CaptureError(f"{found}: cannot be read ({error.strerror or error}).") from error
    except (ValueError, RecursionError, TypeError, KeyError) as error:
        raise CaptureError(
            f"{found}: is no list of Terra's photographs with id and origin_path ({error}). Copy it again, or "
            "remove it where photographs have Terra's names."
        ) from None


def local_origin(file: Path) -> np.ndarray | None:
    """What Terra took off the coordinates of its models (SRSOrigin); None where nothing says it."""
    for folder in (file.parent, file.parent.parent):
        for name in _METADATA:
            if root_element(folder / name) == "ModelMetadata":
                text = read_xml(folder / name).findtext("SRSOrigin")
                return np.array(xml_numbers(text, 3, folder / name, "SRSOrigin")) if text else None
    return None


def warn_of_undistorted(file: Path, views: Sequence[ProjectView], originals: Mapping[str, str]) -> list[str]:
    """A warning where Terra describes photographs without distortion and has other names for the camera's own."""
    bent = any(view.intrinsics.is_distorted for view in views)
    if bent or not originals or "undistort" not in file.name.lower():
        return []
    return [
        f"{file.name} describes photographs whose lens distortion Terra has undone, and says nothing of the lens. "
        "Where the camera's own photographs are used, straight lines bend by some pixels: name the folder of the "
        "undistorted ones (.temp/ImageCorrection/undistort of the reconstruction) with --images, or make poses anew of "
        "the photographs alone: vdgs sfm."
    ]
