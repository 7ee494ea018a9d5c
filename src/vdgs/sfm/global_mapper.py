"""Photographs that the incremental mapper leaves out, placed with all others at once by COLMAP's global mapper.

The incremental mapper places one photograph after another, each by thirty points that are there already: where a flight
overlaps little it ends in parts. The global mapper (GLOMAP, Pan et al. 2024) turns and moves all photographs together,
by what their pairs say. Its model is refined by the incremental mapper, and believed only where the parts that this one
had found keep their shape in it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from vdgs.captures.formats.colmap_writing import check_whole_model, write_model_files
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.similarity import nearest_rotation
from vdgs.sfm import feature_matching, incremental_mapper
from vdgs.sfm.capture_writer import longest_focal, placed_images
from vdgs.sfm.image_metadata import EXACT_MODEL
from vdgs.sfm.reprojection import mean_reprojection_error
from vdgs.sfm.turning import only_turns
from vdgs.sfm.workspace import Workspace, report_progress
from vdgs.system.atomic_files import explain_disk_errors
from vdgs.system.child_python import python_command
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.stop_signals import check_stop_requested

#: Photographs are tried again where so large a share of those that match others is left out (choice).
MIN_MISSING_SHARE = 0.03
#: A photograph is held by so many points at least, as the incremental mapper asks for.
MIN_POINTS = 30
#: A part keeps its shape where its cameras move by no more than this share of their distance to what they see, and turn
#: by no more degrees (RMS and median); smaller parts have little shape to keep (choices).
MAX_MOVED_SHARE, MAX_TURNED_DEG, MIN_PART = 0.02, 1.0, 5
#: Its points are seen where they were before, within so many pixels more; and all points where they should be within so
#: many in the mean.
MAX_WORSE_PX, MAX_ERROR_PX = 0.1, 1.0
#: What the process of the global mapper writes into its folder once it has loaded all that it needs.
_BEGUN = "begun"
_POLL_SECONDS = 0.2


def leaves_photographs_out(workspace: Workspace) -> bool:
    """Whether enough photographs that match others are missing in the largest model, of cameras that the global mapper
    may move and fit: not of rigs, and not of views that were cut out of panoramas."""
    with workspace.open_database() as database:
        fixed = any(rig.num_sensors() > 1 for rig in database.read_all_rigs()) or any(
            camera.model_name == EXACT_MODEL for camera in database.read_all_cameras()
        )
    matched = {name for name, count in feature_matching.count_verified_matches(workspace).items() if count}
    missing = matched - {image.name for image in placed_images(incremental_mapper.read_models(workspace)[0])}
    return not fixed and len(missing) > MIN_MISSING_SHARE * len(matched)


def place_left_out(workspace: Workspace, count: int, fix_focal: bool, threads: int, console: Console) -> None:
    """Make models again, beginning with all photographs at once; those that were set aside (`set_models_aside`) are
    taken back, and why is said, where that places no more photographs, or changes the shape of a part.

    Raises VdgsError for a full disk, and where the process of the global mapper cannot start.
    """
    parts = incremental_mapper.read_models(workspace, workspace.models_aside)
    try:
        why = _map_globally(workspace, count, len(placed_images(parts[0])), fix_focal, threads, console)
        if not why:
            incremental_mapper.run_mapper(workspace, count, fix_focal, threads, console)
            why = _take(workspace, parts)
    except CaptureError as error:  # of COLMAP
        why = str(error)
    if why:
        incremental_mapper.take_models_back(workspace)
        said = f"all photographs at once: {escape(why)}; the parts stay as they are"
    else:
        placed = len(placed_images(incremental_mapper.read_models(workspace)[0]))
        sizes = ", ".join(str(len(placed_images(part))) for part in parts)
        said = f"placed one by one the photographs end in parts of {sizes}; all at once {placed} are placed"
    console.print(f"[yellow]note[/] {said}", highlight=False)


def _take(workspace: Workspace, parts: Sequence[pycolmap.Reconstruction]) -> str:
    """Keep the largest model alone, which takes the place of parts; why not, or empty."""
    joined = incremental_mapper.read_models(workspace)[0]
    for image in placed_images(joined):
        if image.num_points3D < MIN_POINTS:
            joined.deregister_frame(image.frame_id)
    why = _why_not(parts, joined)
    if not why and only_turns(workspace, joined):
        why = "a camera that only turns explains what they show, which tells no depth"
    if not why:
        shutil.rmtree(workspace.models)
        write_model_files(joined, workspace.models / "0")
    return why


def _map_globally(
    workspace: Workspace, count: int, placed: int, fix_focal: bool, threads: int, console: Console
) -> str:
    """Let the incremental mapper go on from the largest model of the global one; why there is none, or empty."""
    if any(workspace.saved_snapshots.glob("*")):
        return ""
    # In a process of its own: the global mapper cannot be interrupted, and a failed check of it ends a process; and in
    # a folder of its own, for such a process may outlive this one.
    folder = Path(tempfile.mkdtemp(dir=workspace.path, prefix="global-"))
    try:
        with report_progress(workspace, console, "mapping", count, f"{placed} placed, now all at once, ") as tell:
            tell(placed)
            said = _run_apart((workspace.database, workspace.images, folder, threads, int(fix_focal)), folder)
        if said or not any(each.is_dir() for each in folder.iterdir()):
            return f"the mapper ended without a model {said}".strip()
        with explain_disk_errors(workspace.path):
            sizes = {each: incremental_mapper.registered_count(each) for each in folder.iterdir() if each.is_dir()}
            largest = max(sizes, key=lambda each: sizes[each])
            check_whole_model(largest)
        workspace.saved_snapshots.mkdir(exist_ok=True)
        os.replace(largest, workspace.saved_snapshots / str(sizes[largest]))
        return ""
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run_apart(arguments: Sequence[object], folder: Path) -> str:
    """Run `map_globally` in a process of its own; what it said last where it failed. Raises VdgsError where it ends
    before it begins: that is a fault of the machine, and says nothing of the photographs."""
    log = folder / "log"
    with log.open("wb") as output:
        command = python_command(__name__, *arguments)
        process = subprocess.Popen(command, stdout=output, stderr=output)
    try:
        while process.poll() is None:
            time.sleep(_POLL_SECONDS)
            check_stop_requested()
    finally:
        process.kill()
        process.wait()
    last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
    said = f"({' '.join([f'exit code {process.returncode}', *last])})" if process.returncode else ""
    if said and not (folder / _BEGUN).exists():
        raise VdgsError(
            f"COLMAP's global mapper cannot be started in a process of its own {said}. `vdgs doctor` says what this "
            "machine lacks; the same command then continues."
        )
    return said


def map_globally(database: Path, images: Path, output: Path, threads: int, fix_focal: bool) -> None:
    """Write the models of COLMAP's global mapper."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = threads, 0
    options.min_model_size = incremental_mapper.MIN_MODEL_SIZE
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = not fix_focal
    options.mapper.global_positioning.use_gpu = adjustment.ceres.use_gpu = False
    options.mapper.retriangulation.ignore_two_view_tracks = False
    with pycolmap.Database.open(database) as lenses:
        options.mapper.retriangulation.max_focal_length_ratio = longest_focal(lenses.read_all_cameras())
    (output / _BEGUN).touch()
    pycolmap.global_mapping(database, images, output, options)


