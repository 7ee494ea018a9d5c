"""Growth's statistics: the native sums equal the twin's, for any number of threads."""

import inspect

import pytest
import torch

import vdgs.kernels.cpu.statistics as native
import vdgs.kernels.torch_ref.statistics as reference
from support.decode_scenes import view_statistics
from support.instruction_sets import every_instruction_set, on_threads, using
from vdgs.kernels.kernel_types import DensificationStats


@every_instruction_set
@pytest.mark.parametrize("seed", [0, 1])
def test_native_equals_twin(instructions, seed):
    inputs, sums = view_statistics(seed)
    expected = [s.clone() for s in sums]
    reference.add_view_statistics(DensificationStats(*expected), *inputs)
    results = []
    for threads in (1, 2, 3):
        ours = [s.clone() for s in sums]
        with using(instructions), on_threads(threads):
            native.add_view_statistics(DensificationStats(*ours), *inputs)
        results.append(ours)
    for ours in results:
        for mine, twin, first in zip(ours, expected, results[0], strict=True):
            torch.testing.assert_close(mine, twin)
            assert torch.equal(mine, first)


@pytest.mark.parametrize("room", [native, reference])
def test_nothing_drawn_counts_only_the_visible_that_are_inside(room):
    sums = [torch.zeros(4, 3), torch.zeros(4, 3), torch.zeros(4), torch.zeros(4)]
    nothing = torch.zeros(0, dtype=torch.int32)
    visible, inside = torch.tensor([0, 1, 3]), torch.tensor([True, False, True])
    room.add_view_statistics(
        DensificationStats(*sums), visible, inside, nothing, torch.zeros(0), torch.zeros(0, 2), 8, 8
    )
    assert not any(bool(s.any()) for s in sums[:3])
    assert sums[3].tolist() == [1, 0, 0, 1]


@pytest.mark.parametrize("room", [native, reference])
def test_a_source_beyond_the_visible_is_refused(room):
    sums = [torch.zeros(4, 3), torch.zeros(4, 3), torch.zeros(4), torch.zeros(4)]
    source = torch.tensor([0, 6], dtype=torch.int32)
    with pytest.raises(IndexError):
        room.add_view_statistics(
            DensificationStats(*sums), torch.tensor([1, 3]), torch.ones(2, dtype=torch.bool), source, torch.zeros(2),
            torch.zeros(2, 2), 8, 8,
        )  # fmt: skip
    assert float(sums[3].sum()) == 0


@pytest.mark.parametrize("room", [native, reference])
def test_a_mask_that_does_not_fit_is_refused(room):
    sums = [torch.zeros(4, 3), torch.zeros(4, 3), torch.zeros(4), torch.zeros(4)]
    nothing = torch.zeros(0, dtype=torch.int32)
    for inside in (torch.ones(3, dtype=torch.bool), torch.ones(2)):
        with pytest.raises((ValueError, TypeError), match="inside"):
            room.add_view_statistics(
                DensificationStats(*sums),
                torch.tensor([1, 3]),
                inside,
                nothing,
                torch.zeros(0),
                torch.zeros(0, 2),
                8,
                8,
            )
    assert float(sums[3].sum()) == 0


@pytest.mark.parametrize("room", [native, reference])
@pytest.mark.parametrize("short", ["opacities", "gradient_px", "drawn", "opacity", "seen"])
def test_what_belongs_to_fewer_splats_or_anchors_is_refused(room, short):
    """The kernel does not look again: it would read or write beyond the end."""
    sums = DensificationStats.zeros(4, 3)
    if short in sums.tensors():
        object.__setattr__(sums, short, getattr(sums, short)[:2])  # without the run-time types of the tests
    given = {"opacities": torch.ones(3), "gradient_px": torch.ones(3, 2)}
    given = {name: tensor[:2] if name == short else tensor for name, tensor in given.items()}
    with pytest.raises(ValueError, match=f"{short} must be"):
        inspect.unwrap(room.add_view_statistics)(
            sums, torch.tensor([1, 3]), torch.ones(2, dtype=torch.bool), torch.tensor([0, 1, 5], dtype=torch.int32),
            **given, width=8, height=8,
        )  # fmt: skip
    assert not any(bool(each.any()) for each in sums.tensors().values())
