"""Lenses that may be fisheyes, which no tag says: the photographs tell.

One radial term does not bend a perspective view as far as a fisheye does: by it the focal length and the ground go
astray, while points still lie within a pixel of where they are seen.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console

from vdgs.config.sfm_options import SfmOptions
from vdgs.sfm.capture_writer import is_impossible, placed_images
from vdgs.sfm.feature_extraction import CameraGroup, group_by_camera
from vdgs.sfm.feature_matching import match_pairs
from vdgs.sfm.focal_decision import fit_focal
from vdgs.sfm.focal_length import DIAGONAL_35_MM, alike
from vdgs.sfm.image_metadata import FISHEYE, RADIAL, ImageMetadata
from vdgs.sfm.reprojection import mean_reprojection_error
from vdgs.sfm.workspace import Workspace
from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.system.lazy_pycolmap import pycolmap

#: Of lenses up to this 35 mm equivalent (mm; choice) some are fisheyes: those of action cameras have 12 to 17.
MAX_FISHEYE_MM = 20.0
#: A lens that tags say to be longer than this is none, however short a model that went astray has it (mm; choice).
NO_FISHEYE_MM = 40.0
#: A fisheye is taken where points lie nearer to where they are seen by this share (choice): its four terms bend a
#: perspective lens as well as one radial term does, and somewhat better where that lens bends oddly.
PLAINLY_NEARER = 0.25
#: What cameras with fisheyes are called, as far as their films and photographs may say no focal length.
_ACTION_CAMERAS = re.compile(
    r"gopro|insta360|osmo ?action|\bac00\d\b|sjcam|xiaoyi|ydxj|\byi technology\b", re.IGNORECASE
)
#: Lenses are compared by so many points, or by so many for each photograph, if there are as many (choice).
LEAST_POINTS, POINTS_PER_IMAGE = 1000, 30
#: Radii at which a lens is compared with a fisheye, and powers of the angle in COLMAP's fisheye.
_RADII, _POWERS = 64, (1, 3, 5, 7, 9)


def equivalent_mm(focal_px: float, width: int, height: int) -> float:
    """The focal length in millimetres that shows the same on 36 x 24 mm, by the diagonal."""
    return DIAGONAL_35_MM * focal_px / math.hypot(width, height)


def candidates(groups: Sequence[CameraGroup], model: pycolmap.Reconstruction | None = None) -> list[int]:
    """The numbers of cameras (from 1) whose lens may be a fisheye: so short by tags or as a model has it, or of a maker
    of such cameras where nothing says it."""
    found = []
    for number, group in enumerate(groups, 1):
        focals = [group.focal_px] if group.has_focal_prior else []
        if model is not None and number in model.cameras:
            focals.append(model.cameras[number].mean_focal_length())
        short = any(equivalent_mm(focal, group.width, group.height) <= MAX_FISHEYE_MM for focal in focals)
        named = not group.has_focal_prior and _ACTION_CAMERAS.search(group.camera) is not None
        if may_be_found([group]) and (short or named):
            found.append(number)
    return found


def may_be_found(groups: Sequence[CameraGroup]) -> bool:
    """Whether some model of their photographs could show one of these lenses to be a fisheye."""
    return any(
        group.model == RADIAL
        and not (group.has_focal_prior and equivalent_mm(group.focal_px, group.width, group.height) > NO_FISHEYE_MM)
        for group in groups
    )


def foretold(photographs: Sequence[ImageMetadata], options: SfmOptions) -> list[str]:
    """What to say before the work of each camera whose lens may be a fisheye."""
    groups = group_by_camera(photographs) if options.camera_model == "auto" else []
    found = list[str]()
    for number in candidates(groups):
        group = groups[number - 1]
        said = "nothing says its focal length"
        if group.has_focal_prior:
            said = f"a 35 mm equivalent of {equivalent_mm(group.focal_px, group.width, group.height):.0f} mm"
        found.append(
            f"{group.camera}, {said}: such lenses may be fisheyes; the photographs will tell, unless you do "
            "(--camera-model opencv-fisheye, simple-radial)"
        )
    return list(dict.fromkeys(found))


def compare(
    model: pycolmap.Reconstruction, groups: Sequence[CameraGroup], numbers: Sequence[int], threads: int
) -> tuple[float, float] | None:
    """Pixels that points of a model lie from where they are seen (mean), with perspective lenses and with fisheyes for
    the cameras of these numbers, both fitted to some of the points; None unless fisheyes are plainly nearer. The model
    stays as it is."""
    placed = {image.camera_id for image in placed_images(model)}
    tried = {number: fisheye_like(model.cameras[number]) for number in numbers if number in placed}
    if not tried:
        return None
    model = _thinned(model)
    straight = pycolmap.Reconstruction(model)
    straight.update_point_3d_errors()
    bent = _fitted(model, tried, threads)
    said = {k: groups[k - 1].focal_px for k in tried if groups[k - 1].has_focal_prior}
    near = all(alike(bent.cameras[k].mean_focal_length(), focal) for k, focal in said.items())
    if said and not (near and _plainly(mean_reprojection_error(bent), straight)):
        # The perspective lens may be so far astray that no fit leads away from it.
        ratio = float(np.median([focal / model.cameras[k].mean_focal_length() for k, focal in said.items()]))
        tried |= {k: _equidistant(model.cameras[k], focal) for k, focal in said.items()}
        bent = min(bent, _fitted(stretched(model, ratio), tried, threads), key=mean_reprojection_error)
    nearest = mean_reprojection_error(bent)
    if any(is_impossible(bent.cameras[number]) for number in tried) or not _plainly(nearest, straight):
        return None
    fit_focal(straight, threads)  # it may have been held at what is wrong
    return (mean_reprojection_error(straight), nearest) if _plainly(nearest, straight) else None


def _thinned(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with some of the points, which tell a lens in a fraction of the time."""
    thin = pycolmap.Reconstruction(model)
    numbers = sorted(thin.points3D)
    every = len(numbers) // max(LEAST_POINTS, POINTS_PER_IMAGE * len(placed_images(thin)))
    for place, number in enumerate(numbers):
        if every > 1 and place % every:
            thin.delete_point3D(number)
    return thin


