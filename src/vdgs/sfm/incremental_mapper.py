"""Poses and points from matches: COLMAP's incremental mapper, with positions as priors."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from rich.console import Console

from vdgs.config.sfm_options import SfmOptions
from vdgs.errors import CaptureError
from vdgs.sfm.feature_extraction import Kind
from vdgs.sfm.focal_length import CALIBRATED
from vdgs.sfm.georegistration import is_line
from vdgs.sfm.gps_priors import Positions
from vdgs.sfm.image_metadata import Photograph
from vdgs.sfm.preflight import OBLIQUE_DEG
from vdgs.sfm.workspace import Work, call, progress

#: Oblique views, or heights that differ by so much of the flying height, let a flight tell the focal length (choice).
OBLIQUE_SHARE, HEIGHTS_DIFFER = 0.15, 0.2
#: Of a way around something no tenth of the positions is nearer to the middle than this share of how far all are (RMS,
#: both axes alike); of strips over an area it is (choice).
AROUND = 0.8
#: Parts of fewer photographs than this are no model.
SMALLEST_MODEL = 3
#: What the mapper has is kept so many times on the way, each time by so many photographs more at least.
SNAPSHOTS, LEAST_BETWEEN = 20, 5


def holds_focal(photographs: Sequence[Photograph], positions: Positions, options: SfmOptions) -> tuple[bool, str]:
    """Whether the focal length is held at what EXIF says, and why: over level ground from one height, straight down, a
    longer lens and a lower flight look the same. Where nothing says that the flight was one like this it is fitted: a
    wrong focal length that is held bends or tears all other scenes."""
    if options.focal != "auto":
        return options.focal == "hold", "asked for"
    if any(photo.lens is None for photo in photographs):
        return False, "nothing says it for some photographs"
    tilts = [photo.attitude.tilt_deg for photo in photographs if photo.attitude]
    if tilts and np.mean(np.array(tilts) > OBLIQUE_DEG) >= OBLIQUE_SHARE:
        return False, f"{np.mean(np.array(tilts) > OBLIQUE_DEG):.0%} oblique views tell it"
    heights = np.array([photo.above_takeoff for photo in photographs if photo.above_takeoff is not None])
    if len(heights) >= 3 and _range(heights) > HEIGHTS_DIFFER * abs(np.median(heights)):
        return False, "flown at several heights, which tell it"
    if 2 * max(len(tilts), len(heights)) >= len(photographs):
        return True, "one height, straight down as far as known: the flight cannot tell it"
    if all(photo.lens is not None and photo.lens.source == CALIBRATED for photo in photographs):
        return True, "calibrated by the maker"
    if _surveys(positions):
        return True, "level strips over an area: the flight cannot tell it, if it looked straight down"
    return False, "nothing says that it was flown level, looking straight down"


def _surveys(positions: Positions) -> bool:
    """Whether photographs were taken from one height all over an area, as a survey is, and not around something."""
    if not positions.usable or is_line(positions.enu, positions.deviations):
        return False
    plane = positions.enu[:, :2] - positions.enu[:, :2].mean(axis=0)
    axes, spread, _ = np.linalg.svd(plane, full_matrices=False)
    spread, alike = spread / np.sqrt(len(plane)), np.linalg.norm(axes, axis=1) * np.sqrt(len(plane))
    around = np.quantile(alike, 0.1) > AROUND * np.sqrt(2)
    return not around and _range(positions.enu[:, 2]) <= HEIGHTS_DIFFER * spread[1]


def _range(heights: np.ndarray) -> float:
    """Between the 5 % quantile and the 95 %."""
    return float(np.ptp(np.quantile(heights, [0.05, 0.95])))


def write_priors(work: Work, photographs: Sequence[Photograph], positions: Positions) -> None:
    """Positions with their covariances and, where the drone says it, which way is down."""
    row_of = {int(i): row for row, i in enumerate(positions.index)} if positions.usable else {}
    database = pycolmap.Database.open(work.database)
    try:
        database.clear_pose_priors()
        images = {image.name: image for image in database.read_all_images()}
        for i, photo in enumerate(photographs):
            if i not in row_of or photo.name not in images:
                continue
            prior = pycolmap.PosePrior(
                corr_data_id=images[photo.name].data_id,
                position=positions.enu[row_of[i]],
                position_covariance=np.diag(positions.deviations[row_of[i]] ** 2),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
            if photo.attitude is not None:
                prior.gravity = photo.attitude.gravity
            database.write_pose_prior(prior)
    finally:
        database.close()


def find_models(
    work: Work, count: int, hold_focal: bool, with_positions: bool, threads: int, console: Console
) -> list[pycolmap.Reconstruction]:
    """All models that the mapper makes of the matches, that of most photographs first.

    What it has is kept on the way, and goes on where it was stopped (`forget_models` first to begin anew). Raises
    CaptureError where it makes none.
    """
    for folder in (work.models, work.snapshots):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    options = _options(hold_focal, with_positions, threads)
    options.snapshot_path, options.snapshot_frames_freq = work.snapshots, max(LEAST_BETWEEN, count // SNAPSHOTS)
    begun = _largest_kept(work)
    placed = int(begun.name) if begun else 2  # a model begins with two
    with progress(console, f"mapping, {f'{placed} placed before, ' if begun else ''}photographs", count) as tell:

        def one_more() -> None:
            nonlocal placed
            placed += 1
            tell(min(placed, count))
            keep_snapshots(work)

        try:
            models = call(
                pycolmap.incremental_mapping, work.database, work.photographs, work.models, options,
                input_path=begun or "", next_image_callback=one_more,
            )  # fmt: skip
        except KeyboardInterrupt:
            keep_snapshots(work)  # the mapper ended by itself: they are whole
            raise
        tell(count)
    if not models:
        raise CaptureError(
            "no two photographs could be joined. Either they do not overlap, or they were all taken at one place "
            "(turning alone shows no depth), or they show nothing to hold on to: water, snow, blurred pictures. Fly "
            "with 70 to 80 % overlap, the camera moving between photographs."
        )
    return _sorted(list(models.values()))


def keep_snapshots(work: Work) -> None:
    """Put whole snapshots of the mapper where the same command goes on from, unless a larger one is there.

    To be called where the mapper does not write: then what is there is whole.
    """
    for folder in sorted(work.snapshots.iterdir()) if work.snapshots.is_dir() else []:
        before, count = _largest_kept(work), _placed_in(folder)
        if before is None or count > int(before.name):
            work.kept.mkdir(exist_ok=True)
            os.replace(folder, work.kept / str(count))
            if before is not None:
                shutil.rmtree(before)
        else:
            shutil.rmtree(folder)


def forget_models(work: Work) -> None:
    """Remove all models, finished or not."""
    for folder in (work.models, work.snapshots, work.kept):
        shutil.rmtree(folder, ignore_errors=True)


def _largest_kept(work: Work) -> Path | None:
    return max(work.kept.glob("*"), key=lambda folder: int(folder.name), default=None)


def _placed_in(folder: Path) -> int:
    """Number of photographs that a written model places: the first eight bytes of its images."""
    with (folder / "images.bin").open("rb") as file:
        return int.from_bytes(file.read(8), "little")


def read_models(work: Work) -> list[pycolmap.Reconstruction]:
    """What `find_models` found before."""
    return _sorted([pycolmap.Reconstruction(folder) for folder in sorted(work.models.iterdir()) if folder.is_dir()])


def _sorted(models: list[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    return sorted(models, key=lambda model: -model.num_reg_images())


def _options(hold_focal: bool, with_positions: bool, threads: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, 0
    options.min_model_size = SMALLEST_MODEL
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not hold_focal
    options.use_prior_position = options.use_robust_loss_on_prior_position = with_positions
    # Its solver takes minutes for each photograph that does not fit, and finds none in overlapping flights.
    options.structure_less_registration_fallback = False
    # Points that two photographs see are where the edges of a flight, and few photographs, have any.
    options.triangulation.ignore_two_view_tracks = False
    return options


def kinds_after(model: pycolmap.Reconstruction, kinds: Sequence[Kind]) -> list[pycolmap.Camera | None]:
    """The fitted cameras in the order of the kinds of photographs; None for those without a placed photograph."""
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    return [model.cameras[k] if k in used and k in model.cameras else None for k in range(1, len(kinds) + 1)]
