"""Visibility: V against brute force, shares of a cycle, and the numbers that describe imbalance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from support.captures import look_down
from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import NEAR_PLANE, Camera, CameraModel
from vdgs.model.anchors import Anchors
from vdgs.training.schedule import view_sampling_weights
from vdgs.visibility.visibility_counts import (
    NearbyCameras,
    count_visibility,
    effective_sample_size,
    fade_factors,
    normalize_visibility,
    visibility_ratio,
    visibility_sampling_weights,
    visibility_stats,
)


def flight(count: int, model: CameraModel = "pinhole", seed: int = 0) -> list[Camera]:
    """Tilted views over a square of 20 units; an orthographic camera has 4 px a unit."""
    generator = np.random.default_rng(seed)
    focal = 60.0 if model == "pinhole" else 4.0
    places = generator.uniform(0, 20, (count, 2))
    poses = [look_down(np.array([*at, 8.0]), generator.uniform(0, 80), generator.uniform(0, 360)) for at in places]
    return [
        Camera(camera_from_world=pose, fx=focal, fy=focal, cx=31.5, cy=25.0, width=64, height=48, model=model)
        for pose in poses
    ]


def cloud(n: int, seed: int = 1) -> np.ndarray:
    """Points on the ground and far above the cameras, float32 values in float64."""
    return np.random.default_rng(seed).uniform([-5, -5, -2], [25, 25, 14], (n, 3)).astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_the_cameras_near_a_part_of_a_scene_count_and_fade_it_as_all_do(model: CameraModel) -> None:
    cameras, points, fewer = flight(40, model), torch.from_numpy(cloud(4000)), 0
    nearby = NearbyCameras(cameras)
    for x, y in np.ndindex(4, 4):
        corner = torch.tensor([x, y]) * 7.5 - 5
        part = points[((points[:, :2] >= corner) & (points[:, :2] < corner + 7.5)).all(dim=1) & (points[:, 2] < 1)]
        near, counts = nearby.of(part), count_visibility(part, cameras)
        assert torch.equal(count_visibility(part, near), counts)
        for least in (1, 3):
            assert torch.equal(fade_factors(part, near, least), fade_factors(part, cameras, least))
            assert torch.equal(nearby.fade_factors(part, least), fade_factors(part, cameras, least))
        fewer += len(near) < len(cameras)
    assert fewer == (16 if model == "pinhole" else 0)
    assert nearby.of(points[:0]) == []


@pytest.mark.parametrize("least", [1, 2, 4])
def test_a_scene_fades_out_smoothly_beyond_what_enough_cameras_see(least: int) -> None:
    """Along a line outwards from a picture's edge, whose cameras all end there."""
    pose = look_down(np.array([0, 0, 8.0]), 0, 0)
    camera = Camera(camera_from_world=pose, fx=600.0, fy=600.0, cx=320, cy=240, width=640, height=480)
    cameras, edge = [camera] * 4, 32 / 60 * 8
    x = torch.linspace(0.5, 1.5, 400) * edge
    places = torch.stack([x, torch.zeros(400), torch.zeros(400)], dim=1)
    seen = count_visibility(places, cameras)
    factors = fade_factors(places, cameras, least)
    assert (factors[seen >= least] == 1).all()
    assert (factors[x > 1.31 * edge] == 0).all()  # 0.15 of the longer side, twice the half side
    assert (factors.diff() <= 0).all()
    assert factors.diff().abs().max() < 0.02  # of 400 places, 75 between the edges
    assert (fade_factors(places, cameras, 5) == 0).all()
    assert (fade_factors(places, [], 1) == 0).all()
    assert (fade_factors(places, cameras, 0) == 1).all()


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_a_place_fades_by_how_much_larger_pictures_would_have_to_be(model: CameraModel) -> None:
    cameras, points, outside = flight(40, model), cloud(2000), list[np.ndarray]()
    for camera in cameras:
        pixels, depth = camera.project(points)
        size = np.array([camera.width, camera.height])
        share = np.maximum(-pixels, pixels - size).max(1) / size.max()
        outside.append(np.where(depth > NEAR_PLANE, share, np.inf))
    held = np.clip(1 - np.sort(outside, axis=0)[2] / 0.15, 0, 1)
    assert ((held > 0.02) & (held < 0.98)).sum() > 50
    factors = fade_factors(torch.from_numpy(points).float(), cameras, 3).numpy()
    np.testing.assert_allclose(factors, held * held * (3 - 2 * held), atol=1e-4)


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_v_is_the_number_of_frusta_that_hold_an_anchor(model: CameraModel) -> None:
    cameras, points = flight(30, model), cloud(3000)
    # float32 rounding decides about places within 1e-3 px of a border: none of them here.
    borderless = np.ones(len(points), bool)
    for camera in cameras:
        pixels, depth = camera.project(points)
        for value, border in ((pixels[:, 0], 0), (pixels[:, 0], 64), (pixels[:, 1], 0), (pixels[:, 1], 48)):
            borderless &= np.abs(value - border) > 1e-3
        borderless &= np.abs(depth - NEAR_PLANE) > 1e-4
    points = points[borderless]
    expected = sum(camera.in_frustum(points).astype(int) for camera in cameras)
    views = count_visibility(torch.from_numpy(points).float(), cameras)
    assert views.dtype == torch.int32
    assert views.tolist() == expected.tolist()
    assert len(set(views.tolist())) > 3
    behind = [torch.from_numpy(camera.position - camera.forward).float()[None] for camera in cameras[:5]]
    alone = [int(count_visibility(place, [camera])) for place, camera in zip(behind, cameras[:5], strict=True)]
    assert alone == [0] * 5


