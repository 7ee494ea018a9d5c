"""Adam on rows: equal to torch's where all rows are given, silent on the others."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from native_choice import every_instruction_set, on_threads, using
from vdgs.kernels.native import adam as native
from vdgs.kernels.reference import adam as reference
from vdgs.training.optimiser import rebuild

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
    optimiser = torch.optim.Adam([peer], lr=0.01, eps=1e-15)
    first, second = torch.zeros_like(parameter), torch.zeros_like(parameter)
    for step in range(1, 8):
        gradient = torch.randn(37, 3, generator=generator) * 10.0 ** (step % 3 - 2)
        peer.grad = gradient.clone()
        optimiser.step()
        rows = None if step % 2 else torch.arange(37)
        assert implementation.adam_rows(parameter, rows, gradient, first, second, learning_rate=0.01, step=step)
        torch.testing.assert_close(parameter, peer.detach(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(first, optimiser.state[peer]["exp_avg"])
    torch.testing.assert_close(second, optimiser.state[peer]["exp_avg_sq"])


@BOTH
def test_rows_that_are_not_given_keep_parameters_and_moments(implementation):
    parameter, gradient, first, second = state(50, 10, 3)
    rows = some_rows(50, 0.4)
    before = [tensor.clone() for tensor in (parameter, first, second)]
    implementation.adam_rows(parameter, rows, gradient[rows], first, second, learning_rate=0.1, step=9)
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
        implementation.adam_rows(
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


@every_instruction_set
def test_same_bits_for_any_number_of_threads(instructions):
    rows, results = some_rows(20_000, 0.6), []
    with using(instructions):
        for threads in (1, 2, 3):
            with on_threads(threads):
                parameter, gradient, first, second = state(20_000, 7)
                native.adam_rows(parameter, rows, gradient[rows], first, second, learning_rate=0.1, step=3)
                results.append((parameter, first, second))
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))
    parameter, gradient, first, second = state(20_000, 7)
    reference.adam_rows(parameter, rows, gradient[rows], first, second, learning_rate=0.1, step=3)
    for value, expected in zip(results[0], (parameter, first, second), strict=True):
        torch.testing.assert_close(value, expected, rtol=2e-6, atol=2e-6)


@BOTH
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("place", [(0, 0), (9_999, 4), (5_001, 2)])
def test_a_gradient_that_is_not_finite_changes_nothing(implementation, bad, place):
    parameter, gradient, first, second = state(10_000, 5)
    gradient[place] = bad
    before = [tensor.clone() for tensor in (parameter, first, second)]
    finite = implementation.adam_rows(parameter, None, gradient, first, second, learning_rate=0.1, step=1)
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
        implementation.adam_rows(parameter, torch.tensor(rows), gradient[:2], first, second, learning_rate=0.1, step=1)
    assert all(torch.equal(a, b) for a, b in zip((parameter, first, second), before, strict=True))


@BOTH
def test_zero_gradients_of_fresh_rows_change_nothing(implementation):
    parameter = torch.randn(5, 3)
    before, zeros = parameter.clone(), torch.zeros(5, 3)
    assert implementation.adam_rows(parameter, None, zeros, zeros.clone(), zeros.clone(), learning_rate=1.0, step=1)
    assert torch.equal(parameter, before)


@BOTH
def test_no_rows_is_a_step_of_nothing(implementation):
    parameter, gradient, first, second = state(4, 3)
    before = parameter.clone()
    none = torch.zeros(0, dtype=torch.int64)
    assert implementation.adam_rows(parameter, none, gradient[:0], first, second, learning_rate=0.1, step=1)
    assert torch.equal(parameter, before)
    empty = torch.zeros(0, 3)
    assert implementation.adam_rows(empty, None, empty, empty, empty, learning_rate=0.1, step=1)


@BOTH
def test_a_parameter_that_asks_for_gradients_is_updated_in_place(implementation):
    parameter, gradient, first, second = state(6, 3)
    leaf = parameter.requires_grad_()
    used = (leaf * leaf).sum()
    before = leaf.detach().clone()
    implementation.adam_rows(leaf, None, gradient, first, second, learning_rate=0.1, step=1)
    assert torch.all(leaf.detach() != before)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        used.backward()


@BOTH
def test_a_strided_gradient_is_read_as_it_is(implementation):
    results = []
    for prepare in (lambda g: g.t().contiguous().t(), lambda g: g):
        parameter, gradient, first, second = state(30, 8)
        implementation.adam_rows(parameter, None, prepare(gradient), first, second, learning_rate=0.1, step=2)
        results.append(parameter)
    assert torch.equal(*results)


@BOTH
def test_unsuitable_arguments_are_refused(implementation):
    parameter, gradient, first, second = state(6, 3)

    def step(p=parameter, rows=None, g=gradient, m=first, v=second, **changes):
        implementation.adam_rows(p, rows, g, m, v, **({"learning_rate": 0.1, "step": 1} | changes))

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


@pytest.mark.parametrize("pruned", [0, 3])
@pytest.mark.parametrize("added", [0, 4])
def test_rebuilding_keeps_rows_of_old_and_new_and_lets_old_tensors_go(pruned, added):
    generator = torch.Generator().manual_seed(pruned + added)
    before = {"a": torch.randn(10, 2, 3, generator=generator), "b": torch.randn(10, generator=generator)}
    more = {name: torch.randn(added, *t.shape[1:], generator=generator) for name, t in before.items()}
    kept = torch.ones(10 + added, dtype=torch.bool)
    kept[torch.randperm(10 + added, generator=generator)[:pruned]] = False
    order = torch.randperm(10 + added, generator=generator)
    for rows in (kept, order):
        tensors = dict(before)
        rebuild(tensors, more, rows)
        for name, tensor in tensors.items():
            assert torch.equal(tensor, torch.cat([before[name], more[name]])[rows])
