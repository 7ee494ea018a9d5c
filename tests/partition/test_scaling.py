"""What is made to grow no faster than its input gives what the plain way gives."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import shapely
import torch
from scipy import ndimage

from vdgs.config.method import AssignmentConfig, MergeConfig
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.scale_bounds import MAX_IMAGE_FRACTION, MAX_SIGMA, max_log_scales
from vdgs.partition import boundary
from vdgs.partition.assignment import score_matrix as scoring
from vdgs.partition.blocks import Block, Blocks
from vdgs.partition.merging import merge_blocks
from vdgs.partition.polygon_lookup import BlockCores
from vdgs.synth import synthetic_points, true_visibility
from vdgs.visibility.frustum import Frusta, project_points
from vdgs.visibility.spatial_groups import GROUP_SIZE, SpatialGroups


def flight(count: int, extent: float, seed: int = 0) -> list[Camera]:
    """Photographs over a square from 30 units, turned and tilted in any direction."""
    generator = np.random.default_rng(seed)
    cameras = []
    for _ in range(count):
        heading, tilt = generator.uniform(0, 2 * np.pi), np.radians(generator.uniform(0, 70))
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        c, s = np.cos(tilt), np.sin(tilt)
        pose = np.eye(4)
        pose[:3, :3] = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ np.diag([1.0, -1.0, -1.0]) @ turn
        pose[:3, 3] = -pose[:3, :3] @ [*generator.uniform(0, extent, 2), 30.0]
        cameras.append(Camera(camera_from_world=pose, fx=90.0, fy=80.0, cx=60.0, cy=41.0, width=120, height=80))
    return cameras


def site(count: int, extent: float, seed: int = 1) -> torch.Tensor:
    """Places all over a square, some of them close together."""
    generator = np.random.default_rng(seed)
    places = generator.uniform([0, 0, 0], [extent, extent, 8], (count, 3))
    places[: count // 2, :2] = generator.normal(extent / 3, extent / 30, (count // 2, 2))
    return torch.from_numpy(places).float()


# ------------------------------------------------------------------------------ places about a camera


@pytest.mark.parametrize("count", [1, GROUP_SIZE - 1, GROUP_SIZE, 20 * GROUP_SIZE + 3])
def test_groups_lose_no_place_that_a_camera_holds(count: int) -> None:
    places = site(count, 400.0)
    groups = SpatialGroups.of(places)
    asked = 0
    for camera in flight(40, 400.0):
        rows = groups.query_frustum(camera)
        asked += len(rows)
        assert torch.equal(rows, rows.unique())
        inside = project_points(places, camera).inside.nonzero().squeeze(1)
        assert np.isin(inside.numpy(), rows.numpy()).all()
    if count > 10 * GROUP_SIZE:
        assert asked < 0.5 * 40 * count, "a camera looks at the groups about its frustum only"


@pytest.mark.parametrize("count", [1, GROUP_SIZE, 12 * GROUP_SIZE + 3])
def test_many_cameras_asked_at_once_answer_as_each_alone(count: int) -> None:
    places, cameras = site(count, 400.0), flight(40, 400.0)
    cameras[7] = Camera(
        camera_from_world=cameras[7].camera_from_world, fx=45.0, fy=50.0, cx=61.0, cy=30.0, width=120, height=80
    )
    frusta = Frusta.of(cameras)
    together = frusta.project(places)
    alone = [project_points(places, camera) for camera in cameras]
    inside = torch.stack([each.inside for each in alone])
    assert torch.equal(together.inside, inside)
    for name in ("column", "row", "depth", "distance"):
        one_by_one = torch.stack([getattr(each, name) for each in alone])
        torch.testing.assert_close(getattr(together, name)[inside], one_by_one[inside], rtol=1e-5, atol=1e-3)
    seen = torch.zeros(len(cameras), count, dtype=torch.bool)
    for rows, watching in SpatialGroups.of(places).visible_groups(frusta):
        seen[watching[:, None], rows] |= frusta.select(watching).project(places[rows]).inside
    assert torch.equal(seen, inside), "no place is lost, and each is in one group"


def test_a_camera_inside_a_group_and_coincident_places_are_held() -> None:
    places = torch.zeros(3 * GROUP_SIZE, 3)
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, 0.5]
    camera = Camera(camera_from_world=pose, fx=90.0, fy=80.0, cx=60.0, cy=41.0, width=120, height=80)
    assert len(SpatialGroups.of(places).query_frustum(camera)) == len(places)
    spread = site(GROUP_SIZE, 1.0)
    assert len(SpatialGroups.of(spread).query_frustum(camera)) == GROUP_SIZE


def test_bounds_of_sizes_are_those_of_all_cameras_asked_about_all_places() -> None:
    places, cameras = site(3000, 400.0), flight(30, 400.0)
    cameras[7] = Camera(
        camera_from_world=cameras[7].camera_from_world, fx=45.0, fy=45.0, cx=60.0, cy=41.0, width=120, height=80
    )
    held = torch.full_like(places[:, 0], math.inf)
    near = held.clone()
    for camera in cameras:
        seen = project_points(places, camera)
        span = max(camera.width, camera.height) / max(camera.fx, camera.fy)
        held = torch.where(seen.inside, torch.minimum(held, span * seen.depth), held)
        near = torch.minimum(near, span * seen.distance)
    expected = (torch.where(held.isfinite(), held, near) * (MAX_IMAGE_FRACTION / (2.0 * MAX_SIGMA))).log()
    assert held.isinf().any()
    assert held.isfinite().any()
    torch.testing.assert_close(max_log_scales(places, cameras), expected, rtol=1e-6, atol=1e-6)


# ---------------------------------------------------------------------------------------- many blocks


def mosaic(across: int, seed: int = 3) -> list[shapely.Polygon]:
    """Boxes of uneven sizes beside each other, with gaps between them."""
    generator = np.random.default_rng(seed)
    shapes = []
    for x in range(across):
        for y in range(across):
            low = generator.uniform(0, 0.3, 2) + np.array([x, y])
            shapes.append(shapely.box(*low, *(low + generator.uniform(0.3, 0.9, 2) * (1 - (low - [x, y])))))
    return shapes


@pytest.mark.parametrize("count", [0, 1, 30, 1500])
def test_of_many_cores_the_nearest_is_found_among_all_and_among_some(count: int) -> None:
    shapes = mosaic(14)
    generator = np.random.default_rng(5)
    places = np.concatenate([generator.uniform(-2, 16, (count, 2)), generator.normal(0, 1e5, (count // 20, 2))])
    distance = np.stack([shapely.distance(shape, shapely.points(places)) for shape in shapes], axis=1)
    cores = BlockCores(shapes)
    assert np.array_equal(cores.nearest(places), distance.argmin(axis=1))
    among = np.sort(generator.permutation(len(shapes))[:60])
    assert np.array_equal(cores.nearest(places, among), among[distance[:, among].argmin(axis=1)])
    assert set(cores.nearest(places, among[:1]).tolist()) <= {int(among[0])}


def test_reaching_with_known_owners_is_reaching() -> None:
    shapes = mosaic(5)
    blocks = Blocks(tuple(Block(shape, shape.buffer(0.5)) for shape in shapes))
    places = np.random.default_rng(6).uniform(-1, 6, (3000, 2))
    owner = blocks.owner(places)
    for index in range(len(blocks)):
        plain = shapely.contains_xy(blocks.items[index].expanded, places[:, 0], places[:, 1]) | (owner == index)
        assert np.array_equal(blocks.in_expanded(index, places), plain)
        assert np.array_equal(blocks.in_expanded(index, places, owner), plain)


def test_the_strongest_cluster_of_a_cell_is_found_in_windows_as_over_all_cells() -> None:
    generator = np.random.default_rng(7)
    shape, count = (60, 45), 40
    middles = generator.uniform(3, [57, 42], (count, 2))
    labels = generator.integers(0, count - 1, 6000)  # the last cluster has no anchors
    cells = (middles[labels] + generator.normal(0, 3, (6000, 2))).astype(int).clip(2, [57, 42])
    flat = cells[:, 0] * shape[1] + cells[:, 1]
    most, expected = np.zeros(shape), np.full(shape, -1)
    for label in range(count):
        anchors = np.bincount(flat[labels == label], minlength=shape[0] * shape[1]).reshape(shape)
        nearby = ndimage.gaussian_filter(anchors.astype(np.float64), 0.5)
        expected[nearby > most] = label
        most = np.maximum(most, nearby)
    expected.ravel()[np.bincount(flat, minlength=expected.size) == 0] = -1
    assert np.array_equal(boundary._dominant_cluster(labels, flat, shape, count, 0.5), expected)


@pytest.mark.parametrize("flags", [boundary.MAX_DENSE_CELLS, 0])
def test_the_first_point_of_each_cell(flags: int) -> None:
    points = np.random.default_rng(8).normal(0, 5, (5000, 2))
    seen, expected = set(), []
    for index, cell in enumerate(map(tuple, np.floor(points / 0.7).astype(int).tolist())):
        if cell not in seen:
            seen.add(cell)
            expected.append(index)
    assert boundary._first_of_cells(points, 0.7, flags).tolist() == expected


@pytest.mark.parametrize("mode", ["coverage", "paper", "leave-one-out"])
def test_a_block_that_a_view_does_not_reach_scores_as_if_it_were_drawn(mode: str) -> None:
    model, blocks = small_model(600), stripes(12, 12.0)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -pose[:3, :3] @ [2.0, 2.0, 4.0]
    camera = Camera(camera_from_world=pose, fx=40.0, fy=40.0, cx=24.0, cy=18.0, width=48, height=36)
    config = AssignmentConfig(mode=mode)  # type: ignore[arg-type]
    found = scoring.compute_score_matrix(model, blocks, [camera], config)
    members = scoring._BlockMembers.of(model, blocks)
    rows, splats = scoring.decode_view(model, camera)
    full = scoring.rasterize_splats(splats, camera, splats.means_px.new_zeros(3))
    anchor = rows[splats.source.long() // model.anchors.offsets.shape[1]]
    drawn = members.reached[:, anchor].any(dim=1)
    assert drawn.any()
    assert not drawn.all()
    for index in (~drawn).nonzero().squeeze(1).tolist():
        alone = scoring._render_subset(splats, members.reached[index, anchor], full, camera)
        expected = {
            "coverage": lambda alone=alone: scoring.drawn_coverage_ratio(alone, full, config.tau),
            "paper": lambda alone=alone: scoring.coverage_ratio(alone, full, config.tau),
            "leave-one-out": lambda: 0.0,
        }[mode]()
        assert found.scores[0, index] == np.float32(expected)
        assert found.coverage[0, index] == np.float32(scoring.drawn_coverage_ratio(alone, full, config.tau))


def small_model(count: int, extent: float = 12.0) -> AnchorModel:
    g = torch.Generator().manual_seed(0)
    positions = site(count, extent)
    positions[:, 2] *= 0.05
    anchors = Anchors(
        positions, 0.5 * torch.randn(count, 32, generator=g), 0.3 * torch.randn(count, 4, 3, generator=g),
        torch.full((count, 6), -1.0),
    )  # fmt: skip
    return AnchorModel(
        anchors=anchors, decoder=Decoder.init_random(4, False, 0, 1, g), voxel_size=0.1, background=(0.5, 0.5, 0.5)
    )


def stripes(count: int, extent: float) -> Blocks:
    cores = [shapely.box(a, -50, b, 50) for a, b in pairwise(np.linspace(0, extent, count + 1))]
    return Blocks(tuple(Block(core, core.buffer(0.2)) for core in cores))


def test_blocks_that_are_opened_one_by_one_merge_to_the_same_bits() -> None:
    model, blocks = small_model(500), stripes(3, 12.0)
    owner = torch.from_numpy(blocks.owner(model.anchors.positions[:, :2].double().numpy()))
    trained = [
        AnchorModel(
            anchors=model.anchors.select(owner == index),
            decoder=model.decoder,
            voxel_size=0.1,
            background=model.background,
        )
        for index in range(3)
    ]
    open_now: list[int] = []

    def opener(index: int) -> Callable[[], AnchorModel]:
        def load() -> AnchorModel:
            open_now.append(index)
            return trained[index]

        return load

    cameras = [flight(2, 12.0, seed) for seed in range(3)]
    expected, facts = merge_blocks(model, trained, blocks, cameras, MergeConfig())
    merged, same_facts = merge_blocks(model, [opener(index) for index in range(3)], blocks, cameras, MergeConfig())
    assert open_now == [0, 1, 2], "each is opened once, after the one before"
    assert facts == same_facts
    for name, tensor in expected.anchors.tensors().items():
        assert torch.equal(tensor, merged.anchors.tensors()[name])
    with_gap, _ = merge_blocks(model, [opener(0), None, opener(2)], blocks, cameras, MergeConfig(), allow_missing=True)
    assert len(with_gap.anchors) == len(merged.anchors)


# --------------------------------------------------------------------------------- generated captures


def test_matches_are_drawn_alike_in_any_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras, places = flight(9, 60.0), site(300, 60.0).double().numpy()
    visible = np.stack([camera.in_frustum(places) for camera in cameras], axis=1)
    home = np.random.default_rng(1).integers(0, 9, len(places))
    whole = synthetic_points._recognized_views(cameras, places, home, visible, np.random.default_rng(2))
    monkeypatch.setattr(synthetic_points, "_PAIRS_PER_CHUNK", 70)
    pieces = synthetic_points._recognized_views(cameras, places, home, visible, np.random.default_rng(2))
    assert whole.any()
    assert np.array_equal(whole, pieces)


def test_observations_by_image_are_all_of_them_in_order() -> None:
    image = np.random.default_rng(3).integers(0, 7, 200)
    found = synthetic_points.observations_by_image(image, 9)
    assert [part.tolist() for part in found] == [np.flatnonzero(image == k).tolist() for k in range(9)]


def test_cameras_about_places_are_all_that_see_any() -> None:
    cameras = flight(60, 500.0)
    for seed in range(20):
        middle = np.random.default_rng(seed).uniform(0, 500, 2)
        places = np.random.default_rng(seed).normal([*middle, 3.0], [15, 15, 2], (50, 3))
        about = true_visibility._about(cameras, places)
        assert {id(c) for c in cameras if c.in_frustum(places).any()} <= {id(c) for c in about}
        assert len(about) < len(cameras)
    assert true_visibility._about(cameras, np.zeros((0, 3))) == []