def stretched(model: pycolmap.Reconstruction, ratio: float) -> pycolmap.Reconstruction:
    """A model so many times as deep along the mean view: a focal length that is too short by that makes it shallow. As
    it is where cameras are held together by rigs."""
    deep = pycolmap.Reconstruction(model)
    if any(rig.num_sensors() > 1 for rig in deep.rigs.values()):
        return deep
    images = placed_images(deep)
    axis = np.mean([image.cam_from_world().rotation.matrix()[2] for image in images], axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-12)
    stretch = np.eye(3) + (ratio - 1) * np.outer(axis, axis)
    for image in images:
        turned = image.cam_from_world().rotation.matrix()
        pose = pycolmap.Rigid3d(np.column_stack([turned, -turned @ stretch @ image.projection_center()]))
        deep.frames[image.frame_id].rig_from_world = pose
    for point in deep.points3D.values():
        point.xyz = stretch @ point.xyz
    return deep


def _fitted(
    model: pycolmap.Reconstruction, lenses: Mapping[int, pycolmap.Camera], threads: int
) -> pycolmap.Reconstruction:
    """A model with other lenses to begin with, all fitted."""
    fitted = pycolmap.Reconstruction(model)
    for number, lens in lenses.items():
        fitted.cameras[number] = lens
    fit_focal(fitted, threads)
    return fitted


def _plainly(nearest: float, straight: pycolmap.Reconstruction) -> bool:
    return nearest < (1 - PLAINLY_NEARER) * mean_reprojection_error(straight)


def fisheye_like(camera: pycolmap.Camera) -> pycolmap.Camera:
    """The fisheye that bends as a camera does, as far as that sees: to begin a fit with."""
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    corner = np.array([camera.width, camera.height])
    radii = np.linspace(0, np.linalg.norm(corner) / 2, _RADII)[1:]
    rays = np.asarray(camera.cam_from_img(center + radii[:, None] * corner / np.linalg.norm(corner))).reshape(-1, 2)
    angles = np.arctan(np.linalg.norm(rays, axis=1))
    seen = np.isfinite(angles)
    terms = np.stack([angles[seen] ** power for power in _POWERS], axis=1)
    first, *others = np.linalg.lstsq(terms, radii[seen], rcond=None)[0].tolist() if seen.any() else [0.0]
    if first <= 0:
        return _equidistant(camera, camera.mean_focal_length())
    return _equidistant(camera, first, tuple(each / first for each in others))


def _equidistant(
    camera: pycolmap.Camera, focal_px: float, terms: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
) -> pycolmap.Camera:
    center = camera.principal_point_x, camera.principal_point_y
    return pycolmap.Camera(
        model=FISHEYE, width=camera.width, height=camera.height, params=[focal_px, focal_px, *center, *terms],
        camera_id=camera.camera_id,
    )  # fmt: skip


def with_fisheyes(groups: Sequence[CameraGroup], numbers: Sequence[int]) -> list[CameraGroup]:
    """The cameras in their order, those of these numbers (from 1) and their photographs with fisheyes."""
    found = list(groups)
    for number in numbers:
        photographs = tuple(replace(photo, camera_model=FISHEYE) for photo in groups[number - 1].images)
        found[number - 1] = replace(groups[number - 1], model=FISHEYE, images=photographs)
    return found


def read_found(workspace: Workspace, key: str) -> list[int]:
    """The numbers of cameras that were found to be fisheyes; none where that was not told yet."""
    found = read_json_or_empty(workspace.fisheyes_file)
    return [int(number) for number in found["cameras"]] if found.get("key") == key else []


def write_found(workspace: Workspace, key: str, numbers: Sequence[int]) -> None:
    write_json(workspace.fisheyes_file, {"key": key, "cameras": list(numbers)})


def use_lenses(workspace: Workspace, groups: Sequence[CameraGroup], key: str, threads: int, console: Console) -> None:
    """Give the cameras in the database these lenses, and verify all matches by them; work that was stopped goes on."""
    key = f"{key}, {', '.join(group.model for group in groups)}"
    if workspace.is_done("lenses", key):
        return
    with workspace.open_database() as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        numbers = [pycolmap.pair_id_to_image_pair(pair) for pair in database.read_num_matches()[0]]
        if not workspace.is_begun("lenses", key):
            for number, group in enumerate(groups, 1):
                camera = pycolmap.Camera.create_from_model_name(
                    number, group.model, group.focal_px, group.width, group.height
                )
                camera.has_prior_focal_length = group.has_focal_prior
                database.update_camera(camera)
            database.clear_two_view_geometries()
            workspace.begin("lenses", key)
    match_pairs(workspace, [(names[one], names[other]) for one, other in numbers], threads, console)
    workspace.finish("lenses", key)
