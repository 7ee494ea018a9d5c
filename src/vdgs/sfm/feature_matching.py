"""Photographs matched: pairs chosen by what is known of them, features compared, pairs verified, in the database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console

from vdgs.config.sfm_options import SfmOptions
from vdgs.sfm import pair_selection
from vdgs.sfm.flights import time_order
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.workspace import Workspace, call_cancellable, report_progress
from vdgs.system.atomic_files import write_text
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.stop_signals import check_stop_requested

#: Pairs that one call compares, for each thread.
PAIRS_PER_THREAD = 12
#: Descriptors of a photograph that are read to tell how it looks.
_MAX_DESCRIPTORS = 2000


def estimate_pair_count(photographs: Sequence[ImageMetadata], positions: GpsPriors, options: SfmOptions) -> int:
    """About how many pairs will be matched."""
    references, at_references, _ = _references(photographs, positions)
    if len(references) < len(photographs):
        each = (len(photographs) / len(references)) ** 2
        return round(each * estimate_pair_count(references, at_references, options))
    count = len(photographs)
    if not positions.usable:
        everyone = count * (count - 1) // 2
        return (
            everyone
            if count <= options.exhaustive_max
            else count
            * (pair_selection.SEQUENTIAL_OVERLAP + pair_selection.QUADRATIC_OVERLAP + pair_selection.NUM_RETRIEVED // 2)
        )
    if count <= pair_selection.SEQUENTIAL_OVERLAP:
        return count * (count - 1) // 2
    return (
        len(spatial_candidates(photographs, positions, options))
        + (count - len(positions)) * pair_selection.NUM_RETRIEVED
    )


def select_pairs(
    workspace: Workspace, photographs: Sequence[ImageMetadata], positions: GpsPriors, options: SfmOptions
) -> list[tuple[str, str]]:
    """Names of the pairs to match, sorted. Views of panoramas are matched with all views of the panoramas that theirs
    is matched with."""
    everyone = photographs
    photographs, positions, members = _references(photographs, positions)
    count = len(photographs)
    order = time_order(photographs)
    if count <= pair_selection.SEQUENTIAL_OVERLAP or (not positions.usable and count <= options.exhaustive_max):
        chosen = pair_selection.exhaustive_pairs(count)
    elif not positions.usable:
        chosen = pair_selection.sequential_pairs(
            order, pair_selection.SEQUENTIAL_OVERLAP, pair_selection.QUADRATIC_OVERLAP
        )
        chosen |= _alike(workspace, everyone, members, range(count))
    else:
        chosen = spatial_candidates(photographs, positions, options)
        lost = np.flatnonzero(~np.isfinite(positions.all_positions(count)).all(axis=1))
        if len(lost):
            chosen |= _alike(workspace, everyone, members, lost.tolist())
            place = {i: k for k, i in enumerate(order)}
            chosen |= {
                (min(i, j), max(i, j))
                for i in lost.tolist()
                for j in order[
                    max(0, place[i] - pair_selection.SEQUENTIAL_OVERLAP) : place[i]
                    + pair_selection.SEQUENTIAL_OVERLAP
                    + 1
                ]
                if i != j
            }
    names = [photo.name for photo in everyone]
    numbers = {(min(a, b), max(a, b)) for i, j in chosen for a in members[i] for b in members[j]}
    return [(names[i], names[j]) for i, j in sorted(numbers)]


def _references(
    photographs: Sequence[ImageMetadata], positions: GpsPriors
) -> tuple[Sequence[ImageMetadata], GpsPriors, list[list[int]]]:
    """One view of each panorama in place of all and every photograph, positions by these, and of each the numbers of
    those that it stands for."""
    if not any(photo.face for photo in photographs):
        return photographs, positions, [[k] for k in range(len(photographs))]
    groups: dict[str, list[int]] = {}
    for k, photo in enumerate(photographs):
        groups.setdefault(photo.frame if photo.face else photo.name, []).append(k)
    members = list(groups.values())
    group_of = {k: number for number, group in enumerate(members) for k in group}
    indices = np.array([group_of[index] for index in positions.image_indices.tolist()], int)
    return [photographs[group[0]] for group in members], replace(positions, image_indices=indices), members


def spatial_candidates(
    photographs: Sequence[ImageMetadata], positions: GpsPriors, options: SfmOptions
) -> set[tuple[int, int]]:
    """Pairs of those near each other, and of those next to each other in time, where a position is wrong."""
    unknown = np.full(3, np.nan)
    views = np.array([photo.attitude.camera_from_enu[2] if photo.attitude else unknown for photo in photographs])
    near = pair_selection.spatial_pairs(positions.all_positions(len(photographs)), options.num_neighbors, views)
    return near | pair_selection.sequential_pairs(time_order(photographs), pair_selection.SEQUENTIAL_OVERLAP_WITH_GPS)


def match_pairs(
    workspace: Workspace, pairs_to_match: Sequence[tuple[str, str]], threads: int, console: Console
) -> None:
    """Match and verify pairs; those that are in the database already are kept."""
    done = _matched(workspace)
    missing = [pair for pair in pairs_to_match if frozenset(pair) not in done]
    before = len(pairs_to_match) - len(missing)
    with report_progress(workspace, console, "matching", len(pairs_to_match)) as tell:
        tell(before)
        for start in range(0, len(missing), PAIRS_PER_THREAD * threads):
            chunk = missing[start : start + PAIRS_PER_THREAD * threads]
            match_chunk(workspace, chunk, threads)
            tell(before + start + len(chunk))


def match_chunk(workspace: Workspace, pairs: Sequence[tuple[str, str]], threads: int) -> None:
    """Match and verify some pairs in one call."""
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.num_threads, options.use_gpu = threads, False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pairing.match_list_path = workspace.path / "pairs.txt"
    write_text(workspace.path / "pairs.txt", "".join(f"{one} {other}\n" for one, other in pairs))
    call_cancellable(
        pycolmap.match_image_pairs, workspace.database, matching_options=options, pairing_options=pairing,
        verification_options=verification, device=pycolmap.Device.cpu,
    )  # fmt: skip


def copy_features(workspace: Workspace, name: str, copy: str) -> None:
    """Copy the features of a photograph in the database to a new name, for which no file is needed."""
    with workspace.open_database() as database:
        image = next(each for each in database.read_all_images() if each.name == name)
        number = database.write_image(pycolmap.Image(name=copy, camera_id=image.camera_id))
        database.write_keypoints(number, database.read_keypoints(image.image_id))
        database.write_descriptors(number, database.read_descriptors(image.image_id))


def count_pairs(workspace: Workspace) -> int:
    """The pairs that were compared, whether or not they match."""
    with workspace.open_database() as database:
        return int(database.num_verified_image_pairs())


def count_inliers(workspace: Workspace) -> list[int]:
    """The matches of each pair that were verified."""
    with workspace.open_database() as database:
        return [int(count) for count in database.read_two_view_geometry_num_inliers()[1]]


def count_matched_features(workspace: Workspace) -> int:
    """The features of all photographs that were matched and verified with some other."""
    with workspace.open_database() as database:
        counts = {
            image.image_id: database.num_keypoints_for_image(image.image_id) for image in database.read_all_images()
        }
        matched = {image: np.zeros(count, bool) for image, count in counts.items()}
        for number in database.read_two_view_geometry_num_inliers()[0]:
            pair = pycolmap.pair_id_to_image_pair(number)
            inliers = np.asarray(database.read_two_view_geometry(*pair).inlier_matches).reshape(-1, 2)
            for image, numbers in zip(pair, inliers.T, strict=True):
                matched[image][numbers] = True
    return int(sum(each.sum() for each in matched.values()))


def count_verified_matches(workspace: Workspace, min_inliers: int = 15) -> dict[str, int]:
    """With how many others each photograph was matched for good, by its name."""
    with workspace.open_database() as database:
        counts = {image.image_id: 0 for image in database.read_all_images()}
        names = {image.image_id: image.name for image in database.read_all_images()}
        for number, inliers in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            if inliers >= min_inliers:
                for image in pycolmap.pair_id_to_image_pair(number):
                    counts[image] += 1
        return {names[image]: count for image, count in counts.items()}


def _matched(workspace: Workspace) -> set[frozenset[str]]:
    """Pairs that were compared and verified."""
    with workspace.open_database() as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        numbers, _ = database.read_two_view_geometry_num_inliers()
        return {frozenset(names[image] for image in pycolmap.pair_id_to_image_pair(number)) for number in numbers}


def delete_matches(workspace: Workspace) -> None:
    with workspace.open_database() as database:
        database.clear_matches()
        database.clear_two_view_geometries()


def _alike(
    workspace: Workspace, photographs: Sequence[ImageMetadata], members: Sequence[Sequence[int]], queries: Sequence[int]
) -> set[tuple[int, int]]:
    """Pairs of `queries` with those that look alike, a panorama by all its views."""
    with workspace.open_database() as database:
        numbers = {image.name: image.image_id for image in database.read_all_images()}

        def descriptors_of(index: int) -> np.ndarray:
            check_stop_requested()
            found = (_descriptors(database, numbers.get(photographs[k].name)) for k in members[index])
            return np.concatenate(list(found))

        return pair_selection.retrieval_pairs(descriptors_of, len(members), queries)


def _descriptors(database: pycolmap.Database, image: int | None) -> np.ndarray:
    """Some descriptors [m, 128] of a photograph, the same in every run."""
    if image is None or not database.exists_descriptors(image):
        return np.zeros((0, 128), np.uint8)
    rows = np.asarray(database.read_descriptors(image).data)
    return rows[:: max(1, len(rows) // _MAX_DESCRIPTORS)].copy()
