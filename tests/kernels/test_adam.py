"""Adam on rows: equal to torch's where all rows are given, silent on the others."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.instruction_sets import every_instruction_set, on_threads, using
from vdgs.kernels.cpu import adam as native
from vdgs.kernels.kernel_types import AdamState
from vdgs.kernels.torch_ref import adam as reference


def adam_rows(implementation, parameter, rows, gradient, first, second, *, learning_rate, step, **settings):
    """A step of the implementation for tensors by name."""
    return implementation.adam_rows(
        AdamState(parameter, first, second, learning_rate), rows, gradient, step, **settings
    )


BOTH = pytest.mark.parametrize("implementation", [reference, native])


def state(n: int, *rest: int, seed: int = 0, dtype=torch.float32):
    """Parameter, gradient for all rows and moments in mid-training."""
    generator = torch.Generator().manual_seed(seed)
    parameter, gradient, first, second = (torch.randn(n, *rest, generator=generator, dtype=dtype) for _ in range(4))
    return parameter, gradient, first * 0.1, second.square() * 0.1


def some_rows(n: int, share: float, seed: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nonzero(torch.rand(n, generator=generator) < share)[:, 0]


@BOTH
def test_all_rows_are_torch_adam(implementation):
    generator = torch.Generator().manual_seed(5)
    parameter = torch.randn(37, 3, generator=generator)
    peer = parameter.clone().requires_grad_()
    optimizer = torch.optim.Adam([peer], lr=0.01, eps=1e-15)
    first, second = torch.zeros_like(parameter), torch.zeros_like(parameter)
    for step in range(1, 8):
        gradient = torch.randn(37, 3, generator=generator) * 10.0 ** (step % 3 - 2)
        peer.grad = gradient.clone()
        optimizer.step()
        rows = None if step % 2 else torch.arange(37)
        assert adam_rows(implementation, parameter, rows, gradient, first, second, learning_rate=0.01, step=step)
        torch.testing.assert_close(parameter, peer.detach(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(first, optimizer.state[peer]["exp_avg"])
    torch.testing.assert_close(second, optimizer.state[peer]["exp_avg_sq"])


@BOTH
def test_rows_that_are_not_given_keep_parameters_and_moments(implementation):
    parameter, gradient, first, second = state(50, 10, 3)
    rows = some_rows(50, 0.4)
    before = [tensor.clone() for tensor in (parameter, first, second)]
    adam_rows(implementation, parameter, rows, gradient[rows], first, second, learning_rate=0.1, step=9)
    others = torch.ones(50, dtype=torch.bool)
    others[rows] = False
    for tensor, old in zip((parameter, first, second), before, strict=True):
        assert torch.equal(tensor[others], old[others])
        assert torch.all(tensor[rows] != old[rows])


@settings(max_examples=40)
@given(
    st.integers(0, 400),
    st.sampled_from([(), (1,), (3,), (6,), (32,), (10, 3)]),
    st.floats(0, 1),
    st.integers(1, 9999),
)
def test_native_equals_twin(n, rest, share, step):
    rows = some_rows(n, share)
    results = []
    for implementation in (reference, native):
        parameter, gradient, first, second = state(n, *rest)
        adam_rows(
            implementation,
            parameter,
            rows,
            gradient[rows],
            first,
            second,
            learning_rate=0.02,
            step=step,
            beta1=0.8,
            beta2=0.99,
        )
        results.append((parameter, first, second))
    for value, expected in zip(*results, strict=True):
        torch.testing.assert_close(value, expected, rtol=2e-6, atol=2e-6)


def some_updates(count: int, most: int = 20_000, seed: int = 2) -> torch.Tensor:
    """Numbers of updates from 1, a half of them small, some beyond what the bias correction can tell."""
    g = torch.Generator().manual_seed(seed)
    few = torch.randint(1, 40, (count,), generator=g, dtype=torch.int32)
    return torch.where(torch.rand(count, generator=g) < 0.5, few, torch.randint(1, most, (count,), generator=g).int())


@settings(max_examples=25)
@given(
    st.integers(1, 80),
    st.sampled_from([(), (1,), (3,), (6,), (32,), (10, 3), (1500,)]),
    st.sampled_from([0.0, 0.3, 0.9, 1.0]),
)
def test_rows_that_count_for_themselves_are_rows_alone(n, rest, share):
    """Native and twin; and each row is to the bit what it would be with its own count as the step of all."""
    rows = some_rows(n, share)
    updates, results = some_updates(len(rows)), []
    for implementation in (reference, native):
        parameter, gradient, first, second = state(n, *rest)
        assert adam_rows(
            implementation, parameter, rows, gradient[rows], first, second, learning_rate=0.02, step=updates
        )
        results.append((parameter, first, second))
        for row, count in list(zip(rows, updates.tolist(), strict=True))[:3]:
            alone, of_all, m, v = state(n, *rest)
            one = row[None]
            adam_rows(implementation, alone, one, of_all[one], m, v, learning_rate=0.02, step=count)
            assert all(torch.equal(a[row], b[row]) for a, b in zip((alone, m, v), results[-1], strict=True))
    for value, expected in zip(*results, strict=True):
        torch.testing.assert_close(value, expected, rtol=2e-6, atol=2e-6)


@BOTH
def test_the_first_step_of_a_row_is_the_same_whenever_it_comes(implementation):
    """Whatever the gradient, the first step of Adam is as long as its rate."""
    g = torch.Generator().manual_seed(3)
    gradient = torch.randn(6, 4, generator=g)
    zeros, moved = torch.zeros(6, 4), []
    for late in (1, 10_000):
        parameter, first, second = torch.zeros(6, 4), torch.zeros(6, 4), torch.zeros(6, 4)
        updates = torch.tensor([late, 1, late, late, 1, late], dtype=torch.int32)
        adam_rows(implementation, parameter, None, gradient, first, second, learning_rate=0.1, step=updates)
        moved.append(parameter)
    torch.testing.assert_close(moved[0], zeros - 0.1 * gradient.sign())
    assert torch.equal(moved[0][[1, 4]], moved[1][[1, 4]])
    assert (moved[1][[0, 2, 3, 5]].abs() > 0.3).all()  # what counting all steps alike would make of it


@BOTH
@pytest.mark.parametrize(
    "updates", [torch.tensor([1, 0, 1], dtype=torch.int32), torch.ones(3), torch.ones(2, dtype=torch.int32)]
)
def test_counts_that_do_not_fit_are_refused(implementation, updates):
    parameter, gradient, first, second = state(3, 4)
    before = parameter.clone()
    with pytest.raises((ValueError, TypeError), match=r"updates|step"):
        adam_rows(implementation, parameter, None, gradient, first, second, learning_rate=0.1, step=updates)
    assert torch.equal(parameter, before)


@every_instruction_set
@pytest.mark.parametrize("counts", [False, True])
def test_same_bits_for_any_number_of_threads(instructions, counts):
    rows, results = some_rows(20_000, 0.6), []
    step = some_updates(len(rows)) if counts else 3
    with using(instructions):
        for threads in (1, 2, 3):
            with on_threads(threads):
                parameter, gradient, first, second = state(20_000, 7)
                adam_rows(native, parameter, rows, gradient[rows], first, second, learning_rate=0.1, step=step)
                results.append((parameter, first, second))
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))
    parameter, gradient, first, second = state(20_000, 7)
    adam_rows(reference, parameter, rows, gradient[rows], first, second, learning_rate=0.1, step=step)
    for value, expected in zip(results[0], (parameter, first, second), strict=True):
        torch.testing.assert_close(value, expected, rtol=2e-6, atol=2e-6)


@BOTH
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("place", [(0, 0), (9_999, 4), (5_001, 2)])
def test_a_gradient_that_is_not_finite_changes_nothing(implementation, bad, place):
    parameter, gradient, first, second = state(10_000, 5)
    gradient[place] = bad
    before = [tensor.clone() for tensor in (parameter, first, second)]
    finite = adam_rows(implementation, parameter, None, gradient, first, second, learning_rate=0.1, step=1)
    assert finite is False
    assert all(torch.equal(a, b) for a, b in zip((parameter, first, second), before, strict=True))


@BOTH
@pytest.mark.parametrize(
    ("rows", "error"),
    [([0, 4], IndexError), ([-1, 2], IndexError), ([2, 1], ValueError), ([1, 1], ValueError)],
)
def test_wrong_rows_are_refused_before_any_change(implementation, rows, error):
    parameter, gradient, first, second = state(4, 3)
    before = [tensor.clone() for tensor in (parameter, first, second)]
    with pytest.raises(error, match="rows"):
        adam_rows(implementation, parameter, torch.tensor(rows), gradient[:2], first, second, learning_rate=0.1, step=1)
    assert all(torch.equal(a, b) for a, b in zip((parameter, first, second), before, strict=True))


@BOTH
def test_zero_gradients_of_fresh_rows_change_nothing(implementation):
    parameter = torch.randn(5, 3)
    before, zeros = parameter.clone(), torch.zeros(5, 3)
    assert adam_rows(implementation, parameter, None, zeros, zeros.clone(), zeros.clone(), learning_rate=1.0, step=1)
    assert torch.equal(parameter, before)


@pytest.mark.parametrize("threads", [1, 3])
@every_instruction_set
def test_moments_of_what_no_view_shows_any_more_end_at_zero(instructions, threads):
    """Steps of numbers nearer to 0 than the least normal one take a processor ten times as long, and 0.9 times the
    least few of them rounds up again. Outside the kernels such numbers stay what they are."""
    least = torch.finfo(torch.float32).smallest_normal
    parameter, gradient = torch.ones(40_000, 2), torch.zeros(40_000, 2)
    first, second = torch.full_like(parameter, 3 * least), torch.full_like(parameter, 1e-8)
    with using(instructions), on_threads(threads):
        for step in range(1000, 1020):
            adam_rows(native, parameter, None, gradient, first, second, learning_rate=0.01, step=step)
    assert not first.any()
    assert (parameter == 1).all()
    assert float(np.float32(least) / np.float32(2)) > 0


@BOTH
def test_no_rows_is_a_step_of_nothing(implementation):
    parameter, gradient, first, second = state(4, 3)
    before = parameter.clone()
    none = torch.zeros(0, dtype=torch.int64)
    assert adam_rows(implementation, parameter, none, gradient[:0], first, second, learning_rate=0.1, step=1)
    assert torch.equal(parameter, before)
    empty = torch.zeros(0, 3)
    assert adam_rows(implementation, empty, None, empty, empty, empty, learning_rate=0.1, step=1)


@BOTH
def test_a_parameter_that_asks_for_gradients_is_updated_in_place(implementation):
    parameter, gradient, first, second = state(6, 3)
    leaf = parameter.requires_grad_()
    used = (leaf * leaf).sum()
    before = leaf.detach().clone()
    adam_rows(implementation, leaf, None, gradient, first, second, learning_rate=0.1, step=1)
    assert torch.all(leaf.detach() != before)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        used.backward()


@BOTH
def test_a_strided_gradient_is_read_as_it_is(implementation):
    results = []
    for prepare in (lambda g: g.t().contiguous().t(), lambda g: g):
        parameter, gradient, first, second = state(30, 8)
        adam_rows(implementation, parameter, None, prepare(gradient), first, second, learning_rate=0.1, step=2)
        results.append(parameter)
    assert torch.equal(*results)


@BOTH
def test_unsuitable_arguments_are_refused(implementation):
    parameter, gradient, first, second = state(6, 3)

    def step(p=parameter, rows=None, g=gradient, m=first, v=second, **changes):
        adam_rows(implementation, p, rows, g, m, v, **({"learning_rate": 0.1, "step": 1} | changes))

    for error, changes in [
        (TypeError, {"p": parameter.long()}),
        (TypeError, {"g": gradient.double()}),
        (TypeError, {"rows": torch.arange(6, dtype=torch.int32)}),
        ((ValueError, TypeError), {"g": gradient[:5]}),
        ((ValueError, TypeError), {"m": first[:, :2]}),
        (ValueError, {"step": 0}),
        (ValueError, {"beta1": 1.0}),
        (ValueError, {"learning_rate": float("nan")}),
        (ValueError, {"epsilon": 0.0}),
    ]:
        with pytest.raises(error):
            step(**changes)


@BOTH
@pytest.mark.parametrize("early", [1.0, 3.0, 1e6])
def test_rows_with_few_updates_move_faster_by_no_more_than_what_is_allowed(implementation, early):
    updates = torch.tensor([1, 20, 118, 900, 30_000], dtype=torch.int32)
    rows = torch.arange(5)
    moved = []
    for factor in (1.0, early):
        parameter, gradient, first, second = state(5, 3)
        before = parameter.clone()
        implementation.adam_rows(AdamState(parameter, first, second, 1e-3, factor), rows, gradient, updates)
        moved.append((parameter - before).double())
    expected = (1 / (1 - 0.999 ** updates.double()).sqrt()).clamp(max=early)
    torch.testing.assert_close(moved[1] / moved[0], expected[:, None].expand(5, 3), rtol=1e-2, atol=0)


@BOTH
@pytest.mark.parametrize("early", [0.9, float("nan"), float("inf")])
def test_rows_are_never_slowed_down(implementation, early):
    parameter, gradient, first, second = state(5, 3)
    with pytest.raises(ValueError, match="lr_boost"):
        implementation.adam_rows(AdamState(parameter, first, second, 1e-3, early), None, gradient, 3)
