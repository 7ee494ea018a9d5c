"""A scene like the one that photographs will become, to time the steps of its training before there is a model.

Level ground with as many points as features foretell, and a few cameras that look straight down on it, overlapping as
the flight does: what a step costs depends on pixels and on the anchors that a view shows, not on what they look like.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from vdgs.captures.capture import Capture, View
from vdgs.captures.image_files import decode_image
from vdgs.captures.undistortion import JPEG_QUALITY
from vdgs.config.capture_options import CaptureOptions
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.sfm.capture_writer import IMAGE_SIZES, SIDE_MULTIPLE
from vdgs.sfm.feature_extraction import DEFAULT_FOCAL_FACTOR
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.system.atomic_files import write_bytes

#: Cameras of the scene, points of it at most, and views of a place where positions do not tell it (choice).
NUM_CAMERAS, MAX_POINTS, TYPICAL_VIEWS_PER_POINT = 6, 150_000, 8.0
#: How far points lie above and below the ground, as a share of the flying height.
RELIEF = 0.02


def assumed_capture(plan: ReconstructionPlan, options: CaptureOptions, points: int, folder: Path) -> Capture:
    """The scene of a plan with so many `points`; its photographs, at the size that is trained on, lie in `folder`."""
    photographs = plan.image_list.images
    chosen = _chosen(plan)
    cameras = assumed_cameras(plan, options)
    overlap = _views_per_point(plan)
    views = tuple(
        _view(photo, camera, folder, k) for k, (photo, camera) in enumerate(zip(chosen, cameras, strict=True))
    )
    rng = np.random.default_rng(0)
    count = min(points, MAX_POINTS)
    first = cameras[0]
    footprint = (first.width / first.fx) * (first.height / first.fy)
    half = np.sqrt(count * footprint * len(photographs) / max(points, 1) / overlap) / 2
    ground = rng.uniform((-half, -half, -RELIEF), (half, half, RELIEF), (count, 3))
    level = GroundFrame(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=False, description="assumed"
    )  # fmt: skip
    return Capture(
        root=folder, source="colmap", images="", views=views, points=ground,
        point_colors=rng.integers(0, 255, (count, 3), dtype=np.uint8), ground=level,
    )  # fmt: skip


def assumed_cameras(plan: ReconstructionPlan, options: CaptureOptions) -> list[Camera]:
    """Of the scene, at the size that is trained on."""
    factor = dict(IMAGE_SIZES)[Path(options.images or IMAGE_SIZES[0][0]).as_posix()] * options.downscale
    return _cameras(_chosen(plan), factor, plan.request.options.max_output_size, _views_per_point(plan))


def _chosen(plan: ReconstructionPlan) -> Sequence[ImageMetadata]:
    """Some photographs from the middle of the flight."""
    photographs = plan.image_list.images
    return photographs[max(0, len(photographs) // 2 - NUM_CAMERAS // 2) :][:NUM_CAMERAS]


def _views_per_point(plan: ReconstructionPlan) -> float:
    return plan.preflight.views_per_point or min(len(plan.image_list.images), TYPICAL_VIEWS_PER_POINT)


def _cameras(photographs: Sequence[ImageMetadata], factor: float, max_size: int, overlap: float) -> list[Camera]:
    """Cameras in a row at height 1, spaced so that `overlap` cameras of a grid of that spacing see each place."""
    first = photographs[0]
    longer = max(first.width, first.height)
    scale = (min(1.0, max_size / longer) if max_size else 1.0) / factor
    width, height = (max(1, int(side * scale) // SIDE_MULTIPLE * SIDE_MULTIPLE) for side in (first.width, first.height))
    focal = (first.lens.focal if first.lens else DEFAULT_FOCAL_FACTOR) * max(width, height)
    step = height / focal / np.sqrt(overlap)
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    cameras = []
    for k in range(len(photographs)):
        pose = down.copy()
        pose[:3, 3] = -down[:3, :3] @ np.array([0.0, (k - len(photographs) / 2) * step, 1.0])
        cameras.append(
            Camera(camera_from_world=pose, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)
        )
    return cameras


def _view(photo: ImageMetadata, camera: Camera, folder: Path, index: int) -> View:
    pixels, _ = decode_image(photo.path)
    small = cv2.resize(pixels, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    file = folder / f"{index}.jpg"
    quality = (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)
    write_bytes(file, cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), quality)[1].tobytes())
    return View(name=file.name, camera=camera, image_path=file, mask_path=None, split="train")