def test_the_left_and_upper_border_belong_to_the_image_the_right_and_lower_do_not() -> None:
    camera = Camera(camera_from_world=np.eye(4), fx=32.0, fy=32.0, cx=32.0, cy=16.0, width=64, height=32)
    places = [[-1, 0, 1], [1, 0, 1], [0, -0.5, 1], [0, 0.5, 1], [0, 0, 1], [0, 0, -1], [0, 0, NEAR_PLANE / 2]]
    points = np.array(places, np.float64)
    assert count_visibility(torch.from_numpy(points).float(), [camera]).tolist() == [1, 0, 1, 0, 1, 0, 0]
    assert camera.in_frustum(points).tolist() == [True, False, True, False, True, False, False]


def test_v_does_not_depend_on_the_order_of_cameras_and_no_camera_sees_nothing() -> None:
    cameras, points = flight(12), torch.from_numpy(cloud(500)).float()
    assert torch.equal(count_visibility(points, cameras), count_visibility(points, cameras[::-1]))
    assert count_visibility(points, []).tolist() == [0] * 500


def test_a_view_counts_once_in_a_cycle_at_whatever_resolution() -> None:
    cameras, points = flight(7), torch.from_numpy(cloud(800)).float()
    share = visibility_ratio(points, cameras)
    again = visibility_ratio(points, [*cameras, cameras[0], cameras[3].resized(32, 24), cameras[3].resized(16, 12)])
    assert torch.equal(share, again)
    assert torch.equal(share, count_visibility(points, cameras).float() / 7)
    # Two parts of one picture are two views: what one of them shows, the other does not.
    for part in ({"cx": cameras[0].cx - 24}, {"cy": cameras[0].cy + 20}):
        both = [*cameras, replace(cameras[0], **part)]
        assert torch.equal(visibility_ratio(points, both), count_visibility(points, both).float() / 8)
    with pytest.raises(ValueError, match="without cameras"):
        visibility_ratio(points, [])


def test_normalized_visibility_spans_zero_to_one_and_is_zero_where_all_are_alike() -> None:
    assert normalize_visibility(np.array([3, 7, 5])) == pytest.approx([0, 1, 0.5])
    assert normalize_visibility(np.array([4, 4])).tolist() == [0, 0]
    assert len(normalize_visibility(np.array([], np.int64))) == 0


@given(st.lists(st.integers(0, 50), min_size=1, max_size=30))
def test_gini_is_the_mean_difference_of_two_anchors(views: list[int]) -> None:
    values = np.array(views, np.float64)
    mean = values.mean()
    expected = np.abs(values[:, None] - values[None]).mean() / (2 * mean) if mean else 0.0
    assert visibility_stats(np.array(views)).gini == pytest.approx(expected, abs=1e-12)


