"""The CUDA loss without a GPU: its own kernels, run on the processor by a stand-in driver, against the reference."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.cuda_on_host import HostDriver, barriers_of, build_on_host, needs_a_compiler, needs_nvrtc
from support.loss_scenes import scene, with_gradient
from vdgs.kernels.cuda import compile_cache
from vdgs.kernels.cuda import loss as cuda
from vdgs.kernels.cuda.driver import CudaUnavailable, get_cuda_driver
from vdgs.kernels.cuda.launch import CudaProgram, read_source
from vdgs.kernels.torch_ref import loss as reference

pytestmark = [needs_nvrtc, pytest.mark.usefixtures("not_for_a_card"), pytest.mark.xdist_group("cuda_loss")]

SIZES = [(1, 1), (3, 2), (16, 16), (17, 33), (37, 50), (64, 31)]


@pytest.fixture(scope="module")
def library(compiled_code):
    return build_on_host(compiled_code)


@pytest.fixture
def program(library):
    return CudaProgram(name="loss.cu", driver=HostDriver(library))


def on_host(program: CudaProgram, image, target, mask=None, **options):
    leaf = image.clone().requires_grad_()
    result = cuda.photometric_loss(leaf, target, mask, program=program, **options)
    (gradient,) = torch.autograd.grad(result.loss, leaf)
    return result, gradient


def test_the_window_is_that_of_the_reference():
    text = read_source("loss.cu").split("kWindow[kTaps] = {")[1].split("}")[0]
    weights = [float(each.strip().rstrip("f")) for each in text.split(",")]
    assert np.array_equal(np.float32(weights), reference.gaussian_window(torch.float32).numpy())


@needs_a_compiler
@pytest.mark.parametrize("kept", [None, 0.7, 0.02])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_it_equals_the_reference(height, width, kept, program):
    image, target, mask = scene(height, width, kept=kept)
    truth, truth_gradient = with_gradient(reference, image.double(), target, mask, ssim_weight=0.3)
    result, gradient = on_host(program, image, target, mask, ssim_weight=0.3)
    for value, expected in zip(result, truth, strict=True):
        assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=1e-6)
    scale = float(truth_gradient.abs().max()) + 1e-12
    assert float((gradient - truth_gradient).abs().max()) < 1e-4 * scale
    assert float((gradient - truth_gradient).abs().max()) < 1e-5


@needs_a_compiler
def test_without_autograd_it_is_the_same_to_the_bit(program):
    image, target, mask = scene(17, 33, kept=0.7)
    result, gradient = on_host(program, image, target, mask)
    found, same_gradient = cuda.photometric_loss_vjp(image, target, mask, program=program)
    assert torch.equal(gradient, same_gradient)
    assert all(torch.equal(one.detach(), other) for one, other in zip(result, found, strict=True))


@needs_a_compiler
def test_no_barrier_is_missing(program, library):
    """The order in which the threads of a block take turns changes no bit."""
    image, target, mask = scene(40, 35, kept=0.8)
    result, gradient = on_host(program, image, target, mask)
    turned = CudaProgram(name="loss.cu", driver=HostDriver(library, order=1))
    again, gradient_again = on_host(turned, image, target, mask)
    assert torch.equal(gradient, gradient_again)
    assert [float(value.detach()) for value in result] == [float(value.detach()) for value in again]


@needs_a_compiler
@pytest.mark.parametrize("barrier", barriers_of("loss"))
def test_a_missing_barrier_would_be_noticed(barrier, library):
    """And every barrier is needed: without any one of them the order of turns changes the result."""
    image, target, _ = scene(18, 17)

    def loss_and_gradient(order: int) -> tuple[float, bytes]:
        driver = HostDriver(library, order, left_out=barrier)
        result, gradient = on_host(CudaProgram(name="loss.cu", driver=driver), image, target)
        return float(result.loss.detach()), gradient.numpy().tobytes()

    assert loss_and_gradient(0) != loss_and_gradient(1)


@needs_a_compiler
def test_kernels_are_compiled_and_loaded_once_and_launched_over_every_tile(program, monkeypatch, tmp_path):
    monkeypatch.undo()  # compiled for a card here
    monkeypatch.setenv(compile_cache.CUDA_CACHE_ENV_VAR, str(tmp_path))
    image, target, _ = scene(33, 50)
    for _ in range(2):
        on_host(program, image, target)
    driver = program.driver
    assert len(driver.loaded) == 1
    assert driver.loaded[0][:4] == b"\x7fELF"
    block = (16, 16, 1)
    assert driver.launched[:3] == [
        ("photometric_forward", (4, 3, 1), block),
        ("photometric_total", (1, 1, 1), block),
        ("photometric_backward", (4, 3, 1), block),
    ]
    cuda.photometric_loss(image, target, program=program)
    assert [name for name, *_ in driver.launched[6:]] == ["photometric_forward", "photometric_total"]


@needs_a_compiler
class TestMeaning:
    def test_nothing_kept_means_no_loss_and_no_gradient(self, program):
        image, target, _ = scene(12, 17)
        result, gradient = on_host(program, image, target, torch.zeros(12, 17, dtype=torch.uint8))
        assert [float(value.detach()) for value in result] == [0.0, 0.0, 1.0]
        assert torch.all(gradient == 0)

    def test_what_lies_under_the_mask_is_without_effect(self, program):
        image, target, mask = scene(40, 30, kept=0.6)
        other = torch.where(mask[..., None] != 0, image, torch.full_like(image, torch.nan))
        result, gradient = on_host(program, image, target, mask)
        again, gradient_again = on_host(program, other, target, mask)
        assert float(result.loss.detach()) == float(again.loss.detach())
        assert torch.equal(gradient, gradient_again)

    def test_a_value_that_is_not_finite_is_reported(self, program):
        image, target, _ = scene(30, 30)
        image[3, 4, 1] = torch.nan
        assert not torch.isfinite(on_host(program, image, target)[0].loss)

    def test_strided_inputs_and_weights_of_the_loss(self, program):
        image, target, mask = (tensor.transpose(0, 1) for tensor in scene(24, 18, kept=0.7))
        leaf = image.clone().requires_grad_()
        (3 * cuda.photometric_loss(leaf, target, mask, program=program).loss).backward()
        _, gradient = with_gradient(reference, image, target, mask)
        torch.testing.assert_close(leaf.grad, 3 * gradient, rtol=1e-3, atol=1e-6)

    def test_unsuitable_inputs_are_refused(self, program):
        image, target, mask = scene(8, 9, kept=0.5)
        with pytest.raises(TypeError, match="float32"):
            cuda.photometric_loss(image.double(), target, program=program)
        with pytest.raises(TypeError, match="mask"):
            cuda.photometric_loss(image, target, mask.float(), program=program)


def test_tensors_in_main_memory_never_reach_a_card():
    image, target, _ = scene(8, 9)
    with pytest.raises((TypeError, CudaUnavailable)):
        cuda.photometric_loss(image, target)


@pytest.mark.gpu
@pytest.mark.parametrize("kept", [None, 0.7, 0.02])
@pytest.mark.parametrize(("height", "width"), [*SIZES, (300, 401)])
def test_a_card_gives_what_the_reference_gives(height, width, kept):
    get_cuda_driver()
    image, target, mask = scene(height, width, kept=kept)
    there = [None if tensor is None else tensor.cuda() for tensor in (image, target, mask)]
    truth, truth_gradient = with_gradient(reference, image.double(), target, mask)
    result, gradient = with_gradient(cuda, *there)
    again, gradient_again = with_gradient(cuda, *there)
    for value, expected in zip(result, truth, strict=True):
        assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=2e-6)
    scale = float(truth_gradient.abs().max()) + 1e-12
    assert float((gradient.cpu() - truth_gradient).abs().max()) < 1e-4 * scale
    assert torch.equal(gradient, gradient_again)
    assert float(result.loss.detach()) == float(again.loss.detach())
