"""Adam on whole small tensors: its CUDA kernel, run on the processor by a stand-in driver, and the native set, against
the reference."""

from __future__ import annotations

from functools import partial

import pytest
import torch

from support.cuda_on_host import ORDERS, HostDriver, barriers_of, build_on_host, needs_a_compiler, needs_nvrtc
from vdgs.kernels import cpu, torch_ref
from vdgs.kernels.cuda.adam import MAX_TENSORS, PROGRAM, adam_tensors
from vdgs.kernels.cuda.launch import CudaProgram
from vdgs.kernels.kernel_types import AdamState

pytestmark = [needs_nvrtc, pytest.mark.usefixtures("not_for_a_card")]
SHAPES = [(32, 35), (32,), (10, 32), (1,), (300, 12), *((3, i + 1) for i in range(MAX_TENSORS))]


def moved(implementation, device: str = "cpu", broken: int | None = None, steps: int = 3):
    """Whether all was finite, and all tensors after some steps; one gradient may hold a NaN at its end."""
    g = torch.Generator().manual_seed(0)
    states = [
        AdamState(
            *(t.to(device) for t in (torch.randn(s, generator=g), torch.zeros(s), torch.zeros(s))), 1e-2 * (1 + i % 3)
        )
        for i, s in enumerate(SHAPES)
    ]
    finite = []
    for step in range(1, steps + 1):
        gradients = [torch.randn(s, generator=g).to(device) for s in SHAPES]
        if broken is not None:
            gradients[broken].view(-1)[-1] = torch.nan
        finite.append(bool(implementation(states, gradients, step)))
    return finite, [tensor.cpu() for state in states for tensor in state[:3]]


def on_host(folder, order: int = 0, left_out: int = -1):
    driver = HostDriver(build_on_host(folder), order, left_out=left_out)
    return partial(adam_tensors, program=CudaProgram(name=PROGRAM.name, driver=driver))


def assert_all_close(found, expected):
    assert found[0] == expected[0]
    for one, other in zip(found[1], expected[1], strict=True):
        torch.testing.assert_close(one, other, rtol=3e-6, atol=3e-6)


@needs_a_compiler
@pytest.mark.parametrize("broken", [None, 4, len(SHAPES) - 1])
def test_it_equals_the_reference_and_leaves_a_tensor_whose_gradient_is_not_finite(broken, compiled_code):
    expected = moved(torch_ref.adam_tensors, broken=broken)
    assert expected[0] == [broken is None] * 3
    assert_all_close(moved(on_host(compiled_code), broken=broken), expected)
    assert_all_close(moved(cpu.adam_tensors, broken=broken), expected)


@needs_a_compiler
def test_its_barrier_is_needed_and_the_order_of_turns_changes_no_bit(compiled_code):
    def results(left_out: int) -> set[bytes]:
        found = (moved(on_host(compiled_code, order, left_out), broken=0)[1] for order in ORDERS)
        return {b"".join(tensor.numpy().tobytes() for tensor in tensors) for tensors in found}

    (barrier,) = barriers_of("adam")
    whole = results(-1)
    assert len(whole) == 1
    assert results(barrier) != whole


def test_tensors_that_do_not_fit_are_refused(compiled_code):
    parameter = torch.zeros(4, 3)
    state = AdamState(parameter, torch.zeros(4, 3), torch.zeros(4, 3), 0.1)
    with pytest.raises(ValueError, match="gradient"):
        on_host(compiled_code)([state], [torch.zeros(4, 2)], 1)
    with pytest.raises(ValueError, match="contiguous"):
        on_host(compiled_code)([state._replace(parameter=torch.zeros(3, 4).t())], [torch.zeros(4, 3)], 1)
    assert on_host(compiled_code)([], [], 1) is True


@pytest.mark.gpu
def test_a_card_gives_what_the_reference_gives():
    for broken in (None, 4):
        assert_all_close(moved(adam_tensors, "cuda", broken), moved(torch_ref.adam_tensors, broken=broken))
