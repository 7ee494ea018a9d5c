"""Means of ellipsoids: C++ of every instruction set does as the twin, which does what the paper on them says."""

from __future__ import annotations

import inspect

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.instruction_sets import on_threads, using
from vdgs.kernels.cpu import ellipsoids as native
from vdgs.kernels.cpu import extension
from vdgs.kernels.torch_ref import ellipsoids as reference
from vdgs.kernels.torch_ref.ellipsoids import from_log_covariances, log_covariances

BOTH = pytest.mark.parametrize("kernels", [native, reference], ids=["native", "reference"])


def seen(counts: list[int], seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Log-scales, quaternions and weights of so many pairs of each Gaussian, and where those of each begin."""
    generator, pairs = torch.Generator().manual_seed(seed), sum(counts)
    weights = 10 ** (6 * torch.rand(pairs, generator=generator) - 3)
    shapes = torch.randn(pairs, 3, generator=generator) - 2, torch.randn(pairs, 4, generator=generator)
    return *shapes, weights, torch.tensor([0, *counts[:-1]]).cumsum(0)


@settings(max_examples=30)
@given(counts=st.lists(st.integers(1, 20), min_size=1, max_size=70), seed=st.integers(0, 10**6))
def test_every_instruction_set_means_what_the_twin_means(counts, seed):
    given_pairs = seen(counts, seed)
    expected = log_covariances(*reference.mean_ellipsoids(*given_pairs))
    for isa in extension.supported_isas():
        with using(isa):
            found = native.mean_ellipsoids(*given_pairs)
        # Ellipsoids as a whole: where two axes are alike, rounding decides where these two point.
        torch.testing.assert_close(log_covariances(*found), expected, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(found[1].norm(dim=1), torch.ones(len(counts)))


@BOTH
def test_the_logarithm_of_the_mean_is_the_mean_of_the_logarithms(kernels):
    log_scales, quaternions, weights, starts = seen([4] * 50)
    shares = (weights.view(-1, 4) / weights.view(-1, 4).sum(1, keepdim=True))[..., None]
    expected = (log_covariances(log_scales, quaternions).view(-1, 4, 6) * shares).sum(1)
    found = log_covariances(*kernels.mean_ellipsoids(log_scales, quaternions, weights, starts))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@BOTH
@pytest.mark.parametrize("scales", [(0, 0, 0), (-1, -1, -3), (-30, -1, -1), (2, 2, 2)])
def test_of_alike_ellipsoids_and_axes_the_mean_is_each(kernels, scales):
    log_scales = torch.tensor([scales] * 3, dtype=torch.float32)
    quaternions = torch.randn(1, 4, generator=torch.Generator().manual_seed(1)).expand(3, 4)
    for turned in (quaternions, torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4)):
        found = kernels.mean_ellipsoids(log_scales, turned, torch.tensor([1e-3, 1.0, 1e3]), torch.tensor([0]))
        torch.testing.assert_close(
            log_covariances(*found), log_covariances(log_scales[:1], turned[:1]), atol=1e-5, rtol=1e-5
        )


@BOTH
def test_what_is_not_cut_into_runs_is_refused_and_nothing_has_no_mean(kernels):
    log_scales, quaternions, weights, _ = seen([2, 3])
    for starts in ([1, 2], [0, 0], [0, 5]):
        with pytest.raises(ValueError, match="needs a pair of its own"):
            kernels.mean_ellipsoids(log_scales, quaternions, weights, torch.tensor(starts))
    none = kernels.mean_ellipsoids(log_scales[:0], quaternions[:0], weights[:0], torch.zeros(0, dtype=torch.int64))
    assert [tuple(each.shape) for each in none] == [(0, 3), (0, 4)]


@BOTH
@pytest.mark.parametrize("short", [0, 1])
def test_scales_and_axes_of_fewer_pairs_are_refused(kernels, short):
    """The kernel does not look again: it would read beyond the end."""
    arguments = list(seen([2, 3]))
    arguments[short] = arguments[short][:2]
    with pytest.raises(ValueError, match=r"must be .5"):
        inspect.unwrap(kernels.mean_ellipsoids)(*arguments)


def test_threads_change_no_bit():
    given_pairs = seen([1 + i % 7 for i in range(3000)])
    found = []
    for count in (1, 3):
        with on_threads(count):
            found.append(native.mean_ellipsoids(*given_pairs))
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_the_mean_of_ellipsoids_minds_neither_the_order_nor_the_signs_of_axes():
    generator = torch.Generator().manual_seed(0)
    scales, turns = torch.randn(400, 3, generator=generator), torch.randn(400, 4, generator=generator)
    logarithm = log_covariances(scales, turns)
    named = from_log_covariances(logarithm)
    torch.testing.assert_close(log_covariances(*named), logarithm, atol=1e-5, rtol=0)
    torch.testing.assert_close(named[0].sort(1).values, scales.sort(1).values, atol=1e-5, rtol=0)
    torch.testing.assert_close(named[1].norm(dim=1), torch.ones(400))
    # The same ellipsoids with axes named anew are the same logarithms, so they have the same mean.
    quarter = torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])  # about x: y becomes z
    w, x, y, z = turns.unbind(1)
    anew = torch.stack([w - x, w + x, y + z, z - y], 1) * quarter[0]
    torch.testing.assert_close(log_covariances(scales[:, [0, 2, 1]], -anew), logarithm, atol=1e-4, rtol=0)
