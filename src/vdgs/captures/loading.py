"""From a folder to a checked `Capture`: read, match photographs, find the ground frame, split."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from vdgs.captures.capture import Capture, Observations, Split, View
from vdgs.captures.capture_root import capture_root
from vdgs.captures.format_dispatch import check_folder, read_source
from vdgs.captures.formats.ply_reader import GRAY
from vdgs.captures.formats.project_photographs import UNDISTORTED
from vdgs.captures.formats.source_capture import SourceCapture
from vdgs.captures.formats.transforms import is_transforms
from vdgs.captures.ground_estimation import find_ground_frame, transform_pose
from vdgs.captures.image_checks import detect_rounding
from vdgs.captures.image_files import MIN_SIDE_PX
from vdgs.captures.image_matching import MatchedView, match_images
from vdgs.captures.image_suffixes import VIDEO_SUFFIXES
from vdgs.captures.nested_captures import check_no_foreign_file
from vdgs.captures.off_path import match_off_path
from vdgs.captures.output_guard import check_not_among_files
from vdgs.captures.pinholes import fold_notes
from vdgs.captures.project_formats import is_project
from vdgs.captures.splits import assign_splits, select_central_views
from vdgs.captures.undistortion import ImageFile, undistort
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.ranges import find_range_errors
from vdgs.errors import CaptureError
from vdgs.geometry.camera import Camera, camera_centers
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.system.quoting import shell_word

#: Points farther from the cameras than this many times their spread are strays of the matching.
MAX_DISTANCE_RATIO = 100.0
#: Points are black where this share of their colors is at most so bright, of 255 (choice).
NEARLY_ALL, BLACK = 0.99, 8


def load_capture(path: Path, options: CaptureOptions | None = None) -> Capture:
    """Read, check and normalize the capture in the folder `path`.

    Raises `CaptureError` naming the file, what is wrong and the remedy, before anything expensive happens.
    Pixels are not decoded here; `image_checks.check_images` does that.
    """
    options = options or CaptureOptions()
    return make_capture(Path(path), read_files(Path(path), options), options)


def read_files(root: Path, options: CaptureOptions) -> SourceCapture:
    """The files of a capture, without its photographs. Raises as `load_capture`."""
    if not (root.is_dir() or is_transforms(root) or is_project(root)):
        if root.suffix.lower() in VIDEO_SUFFIXES and root.is_file():
            raise CaptureError(
                f"{root}: is a film, which becomes a capture first: vdgs sfm {shell_word(root)} --output CAPTURE (with "
                "--dry-run it only says what frames it has)"
            )
        check_no_foreign_file(root)
        what, archive = (
            ("is a file", " (of an archive, once it is unpacked)") if root.is_file() else ("no such folder", "")
        )
        raise CaptureError(
            f"{root}: {what}. Give the folder of the photographs, or one that holds images/ and sparse/{archive}."
        )
    _check_options(root, options)
    return read_source(root, options)


def make_capture(root: Path, source: SourceCapture, options: CaptureOptions) -> Capture:
    """The capture of files that are read (`read_files`). Raises as `load_capture`."""
    root = capture_root(root)
    warnings = list(source.warnings)
    source = _without_bad_points(source, warnings)
    photographs, unused = match_images(root, source, options, warnings)
    photographs = _undistorted(root, source, photographs, options, warnings)
    _refuse_tiny(photographs, options)
    ground, ground_warnings = find_ground_frame(source, root, options)
    views = [_view(photo, options, ground) for photo in photographs]
    points, colors = ground.to_ground(source.points), source.colors
    if (colors == GRAY).all():
        warnings.append("the points bring no colors under a name that is known; the scene starts from gray.")
    elif np.quantile(colors, NEARLY_ALL) <= BLACK:
        warnings.append(
            "the points are all but black, and so is what the scene starts from. Where photographs are not, the file "
            "of the points has colors of an unusual scale: write them from 0 to 255."
        )
    if options.max_images is not None and options.max_images < len(views):
        warnings.append(f"using the {options.max_images} of {len(views)} photographs nearest to the middle.")
        views = select_central_views(views, options.max_images)
        seen = np.zeros(len(points), bool)
        for view in views:
            seen |= view.camera.in_frustum(points)
        points, colors = points[seen], colors[seen]
        if not seen.any():
            raise CaptureError(f"{root}: the chosen {options.max_images} photographs see no points; use more.")
    explicit = {photo.view.name: photo.view.split for photo in photographs}
    views = assign_splits(root, views, explicit, options, warnings, images=source.images)
    off_path = [_view(photo, options, ground, "test") for photo in match_off_path(root, options, warnings)]
    return Capture(
        root=root, source=source.source, images=source.images, views=tuple(views), points=points,
        point_colors=colors, ground=ground, warnings=(*warnings, *ground_warnings), downscale=options.downscale,
        num_unused_images=unused + len(photographs) - len(views), off_path_views=tuple(off_path),
    )  # fmt: skip


def _check_options(root: Path, options: CaptureOptions) -> None:
    found = find_range_errors(options)
    if found:
        raise CaptureError("\n  ".join(found))
    if not (root / options.masks).is_dir() and not Path(options.masks).is_dir():
        check_folder("--masks", options.masks)


# -------------------------------------------------------------------------------------------- points


def _without_bad_points(source: SourceCapture, warnings: list[str]) -> SourceCapture:
    """Drop points that are not finite or absurdly far from the cameras."""
    poses = np.stack([view.camera_from_world for view in source.views])
    centers = camera_centers(poses)
    finite = np.isfinite(source.points).all(axis=1) & (np.abs(source.points) < 1e12).all(axis=1)
    if not finite.any():
        raise CaptureError(f"{source.source} model: none of its {len(source.points)} points is a finite number.")
    middle = np.median(centers, axis=0)
    distance = np.linalg.norm(np.where(finite[:, None], source.points, middle) - middle, axis=1)
    spread = max(float(np.quantile(np.linalg.norm(centers - middle, axis=1), 0.9)), float(np.median(distance[finite])))
    keep = finite & (distance <= MAX_DISTANCE_RATIO * spread)
    if not keep.all():
        warnings.append(
            f"{(~finite).sum()} points that are not finite and {(finite & ~keep).sum()} points farther than "
            f"{MAX_DISTANCE_RATIO:.0f}x the spread of the cameras were left out of {len(keep)}."
        )
    far = float(np.median(distance[keep]))
    step = detect_rounding(source.points[keep], far)
    if step:
        warnings.append(
            f"the sparse points are rounded to {step:.3g} of their world's units, {step / far:.1%} of their distance "
            "to the cameras: survey coordinates saved with too few digits (float32)? Subtract an origin in the place "
            "before saving, or save double precision."
        )
    return replace(source, points=source.points[keep], colors=source.colors[keep])


# --------------------------------------------------------------------------------------- photographs


def _undistorted(
    root: Path, source: SourceCapture, photographs: list[MatchedView], options: CaptureOptions, warnings: list[str]
) -> list[MatchedView]:
    """Pinhole photographs only: those of other lenses are undistorted, once, into a folder of their own."""
    bent = [photo for photo in photographs if photo.file.intrinsics.is_distorted]
    if not bent:
        return photographs
    elsewhere = Path(source.images).is_absolute()
    inside = "images" if source.original_images or elsewhere else options.images or "images"
    folder = options.undistorted_folder or root / UNDISTORTED / inside
    files = [photo.file for photo in photographs]
    check_not_among_files(folder, root, [path for file in files for path in (file.path, file.mask) if path is not None])
    straight = undistort(folder, files)
    models = sorted({photo.file.intrinsics.model for photo in bent})
    warnings.append(
        f"{len(bent)} photographs with lens distortion ({', '.join(models)}) were undistorted into {folder}."
    )
    warnings += fold_notes(photo.file.intrinsics for photo in bent)
    return [MatchedView(photo.view, file) for photo, file in zip(photographs, straight, strict=True)]


def _refuse_tiny(photographs: list[MatchedView], options: CaptureOptions) -> None:
    """Raise CaptureError where so little is left of a photograph by --downscale that it shows nothing."""
    smallest = min((photo.file for photo in photographs), key=lambda file: min(_size(file)))
    (width, height), factor = _size(smallest), options.downscale
    if factor > 1 and min(width, height) / factor < MIN_SIDE_PX:
        raise CaptureError(
            f"--downscale {factor:g}: photographs of {width}x{height} would be {int(width / factor)}x"
            f"{int(height / factor)} ({smallest.path}), too few pixels to show anything. Give at most "
            f"{max(1, min(width, height) // MIN_SIDE_PX)}."
        )


def _size(file: ImageFile) -> tuple[int, int]:
    return file.intrinsics.width, file.intrinsics.height


def _view(photo: MatchedView, options: CaptureOptions, ground: GroundFrame, split: Split = "train") -> View:
    intrinsics = photo.file.intrinsics
    (fx, fy), (cx, cy) = intrinsics.focal, intrinsics.principal_point
    width, height = intrinsics.width, intrinsics.height
    pose = transform_pose(photo.view.camera_from_world, ground)
    camera = Camera(camera_from_world=pose, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
    if options.downscale != 1:
        width, height = int(width / options.downscale), int(height / options.downscale)
        camera = camera.resized(width, height)
    seen = photo.view.observations
    sightings = None if seen is None else Observations(ground.to_ground(seen.points), seen.rays, seen.point_ids)
    return View(
        name=photo.view.name, camera=camera, image_path=photo.file.path, mask_path=photo.file.mask, split=split,
        observations=sightings,
    )  # fmt: skip
