"""The CUDA decoder without a GPU: its own kernel, run on the processor by a stand-in driver, against the reference."""

from __future__ import annotations

import ctypes
import inspect
from copy import copy
from dataclasses import fields, replace
from functools import partial

import pytest
import torch

from support.block_training import block_stage
from support.cuda_on_host import ORDERS, HostDriver, barriers_of, build_on_host, needs_a_compiler, needs_nvrtc
from support.decode_scenes import Scene, looking_down, moved_by, near, turned
from vdgs.config.method import BlockConfig, LossConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels.cuda.decode import PROGRAM, SplatCapacity, decode, decode_for_training, expand_sources
from vdgs.kernels.cuda.decode_adam import decode_backward_adam
from vdgs.kernels.cuda.driver import get_cuda_driver
from vdgs.kernels.cuda.launch import CudaProgram, PackedCamera, read_header
from vdgs.kernels.kernel_types import AdamState, AnchorSplats, SplatGradients, Splats, TrainingSplats
from vdgs.kernels.splat_segments import SplatMask
from vdgs.kernels.torch_ref.decode import decode as reference
from vdgs.kernels.torch_ref.decode_adam import decode_backward_adam as by_reference
from vdgs.training.target import opacity_factors_at

pytestmark = [needs_nvrtc, pytest.mark.usefixtures("not_for_a_card"), pytest.mark.xdist_group("cuda_decode")]

#: Of the decoder, and of what moves anchors.
*BARRIERS, BARRIER_OF_MOVING = barriers_of("decode")
CAMERAS = {
    "down": looking_down(),
    "turned": turned(),
    "orthographic": near(looking_down("orthographic")),
    "part": near(turned(width=96, height=64).cropped(20, 10, 70, 50)),
}


@pytest.fixture(scope="module")
def library(compiled_code):
    return build_on_host(compiled_code)


def decoded(
    scene: Scene, camera: Camera, library: ctypes.CDLL, rows=None, order: int = 0, left_out: int = -1
) -> AnchorSplats:
    driver = HostDriver(library, order, left_out=left_out)
    program = CudaProgram(name=PROGRAM.name, driver=driver, headers=PROGRAM.headers)
    anchors = scene.positions, scene.features, scene.offsets, scene.log_scales
    with torch.no_grad():
        return decode(*anchors, scene.weights, camera, rows, program=program)


def scattered(scene: Scene, camera: Camera, library: ctypes.CDLL, rows=None, order: int = 0) -> TrainingSplats:
    """As a training step is given them."""
    program = CudaProgram(name=PROGRAM.name, driver=HostDriver(library, order), headers=PROGRAM.headers)
    return decode_for_training(*scene.arguments, camera, rows, program=program)


def put_in_order(splats: TrainingSplats, library: ctypes.CDLL) -> dict[str, torch.Tensor]:
    """All that is known of each splat, in the order of the anchors."""
    order = splats.segments.order(len(splats.source))
    program = CudaProgram(name=PROGRAM.name, driver=HostDriver(library), headers=PROGRAM.headers)
    named = {field.name: getattr(splats, field.name) for field in fields(Splats)}
    named["source"] = expand_sources(splats.source, program=program)
    return {name: tensor[order] for name, tensor in named.items()}


def exactly(scene: Scene, camera: Camera, rows=None) -> AnchorSplats:
    exact = scene.to(torch.float64)
    with torch.no_grad():
        return reference(
            exact.positions.double(), exact.features, exact.offsets, exact.log_scales, exact.weights, camera, rows
        )


def assert_same(found: AnchorSplats, exact: AnchorSplats) -> None:
    assert torch.equal(found.source, exact.source)
    for field in fields(AnchorSplats):
        ours, theirs = getattr(found, field.name), getattr(exact, field.name)
        scale = float(theirs.double().abs().max()) if theirs.numel() else 0.0
        torch.testing.assert_close(ours.double(), theirs.double(), rtol=2e-4, atol=1e-5 * scale, msg=field.name)


@needs_a_compiler
@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize(("k", "with_distance"), [(10, False), (3, True)])
def test_it_equals_the_reference(name, k, with_distance, library):
    scene = Scene.random(40, k, with_distance=with_distance)
    exact = exactly(scene, CAMERAS[name])
    assert 5 < len(exact.source) < 40 * k
    assert_same(decoded(scene, CAMERAS[name], library), exact)


