"""Photographs matched: pairs chosen by what is known of them, features compared, pairs verified, in the database."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap
from rich.console import Console

from vdgs.config.sfm_options import SfmOptions
from vdgs.sfm import pair_selection
from vdgs.sfm.gps_priors import Positions
from vdgs.sfm.image_metadata import Photograph
from vdgs.sfm.workspace import Work, call, progress
from vdgs.system.atomic_files import write_text

#: Pairs that one call compares, for each thread.
AT_ONCE = 12
#: Descriptors of a photograph that are read to tell how it looks.
_READ = 2000


def expected_pairs(photographs: Sequence[Photograph], positions: Positions, options: SfmOptions) -> int:
    """About how many pairs will be matched."""
    count = len(photographs)
    if not positions.usable:
        everyone = count * (count - 1) // 2
        return (
            everyone
            if count <= options.exhaustive
            else count * (pair_selection.NEXT + pair_selection.DOUBLINGS + pair_selection.ALIKE // 2)
        )
    if count <= pair_selection.NEXT:
        return count * (count - 1) // 2
    return len(_by_positions(photographs, positions, options)) + (count - len(positions)) * pair_selection.ALIKE


def choose_pairs(
    work: Work, photographs: Sequence[Photograph], positions: Positions, options: SfmOptions
) -> list[tuple[str, str]]:
    """Names of the pairs to match, sorted."""
    count = len(photographs)
    order = _in_time(photographs)
    if count <= pair_selection.NEXT or (not positions.usable and count <= options.exhaustive):
        chosen = pair_selection.everyone(count)
    elif not positions.usable:
        chosen = pair_selection.in_order(order, pair_selection.NEXT, pair_selection.DOUBLINGS)
        chosen |= pair_selection.alike(_descriptors(work, photographs), range(count))
    else:
        chosen = _by_positions(photographs, positions, options)
        lost = np.flatnonzero(~np.isfinite(positions.rows(count)).all(axis=1))
        if len(lost):
            chosen |= pair_selection.alike(_descriptors(work, photographs), lost.tolist())
            place = {i: k for k, i in enumerate(order)}
            chosen |= {
                (min(i, j), max(i, j))
                for i in lost.tolist()
                for j in order[max(0, place[i] - pair_selection.NEXT) : place[i] + pair_selection.NEXT + 1]
                if i != j
            }
    names = [photo.name for photo in photographs]
    return [(names[i], names[j]) for i, j in sorted(chosen)]


def _by_positions(photographs: Sequence[Photograph], positions: Positions, options: SfmOptions) -> set[tuple[int, int]]:
    """Pairs of those near each other, and of those next to each other in time, where a position is wrong."""
    unknown = np.full(3, np.nan)
    views = np.array([photo.attitude.camera_from_enu[2] if photo.attitude else unknown for photo in photographs])
    near = pair_selection.near(positions.rows(len(photographs)), options.neighbours, views)
    return near | pair_selection.in_order(_in_time(photographs), pair_selection.NEXT_WITH_POSITIONS)


def _in_time(photographs: Sequence[Photograph]) -> list[int]:
    return sorted(range(len(photographs)), key=lambda i: (photographs[i].taken, photographs[i].name))


def match(work: Work, chosen: Sequence[tuple[str, str]], threads: int, console: Console) -> None:
    """Match and verify pairs; those that are in the database already are kept."""
    done = _matched(work)
    missing = [pair for pair in chosen if frozenset(pair) not in done]
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.num_threads, options.use_gpu = threads, False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pairing.match_list_path = work.path / "pairs.txt"
    before = len(chosen) - len(missing)
    with progress(console, "matching, pairs", len(chosen)) as tell:
        for start in range(0, len(missing), AT_ONCE * threads):
            chunk = missing[start : start + AT_ONCE * threads]
            write_text(work.path / "pairs.txt", "".join(f"{one} {other}\n" for one, other in chunk))
            call(
                pycolmap.match_image_pairs, work.database, matching_options=options, pairing_options=pairing,
                verification_options=verification, device=pycolmap.Device.cpu,
            )  # fmt: skip
            tell(before + start + len(chunk))


def verified_counts(work: Work, least: int = 15) -> dict[str, int]:
    """With how many others each photograph was matched for good, by its name."""
    database = pycolmap.Database.open(work.database)
    try:
        counts = {image.image_id: 0 for image in database.read_all_images()}
        names = {image.image_id: image.name for image in database.read_all_images()}
        for number, inliers in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            if inliers >= least:
                for image in pycolmap.pair_id_to_image_pair(number):
                    counts[image] += 1
        return {names[image]: count for image, count in counts.items()}
    finally:
        database.close()


def _matched(work: Work) -> set[frozenset[str]]:
    """Pairs that were compared and verified."""
    database = pycolmap.Database.open(work.database)
    try:
        names = {image.image_id: image.name for image in database.read_all_images()}
        numbers, _ = database.read_two_view_geometry_num_inliers()
        return {frozenset(names[image] for image in pycolmap.pair_id_to_image_pair(number)) for number in numbers}
    finally:
        database.close()


def forget_matches(work: Work) -> None:
    database = pycolmap.Database.open(work.database)
    try:
        database.clear_matches()
        database.clear_two_view_geometries()
    finally:
        database.close()


def _descriptors(work: Work, photographs: Sequence[Photograph]) -> list[np.ndarray]:
    """Some descriptors [m, 128] of each photograph, the same in every run."""
    database = pycolmap.Database.open(work.database)
    try:
        numbers = {image.name: image.image_id for image in database.read_all_images()}
        found = []
        for photo in photographs:
            number = numbers.get(photo.name)
            if number is None or not database.exists_descriptors(number):
                found.append(np.zeros((0, 128), np.uint8))
                continue
            rows = np.asarray(database.read_descriptors(number).data)
            found.append(rows[:: max(1, len(rows) // _READ)].copy())
        return found
    finally:
        database.close()
