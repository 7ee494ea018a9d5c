"""Block training: what is frozen keeps its bits, and a block of everything is the scene."""

from dataclasses import replace

import pytest
import shapely
import torch

from support.block_training import BLOCKS, CONFIG, block_stage, coarse
from support.checkerboard import Photographs
from vdgs.config.method import (
    BlockConfig,
    CompensationConfig,
    DensifyConfig,
    MethodConfig,
    block_train_config,
    scaled_growth_start,
)
from vdgs.config.presets import PRESETS
from vdgs.model.anchors import Anchors
from vdgs.model.renderer import cull_anchors
from vdgs.partition.block_regions import growth_mask, lr_ramp, split_trainable_anchors, visible_anchors
from vdgs.partition.blocks import Block, Blocks, xy_positions
from vdgs.training import (
    FrozenAnchors,
    TrainingProblem,
    TrainingState,
    from_checkpoint,
    initial_state,
    to_checkpoint,
    train,
    views_in_cycle,
)

pytestmark = pytest.mark.slow


def finish(stage: TrainingProblem, state: TrainingState, until: int = 1000) -> TrainingState:
    train(state, stage, stop=lambda: state.iteration >= until, after_step=lambda *_: None)
    return state


def rows_of(anchors: Anchors) -> dict[bytes, bytes]:
    """All that an anchor holds, by its position."""
    return {
        position.numpy().tobytes(): b"".join(t[i].numpy().tobytes() for t in anchors.tensors().values())
        for i, position in enumerate(anchors.positions)
    }


@pytest.fixture(scope="module")
def finished():
    """What a block, its surroundings and their decoder were before it was trained; its stage, and what it is then."""
    stage, state = block_stage(BlockConfig())
    decoder = {name: tensor.clone() for name, tensor in state.decoder.tensors().items()}
    before = rows_of(state.anchors), rows_of(stage.frozen_anchors.anchors), decoder
    return before, stage, finish(stage, state)


def test_ring_context_and_decoder_keep_their_bits(finished):
    (own, around, decoder), stage, state = finished
    assert rows_of(stage.frozen_anchors.anchors) == around
    assert all(torch.equal(tensor, decoder[name]) for name, tensor in state.decoder.tensors().items())
    after = rows_of(state.anchors)
    assert sum(after.get(position) != row for position, row in own.items()) > 0.5 * len(own)


def test_a_block_with_a_decoder_of_its_own_leaves_the_surroundings_theirs():
    stage, state = block_stage(BlockConfig())
    shared = state.decoder
    before = {name: tensor.clone() for name, tensor in shared.tensors().items()}
    stage = replace(stage, frozen_decoder=False)
    own = initial_state(state.anchors, shared.copy(), stage)
    finish(stage, own)
    assert all(torch.equal(tensor, before[name]) for name, tensor in shared.tensors().items())
    assert stage.frozen_anchors.decoder is shared
    moved = [not torch.equal(tensor, before[name]) for name, tensor in own.decoder.tensors().items()]
    assert all(moved)


def test_new_anchors_stand_in_the_core(finished):
    (own, *_), _, state = finished
    assert len(state.anchors) > len(own)
    assert (BLOCKS.owner(xy_positions(state.anchors.positions)) == 0).all()


def test_every_anchor_is_own_or_around_and_only_what_cameras_draw_is_held():
    anchors, _ = coarse()
    own, around = split_trainable_anchors(anchors, BLOCKS, 0, BlockConfig())
    assert torch.equal(own, ~around)
    cameras = Photographs().cameras
    drawn = visible_anchors(anchors, cameras)
    for camera in cameras:
        assert drawn[cull_anchors(anchors, camera)].all()
    far = replace(anchors, positions=anchors.positions + 100)
    assert not visible_anchors(far, cameras).any()


def test_without_context_only_the_ring_is_drawn():
    anchors, _ = coarse()
    _, around = split_trainable_anchors(anchors, BLOCKS, 0, BlockConfig(draw_outside=False))
    x = anchors.positions[around, 0]
    assert len(x) > 0
    assert float(x.min()) >= 0
    assert float(x.max()) <= 1


def test_a_free_ring_moves_and_a_ramp_moves_it_less():
    moved = {}
    for ring in ("free", "ramp"):
        stage, state = block_stage(
            BlockConfig(margin=ring), training=replace(CONFIG, densify=DensifyConfig(num_levels=0))
        )
        before = state.anchors.features.clone()
        ring_rows = state.anchors.positions[:, 0] > 0.5  # beyond the middle of the ring
        finish(stage, state, until=10)
        moved[ring] = float((state.anchors.features - before)[ring_rows].abs().mean())
    assert 0 < moved["ramp"] < 0.7 * moved["free"]


def test_the_ramp_falls_from_core_to_boundary():
    mobility = lr_ramp(BLOCKS, 0, BlockConfig(margin="ramp"))
    assert mobility is not None
    at = torch.tensor([[-2.0, 0, 0], [0.25, 0, 0], [0.5, 0, 0], [0.75, 0, 0], [-50, 0, 0]])
    expected = torch.tensor([1.0, 0.75, 0.5, 0.25, 1.0])
    torch.testing.assert_close(mobility(at), expected, atol=0.02, rtol=0)