def _why_not(parts: Sequence[pycolmap.Reconstruction], joined: pycolmap.Reconstruction) -> str:
    """Why a model is not taken in place of its parts; empty where it is."""
    if len(placed_images(joined)) <= len(placed_images(parts[0])):
        return "no more are placed"
    if mean_reprojection_error(joined) > MAX_ERROR_PX:
        return f"points are {mean_reprojection_error(joined):.1f} px from where they should be"
    for part in parts:
        if len(placed_images(part)) >= MIN_PART and not _keeps_shape(part, joined):
            return f"the part of {len(placed_images(part))} has another shape in it"
    return ""


def _keeps_shape(part: pycolmap.Reconstruction, joined: pycolmap.Reconstruction) -> bool:
    """Whether photographs of a part lie to each other as in a model of more of them, and show its points as well."""
    before, after = (_by_name(placed_images(model)) for model in (part, joined))
    names = sorted(before.keys() & after.keys())
    if len(names) < max(3, (1 - MIN_MISSING_SHARE) * len(before)):
        return False
    centers, moved = (np.array([of[name].projection_center() for name in names]) for of in (before, after))
    rotations = [np.array([of[name].cam_from_world().rotation.matrix() for name in names]) for of in (before, after)]
    # By the rotations of the cameras, for their places leave it open where they lie on one line.
    turn = nearest_rotation(np.einsum("nji,njk->ik", *rotations))
    centers, moved = centers - centers.mean(axis=0), (moved - moved.mean(axis=0)) @ turn.T
    off = np.linalg.norm(centers - (centers * moved).sum() / (moved**2).sum() * moved, axis=1)
    cosines = (np.einsum("nij,jk,nik->n", rotations[0], turn, rotations[1]) - 1) / 2
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    seen = [before[name] for name in names if before[name].num_points3D]
    away = np.median([incremental_mapper.height_over_points(image, part) for image in seen])
    worse = mean_reprojection_error(joined) - mean_reprojection_error(part)
    return bool(
        np.sqrt((off**2).mean()) <= MAX_MOVED_SHARE * away
        and np.median(angles) <= MAX_TURNED_DEG
        and worse <= MAX_WORSE_PX
    )


def _by_name(images: Iterable[pycolmap.Image]) -> dict[str, pycolmap.Image]:
    return {image.name: image for image in images}


def _end_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_SECONDS)
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    map_globally(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]), sys.argv[5] == "1")