@needs_a_compiler
@pytest.mark.parametrize(("v", "k"), [(1, 1), (9, 32), (0, 10)])
def test_any_number_of_anchors_and_offsets(v, k, library):
    scene = Scene.random(v, k, log_scale=-0.5)
    assert_same(decoded(scene, looking_down(), library), exactly(scene, looking_down()))


@needs_a_compiler
def test_rows_are_read_where_they_stand(library):
    scene, rows = Scene.random(30, 10), torch.tensor([0, 3, 4, 17, 29])
    assert_same(decoded(scene, turned(), library, rows), exactly(scene, turned(), rows))


@needs_a_compiler
@pytest.mark.parametrize("name", ["positions", "features", "offsets", "log_scales"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_what_is_not_finite_spawns_nothing(name, value, library):
    scene = Scene.random(20, 4)
    getattr(scene, name)[7].view(-1)[1] = value
    found = decoded(scene, looking_down(), library)
    assert_same(found, exactly(scene, looking_down()))
    assert all(getattr(found, field.name).isfinite().all() for field in fields(AnchorSplats))


@needs_a_compiler
@pytest.mark.parametrize("order", ORDERS[1:])
def test_the_order_in_which_threads_take_turns_changes_no_bit(order, library):
    one, other = (decoded(Scene.random(21, 10), turned(), library, order=turns) for turns in (0, order))
    assert all(torch.equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(AnchorSplats))


@needs_a_compiler
@pytest.mark.parametrize("order", ORDERS)
def test_for_training_splats_are_the_same_in_another_order(order, library):
    """To the bit; and so is the mean of their volumes, whatever comes first."""
    scene, rows = Scene.random(141, 10), torch.arange(0, 141, 2)
    splats, expected = scattered(scene, turned(), library, rows, order), decoded(scene, turned(), library, rows)
    found = put_in_order(splats, library)
    assert all(torch.equal(tensor, getattr(expected, name)) for name, tensor in found.items())
    in_rows = expand_sources(
        splats.source, program=CudaProgram(name=PROGRAM.name, driver=HostDriver(library), headers=PROGRAM.headers)
    )
    assert torch.equal(in_rows, expected.source) is (order == 0)  # other orders of blocks do give another one
    torch.testing.assert_close(splats.volume, expected.volumes.mean())
    assert torch.equal(splats.volume, scattered(scene, turned(), library, rows).volume)
    again = SplatMask.of(expected.source, len(rows), 10)
    assert torch.equal(again.bits, splats.source.bits)
    assert torch.equal(again.segments.lengths, splats.segments.lengths)


@needs_a_compiler
@pytest.mark.parametrize("order", ORDERS)
def test_the_noise_of_an_opacity_belongs_to_its_splat(order, library):
    """Whichever block comes first: as on the processor, where splats stand in the order of anchors."""
    stage, _ = block_stage(BlockConfig())
    noisy = replace(stage, config=replace(stage.config, loss=LossConfig(opacity_noise=0.3)))
    scene = Scene.random(141, 10)
    splats, ordered = scattered(scene, turned(), library, order=order), decoded(scene, turned(), library)
    found = opacity_factors_at(noisy, 3, splats)
    expected = opacity_factors_at(noisy, 3, TrainingSplats.of(ordered))
    assert torch.equal(found[splats.segments.order(len(splats.source))], expected)


@needs_a_compiler
def test_nothing_to_show_has_no_mean_volume(library):
    nothing = scattered(Scene.random(9, 4, spread=0.1, log_scale=-9.0), CAMERAS["part"].cropped(0, 0, 1, 1), library)
    assert len(nothing.source) == len(nothing.depths) == 0
    assert nothing.volume.isnan()
    assert len(scattered(Scene.random(9, 4), turned(), library, torch.arange(0)).source) == 0


class Narrow(SplatCapacity):
    """As if a view had needed less than the next one."""

    def estimate(self, count, offsets, device):
        return 11


class Watched(CudaProgram):
    """Looks behind the room that a kernel is told of."""

    spare = 500

    def launch(self, kernel, grid, block, *arguments):
        tensors = [each for each in arguments[-7:] if each is not None]
        wider = [torch.full((len(t) + self.spare, *t.shape[1:]), 77, dtype=t.dtype) for t in tensors]
        given = iter(wider)
        super().launch(
            kernel, grid, block, *arguments[:-7], *(None if each is None else next(given) for each in arguments[-7:])
        )
        for tensor, room in zip(tensors, wider, strict=True):
            tensor.copy_(room[: len(tensor)])
            assert (room[len(tensor) :] == 77).all()


@needs_a_compiler
@pytest.mark.parametrize("order", ORDERS)
def test_where_there_is_too_little_room_they_are_decoded_once_more(order, library):
    scene = Scene.random(40, 10)
    program = Watched(name=PROGRAM.name, driver=HostDriver(library, order), headers=PROGRAM.headers)
    with torch.no_grad():
        found = decode(*scene.arguments, turned(), program=program, capacity=Narrow())
    assert [name for name, *_ in program.driver.launched] == ["decode_anchors"] * 2
    expected = decoded(scene, turned(), library)
    assert all(torch.equal(getattr(found, field.name), getattr(expected, field.name)) for field in fields(AnchorSplats))


def test_room_follows_what_views_need():
    room, device = SplatCapacity(), torch.device("cpu")
    assert 5000 < room.estimate(1000, 10, device) < 10_000  # half of the offsets, before any view is known
    assert room.estimate(10, 10, device) == 100  # never more than there are offsets
    room.update(1000, 10, device, 2000)
    once = room.estimate(1000, 10, device)
    assert 2000 < once < 3000
    room.update(1000, 10, device, 1000)
    assert 2000 < room.estimate(1000, 10, device) < once  # slowly forgotten
    room.update(500, 10, device, 4000)
    assert 8000 < room.estimate(1000, 10, device) <= 10_000
    assert room.estimate(1000, 4, device) < 4000  # other models have other offsets


@needs_a_compiler
@pytest.mark.parametrize("barrier", BARRIERS)
def test_a_missing_barrier_would_be_noticed(barrier, library):
    """Those of blocks: before splats are added up, and before a block's place is read."""
    found = [decoded(Scene.random(61, 10), turned(), library, order=turns, left_out=barrier) for turns in (0, 1)]
    assert not all(torch.equal(*(getattr(each, field.name) for each in found)) for field in fields(AnchorSplats))


@needs_a_compiler
def test_where_autograd_follows_the_reference_decodes(library):
    scene = Scene.random(10, 4).to(torch.float32)
    program = CudaProgram(name=PROGRAM.name, driver=HostDriver(library), headers=PROGRAM.headers)
    anchors = scene.positions, scene.features, scene.offsets, scene.log_scales
    splats = decode(*anchors, scene.weights, turned(), program=program)
    assert splats.opacities.requires_grad
    assert program.driver.launched == []


def test_unsuitable_anchors_are_refused():
    for scene, error in ((Scene.random(2, 33), ValueError), (Scene.random(2, 4).to(torch.float64), TypeError)):
        with pytest.raises(error), torch.no_grad():
            decode(scene.positions, scene.features, scene.offsets, scene.log_scales, scene.weights, turned())


@pytest.mark.parametrize(
    "change",
    [
        lambda scene: replace(scene, features=scene.features[:, :31]),
        lambda scene: replace(scene, offsets=scene.offsets[:3]),
        lambda scene: replace(scene, log_scales=scene.log_scales[:, :5]),
        lambda scene: replace(scene, weights=Scene.random(1, k=9).weights),
    ],
)
def test_shapes_that_do_not_belong_together_are_refused(change):
    """A kernel does not look again: it would read beyond the end."""
    wrong = change(Scene.random(4, 4))
    with pytest.raises(ValueError, match="must be"), torch.no_grad():
        inspect.unwrap(decode)(
            wrong.positions, wrong.features, wrong.offsets, wrong.log_scales, wrong.weights, turned()
        )


def test_more_offsets_than_can_be_numbered_are_refused():
    scene = Scene.random(1, k=32)
    many = [each.expand(2**26, *each.shape[1:]) for each in scene.arguments[:4]]
    with pytest.raises(ValueError, match=r"at most 2.31 - 1 offsets"), torch.no_grad():
        decode(*many, scene.weights, turned())


def test_rows_of_another_type_are_refused():
    scene = Scene.random(4, 4)
    with pytest.raises(TypeError, match="rows must be int64"), torch.no_grad():
        inspect.unwrap(decode)(
            scene.positions, scene.features, scene.offsets, scene.log_scales, scene.weights, turned(),
            torch.arange(4, dtype=torch.int32),
        )  # fmt: skip


def test_the_camera_is_laid_out_as_the_header_says():
    """Field by field, in the header's own order."""
    text = read_header("gaussian_math.h").split("struct Camera {")[1].split("};")[0]
    named = [name for line in text.splitlines() if ";" in line for name in _names(line.split("//")[0])]
    assert named == [name for name, _ in PackedCamera._fields_]


def _names(declaration: str) -> list[str]:
    return [each.strip().split()[-1] for each in declaration.strip().rstrip(";").split(",")]


@pytest.mark.gpu
@pytest.mark.parametrize("name", CAMERAS)
def test_a_card_gives_what_the_reference_gives(name):
    get_cuda_driver()
    scene = Scene.random(500, 10)
    weights = scene.weights.map(lambda t: t.cuda())
    anchors = (t.cuda() for t in (scene.positions, scene.features, scene.offsets, scene.log_scales))
    with torch.no_grad():
        found = decode(*anchors, weights, CAMERAS[name])
    here = AnchorSplats(**{field.name: getattr(found, field.name).cpu() for field in fields(AnchorSplats)})
    assert_same(here, exactly(scene, CAMERAS[name]))


def with_depths(kernels):
    """An operation that moves anchors, where a loss of depths reaches the splats too."""

    def kernel(positions, states, weights, camera, rows, gradients, updates):
        deep = replace(gradients, depths=10 * gradients.opacities)
        return kernels(positions, states, weights, camera, rows, deep, updates)

    return kernel


#: Of a view that shows no splat.
NONE = SplatGradients(
    means_px=torch.zeros(0, 2), conics=torch.zeros(0, 3), colors=torch.zeros(0, 3), opacities=torch.zeros(0),
    volume=0.0, source=torch.zeros(0).int(), color_values=torch.zeros(0, 3), opacity_values=torch.zeros(0),
)  # fmt: skip


def with_a_color(gradients: SplatGradients) -> SplatGradients:
    wrong = copy(gradients)  # without the run-time types of the tests
    object.__setattr__(wrong, "colors", torch.zeros(1, 3))
    return wrong


@needs_a_compiler
class TestMoving:
    @pytest.fixture
    def moving(self, library):
        return partial(
            decode_backward_adam,
            program=CudaProgram(name=PROGRAM.name, driver=HostDriver(library), headers=PROGRAM.headers),
        )

    @pytest.mark.parametrize("name", CAMERAS)
    @pytest.mark.parametrize(("k", "with_distance"), [(10, False), (3, True)])
    @pytest.mark.parametrize("deep", [False, True])
    def test_anchors_move_as_by_the_reference(self, name, k, with_distance, deep, moving):
        scene, rows = Scene.random(45, k, with_distance=with_distance), torch.arange(0, 45, 2)
        ours, theirs = (
            moved_by(with_depths(kernels) if deep else kernels, scene, CAMERAS[name], rows)
            for kernels in (moving, by_reference)
        )
        assert ours[0] is theirs[0] is True
        assert torch.equal(ours[2], theirs[2])
        for found, expected in zip((*ours[1], *ours[3]), (*theirs[1], *theirs[3]), strict=True):
            error = float((found - expected).norm() / expected.norm().clamp(min=1e-6))
            assert error < 1e-4, error

    @pytest.mark.parametrize("order", ORDERS)
    def test_wherever_splats_stand_anchors_move_to_the_same_bits(self, order, library, moving):
        scene, rows = Scene.random(141, 10), torch.arange(0, 141, 2)
        expected = moved_by(moving, scene, turned(), rows)
        shown = scattered(scene, turned(), library, rows, order).source
        found = moved_by(moving, scene, turned(), rows, shown=shown)
        assert found[0] is True
        assert all(torch.equal(one, other) for one, other in zip(found[1], expected[1], strict=True))
        assert all(torch.equal(one, other) for one, other in zip(found[3], expected[3], strict=True))

    def test_the_reference_asks_for_sources(self, library):
        """It does not read what shows as bits."""
        scene, rows = Scene.random(20, 4), torch.arange(20)
        shown = scattered(scene, turned(), library, rows, 1).source
        with pytest.raises(TypeError, match="on that card"):
            moved_by(by_reference, scene, turned(), rows, shown=shown)

    def test_piece_by_piece_anchors_move_to_the_same_bits(self, moving):
        """The decoder's gradients are sums of those of pieces."""
        scene, rows = Scene.random(45, 10), torch.arange(0, 45, 2)
        whole = moved_by(moving, scene, turned(), rows)
        program = moving.keywords["program"]
        program.driver.launched.clear()
        pieces = moved_by(partial(moving, chunk=16), scene, turned(), rows)
        assert [grid for _, grid, _ in program.driver.launched] == [(2, 1, 1), (1, 1, 1)]
        assert all(torch.equal(one, other) for one, other in zip(whole[1], pieces[1], strict=True))
        for one, other in zip(whole[3], pieces[3], strict=True):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6 * float(one.abs().max()))

    def test_what_autograd_has_saved_of_the_anchors_is_no_longer_good(self, moving):
        scene, rows = Scene.random(20, 4), torch.arange(20)
        read = []

        def watched(positions, states, weights, camera, rows, gradients, updates):
            moved = [updates, *(tensor for state in states for tensor in state[:3])]
            before = [tensor._version for tensor in moved]
            answer = moving(positions, states, weights, camera, rows, gradients, updates)
            read.extend(tensor._version > old for tensor, old in zip(moved, before, strict=True))
            return answer

        moved_by(watched, scene, turned(), rows)
        assert read == 10 * [True]

    def test_a_frozen_decoder_costs_nothing(self, moving):
        scene, rows = Scene.random(20, 4), torch.arange(20)
        assert moved_by(moving, scene, turned(), rows, frozen=True)[3] is None

    def test_a_gradient_that_is_no_number_is_told_and_moves_nothing_of_its_anchor(self, moving):
        scene, rows = Scene.random(20, 4), torch.arange(20)
        finite, tensors, updates, _ = moved_by(moving, scene, looking_down(), rows, spoil=True)
        assert not finite
        assert all(tensor.isfinite().all() for tensor in tensors)
        assert int(updates[5]) == 26

    @pytest.mark.parametrize("order", ORDERS[1:])
    def test_the_order_in_which_threads_take_turns_changes_no_bit(self, order, library):
        results = []
        for turns in (0, order):
            program = CudaProgram(name=PROGRAM.name, driver=HostDriver(library, turns), headers=PROGRAM.headers)
            moving = partial(decode_backward_adam, program=program)
            results.append(moved_by(moving, Scene.random(17, 10), turned(), torch.arange(17)))
        assert all(torch.equal(one, other) for one, other in zip(results[0][1], results[1][1], strict=True))
        assert all(torch.equal(one, other) for one, other in zip(results[0][3], results[1][3], strict=True))

    def test_a_missing_barrier_would_be_noticed(self, library):
        """The only one, of warps: it keeps a lane from counting up what others have not read yet."""
        scene, results = Scene.random(9, 4), []
        for turns in (0, 1):
            driver = HostDriver(library, turns, left_out=BARRIER_OF_MOVING)
            program = CudaProgram(name=PROGRAM.name, driver=driver, headers=PROGRAM.headers)
            results.append(moved_by(partial(decode_backward_adam, program=program), scene, turned(), torch.arange(9)))
        assert not all(torch.equal(one, other) for one, other in zip(results[0][1], results[1][1], strict=True))

    def test_states_that_anneal_apart_are_refused(self, moving):
        scene = Scene.random(4, 3)
        states = [AdamState(t, t, t, 0.1, early) for t, early in zip(scene.trainable[:3], (1.0, 2.0, 1.0), strict=True)]
        with pytest.raises(ValueError, match="annealed alike"):
            moving(scene.positions, states, scene.weights, turned(), torch.arange(4), NONE, torch.zeros(4).int())

    @pytest.mark.parametrize(
        ("spoil", "said"),
        [
            (lambda states, none: (states, with_a_color(none)), r"colors must be \[0, 3\]"),
            (lambda states, none: ([states[0]._replace(first=states[0].first[:3]), *states[1:]], none), "of one shape"),
            (lambda states, none: ([states[1], states[1], states[2]], none), r"features must be \[4, 32\]"),
        ],
    )
    def test_shapes_that_do_not_belong_together_are_refused(self, spoil, said, moving):
        scene = Scene.random(4, 3)
        states, gradients = spoil([AdamState(t, t, t, 0.1) for t in scene.trainable[:3]], NONE)
        step = partial(inspect.unwrap(moving.func), **moving.keywords)
        with pytest.raises(ValueError, match=said):
            step(scene.positions, states, scene.weights, turned(), torch.arange(4), gradients, torch.zeros(4).int())