def test_the_ramp_falls_into_a_hole_as_it_does_outwards():
    """Outskirts lie around a dense center."""
    middle = shapely.Point(0, 0)
    outskirts = Block(middle.buffer(20, 64).difference(middle.buffer(12, 64)),
                      middle.buffer(25, 64).difference(middle.buffer(7, 64)))  # fmt: skip
    mobility = lr_ramp(
        Blocks((outskirts, Block(middle.buffer(12, 64), middle.buffer(14, 64)))), 0, BlockConfig(margin="ramp")
    )
    assert mobility is not None
    at = torch.tensor([[15.0, 0, 0], [10.75, 0, 0], [0, 9.5, 0], [-8.25, 0, 0], [6.5, 0, 0]])
    torch.testing.assert_close(mobility(at), torch.tensor([1.0, 0.75, 0.5, 0.25, 0.0]), atol=0.02, rtol=0)


def test_ground_that_the_block_owns_beyond_its_boundary_moves_in_full():
    bent = shapely.union(shapely.box(-10, -10, 10, -6), shapely.box(-10, -10, -6, 10))
    blocks = Blocks((Block(bent, bent.buffer(1)), Block(shapely.box(20, 20, 30, 30), shapely.box(19, 19, 31, 31))))
    mobility = lr_ramp(blocks, 0, BlockConfig(margin="ramp"))
    assert mobility is not None
    assert mobility(torch.tensor([[9.0, 9.0, 0.0], [0.0, 0.0, 0.0], [-8.0, 5.0, 0.0]])).tolist() == [1.0, 1.0, 1.0]


def test_one_block_without_surroundings_is_plain_training():
    whole = Blocks((Block(shapely.box(-9, -9, 9, 9), shapely.box(-10, -10, 10, 10)),))
    anchors, decoder = coarse()
    own, around = split_trainable_anchors(anchors, whole, 0, BlockConfig())
    assert own.all()
    states = []
    for surroundings, may_hold in (
        (None, None),
        (FrozenAnchors(anchors.select(around), decoder), growth_mask(whole, 0, BlockConfig())),
    ):
        stage = TrainingProblem(
            config=CONFIG, images=Photographs(), num_images=8, voxel_size=0.4, camera_height=5.0, frozen_decoder=True,
            frozen_anchors=surroundings, growth_mask=may_hold,
        )  # fmt: skip
        copied = anchors.select(torch.arange(len(anchors)))
        states.append(finish(stage, initial_state(copied, decoder, stage)))
    assert rows_of(states[0].anchors) == rows_of(states[1].anchors)


def test_a_stopped_and_continued_block_has_the_same_bits(finished):
    *_, unbroken = finished
    stage, state = block_stage(BlockConfig())
    for until in (7, 10, 25):
        finish(stage, state, until)
        state = from_checkpoint(to_checkpoint(state), stage)
    finish(stage, state)
    for name, tensor in to_checkpoint(unbroken).tensors.items():
        assert torch.equal(tensor, to_checkpoint(state).tensors[name]), name


def test_compensation_that_adds_nothing_is_plain_growth_bit_for_bit():
    results = []
    nothing = [replace(CONFIG.compensation, **change) for change in ({"beta_g": 0.0}, {"t_low": 0.0})]
    for compensation in (CompensationConfig(enabled=False), *nothing):
        stage, state = block_stage(BlockConfig(), training=replace(CONFIG, compensation=compensation))
        results.append(rows_of(finish(stage, state).anchors))
    plain, *compensated = results
    assert len(plain) > 170
    assert compensated == [plain, plain]


def test_a_cycle_lasts_from_decision_to_decision():
    stage = TrainingProblem(
        config=replace(CONFIG, densify=DensifyConfig(every=3, stats_start=0, start=6)),
        images=Photographs(),
        num_images=8,
        voxel_size=1,
        camera_height=1,
    )
    assert len(views_in_cycle(6, stage)) == 6  # the first cycle counts since the statistics began
    late = replace(stage, config=replace(CONFIG, densify=DensifyConfig(every=3, stats_start=4, start=6)))
    assert len(views_in_cycle(6, late)) == 2  # the statistics began after the cycle would have
    assert len(views_in_cycle(12, stage)) == 3  # steps 10 to 12, within one epoch, which has no view twice
    assert not {*views_in_cycle(12, stage)} & {*views_in_cycle(15, stage)}


@pytest.mark.parametrize("scale", [0.004, 0.2, 0.25, 0.6, 1.0, 2.0, 2.4])
def test_growth_begins_on_the_same_side_of_a_decision_however_long_a_block_trains(scale: float):
    """Preset `paper` leaves out the decision on which `default` begins."""
    begins = PRESETS["default"].block.densify.start * scale
    starts = [scaled_growth_start(PRESETS[name].block.densify, scale) for name in ("default", "paper")]
    assert starts == [round(begins), round(begins) + 1]


def test_rates_and_growth_restart_and_iterations_scale():
    """The paper prints neither rates nor a start of growth for blocks: those of the coarse stage, unless asked."""
    method = MethodConfig(block=BlockConfig(steps_scaler=0.1))
    config = block_train_config(method, 500)
    assert config.iterations == 5000
    assert (config.densify.stats_start, config.densify.start) == (50, 150)
    assert config.lr == method.training.lr
    damped = block_train_config(replace(method, block=BlockConfig(lr_scale_offsets=0.4, lr_scale_log_scales=0.8)), 500)
    assert damped.lr.offsets == pytest.approx((0.004, 4e-5))
    assert damped.lr.log_scales == pytest.approx((0.0056, 0.0056))
    assert damped.lr.features == method.training.lr.features
    assert block_train_config(replace(method, block=BlockConfig(iterations=0)), 33).iterations == 500
