"""Spherical harmonics of many Gaussians, fit and colors: C++ of every instruction set does as the twin."""

from __future__ import annotations

import inspect

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.instruction_sets import on_threads, using
from vdgs.export.bake import RIDGE_WEIGHT
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu import harmonics as native
from vdgs.kernels.spherical_harmonics import eval_sh_bases, eval_sh_colors, num_sh_bases
from vdgs.kernels.torch_ref import harmonics as reference

BOTH = pytest.mark.parametrize("kernels", [native, reference], ids=["native", "reference"])


def unit(count: int, generator: torch.Generator) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def seen(counts: list[int], seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Directions, colors and weights of so many pairs of each Gaussian, and where those of each begin."""
    generator, pairs = torch.Generator().manual_seed(seed), sum(counts)
    starts = torch.tensor([0, *counts[:-1]]).cumsum(0)
    # What makes a thousandth of a pixel stands beside what makes a thousand.
    weights = 10 ** (6 * torch.rand(pairs, generator=generator) - 3)
    return unit(pairs, generator), torch.rand(pairs, 3, generator=generator), weights, starts


@BOTH
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_each_regression_is_solved_as_if_it_were_alone(kernels, degree):
    counts = [1, 30, 2, 17, 2, 90, *range(1, 40)]
    directions, colors, weights, starts = seen(counts, 1)
    together = kernels.fit_harmonics(directions, colors, weights, starts, degree, RIDGE_WEIGHT)
    f = num_sh_bases(degree)
    assert together.shape == (len(counts), f, 3)
    for number, (start, count) in enumerate(zip(starts.tolist(), counts, strict=True)):
        part = slice(start, start + count)
        functions = eval_sh_bases(directions[part].double(), degree)
        share = (weights[part].double() / weights[part].double().sum())[:, None]
        ridge = torch.diag(torch.tensor([0.0] + (f - 1) * [RIDGE_WEIGHT], dtype=torch.float64))
        matrix = functions.T @ (share * functions) + ridge
        alone = torch.linalg.solve(matrix, functions.T @ (share * (colors[part].double() - 0.5)))
        torch.testing.assert_close(together[number].double(), alone, atol=1e-5, rtol=1e-4)


@settings(max_examples=30)
@given(
    counts=st.lists(st.integers(1, 40), min_size=1, max_size=70), degree=st.integers(0, 3), seed=st.integers(0, 10**6)
)
def test_every_instruction_set_fits_what_the_twin_fits(counts, degree, seed):
    given_pairs = seen(counts, seed)
    expected = reference.fit_harmonics(*given_pairs, degree, RIDGE_WEIGHT)
    for isa in extension.supported_isas():
        with using(isa):
            found = native.fit_harmonics(*given_pairs, degree, RIDGE_WEIGHT)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)


@BOTH
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_that_were_seen_from_everywhere_are_found_again(kernels, degree):
    generator = torch.Generator().manual_seed(degree)
    m, views = 5, 400
    dc = 0.3 * torch.randn(m, 3, generator=generator)
    rest = 0.03 * torch.randn(m, num_sh_bases(degree) - 1, 3, generator=generator)
    directions = unit(m * views, generator)
    colors = eval_sh_colors(dc.repeat_interleave(views, 0), rest.repeat_interleave(views, 0), directions, degree)
    weights = 0.5 + torch.rand(m * views, generator=generator)
    found = kernels.fit_harmonics(directions, colors, weights, torch.arange(m) * views, degree, RIDGE_WEIGHT)
    assert torch.allclose(found[:, 0], dc, atol=0.02)
    # The ridge shrinks by RIDGE against the mean square of a function, 1 / (4 pi).
    assert torch.allclose(found[:, 1:], rest, atol=0.03)


@BOTH
def test_one_view_says_one_color_for_all_directions(kernels):
    color, one = torch.tensor([[0.2, 0.5, 0.9]]), torch.tensor([[0.0, 0.0, -1.0]])
    found = kernels.fit_harmonics(one, color, torch.ones(1), torch.tensor([0]), 3, RIDGE_WEIGHT)
    shown = eval_sh_colors(found[:, 0], found[:, 1:], one, 3)
    assert torch.allclose(shown, color, atol=0.01)
    sideways = eval_sh_colors(found[:, 0], found[:, 1:], torch.tensor([[1.0, 0.0, 0.0]]), 3)
    assert (sideways - color).abs().max() < 0.25


@BOTH
@pytest.mark.parametrize("count", [1, 2, 50])
def test_many_looks_from_one_place_are_a_number(kernels, count):
    directions, colors = torch.tensor([[0.6, 0.0, -0.8]]).repeat(count, 1), torch.full((count, 3), 0.75)
    found = kernels.fit_harmonics(directions, colors, torch.full((count,), 1e-3), torch.tensor([0]), 3, RIDGE_WEIGHT)
    assert torch.isfinite(found).all()
    shown = eval_sh_colors(found[:, 0], found[:, 1:], directions[:1], 3)
    torch.testing.assert_close(shown, colors[:1], atol=1e-3, rtol=0)


@BOTH
def test_what_no_fit_can_be_made_of_is_refused(kernels):
    directions, colors, weights, _ = seen([3, 2])
    for starts in ([0, 5], [1, 3], [0, 0], [2, 1], []):
        with pytest.raises(ValueError, match="pair"):
            kernels.fit_harmonics(directions, colors, weights, torch.tensor(starts, dtype=torch.int64), 1, RIDGE_WEIGHT)
    nothing = torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, dtype=torch.int64)
    assert kernels.fit_harmonics(*nothing, 2, RIDGE_WEIGHT).shape == (0, 9, 3)
    with pytest.raises(ValueError, match="degree"):
        kernels.fit_harmonics(directions, colors, weights, torch.tensor([0, 3]), 4, RIDGE_WEIGHT)


@settings(max_examples=30)
@given(n=st.integers(1, 100), degree=st.integers(0, 3), seed=st.integers(0, 10**6))
def test_every_instruction_set_shows_what_the_twin_shows(n, degree, seed):
    """Coefficients stand apart, among other numbers, as in a file; rows in any order, some twice."""
    generator = torch.Generator().manual_seed(seed)
    width = 3 * num_sh_bases(degree)
    table = torch.randn(n, width + 7, generator=generator)
    coefficients = table[:, 5 : 5 + width]
    rows = torch.randint(n, (2 * n,), generator=generator)
    means, eye = 9 * torch.randn(len(rows), 3, generator=generator), torch.tensor([0.3, -0.4, 20.0])
    expected = reference.harmonic_colors(means, coefficients, rows, eye, degree)
    for isa in extension.supported_isas():
        with using(isa):
            shown = native.harmonic_colors(means, coefficients, rows, eye, degree)
            one = native.harmonic_colors(means[:1], coefficients, rows[:1], means[0], degree)
        torch.testing.assert_close(shown, expected, atol=2e-5, rtol=1e-5)
        assert torch.isfinite(one).all()  # seen from its own center


@BOTH
def test_rows_and_coefficients_that_do_not_fit_are_refused(kernels):
    means, eye = torch.zeros(1, 3), torch.ones(3)
    for row in (-1, 4):
        with pytest.raises(IndexError, match="outside the 4"):
            kernels.harmonic_colors(means, torch.zeros(4, 12), torch.tensor([row]), eye, 1)
    with pytest.raises(ValueError, match="degree 2 has 27 coefficients, not 12"):
        kernels.harmonic_colors(means, torch.zeros(4, 12), torch.tensor([0]), eye, 2)


@BOTH
def test_pairs_and_places_that_are_too_few_are_refused(kernels):
    """The kernel does not look again: it would read beyond the end."""
    fit, show = inspect.unwrap(kernels.fit_harmonics), inspect.unwrap(kernels.harmonic_colors)
    directions, colors, weights, starts = seen([3, 2])
    for few in ((directions[:2], colors), (directions, colors[:2])):
        with pytest.raises(ValueError, match=r"must be .5, 3"):
            fit(*few, weights, starts, 1, RIDGE_WEIGHT)
    coefficients, rows = torch.zeros(4, 12), torch.tensor([0, 3])
    with pytest.raises(ValueError, match=r"means must be .2, 3"):
        show(torch.zeros(1, 3), coefficients, rows, torch.ones(3), 1)
    with pytest.raises(ValueError, match=r"eye must be .3"):
        show(torch.zeros(2, 3), coefficients, rows, torch.ones(1), 1)


def test_any_number_of_threads_gives_the_same_bits():
    pairs = seen([1 + number % 23 for number in range(1500)])
    generator = torch.Generator().manual_seed(3)
    table, rows = torch.randn(1500, 48, generator=generator), torch.arange(1500)
    means = torch.randn(1500, 3, generator=generator)
    found = []
    for threads in (1, 3):
        with on_threads(threads):
            found.append((native.fit_harmonics(*pairs, 3, RIDGE_WEIGHT),
                          native.harmonic_colors(means, table, rows, torch.zeros(3), 3)))  # fmt: skip
    for one, many in zip(*found, strict=True):
        assert torch.equal(one, many)
