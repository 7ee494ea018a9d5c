"""The CUDA statistics of growth without a GPU: their own kernel, run on the processor by a stand-in driver, against the
reference."""

from __future__ import annotations

import ctypes
from functools import partial

import pytest
import torch

from support.cuda_on_host import ORDERS, HostDriver, build_on_host, needs_a_compiler, needs_nvrtc
from support.decode_scenes import view_statistics
from vdgs.kernels.cuda.driver import get_cuda_driver
from vdgs.kernels.cuda.launch import CudaProgram, read_source
from vdgs.kernels.cuda.statistics import PROGRAM, add_view_statistics
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.kernels.torch_ref.statistics import add_view_statistics as by_reference

pytestmark = [needs_nvrtc, pytest.mark.usefixtures("not_for_a_card"), pytest.mark.xdist_group("cuda_statistics")]


@pytest.fixture(scope="module")
def library(compiled_code):
    return build_on_host(compiled_code)


def on_host(library: ctypes.CDLL, order: int = 0):
    return partial(
        add_view_statistics,
        program=CudaProgram(name=PROGRAM.name, driver=HostDriver(library, order), headers=PROGRAM.headers),
    )


def added(add, inputs, sums, views: int = 2) -> list[torch.Tensor]:
    """The sums after so many views."""
    sums = [each.clone() for each in sums]
    for _ in range(views):
        add(DensificationStats(*sums), *inputs)
    return sums


@needs_a_compiler
@pytest.mark.parametrize(("n", "k"), [(3000, 7), (40, 1), (40, 32), (1, 10)])
def test_it_equals_the_reference(n, k, library):
    inputs, sums = view_statistics(0, n, k)
    for ours, theirs in zip(added(on_host(library), inputs, sums), added(by_reference, inputs, sums), strict=True):
        torch.testing.assert_close(ours, theirs)


@needs_a_compiler
@pytest.mark.parametrize("order", ORDERS[1:])
def test_the_order_in_which_threads_take_turns_changes_no_bit(order, library):
    inputs, sums = view_statistics(1, 300)
    results = [added(on_host(library, turns), inputs, sums) for turns in (0, order)]
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


def test_there_is_no_barrier_that_could_be_missing():
    """Threads never meet: each sum has one that writes it. In test_cuda_rasterize.py barriers are left out."""
    text = read_source(PROGRAM.name)
    assert "__shared__" not in text
    assert "sync" not in text


@needs_a_compiler
def test_nothing_drawn_counts_only_the_visible_that_are_inside(library):
    sums = [torch.zeros(4, 3), torch.zeros(4, 3), torch.zeros(4), torch.zeros(4)]
    nothing = torch.zeros(0, dtype=torch.int32)
    visible, inside = torch.tensor([0, 1, 3]), torch.tensor([True, False, True])
    on_host(library)(DensificationStats(*sums), visible, inside, nothing, torch.zeros(0), torch.zeros(0, 2), 8, 8)
    assert not any(bool(s.any()) for s in sums[:3])
    assert sums[3].tolist() == [1, 0, 0, 1]
    nobody = torch.zeros(0, dtype=torch.int64)
    on_host(library)(DensificationStats(*sums), nobody, inside[:0], nothing, torch.zeros(0), torch.zeros(0, 2), 8, 8)
    assert sums[3].tolist() == [1, 0, 0, 1]


@needs_a_compiler
class TestRefusals:
    def test_a_source_beyond_the_visible(self, library):
        (visible, inside, source, *rest), sums = view_statistics(0, 40)
        source[-1] = len(visible) * 7
        with pytest.raises(IndexError):
            on_host(library)(DensificationStats(*sums), visible, inside, source, *rest)

    def test_a_mask_that_does_not_fit(self, library):
        (visible, inside, *rest), sums = view_statistics(0, 40)
        with pytest.raises((ValueError, TypeError), match="inside"):
            on_host(library)(DensificationStats(*sums), visible, inside[1:], *rest)

    def test_splats_that_are_not_as_many_as_sources(self, library):
        (visible, inside, source, opacities, gradient_px, *size), sums = view_statistics(0, 40)
        with pytest.raises((ValueError, TypeError), match="opacities"):
            on_host(library)(DensificationStats(*sums), visible, inside, source, opacities[1:], gradient_px, *size)

    def test_other_types(self, library):
        (visible, inside, source, opacities, *rest), sums = view_statistics(0, 40)
        with pytest.raises(TypeError, match="opacities must be float32"):
            on_host(library)(DensificationStats(*sums), visible, inside, source, opacities.double(), *rest)
        with pytest.raises(TypeError, match="source"):
            on_host(library)(DensificationStats(*sums), visible, inside, source.long(), opacities, *rest)


@pytest.mark.gpu
def test_a_card_gives_what_the_reference_gives():
    get_cuda_driver()
    inputs, sums = view_statistics(0)
    there = [t.cuda() if isinstance(t, torch.Tensor) else t for t in inputs]
    found = added(add_view_statistics, there, [s.cuda() for s in sums])
    for ours, theirs in zip(found, added(by_reference, inputs, sums), strict=True):
        torch.testing.assert_close(ours.cpu(), theirs)
