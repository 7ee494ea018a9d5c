"""The capture: photographs without lens distortion, in three sizes, and the model that goes with them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from vdgs.captures.formats.colmap_writing import write_model_files
from vdgs.captures.formats.lens_projection import pixel_rays
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.image_files import decode_image
from vdgs.captures.name_resolution import jpeg_name
from vdgs.captures.pinholes import folds_to_nothing, undistorted_pinhole
from vdgs.captures.undistortion import encode_jpeg, sampling_map
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.sfm.focal_length import AGREE, MAX_FOCAL
from vdgs.sfm.mask_files import encode_mask, undistort_mask
from vdgs.sfm.workspace import Workspace
from vdgs.system.atomic_files import read_json_or_empty, write_bytes, write_json
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.stop_signals import check_stop_requested

#: Sides are multiples of this, so that the smaller sizes are exactly a half and a quarter.
SIDE_MULTIPLE = 4
#: The folders of the sizes, and by how much they are shrunk.
IMAGE_SIZES = (("images", 1), ("images_2", 2), ("images_4", 4))
#: No perspective lens sees more degrees from corner to corner: those of 9 mm for 36 x 24 mm see 135.
WIDEST_DEG = 138.0
#: COLMAP's limits of focal lengths over the longer side; and the longest by tags, fitted a little longer: of a zoom.
SHORTEST, LONGEST, LONGEST_BY_TAGS = 0.1, 10.0, AGREE * MAX_FOCAL
#: The folder of masks, of the largest size.
MASK_FOLDER = CaptureOptions.masks
IMAGE_FOLDERS = (*(folder for folder, _ in IMAGE_SIZES), MASK_FOLDER)
#: The lenses by which the written photographs lost their distortion.
LENSES_FILE = "lenses.json"
#: Lenses are compared at so many places across a picture and down.
LENS_PLACES = 100


@dataclass(frozen=True, eq=False)
class Undistortion:
    """How photographs of one camera lose their distortion: pixels [h, w, 2] of the original for those of the pinhole
    picture, how much that is then shrunk, and the camera that comes out."""

    grid: np.ndarray
    resized: tuple[int, int]
    """Width and height after shrinking, before the sides become multiples of `SIDE_MULTIPLE`."""
    intrinsics: Intrinsics


def make_undistortion(bent: Intrinsics, max_size: int) -> Undistortion:
    """The pinhole camera and the way to it; `max_size` bounds the longer side (0: not at all). The map takes 8 bytes a
    pixel, and seconds."""
    pinhole = undistorted_pinhole(bent)
    return Undistortion(sampling_map(bent, pinhole), *_shrunk(pinhole, max_size))


def straight_camera(bent: Intrinsics, max_size: int) -> Intrinsics:
    """The pinhole camera of `make_undistortion` alone, without the map."""
    return _shrunk(undistorted_pinhole(bent), max_size)[1]


def _shrunk(pinhole: Intrinsics, max_size: int) -> tuple[tuple[int, int], Intrinsics]:
    """Width and height of a pinhole picture after shrinking, and its camera with sides that are multiples."""
    longer = max(pinhole.width, pinhole.height)
    scale = min(1.0, max_size / longer) if max_size else 1.0
    width, height = round(pinhole.width * scale), round(pinhole.height * scale)
    across, up = width / pinhole.width, height / pinhole.height
    (fx, fy), (cx, cy) = pinhole.focal, pinhole.principal_point
    kept = width - width % SIDE_MULTIPLE, height - height % SIDE_MULTIPLE
    return (width, height), Intrinsics("PINHOLE", (fx * across, fy * up, cx * across, cy * up), *kept)


def read_lenses(output: Path) -> dict[int, Intrinsics]:
    """The lenses by which the photographs of a capture lost their distortion, by camera; none where that is unknown."""
    try:
        return {
            int(number): Intrinsics(model, tuple(map(float, params)), int(width), int(height))
            for number, (model, params, width, height) in read_json_or_empty(output / LENSES_FILE).items()
        }
    except (TypeError, ValueError):
        return {}


def write_lenses(output: Path, lenses: Mapping[int, Intrinsics]) -> None:
    """Note the lenses by which photographs are about to lose their distortion."""
    write_json(
        output / LENSES_FILE,
        {str(number): [lens.model, lens.params, lens.width, lens.height] for number, lens in lenses.items()},
    )


def lens_shift_px(before: Mapping[int, Intrinsics], after: Mapping[int, Intrinsics]) -> float:
    """By how many pixels of a photograph, at most, pictures without distortion change from some lenses to others.

    Infinite where there are other cameras, or the pictures have another size.
    """
    if before.keys() != after.keys():
        return float("inf")
    return max((_shift_px(before[number], lens) for number, lens in after.items()), default=0.0)


def _shift_px(before: Intrinsics, after: Intrinsics) -> float:
    if before == after:
        return 0.0
    old, new = undistorted_pinhole(before), undistorted_pinhole(after)
    if (old.width, old.height) != (new.width, new.height):
        return float("inf")
    shown = [sampling_map(bent, _coarse(pinhole)) for bent, pinhole in ((before, old), (after, new))]
    return float(np.linalg.norm(shown[0] - shown[1], axis=-1).max())


def _coarse(pinhole: Intrinsics) -> Intrinsics:
    """The camera of a picture of `LENS_PLACES` pixels across and down that shows the same."""
    across, down = LENS_PLACES / pinhole.width, LENS_PLACES / pinhole.height
    (fx, fy), (cx, cy) = pinhole.focal, pinhole.principal_point
    return Intrinsics("PINHOLE", (fx * across, fy * down, cx * across, cy * down), LENS_PLACES, LENS_PLACES)


def write_images(
    output: Path,
    workspace: Workspace,
    names: Mapping[int, Sequence[str]],
    lenses: Mapping[int, Intrinsics],
    max_size: int,
    threads: int,
    tell: Callable[[int], object],
) -> None:
    """Write images, images_2, images_4, and masks of those that have one: `names` of the photographs of each camera,
    and the lenses of these; `max_size` bounds the longer side (0: not at all). What is there is kept; `tell` is called
    with how many are done.

    Raises CaptureError for photographs that cannot be decoded, VdgsError where the disk is full.
    """
    done = 0
    tell(done)
    with ThreadPoolExecutor(threads) as pool:
        for camera, members in names.items():  # one at a time, however many there are: maps take memory
            check_stop_requested()
            missing = [name for name in members if not _is_written(output, workspace, name)]
            done += len(members) - len(missing)
            if missing:
                undistort = partial(_write_one, output, workspace, make_undistortion(lenses[camera], max_size))
                for _ in pool.map(undistort, missing):
                    check_stop_requested()
                    done += 1
                    tell(done)
                del undistort  # before the next map is made
            tell(done)


def _is_written(output: Path, workspace: Workspace, name: str) -> bool:
    return all(target.is_file() for target in _targets(output, name)) and (
        _mask_target(output, name).is_file() or not workspace.mask(name).is_file()
    )


def _targets(output: Path, name: str) -> list[Path]:
    return [output / folder / jpeg_name(name) for folder, _ in IMAGE_SIZES]


def _mask_target(output: Path, name: str) -> Path:
    return output / MASK_FOLDER / f"{jpeg_name(name)}.png"


def _write_one(output: Path, workspace: Workspace, undistortion: Undistortion, name: str) -> None:
    check_stop_requested()
    if workspace.mask(name).is_file():
        _write_mask(output, workspace.mask(name), undistortion, name)
    targets = _targets(output, name)
    if all(target.is_file() for target in targets):
        return
    pixels, _ = decode_image((workspace.images / name).resolve())
    straight = cv2.remap(
        pixels, undistortion.grid[..., 0], undistortion.grid[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    if straight.shape[1::-1] != undistortion.resized:
        straight = cv2.resize(straight, undistortion.resized, interpolation=cv2.INTER_AREA)
    straight = straight[: undistortion.intrinsics.height, : undistortion.intrinsics.width]
    for target, (_, factor) in zip(targets, IMAGE_SIZES, strict=True):
        size = undistortion.intrinsics.width // factor, undistortion.intrinsics.height // factor
        small = straight if factor == 1 else cv2.resize(straight, size, interpolation=cv2.INTER_AREA)
        write_bytes(target, encode_jpeg(small))


def _write_mask(output: Path, mask: Path, undistortion: Undistortion, name: str) -> None:
    target = _mask_target(output, name)
    if not target.is_file():
        keep = undistort_mask(mask, undistortion.grid, undistortion.resized)[
            : undistortion.intrinsics.height, : undistortion.intrinsics.width
        ]
        write_bytes(target, encode_mask(keep))


def write_model(
    output: Path,
    model: pycolmap.Reconstruction,
    pinholes: Mapping[int, Intrinsics],
    pinhole_of: Mapping[str, int] | None = None,
) -> None:
    """Write sparse/0 with pinhole cameras: poses, points, and the observations that points have, without distortion.
    `pinhole_of` the names of photographs, where these have other cameras than in the model."""
    straight = pycolmap.Reconstruction()
    for number, kept in pinholes.items():
        camera = pycolmap.Camera(
            model="PINHOLE", width=kept.width, height=kept.height, params=list(kept.params), camera_id=number
        )
        straight.add_camera_with_trivial_rig(camera)
    places: dict[int, np.ndarray] = {}  # of each image, by its features: the number of an observation, or -1
    for image in placed_images(model):
        seen = [k for k, point in enumerate(image.points2D) if point.has_point3D()]
        bent = np.array([image.points2D[k].xy for k in seen]).reshape(-1, 2)
        rays = pixel_rays(lens_of(model.cameras[image.camera_id]), bent)
        shown = np.isfinite(rays).all(axis=1)  # a fisheye may look beside and behind itself, and a lens fold over
        seen, rays = [k for k, there in zip(seen, shown, strict=True) if there], rays[shown]
        camera_id = image.camera_id if pinhole_of is None else pinhole_of[image.name]
        fx, fy, cx, cy = pinholes[camera_id].params
        places[image.image_id] = np.full(image.num_points2D(), -1, np.int32)
        places[image.image_id][seen] = np.arange(len(seen))
        straight.add_image_with_trivial_frame(
            pycolmap.Image(
                name=jpeg_name(image.name), keypoints=rays * [fx, fy] + [cx, cy], camera_id=camera_id,
                image_id=image.image_id,
            ),
            image.cam_from_world(),
        )  # fmt: skip
    for point in model.points3D.values():
        track = pycolmap.Track(
            [
                pycolmap.TrackElement(each.image_id, int(places[each.image_id][each.point2D_idx]))
                for each in point.track.elements
                if each.image_id in places and places[each.image_id][each.point2D_idx] >= 0
            ]
        )
        number = straight.add_point3D(point.xyz, track, point.color)
        straight.point3D(number).error = point.error
    # The model makes the folder a capture: it comes last and as a whole.
    part, whole = output / "sparse" / ".part", output / "sparse" / "0"
    write_model_files(straight, part)
    os.replace(part, whole)


def placed_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The images that a model places, by their numbers. Not those that have a pose by their rig alone: of the sky."""
    images = (model.images[number] for number in sorted(model.images))
    return [image for image in images if image.has_pose and (image.num_points3D or not _is_of_rig(model, image))]


