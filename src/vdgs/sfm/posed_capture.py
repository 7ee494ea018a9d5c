"""A capture of a project or data set that has poses and no points: points are found with poses and lenses held as they
are.

Features are found in the photographs as they are, and their places brought to one pinhole for all photographs of a size
by the project's own lenses, whatever their models and however many they are; pairs that look at the same are matched,
and what agrees is triangulated. The same command goes on where it was stopped.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from vdgs.captures.formats.colmap_writing import write_model_files
from vdgs.captures.formats.lens_projection import colmap_camera, pixel_rays
from vdgs.captures.formats.ply_reader import GRAY
from vdgs.captures.formats.source_capture import Intrinsics, SourceCapture, SourceView, format_list
from vdgs.captures.georeference import ENU_FRAME, LOCAL_FRAME, ORIGIN_KEYS
from vdgs.captures.image_files import decode_image
from vdgs.captures.name_resolution import jpeg_name
from vdgs.captures.output_guard import check_output
from vdgs.captures.reconstruction import DIGESTS_FILE, STEPS_FILE, WORK_FOLDER
from vdgs.captures.split_lists import TEST_LIST, VALIDATION_LIST
from vdgs.captures.up_axis import estimate_up
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.ranges import check_ranges
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.camera import camera_centers
from vdgs.geometry.similarity import rotation_to_z
from vdgs.kernels import default_num_threads
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm import capture_writer, feature_extraction, feature_matching, mask_files, pair_selection
from vdgs.sfm.discarding import agree_to_discard, check_nothing_trained, discard_training, forget_agreement
from vdgs.sfm.feature_extraction import UNDECODABLE
from vdgs.sfm.image_list import ExcludedImage
from vdgs.sfm.posed_photographs import (
    BENT,
    CAPTURE,
    FEATURES,
    MATCHES,
    POINTS,
    PosedPhotographs,
    read_posed_photographs,
    write_on_white,
)
from vdgs.sfm.random_points import random_points
from vdgs.sfm.reconstruct import writing
from vdgs.sfm.reprojection import drop_unseen_observations, mean_reprojection_error
from vdgs.sfm.workspace import Workspace, call_cancellable, report_progress, silence_colmap
from vdgs.system.atomic_files import write_json, write_text
from vdgs.system.lazy_pycolmap import pycolmap

#: Where features go that the lens cannot have shown: no pair of them agrees with any.
_NOWHERE = -1e5
#: Fewer points than this are no scene.
MIN_POINTS = 100
#: Of features that were matched and verified, poses that are true place at least this share (choice: of a generated
#: flight 99.9 % are placed, 42 to 54 % where photographs and poses are exchanged).
LEAST_AGREEING = 0.65


def make_posed_capture(
    request: SfmRequest,
    options: CaptureOptions,
    console: Console,
    run: RunFolder | None = None,
) -> None:
    """Make a capture with points of a project without, in `request.output`, or go on with one that was begun.

    `run` is the run that the capture is for. Raises CaptureError for projects and photographs that cannot become one,
    VdgsError for an output that is something else.
    """
    silence_colmap()
    check_ranges(request)
    photographs = read_posed_photographs(request, options)
    output, threads = request.output, request.threads or default_num_threads()
    work, finished = Workspace(output / WORK_FOLDER), Workspace(output)
    for warning in photographs.warnings:
        console.print(f"[yellow]note[/] {warning}", highlight=False)
    if finished.is_done(CAPTURE, photographs.keys[CAPTURE]):
        console.print(f"{output}: made of these poses already; nothing to do", highlight=False)
        with suppress(VdgsError):  # it saves reading, and the folder may be read-only
            photographs.digests.write()
            forget_agreement(output)
        return
    check_posed_output(photographs)
    check_nothing_trained(request, run, photographs.keys[CAPTURE])
    console.print(
        f"{len(photographs.views)} photographs, poses and lenses as they are; points are found",
        highlight=False,
    )
    with writing(request, run):
        photographs.digests.write()
        agree_to_discard(output, photographs.keys[CAPTURE], run)
        _find_features(photographs, work, request, threads, console)
        _match(photographs, work, request, threads, console)
        model = _triangulate(photographs, work, threads, console)
        drop_unseen_observations(model)
        discard_training(output, run)
        if not finished.is_begun(CAPTURE, photographs.keys[CAPTURE]):
            finished.forget(CAPTURE)  # before: an interrupted removal is no finished capture
            for name in (*capture_writer.IMAGE_FOLDERS, "sparse"):
                shutil.rmtree(output / name, ignore_errors=True)
            for name in ("georef.json", TEST_LIST, VALIDATION_LIST):
                (output / name).unlink(missing_ok=True)
            finished.begin(CAPTURE, photographs.keys[CAPTURE])
        _write(photographs, work, model, request, threads, console)
        finished.finish(CAPTURE, photographs.keys[CAPTURE])
    if error := mean_reprojection_error(model):  # random points have none
        console.print(f"{model.num_points3D():,} points, mean reprojection error {error:.2f} px", highlight=False)


def check_posed_output(photographs: PosedPhotographs) -> None:
    """Raise VdgsError unless the output is a new folder, an empty one, or one that was begun with the same project."""
    request, output = photographs.request, photographs.request.output
    work, finished = Workspace(output / WORK_FOLDER), Workspace(output)
    check_output(output)
    if not output.exists() or (output.is_dir() and {each.name for each in output.iterdir()} <= {".lock", DIGESTS_FILE}):
        return
    begun = (work.path / STEPS_FILE).is_file() or (output / STEPS_FILE).is_file()
    if not begun:
        raise VdgsError(f"{output}: holds other things already. Choose a new folder with --output.")
    keys = photographs.keys
    same = work.is_begun_by_any(FEATURES, keys[FEATURES]) or finished.is_begun_by_any(CAPTURE, keys[CAPTURE])
    if not same and not request.overwrite:
        raise VdgsError(
            f"{output}: was begun with other photographs, poses or settings than there are now. Add --overwrite to "
            "make it anew, or choose another --output."
        )


# ------------------------------------------------------------------------------------------------- the steps


def _find_features(
    photographs: PosedPhotographs, work: Workspace, request: SfmRequest, threads: int, console: Console
) -> None:
    """Features as the photographs show them, in their own database, then a copy in which the lens is undone."""
    bent, keys = Workspace(work.path / BENT), photographs.keys
    if not work.is_begun(FEATURES, keys[FEATURES]):
        work.remove()
        work.begin(FEATURES, keys[FEATURES])
    groups = _groups(photographs)
    images = [image for group in groups for image in group.images]
    feature_extraction.create_database(bent, groups)
    write_on_white(photographs, bent)
    _refuse_damaged(feature_extraction.write_upright_images(bent, images, threads))
    if not work.is_done(FEATURES, keys[FEATURES]):
        mask_files.write_upright_masks(bent, images, threads)
        there = feature_extraction.count_features(bent)
        with report_progress(work, console, "features", len(images)) as tell:
            feature_extraction.extract_groups(bent, groups, request.options, len(images), threads, there, tell)
        work.finish(FEATURES, keys[FEATURES])
    counts = feature_extraction.count_features(bent)
    _refuse_damaged([ExcludedImage(photo.name, UNDECODABLE) for photo in images if photo.name not in counts])
    if not photographs.is_data_set:  # objects without texture begin from random points
        feature_extraction.images_without_features(images, counts)
    if work.is_done(BENT, keys[BENT]):
        return
    work.begin(BENT, keys[BENT])
    for rest in work.path.glob("database.db*"):
        rest.unlink()
    shutil.copyfile(bent.database, work.database)
    _straighten(photographs, work)
    work.finish(BENT, keys[BENT])


def _refuse_damaged(damaged: Sequence[ExcludedImage]) -> None:
    """Raise CaptureError where photographs cannot be decoded: each has a pose, and is written in the end."""
    if damaged:
        raise CaptureError(
            f"{len(damaged)} photographs of the project cannot be used; copy them again, or take them out of the "
            f"project.{format_list([each.line for each in damaged])}"
        )


def _groups(photographs: PosedPhotographs) -> list[feature_extraction.CameraGroup]:
    groups = []
    for number, lens in enumerate(photographs.pinholes, 1):
        members = tuple(
            photographs.metadata(view) for view in photographs.views if photographs.number_of(view) == number
        )
        groups.append(
            feature_extraction.CameraGroup(
                camera="", width=lens.width, height=lens.height, focal_px=lens.focal[0], has_focal_prior=True,
                source="the project", images=members,
            )
        )  # fmt: skip
    return groups


def _straighten(photographs: PosedPhotographs, work: Workspace) -> None:
    """Cameras of the database become pinholes, and features lie where these show them."""
    by_name = {view.view.name: view for view in photographs.views}
    with work.open_database() as database:
        for number, pinhole in enumerate(photographs.pinholes, 1):
            database.update_camera(_camera(number, pinhole))
        for image in database.read_all_images():
            if database.exists_keypoints(image.image_id):
                lens, pinhole = by_name[image.name].file.intrinsics, photographs.pinholes[image.camera_id - 1]
                features = np.array(database.read_keypoints(image.image_id))
                rays = pixel_rays(lens, features[:, :2].astype(np.float64))
                features[:, :2] = np.nan_to_num(rays * pinhole.focal + pinhole.principal_point, nan=_NOWHERE)
                database.update_keypoints(image.image_id, features)


def _camera(number: int, lens: Intrinsics) -> pycolmap.Camera:
    camera = colmap_camera(lens)
    camera.camera_id = number
    return camera


def _match(photographs: PosedPhotographs, work: Workspace, request: SfmRequest, threads: int, console: Console) -> None:
    key = photographs.keys[MATCHES]
    if work.is_done(MATCHES, key):
        return
    if not work.is_begun(MATCHES, key):
        feature_matching.delete_matches(work)
        work.begin(MATCHES, key)
    there = feature_extraction.count_features(work)
    names = [view.view.name for view in photographs.views]
    pairs = [(names[i], names[j]) for i, j in sorted(near_pairs(photographs, request.options.num_neighbors))]
    pairs = [pair for pair in pairs if all(there.get(name) for name in pair)]
    feature_matching.match_pairs(work, pairs, threads, console)
    work.finish(MATCHES, key)


def near_pairs(photographs: PosedPhotographs, num_neighbors: int) -> set[tuple[int, int]]:
    """Pairs of photographs whose cameras are near each other and look the same way."""
    used = photographs.trained
    if len(used) <= pair_selection.SEQUENTIAL_OVERLAP:
        pairs = pair_selection.exhaustive_pairs(len(used))
    else:
        pairs = _near_views([photographs.views[k].view for k in used], photographs.source, num_neighbors)
    return {(used[i], used[j]) for i, j in pairs}


def _near_views(views: Sequence[SourceView], source: SourceCapture, num_neighbors: int) -> set[tuple[int, int]]:
    poses = np.stack([view.camera_from_world for view in views])
    rotations, centers = poses[:, :3, :3], camera_centers(poses)
    level = np.eye(3)
    if source.georef is None:
        level = rotation_to_z(estimate_up(centers, rotations, centers, [])[0])
    return pair_selection.spatial_pairs(centers @ level.T, num_neighbors, rotations[:, 2] @ level.T)


def _triangulate(
    photographs: PosedPhotographs, work: Workspace, threads: int, console: Console
) -> pycolmap.Reconstruction:
    folder, key = work.models / "0", photographs.keys[POINTS]
    if work.is_done(POINTS, key):
        return pycolmap.Reconstruction(folder)
    work.begin(POINTS, key)
    shutil.rmtree(work.models, ignore_errors=True)
    folder.mkdir(parents=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = threads, 0, False
    options.max_focal_length_ratio = options.triangulation.max_focal_length_ratio = capture_writer.LONGEST_BY_TAGS
    options.triangulation.ignore_two_view_tracks = False  # as in the mapper: edges of a flight have no others
    with report_progress(work, console, "mapping", len(photographs.views), "poses held, ") as tell:
        tell(0)
        model = call_cancellable(
            _triangulate_points, work.database, posed_model(photographs, work), work.path, folder, options
        )
        tell(len(photographs.views))
    if photographs.is_data_set and model.num_points3D() < MIN_POINTS:
        model = _with_random_points(photographs, work, console)
        shutil.rmtree(folder)
        write_model_files(model, folder)
    else:
        _check_agreement(model, work)
    work.finish(POINTS, key)
    return model


def _check_agreement(model: pycolmap.Reconstruction, work: Workspace) -> None:
    """Raise CaptureError where what was matched is not where the poses would have it."""
    agreeing = sum(point.track.length() for point in model.points3D.values())
    share = agreeing / max(1, feature_matching.count_matched_features(work))
    if model.num_points3D() < MIN_POINTS or share < LEAST_AGREEING:
        raise CaptureError(
            f"{model.num_points3D()} points, {share:.0%} of what photographs show together, agree with the poses of "
            "the project; of true poses nearly all do. Are the photographs those that it was made of, at their own "
            "size and not turned, and are its lenses exported with it? Or let poses be found anew: give the folder of "
            "the photographs alone to vdgs sfm."
        )


def _with_random_points(photographs: PosedPhotographs, work: Workspace, console: Console) -> pycolmap.Reconstruction:
    """A model of the poses with random points, where features give too few."""
    views = [photographs.views[k] for k in photographs.trained]
    poses, lenses = [view.view.camera_from_world for view in views], [view.file.intrinsics for view in views]
    points, edge = random_points(poses, lenses)
    console.print(
        f"[yellow]note[/] the photographs share too few features for points: the scene starts from {len(points):,} "
        f"random points in the middle of what the cameras see (a box of {edge:.3g} units).",
        highlight=False,
    )
    model = posed_model(photographs, work)
    for point in points:
        model.add_point3D(point, pycolmap.Track(), np.full(3, GRAY, np.uint8))
    return model


def _triangulate_points(database: Path, model: Any, images: Path, output: Path, options: Any, **named: Any) -> Any:
    return pycolmap.triangulate_points(model, database, images, output, options=options, **named)


def posed_model(photographs: PosedPhotographs, work: Workspace) -> pycolmap.Reconstruction:
    """A model of the cameras alone, with the numbers of the database."""
    model = pycolmap.Reconstruction()
    for number, lens in enumerate(photographs.pinholes, 1):
        model.add_camera_with_trivial_rig(_camera(number, lens))
    with work.open_database() as database:
        numbers = {image.name: image.image_id for image in database.read_all_images()}
    for view in photographs.views:
        name, camera = view.view.name, photographs.number_of(view)
        if name in numbers:
            image = pycolmap.Image(name=name, camera_id=camera, image_id=numbers[name])
            pose = pycolmap.Rigid3d(view.view.camera_from_world[:3])
            model.add_image_with_trivial_frame(image, pose)
    return model


# --------------------------------------------------------------------------------------------------- capture


def _write(
    photographs: PosedPhotographs,
    work: Workspace,
    model: pycolmap.Reconstruction,
    request: SfmRequest,
    threads: int,
    console: Console,
) -> None:
    output, bent = request.output, Workspace(work.path / BENT)
    members: dict[Intrinsics, list[str]] = {}
    for view in photographs.views:
        members.setdefault(view.file.intrinsics, []).append(view.view.name)
    size, bent_lenses = request.options.max_output_size, dict(enumerate(members, 1))
    names = {number: members[lens] for number, lens in bent_lenses.items()}
    with report_progress(work, console, "writing", len(photographs.views), "without distortion, ") as tell:
        capture_writer.write_images(output, bent, names, bent_lenses, size, threads, tell)
    lenses = {number: capture_writer.straight_camera(lens, size) for number, lens in bent_lenses.items()}
    lens_of = {name: number for number, group in names.items() for name in group}
    color_points(model, output, lenses, lens_of)
    georef = photographs.source.georef
    if georef is not None:
        place = {} if georef.origin is None else dict(zip(ORIGIN_KEYS, georef.origin, strict=True))
        frame = LOCAL_FRAME if georef.origin is None else ENU_FRAME
        write_json(
            output / "georef.json", {"frame": frame, **place, "method": georef.method, "accuracy": georef.accuracy}
        )
    kept_out = {view.view.name for view in photographs.views if view.view.split == "test"}
    lists = {TEST_LIST: kept_out - photographs.validation, VALIDATION_LIST: kept_out & photographs.validation}
    for file, names_of_list in lists.items():
        if names_of_list:
            write_text(output / file, "".join(f"{capture_writer.jpeg_name(name)}\n" for name in sorted(names_of_list)))
    shutil.rmtree(output / "sparse", ignore_errors=True)
    capture_writer.write_model(output, model, lenses, lens_of)


def color_points(
    model: pycolmap.Reconstruction, output: Path, lenses: Mapping[int, Intrinsics], lens_of: Mapping[str, int]
) -> None:
    """Each point gets the mean color of where written photographs (the smallest of them) show it."""
    folder, factor = capture_writer.IMAGE_SIZES[-1]
    numbers = np.array(sorted(number for number, point in model.points3D.items() if point.track.length()), np.uint64)
    sums = np.zeros((len(numbers), 4))
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        rays = np.asarray(model.cameras[image.camera_id].cam_from_img(np.array([point.xy for point in seen])))
        fx, fy, cx, cy = lenses[lens_of[image.name]].params
        pixels, _ = decode_image(output / folder / jpeg_name(image.name))
        at = (rays.reshape(-1, 2) * [fx, fy] + [cx, cy]) / factor
        x, y = at.astype(int).clip(0, np.array(pixels.shape[1::-1]) - 1).T
        index = np.searchsorted(numbers, np.array([point.point3D_id for point in seen], dtype=np.uint64))
        np.add.at(sums, index, np.column_stack([pixels[y, x], np.ones(len(x))]))
    means = np.round(sums[:, :3] / np.maximum(sums[:, 3:], 1)).astype(np.uint8)
    for number, mean in zip(numbers.tolist(), means, strict=True):
        model.points3D[number].color = mean
