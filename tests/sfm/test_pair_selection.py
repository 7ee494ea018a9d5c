"""Which photographs are matched with which: near ones, the next in order, and those that look alike."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap
from hypothesis import given
from hypothesis import strategies as st

from support.flights import write_photograph
from vdgs.config.sfm_options import SfmOptions
from vdgs.sfm import pair_selection
from vdgs.sfm.feature_extraction import create_database, group_by_camera
from vdgs.sfm.feature_matching import select_pairs
from vdgs.sfm.flights import flights_of, time_order
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_metadata import ImageMetadata, read_image_metadata
from vdgs.sfm.workspace import Workspace


def photograph(folder: Path) -> ImageMetadata:
    """One without a position and a date."""
    folder.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    write_photograph(folder / "p.jpg", pixels, 0, None)
    return replace(read_image_metadata(folder / "p.jpg", "p.jpg"), datetime="")


@given(st.integers(2, 40), st.integers(1, 8), st.integers(0, 4))
def test_pairs_are_sorted_and_none_is_of_one_photograph(count, following, doublings):
    order = list(np.random.default_rng(count).permutation(count))
    chosen = pair_selection.sequential_pairs(order, following, doublings) | pair_selection.spatial_pairs(
        np.random.default_rng(0).random((count, 3)), 4
    )
    assert all(0 <= i < j < count for i, j in chosen)
    assert {tuple(sorted(pair)) for pair in pairwise(order)} <= chosen


def test_near_ones_are_matched_and_those_without_a_place_are_not():
    places = np.array([[0, 0, 9], [1, 0, 5], [2, 0, 9], [90, 0, 9], [np.nan, 0, 0]])
    assert pair_selection.spatial_pairs(places, 1) == {(0, 1), (1, 2), (2, 3)}


def test_photographs_follow_each_other_by_the_clock_and_without_one_as_they_are_counted(tmp_path):
    """Frames of a film are often counted without zeros in front: frame10 follows frame9, in each folder on its own."""
    one = photograph(tmp_path)
    names = [f"{folder}/frame{k}.jpg" for folder in ("part2", "part10") for k in range(1, 31)]
    frames = [replace(one, name=name) for name in sorted(names)]
    assert [frames[k].name for k in time_order(frames)] == names
    chosen = pair_selection.sequential_pairs(time_order(frames), 1)
    assert {frozenset(frames[k].name for k in pair) for pair in chosen} == {frozenset(pair) for pair in pairwise(names)}
    second = replace(one, datetime="2026:06:23 16:31:59")
    burst = [replace(second, name=f"{k}.jpg", subsecond=at) for k, at in ((1, 0.75), (2, 0.25), (3, 0.5))]
    assert [burst[k].name for k in time_order(burst)] == ["2.jpg", "3.jpg", "1.jpg"]
    climbing = [replace(one, name=f"f{k}.jpg") for k in range(30)]
    heights = 9.0 * np.arange(30)
    listed = sorted(range(30), key=lambda k: climbing[k].name)
    assert not flights_of([climbing[k] for k in listed], altitudes=heights[listed]).any()  # no step


def test_photographs_that_look_alike_find_each_other():
    rng = np.random.default_rng(0)
    kinds = rng.integers(0, 255, (2, 30, 128))
    looks = [(kinds[k % 2] + rng.normal(0, 3, (30, 128))).clip(0, 255).astype(np.uint8) for k in range(30)]
    chosen = pair_selection.retrieval_pairs(looks.__getitem__, len(looks), [0, 1])
    assert sum((i + j) % 2 == 0 for i, j in chosen) > 0.95 * len(chosen)


def test_without_positions_those_that_look_alike_are_matched_too(tmp_path):
    """By the descriptors in the database; a panorama by those of all its views, each with each."""
    rng = np.random.default_rng(0)
    kinds, one = rng.integers(0, 255, (2, 300, 128)), photograph(tmp_path / "card")
    photographs = [replace(one, name=f"{k:03d}.jpg") for k in range(120)]
    photographs += [replace(one, name=f"pano_{face}/120.jpg", face=face) for face in ("front", "right")]
    work = Workspace(tmp_path / "work")
    create_database(work, group_by_camera([one]))
    with work.open_database() as database:
        for k, photo in enumerate(photographs):
            number = database.write_image(pycolmap.Image(name=photo.name, camera_id=1))
            if k != 7:  # of this one nothing is known
                looks = (kinds[k // 60 % 2] + rng.normal(0, 9, (300, 128))).clip(0, 255).astype(np.uint8)
                kind = pycolmap.FeatureExtractorType.SIFT
                database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, looks))
    nowhere = read_gps_priors([one], None, (1.0, 2.0))
    chosen = select_pairs(work, photographs, nowhere, SfmOptions(exhaustive_max=20))
    assert chosen == select_pairs(work, photographs, nowhere, SfmOptions(exhaustive_max=20))
    places = {photo.name: k for k, photo in enumerate(photographs)}
    steps = {1, 2, 3, 4, 5, 6, 12, 24, 48, 96}
    alike = [(places[a], places[b]) for a, b in chosen if places[b] - places[a] not in steps and places[b] < 120]
    assert len(alike) > 300
    assert np.mean([(i < 60) == (j < 60) for i, j in alike]) > 0.95
    assert not any(7 in pair for pair in alike)
    views = [{a for a, b in chosen if b == photo.name and places[a] < 120} for photo in photographs[-2:]]
    assert views[0] == views[1]
    assert sum(places[name] < 60 for name in views[0]) > 10


def test_how_a_photograph_looks_does_not_depend_on_how_many_there_are(monkeypatch):
    """Of each all descriptors count, however few the vocabulary is made of: a strip of which neighbors show a part."""
    rng = np.random.default_rng(0)
    ground = 512 * rng.dirichlet(np.full(128, 0.3), 2100)
    strip = [
        (ground[50 * k + rng.choice(400, 200, replace=False)] + rng.normal(0, 5, (200, 128))).clip(0, 255)
        for k in range(35)
    ]
    strip[3] = np.zeros((0, 128))  # of one nothing is known
    looks = [each.astype(np.uint8) for each in strip]

    def overlapping() -> float:
        chosen = pair_selection.retrieval_pairs(looks.__getitem__, len(looks), range(len(looks)))
        assert chosen == pair_selection.retrieval_pairs(looks.__getitem__, len(looks), range(len(looks)))
        assert not any(3 in pair for pair in chosen)
        return float(np.mean([j - i < 8 for i, j in chosen]))

    monkeypatch.setattr(pair_selection, "NUM_RETRIEVED", 5)
    of_all = overlapping()
    monkeypatch.setattr(pair_selection, "VOCABULARY_SAMPLE", 8 * len(looks))  # as of 5000 photographs
    of_few = overlapping()
    assert of_few > of_all - 0.1
    assert of_all > 0.9
    assert pair_selection.retrieval_pairs(lambda _: looks[3], 5, range(5)) == set()


def test_cameras_of_one_place_that_look_four_ways_do_not_share_it():
    """Of a walk with four cameras: each is matched with the next that look its way, not with three times as many."""
    ways = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    places, directions = np.repeat(np.arange(30), 4), np.tile(ways, (30, 1))
    positions = np.stack([places, 0 * places, 0 * places], axis=1).astype(float)
    chosen = pair_selection.spatial_pairs(positions, 4, directions)
    apart = [places[j] - places[i] for i, j in chosen if (j - i) % 4 == 0]
    assert {1, 2} <= set(apart)
    assert max(apart) <= 4


def test_what_a_photograph_shows_many_times_counts_little_more_than_once(monkeypatch):
    """A roof of 40 equal tiles among 40 other things: who shows those is more alike than who shows such a roof."""
    rng = np.random.default_rng(0)
    words = rng.uniform(60, 195, (41, 128)).astype(np.float32)
    things, others = (words + rng.uniform(-9, 9, (2, 41, 128))).round().astype(np.uint8)
    roof, garden, street = np.repeat(things[:1], 40, axis=0), things[1:].repeat(2, axis=0), others[1:].repeat(2, axis=0)
    looks = [np.concatenate([roof, garden]), garden, np.concatenate([roof, street])]
    monkeypatch.setattr(pair_selection, "NUM_RETRIEVED", 1)
    monkeypatch.setattr(pair_selection, "_vocabulary", lambda *_: words)
    assert pair_selection.retrieval_pairs(looks.__getitem__, 3, [0]) == {(0, 1)}
