"""Cells and Morton order: the native hash against sorting in torch."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.instruction_sets import every_instruction_set, on_threads, using
from vdgs.kernels.cpu import cells as native
from vdgs.kernels.torch_ref import cells as reference

BOTH = pytest.mark.parametrize("implementation", [reference, native])
KEYS = st.lists(
    st.one_of(st.integers(-3, 3), st.integers(-(2**63), 2**63 - 1), st.integers(2**40, 2**40 + 20)),
    max_size=200,
).map(lambda values: torch.tensor(values, dtype=torch.int64))


def cloud(n: int, seed: int = 0, dtype=torch.float32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, 3, generator=generator, dtype=dtype) * torch.tensor([100.0, 80.0, 5.0])


@BOTH
def test_a_cell_holds_its_positions_and_its_center(implementation):
    positions, origin = cloud(2_000, dtype=torch.float64), torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64)
    keys = implementation.cell_keys(positions, 0.7, origin)
    centers = implementation.cell_centers(keys, 0.7, origin)
    assert torch.all((positions - centers).abs() <= 0.35 + 1e-9)
    assert torch.equal(implementation.cell_keys(centers, 0.7, origin), keys)
    assert torch.all(keys >= 0)


@BOTH
def test_keys_ascend_with_x_then_y_then_z(implementation):
    corners = torch.cartesian_prod(*[torch.tensor([-1.5, -0.5, 0.5, 1.5])] * 3)
    keys = implementation.cell_keys(corners, 1.0, torch.zeros(3))
    assert torch.all(keys[1:] > keys[:-1])


@BOTH
@pytest.mark.parametrize("bad", [2.0**20, -(2.0**20) - 1, torch.nan, torch.inf])
def test_positions_that_do_not_fit_are_refused(implementation, bad):
    positions = torch.zeros(5_000, 3)
    positions[4_321, 1] = bad
    with pytest.raises(ValueError, match="larger cell"):
        implementation.cell_keys(positions, 1.0, torch.zeros(3))
    edge = torch.tensor([[2.0**20 - 1, -(2.0**20), 0.0]])
    assert torch.equal(
        implementation.cell_centers(implementation.cell_keys(edge, 1.0, torch.zeros(3)), 1.0, torch.zeros(3)),
        edge + 0.5,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("cell_size", [0.013, 1.0, 777.0])
def test_native_keys_equal_the_twin(dtype, cell_size):
    positions, origin = cloud(10_000, dtype=dtype), torch.tensor([0.3, 9.0, -4.0], dtype=dtype)
    expected = reference.cell_keys(positions, cell_size, origin)
    assert torch.equal(native.cell_keys(positions, cell_size, origin), expected)


@settings(max_examples=60)
@given(KEYS)
def test_groups_equal_torch_unique(keys):
    expected = torch.unique(keys, return_inverse=True)
    for implementation in (reference, native):
        unique, group = implementation.group_cells(keys)
        assert torch.equal(unique, expected[0])
        assert torch.equal(group, expected[1])


@settings(max_examples=60)
@given(KEYS, KEYS)
def test_contains_equals_membership(table, query):
    held = set(table.tolist())
    expected = [key in held for key in query.tolist()]
    for implementation in (reference, native):
        assert implementation.contains(table, query).tolist() == expected


@settings(max_examples=40)
@given(st.integers(0, 300), st.integers(1, 40), st.integers(1, 50), st.integers(0, 1000))
def test_native_group_max_equals_the_twin(n, d, count, seed):
    generator = torch.Generator().manual_seed(seed)
    group = torch.randint(count, (n,), generator=generator)
    for dtype in (torch.float32, torch.float64):
        values = torch.randn(n, d, generator=generator, dtype=dtype)
        result = native.group_max(values, group, count)
        assert result.dtype == dtype
        assert torch.equal(result, reference.group_max(values, group, count))


@BOTH
def test_group_max_by_hand(implementation):
    values = torch.tensor([[1.0, -5.0], [3.0, -7.0], [-2.0, torch.nan], [-4.0, 1.0]])
    result = implementation.group_max(values, torch.tensor([0, 0, 2, 2]), 4)
    expected = torch.tensor([[3.0, -5.0], [0.0, 0.0], [-2.0, torch.nan], [0.0, 0.0]])
    torch.testing.assert_close(result, expected, rtol=0, atol=0, equal_nan=True)


@BOTH
@pytest.mark.parametrize("bad", [-1, 4])
def test_group_max_refuses_groups_that_do_not_exist(implementation, bad):
    with pytest.raises(IndexError, match="of 4"):
        implementation.group_max(torch.zeros(3, 2), torch.tensor([0, bad, 1]), 4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [1, 2, 1_000, 20_000])
def test_native_morton_order_equals_the_twin(n, dtype):
    positions = cloud(n, dtype=dtype)
    assert torch.equal(native.morton_order(positions), reference.morton_order(positions))


@BOTH
def test_morton_order_is_the_z_curve(implementation):
    corners = torch.cartesian_prod(*[torch.arange(4.0)] * 3)  # x slowest
    order = implementation.morton_order(corners)
    assert sorted(order.tolist()) == list(range(64))
    walked = corners[order]
    assert walked[:8].max() == 1  # the first octant is walked before any other
    assert walked[:3].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@BOTH
def test_morton_order_keeps_the_order_of_equals(implementation):
    assert implementation.morton_order(torch.ones(100, 3)).tolist() == list(range(100))
    flat = torch.zeros(60, 3)
    flat[:, 1] = torch.arange(60) % 2
    assert implementation.morton_order(flat).tolist() == [*range(0, 60, 2), *range(1, 60, 2)]


@BOTH
def test_morton_order_does_not_depend_on_where_the_scene_lies(implementation):
    positions = (cloud(500, dtype=torch.float64) * 64).round() / 64
    moved = positions + torch.tensor([4096.0, -512.0, 64.0])
    assert torch.equal(implementation.morton_order(positions), implementation.morton_order(moved))


@BOTH
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_morton_order_refuses_what_is_not_finite(implementation, bad):
    positions = cloud(3_000)
    positions[2_999, 2] = bad
    with pytest.raises(ValueError, match="finite"):
        implementation.morton_order(positions)


@every_instruction_set
def test_any_instruction_set_and_number_of_threads_give_the_same(instructions):
    positions, origin = cloud(60_000), torch.zeros(3)
    keys = reference.cell_keys(positions, 2.0, origin)
    unique, group = reference.group_cells(keys)
    values = cloud(60_000, seed=1)
    held, best, order = (
        reference.contains(unique[::3], keys),
        reference.group_max(values, group, len(unique)),
        reference.morton_order(positions),
    )
    with using(instructions):
        for threads in (1, 2, 3):
            with on_threads(threads):
                assert torch.equal(native.cell_keys(positions, 2.0, origin), keys)
                assert all(map(torch.equal, native.group_cells(keys), (unique, group)))
                assert torch.equal(native.contains(unique[::3], keys), held)
                assert torch.equal(native.group_max(values, group, len(unique)), best)
                assert torch.equal(native.morton_order(positions), order)


@BOTH
def test_empty_inputs(implementation):
    none = torch.zeros(0, dtype=torch.int64)
    assert implementation.cell_keys(torch.zeros(0, 3), 1.0, torch.zeros(3)).shape == (0,)
    assert [part.shape for part in implementation.group_cells(none)] == [(0,), (0,)]
    assert implementation.contains(none, torch.tensor([1])).tolist() == [False]
    assert implementation.contains(torch.tensor([1]), none).tolist() == []
    assert implementation.group_max(torch.zeros(0, 4), none, 2).tolist() == [[0.0] * 4] * 2
    assert implementation.morton_order(torch.zeros(0, 3)).shape == (0,)


@BOTH
def test_unsuitable_inputs_are_refused(implementation):
    with pytest.raises(TypeError):
        implementation.cell_keys(torch.zeros(2, 3).long(), 1.0, torch.zeros(3))
    with pytest.raises((ValueError, TypeError)):
        implementation.cell_keys(torch.zeros(2, 2), 1.0, torch.zeros(3))
    with pytest.raises(ValueError, match="cell_size"):
        implementation.cell_keys(torch.zeros(2, 3), 0.0, torch.zeros(3))
    with pytest.raises(TypeError):
        implementation.group_cells(torch.zeros(4))
    with pytest.raises(TypeError):
        implementation.contains(torch.zeros(4), torch.zeros(4).long())
    with pytest.raises((ValueError, TypeError)):
        implementation.group_max(torch.zeros(4, 2), torch.zeros(3).long(), 1)
