"""Panoramas of 360° (equirectangular): six views of 90° for each, the faces of a cube, which move as one rig."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vdgs.captures.image_files import decode_image
from vdgs.sfm.cube_faces import FACES, cut_face
from vdgs.sfm.focal_length import Lens
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_metadata import EXACT_MODEL, ImageMetadata
from vdgs.sfm.mask_files import apply_orientation
from vdgs.sfm.workspace import Workspace
from vdgs.system.lazy_pycolmap import pycolmap

if TYPE_CHECKING:
    from vdgs.sfm.image_list import ImageList

#: The face that stands for its panorama: has its position, and chooses its partners.
REFERENCE = "front"
#: Sides of faces are multiples of this.
_SIDE_MULTIPLE = 4
_SOURCE = "the cube that the panorama was cut into"


def with_views(collection: ImageList, positions: GpsPriors) -> tuple[ImageList, GpsPriors]:
    """The photographs with six views in place of each panorama, and the positions, which the front views have."""
    if not any(photo.is_panorama for photo in collection.images):
        return collection, positions
    sizes = sorted({photo.size for photo in collection.images if photo.is_panorama})
    place, views = dict[str, int](), list[ImageMetadata]()
    for photo in collection.images:
        views += _views(photo, sizes.index(photo.size)) if photo.is_panorama else [photo]
    views.sort(key=lambda view: view.name)
    for k, view in enumerate(views):
        if view.face in ("", REFERENCE):
            place[view.frame] = k
    names = [collection.images[index].name for index in positions.image_indices.tolist()]
    indices = np.array([place[name] for name in names], int)
    return replace(collection, images=tuple(views)), replace(positions, image_indices=indices)


def _views(photo: ImageMetadata, kind: int) -> list[ImageMetadata]:
    """The faces of a panorama, as sharp in their middles as the panorama."""
    side = max(_SIDE_MULTIPLE, round(photo.width / math.pi / _SIDE_MULTIPLE) * _SIDE_MULTIPLE)
    folder = "pano" if kind == 0 else f"pano{kind + 1}"
    return [
        replace(
            photo, name=f"{folder}_{face}/{photo.name}", width=side, height=side,
            lens=Lens(0.5, _SOURCE, confirmed=True), camera=f"{photo.camera}, {face}", attitude=None, frame=photo.name,
            face=face, camera_model=EXACT_MODEL, kind="", is_panorama=False, whole_size=photo.size,
        )
        for face in FACES
    ]  # fmt: skip


def read_panorama(view: ImageMetadata) -> np.ndarray:
    """The upright pixels [h, w, 3] of the panorama of a face. Raises CaptureError where it cannot be decoded."""
    return np.ascontiguousarray(apply_orientation(decode_image(view.path)[0], view.orientation))


def cut_view(view: ImageMetadata, panorama: np.ndarray) -> np.ndarray:
    """The pixels [h, w, 3] of a face."""
    return cut_face(panorama, view.face, view.width)


def apply_rigs(workspace: Workspace, photographs: Sequence[ImageMetadata]) -> None:
    """Let the views of each panorama move as one in COLMAP's database, once it has all of them."""
    configs = rig_configs(photographs)
    if not configs:
        return
    with workspace.open_database() as database:
        if not any(rig.num_sensors() > 1 for rig in database.read_all_rigs()):
            pycolmap.apply_rig_config(configs, database)


def rig_configs(photographs: Sequence[ImageMetadata]) -> list[pycolmap.RigConfig]:
    """The rigs of views: one for each size of panoramas."""
    folders = sorted({view.name.split("/")[0].rpartition("_")[0] for view in photographs if view.face})
    return [pycolmap.RigConfig(cameras=[_rig_camera(folder, face) for face in FACES]) for folder in folders]


def _rig_camera(folder: str, face: str) -> pycolmap.RigConfigCamera:
    """The reference looks as the panorama does."""
    known = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(FACES[face])), np.zeros(3))
    is_reference = face == REFERENCE
    return pycolmap.RigConfigCamera(
        ref_sensor=is_reference, image_prefix=f"{folder}_{face}/", cam_from_rig=None if is_reference else known
    )
