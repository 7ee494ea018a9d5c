"""Gaussians that join: what a group conserves, and which neighbors go first."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.gaussians import overhead, picture, psnr, random_gaussians
from vdgs.model.gaussian_merging import gaussian_weights, group_neighbors, merge_by_moments, single_members
from vdgs.model.gaussian_transform import gaussian_covariances, quaternion_from_matrix, transform_gaussians
from vdgs.model.gaussians import Gaussians


def total(gaussians: Gaussians, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted mean, covariance about it and color of all."""
    share = (weights / weights.sum())[:, None]
    means = gaussians.means.double().numpy()
    middle = (share * means).sum(0)
    apart = means - middle
    spread = gaussian_covariances(gaussians).double().numpy() + apart[:, :, None] * apart[:, None, :]
    return middle, (share[:, :, None] * spread).sum(0), (share * gaussians.sh0.double().numpy()).sum(0)


def test_weight_mean_covariance_and_color_of_groups_are_conserved():
    some, rng = random_gaussians(300, 2), np.random.default_rng(0)
    groups = rng.permutation(np.arange(300) % 40)
    weights = rng.uniform(0.1, 2, 300)
    merged = merge_by_moments(some, groups, weights, enlarge=1.0)
    assert len(merged) == 40
    of_groups = np.bincount(groups, weights)
    for given, expected in zip(total(merged, of_groups), total(some, weights), strict=True):
        np.testing.assert_allclose(given, expected, rtol=1e-4, atol=1e-5)
    members = some.select(torch.from_numpy(groups == 7))
    np.testing.assert_allclose(total(members, weights[groups == 7])[0], merged.means[7], atol=1e-5)


def test_a_group_of_one_stays_as_it_is():
    some = random_gaussians(50, 3)
    order = np.random.default_rng(1).permutation(50)
    merged = merge_by_moments(some, order)
    for name, tensor in merged.tensors().items():
        assert torch.equal(tensor[torch.from_numpy(order)], some.tensors()[name]), name


def test_equal_gaussians_give_their_shape_and_color_back():
    some = random_gaussians(20, 1)
    four = merge_by_moments(some.select(torch.arange(20).repeat(4)), np.tile(np.arange(20), 4), enlarge=1.0)
    torch.testing.assert_close(gaussian_covariances(four), gaussian_covariances(some), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(four.shN, some.shN)
    # They cover four times as much, as far as one can.
    covered = (4 * some.opacity_logits.double().sigmoid()).clamp_max(0.999)
    torch.testing.assert_close(four.opacity_logits.double().sigmoid(), covered, rtol=1e-3, atol=1e-5)


def test_a_group_covers_what_its_members_cover():
    """Side by side: the wider Gaussian has the opacity of its members."""
    one = random_gaussians(1, 0)
    one = replace(one, log_scales=torch.log(torch.tensor([[0.5, 0.5, 0.01]])), opacity_logits=torch.tensor([-2.0]))
    row = one.select(torch.zeros(9, dtype=torch.int64))
    row = replace(row, means=torch.arange(9.0)[:, None] * torch.tensor([[0.3, 0.0, 0.0]]),
                  quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(9, 1))  # fmt: skip
    merged = merge_by_moments(row, np.zeros(9, np.int64))
    np.testing.assert_allclose(gaussian_weights(merged).sum(), gaussian_weights(row).sum(), rtol=1e-3)


def test_what_closed_a_surface_closes_it_merged():
    """Moments alone leave gaps between squares: the Gaussians are enlarged, and no more than is said."""
    x, y = np.meshgrid(np.arange(6.0), np.arange(6.0))
    one = replace(random_gaussians(1, 0), log_scales=torch.log(torch.tensor([[0.6, 0.6, 0.1]])),
                  opacity_logits=torch.tensor([4.0]))  # fmt: skip
    square = replace(one.select(torch.zeros(36, dtype=torch.int64)),
                     means=torch.from_numpy(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)).float())  # fmt: skip
    groups = np.zeros(36, np.int64)
    exact, larger = (merge_by_moments(square, groups, enlarge=most) for most in (1.0, 2.0))
    torch.testing.assert_close(larger.quaternions, exact.quaternions)
    times = (larger.log_scales - exact.log_scales).exp()
    assert 1.2 < float(times.min()) <= float(times.max()) <= 2.0 + 1e-6
    enough = merge_by_moments(square, groups, enlarge=100.0)
    np.testing.assert_allclose(gaussian_weights(enough).sum(), gaussian_weights(square).sum(), rtol=1e-3)


def test_merged_gaussians_cover_what_their_members_cover_through_all_levels():
    """Also where that is more than an opaque Gaussian covers: what one lacks, the next level still knows."""
    some = random_gaussians(400, 1)
    level = single_members(some)
    for count in (100, 20, 1):
        level = merge_by_moments(level, np.arange(len(level)) % count, enlarge=1.0)
        assert len(level.covers) == count
        np.testing.assert_allclose(gaussian_weights(level).sum(), gaussian_weights(some).sum(), rtol=1e-3)
    assert level.covers[0] > 1