def test_imbalance_in_numbers() -> None:
    facts = visibility_stats(np.arange(101))
    assert facts.mean == 50
    assert facts.quantiles == {5: 5, 25: 25, 50: 50, 75: 75, 95: 95}
    assert facts.fraction_below == {3: 3 / 101, 5: 5 / 101, 10: 10 / 101}
    with pytest.raises(ValueError, match="no anchors"):
        visibility_stats(np.array([], np.int64))


def test_every_anchor_divides_its_vote_among_the_cameras_that_hold_it() -> None:
    cameras, points = flight(20), torch.from_numpy(cloud(500))
    held = np.array([count_visibility(points, [camera]).numpy() > 0 for camera in cameras])
    seen = held.sum(0)
    expected = [sum(1.0 / seen[i] for i in np.flatnonzero(row)) for row in held]
    shares = visibility_sampling_weights(points, cameras)
    assert np.allclose(shares, expected)
    assert np.isclose(sum(shares), (seen > 0).sum())


@given(count=st.integers(1, 50), weight=st.floats(1e-3, 1e3))
def test_photographs_used_alike_are_worth_their_number_and_one_that_outweighs_all_is_worth_one(
    count: int, weight: float
) -> None:
    assert effective_sample_size([weight] * count) == pytest.approx(count)
    assert effective_sample_size([weight] * count + [0.0] * 7) == pytest.approx(count)
    assert effective_sample_size([weight] * count + [1e9 * weight]) == pytest.approx(1.0)


@pytest.mark.parametrize(("sampling", "ratio"), [("uniform", None), ("visibility", 9.0), ("sqrt-visibility", 3.0)])
def test_how_often_a_photograph_with_nine_times_the_votes_is_used(sampling: str, ratio: float | None) -> None:
    cameras = [
        Camera(
            camera_from_world=look_down(np.array([x, 0.0, 8.0]), 0.0, 0.0),
            fx=60.0,
            fy=60.0,
            cx=32.0,
            cy=24.0,
            width=64,
            height=48,
        )
        for x in (0.0, 100.0)
    ]
    positions = torch.tensor([[0.0, 0.0, 0.0]] + [[100.0, 0.0, 0.0]] * 9)
    anchors = Anchors(positions, torch.zeros(10, 32), torch.zeros(10, 1, 3), torch.zeros(10, 6))
    shares = view_sampling_weights(TrainConfig(view_sampling=sampling), anchors, cameras)
    assert (None if shares is None else shares[1] / shares[0]) == (ratio and pytest.approx(ratio))


@pytest.mark.parametrize(("obliques", "ratio"), [(2, 3.0), (4, 1.5), (8, 1.0), (0, None)])
def test_obliques_are_used_more_often_but_not_more_than_the_others_together(obliques: int, ratio: float | None) -> None:
    def camera(tilt_degrees: float) -> Camera:
        pose = look_down(np.array([0.0, 0.0, 8.0]), tilt_degrees)
        return Camera(camera_from_world=pose, fx=60.0, fy=60.0, cx=32.0, cy=24.0, width=64, height=48)

    cameras = [camera(10.0)] * 6 + [camera(40.0)] * obliques
    nothing = Anchors(torch.zeros(0, 3), torch.zeros(0, 32), torch.zeros(0, 1, 3), torch.zeros(0, 6))
    shares = view_sampling_weights(TrainConfig(oblique_sampling=3.0), nothing, cameras)
    assert (None if shares is None else shares[-1] / shares[0]) == (ratio and pytest.approx(ratio))
    assert view_sampling_weights(TrainConfig(), nothing, cameras) is None


def test_a_camera_alone_over_a_place_has_the_votes_of_all_its_anchors() -> None:
    def above(x: float) -> Camera:
        return Camera(
            camera_from_world=look_down(np.array([x, 0.0, 8.0]), 0.0, 0.0), fx=60.0, fy=60.0, cx=32.0, cy=24.0,
            width=64, height=48,
        )  # fmt: skip

    crowd, lonely = [above(0.0)] * 9, above(100.0)
    points = torch.tensor([[0.0, 0.0, 0.0]] * 9 + [[100.0, 0.0, 0.0]] * 9)
    assert np.allclose(visibility_sampling_weights(points, [*crowd, lonely]), [1.0] * 9 + [9.0])
    assert visibility_sampling_weights(torch.zeros(0, 3), crowd) == (1.0,) * 9
