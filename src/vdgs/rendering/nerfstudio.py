"""The frame that nerfstudio trains in, and the way back from it.

Before it trains, nerfstudio turns a scene upright, centers it on its cameras and scales it into a unit box; the camera
paths of its viewer are in that frame. The folder of the training, outputs/NAME/METHOD/DATE, has the transformation in
dataparser_transforms.json: `transform`, a rigid motion [3, 4], and `scale`, with

    x_nerfstudio = scale * (transform @ x_source)

where the source is the original world: that of the COLMAP model, and that of transforms.json before its
`applied_transform`, which `transform` includes. It is the source frame of our captures too.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vdgs.captures.formats.json_poses import parse_matrix, parse_number, read_capture_json
from vdgs.captures.formats.source_capture import to_rigid
from vdgs.errors import VdgsError
from vdgs.geometry.similarity import Similarity
from vdgs.rendering.camera_paths import pose_from_rotation

TRANSFORMS_FILE = "dataparser_transforms.json"
#: Scales beyond these are none of a scene.
_MIN_SCALE, _MAX_SCALE = 1e-9, 1e9


def pose_in_source(camera_from_world: Float[np.ndarray, "4 4"], nerfstudio: Similarity) -> Float[np.ndarray, "4 4"]:
    """The pose in the source frame of a camera in nerfstudio's frame."""
    rotation = camera_from_world[:3, :3]
    position = -rotation.T @ camera_from_world[:3, 3]
    return pose_from_rotation(rotation @ nerfstudio.rotation, nerfstudio.apply_inverse(position[None])[0])


def find_nerfstudio_frame(path: Path, capture: Path | None) -> Similarity:
    """From the source frame to that of a camera path, by the first file that says it: beside the path, one folder up
    (nerfstudio saves paths in camera_paths/ of its data), or in the folder of the capture.

    Raises VdgsError where there is none, and CaptureError for one that is damaged.
    """
    folders = [*path.absolute().parents[:2], *([] if capture is None else [capture])]
    file = next((folder / TRANSFORMS_FILE for folder in folders if (folder / TRANSFORMS_FILE).is_file()), None)
    if file is None:
        raise VdgsError(_missing_message(path, folders))
    content = read_capture_json(file)
    motion = to_rigid(parse_matrix(content.get("transform"), file, "transform"), file, "transform")
    scale = parse_number(content, "scale", file)
    if scale is None or not _MIN_SCALE < scale < _MAX_SCALE:
        raise VdgsError(f"{file}: scale is {scale}; it must be a positive factor. Copy the file again.")
    return Similarity(scale, motion[:3, :3], scale * motion[:3, 3])


def _missing_message(path: Path, folders: Sequence[Path]) -> str:
    looked = ", ".join(dict.fromkeys(str(folder) for folder in folders))
    return (
        f"{path}: is a camera path of nerfstudio, which turns, moves and scales a scene before it trains, and there is "
        f"no {TRANSFORMS_FILE} to say how (looked in {looked}). Copy it there from the folder of that training, "
        f"outputs/NAME/METHOD/DATE/{TRANSFORMS_FILE}. If the path is in the frame of the capture's own cameras, add "
        '"frame": "source" to it.'
    )