def test_what_is_known_of_members_is_that_of_all_of_them_through_all_levels():
    some, rng = random_gaussians(400, 1), np.random.default_rng(2)
    weights, colors = gaussian_weights(some), rng.uniform(0.1, 3, 400)
    level = single_members(some, colors)
    for count in (100, 20, 1):
        level = merge_by_moments(level, np.arange(len(level)) % count, enlarge=1.0)
    mean = np.average(np.log(weights), weights=weights)
    std = np.average((np.log(weights) - mean) ** 2, weights=weights) ** 0.5
    np.testing.assert_allclose([float(level.log_weight_mean), float(level.log_weight_std)], [mean, std], rtol=1e-3)
    wanted = np.average(some.sh0.numpy(), axis=0, weights=weights * colors)
    np.testing.assert_allclose(level.sh0[0].numpy(), wanted, atol=2e-3)


def test_how_the_colors_of_members_follow_their_sizes_is_known_through_all_levels():
    some = random_gaussians(400, 1)
    weights = gaussian_weights(some)
    logs = torch.from_numpy(np.log(weights)).float()
    some = replace(some, sh0=some.sh0 + 0.5 * logs[:, None] * torch.tensor([1.0, 0.0, -1.0]))
    level = single_members(some)
    for count in (100, 20, 1):
        level = merge_by_moments(level, np.arange(len(level)) % count, enlarge=1.0)
    wanted = np.cov(np.vstack([logs, some.sh0.T]), aweights=weights, ddof=0)[0, 1:]
    assert wanted[0] > 0.1
    assert wanted[2] < -0.1
    np.testing.assert_allclose(level.sh0_log_weight_cov[0].numpy(), wanted, rtol=5e-3, atol=5e-3)


def test_flat_gaussians_stay_flat_and_what_has_no_extent_stays_finite():
    some = random_gaussians(60, 0)
    flat = replace(some, log_scales=torch.tensor([[-2.0, -2.0, -40.0]]).repeat(60, 1), means=some.means * 0,
                   quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(60, 1))  # fmt: skip
    merged = merge_by_moments(flat, group_neighbors(flat, 7))
    assert len(merged) == 7
    assert all(bool(torch.isfinite(each).all()) for each in merged.tensors().values())
    assert float(merged.log_scales.amin(1).max()) < -10


def test_merging_turns_with_the_scene():
    some = random_gaussians(400, 1)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    turned = transform_gaussians(some, 1.0, turn, np.array([1.0, -2.0, 3.0]))
    groups = group_neighbors(some, 100)
    np.testing.assert_array_equal(group_neighbors(turned, 100), groups)
    expected = transform_gaussians(merge_by_moments(some, groups), 1.0, turn, np.array([1.0, -2.0, 3.0]))
    merged = merge_by_moments(turned, groups)
    torch.testing.assert_close(gaussian_covariances(merged), gaussian_covariances(expected), rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(merged.shN, expected.shN, rtol=1e-3, atol=1e-4)
    assert quaternion_from_matrix(np.eye(3))[0] == 1


@pytest.mark.parametrize("most", [1, 2, 99, 299])
def test_as_many_groups_as_asked_for_each_with_a_member(most):
    some = random_gaussians(300, 0)
    groups = group_neighbors(some, most)
    assert np.unique(groups).tolist() == list(range(most))
    np.testing.assert_array_equal(group_neighbors(some, most), groups)
    assert group_neighbors(some, 300).tolist() == list(range(300))


def test_a_regular_grid_of_equals_merges():
    """All pairs cost the same there."""
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    some = random_gaussians(1, 0).select(torch.zeros(900, dtype=torch.int64))
    some = replace(some, means=torch.from_numpy(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)).float())
    sizes = np.bincount(group_neighbors(some, 225))
    assert len(sizes) == 225
    assert sizes.max() <= 16


def test_what_is_alike_joins_before_what_differs():
    """A red car on a gray road, and the edge of a roof above it, are left while the road is merged."""
    x, y = np.meshgrid(np.arange(24.0), np.arange(24.0))
    n = x.size
    car = (abs(x.ravel() - 12) < 2) & (abs(y.ravel() - 12) < 2)
    roof = x.ravel() > 18
    road = Gaussians(
        means=torch.from_numpy(np.stack([x.ravel(), y.ravel(), 4.0 * roof], 1)).float(),
        log_scales=torch.log(torch.tensor([[0.6, 0.6, 0.05]])).repeat(n, 1),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), 3.0),
        sh0=torch.from_numpy(np.where(car[:, None], [1.5, -1.5, -1.5], [0.1, 0.1, 0.1])).float(),
        shN=torch.zeros(n, 0, 3),
    )
    groups = group_neighbors(road, n // 6)
    for apart in (car, roof):
        assert not set(groups[apart]) & set(groups[~apart])


def test_weights_of_cameras_decide_where_given():
    some = random_gaussians(2, 0)
    merged = merge_by_moments(some, np.zeros(2, np.int64), np.array([1.0, 3.0]))
    torch.testing.assert_close(merged.sh0[0], some.sh0[0] / 4 + some.sh0[1] * 3 / 4)
    assert (gaussian_weights(some) > 0).all()


def test_a_merged_scene_looks_like_the_scene():
    some = random_gaussians(3000, 2, reach=6.0)
    some = replace(some, means=some.means * torch.tensor([1.0, 1.0, 0.05]), opacity_logits=some.opacity_logits + 2)
    from_afar = replace(overhead(height=40.0, aside=3.0, size=48), fx=90.0, fy=90.0)
    coarse = merge_by_moments(some, group_neighbors(some, 700))
    assert psnr(picture(coarse, from_afar), picture(some, from_afar)) > 24