def _is_of_rig(model: pycolmap.Reconstruction, image: pycolmap.Image) -> bool:
    return bool(model.rigs[model.frames[image.frame_id].rig_id].num_sensors() > 1)


def is_impossible(camera: pycolmap.Camera) -> bool:
    """Whether there is no such lens."""
    bogus = not camera.verify_params() or camera.has_bogus_params(SHORTEST, LONGEST_BY_TAGS, 1.0)
    return bogus or _perspective_deg(camera) > WIDEST_DEG or folds_to_nothing(lens_of(camera))


def longest_focal(cameras: Iterable[pycolmap.Camera]) -> float:
    """The longest focal length over the longer side that a mapper should believe: COLMAP's limit, but where tags say
    one that may be fitted beyond it."""
    told = [each.mean_focal_length() / max(each.width, each.height) for each in cameras if each.has_prior_focal_length]
    return LONGEST_BY_TAGS if AGREE * max(told, default=0.0) > LONGEST else LONGEST


def _perspective_deg(camera: pycolmap.Camera) -> float:
    """How far a perspective lens of this focal length sees from corner to corner, degrees; 0 for a fisheye."""
    if "FISHEYE" in camera.model_name:
        return 0.0
    return 2 * math.degrees(math.atan2(math.hypot(camera.width, camera.height) / 2, camera.mean_focal_length()))


def fitted_intrinsics(camera: pycolmap.Camera) -> Intrinsics:
    """The lens of a camera. Raises CaptureError for one that there is not."""
    seen = _perspective_deg(camera)
    if is_impossible(camera) and seen > WIDEST_DEG:
        raise CaptureError(
            f"the fitted lens of a camera ({camera.params_to_string()}) would see {seen:.0f}° from corner to corner, "
            f"and perspective lenses end at {WIDEST_DEG:.0f}°: if it is a fisheye, say it: --camera-model "
            "opencv-fisheye"
        )
    if is_impossible(camera):
        raise CaptureError(
            f"the fitted lens of a camera ({camera.params_to_string()}) is none that there is: the photographs do not "
            "tell it. Hold the focal length: --focal fixed"
        )
    return lens_of(camera)


def lens_of(camera: pycolmap.Camera) -> Intrinsics:
    """The lens of a camera, whatever it is."""
    return Intrinsics(camera.model_name, tuple(float(value) for value in camera.params), camera.width, camera.height)
