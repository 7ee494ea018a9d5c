"""Momentum-GS: one block is plain training, blocks share a decoder, what lags weighs more, a stop changes nothing."""

import math
from dataclasses import replace

import pytest
import torch

from experiments.baselines.momentum_gs.blocks import MomentumTraining, restore, set_trainable, turn_length
from experiments.baselines.momentum_gs.guidance import BlockWeights, MomentumConfig, MomentumTeacher
from experiments.baselines.turns import next_in_turn
from support.block_training import BLOCKS, CONFIG, block_stage, coarse
from support.checkerboard import Photographs
from vdgs.config.method import BlockConfig, CompensationConfig
from vdgs.model.decoder import EXPOSURE, Decoder
from vdgs.model.renderer import cull_anchors
from vdgs.training import initial_state, to_checkpoint, train, view_at
from vdgs.training.training_loop import downscale_at

pytestmark = pytest.mark.slow

PLAIN = replace(CONFIG, iterations=24, compensation=CompensationConfig(enabled=False))


def blocks(count: int, config: MomentumConfig) -> MomentumTraining:
    problems, states, decoder = [], [], coarse()[1]
    for index in range(count):
        problem, state = block_stage(BlockConfig(), index, PLAIN)
        problems.append(replace(problem, frozen_decoder=False, kind="block"))
        states.append(initial_state(state.anchors, decoder, problems[-1]))
    return MomentumTraining(states, problems, config)


def finish(training: MomentumTraining, steps: int = 10_000) -> MomentumTraining:
    while training.iteration < steps and training.advance() is not None:
        pass
    return training


def bits(saved) -> dict[str, bytes]:
    return {name: tensor.detach().numpy().tobytes() for name, tensor in saved.tensors.items()}


def test_one_block_without_momentum_is_plain_training():
    training = finish(blocks(1, MomentumConfig(momentum=0.0, weigh_blocks=False)))
    problem, state = block_stage(BlockConfig(), 0, PLAIN)
    problem = replace(problem, frozen_decoder=False, kind="block")
    alone = initial_state(state.anchors, coarse()[1], problem)
    train(alone, problem, stop=lambda: False, after_step=lambda *_: None)
    assert bits(to_checkpoint(training.states[0])) == bits(to_checkpoint(alone))


def test_the_decoder_is_one_and_a_stop_changes_nothing():
    config = MomentumConfig(interval=5)
    whole = finish(blocks(2, config))
    assert whole.states[0].decoder is whole.states[1].decoder
    assert [state.iteration for state in whole.states] == [24, 24]
    assert whole.interval == 2
    half = finish(blocks(2, config), steps=21)
    again = restore(half.to_checkpoint(), [replace(each, guidance=None) for each in half._problems], config)
    assert again.states[0].decoder is again.states[1].decoder
    assert bits(finish(again).to_checkpoint()) == bits(whole.to_checkpoint())
    own = BLOCKS.owner(whole.states[1].anchors.positions[:, :2].double().numpy())
    assert (own == 1).all()


def test_in_the_last_round_the_others_take_the_decoder_as_it_is():
    training = finish(blocks(2, MomentumConfig()), steps=46)
    assert [state.iteration for state in training.states] == [24, 22]
    before = {name: tensor.clone() for name, tensor in training.decoder.tensors().items()}
    finish(training)
    assert all(torch.equal(tensor, before[name]) for name, tensor in training.decoder.tensors().items())


def test_a_turn_moves_the_heads_and_nothing_that_all_blocks_share():
    decoder = replace(coarse()[1].copy(), exposure=torch.zeros(2, 3, 4), envmap=torch.zeros(4, 8, 3))
    set_trainable(decoder, replace(block_stage(BlockConfig(), 0, PLAIN)[0], frozen_decoder=False), True)
    assert {name for name, tensor in decoder.tensors().items() if not tensor.requires_grad} == {EXPOSURE, "envmap"}


def test_consistency_pulls_the_student_to_its_teacher():
    anchors, teacher = coarse()
    student = Decoder.init_random(4, False, 0, 8, torch.Generator().manual_seed(5))
    for tensor in student.tensors().values():
        tensor.requires_grad_(True)
    camera = Photographs().cameras[0]
    rows, follower = cull_anchors(anchors, camera), MomentumTeacher(teacher, MomentumConfig(consistency=2.0))
    found = follower.gradients(anchors, rows, student, camera, 1.0)
    assert set(found) == set(student.tensors())
    doubled = follower.gradients(anchors, rows, student, camera, 2.0)
    torch.testing.assert_close(doubled["color_w1"], 2 * found["color_w1"])
    same = MomentumTeacher(student, MomentumConfig()).gradients(anchors, rows, student, camera, 1.0)
    assert all(not tensor.any() for tensor in same.values())
    follower.follow(student)
    expected = 0.9 * teacher.tensors()["color_w1"] + 0.1 * student.tensors()["color_w1"]
    torch.testing.assert_close(follower.decoder.tensors()["color_w1"], expected.detach())


def test_blocks_that_lag_weigh_more():
    weights = BlockWeights(2, MomentumConfig())
    weights.update(0, 25.0, 0.8)
    assert weights.weight(0) == 1.0  # the other is not measured
    weights.update(1, 20.0, 0.7)
    assert weights.weight(0) == 1.0
    assert weights.weight(1) == pytest.approx(2 - math.exp(-(5**2 + 1**2) / 200))


def first_step(config: MomentumConfig, index: int) -> MomentumTraining:
    """Two blocks, the second behind the first, beside a teacher with other heads, after one step of a block. First
    moments are then a tenth of the gradients."""
    training = blocks(2, replace(config, momentum=1.0))
    for tensor in training.teacher.decoder.tensors().values():
        tensor.mul_(0.5)
    training.weights.update(0, 25.0, 0.8)
    training.weights.update(1, 20.0, 0.7)
    training.step(index)
    return training


def test_a_block_that_lags_moves_by_its_weight_times_its_gradients():
    plain, weighed = (
        first_step(MomentumConfig(consistency=0.0, weigh_blocks=weigh), 1).states[1].optimizer
        for weigh in (False, True)
    )
    for alone, more in ((plain.anchors, weighed.anchors), (plain.decoder, weighed.decoder)):
        for name, first in alone.first.items():
            torch.testing.assert_close(more.first[name], (2 - math.exp(-(5**2 + 1**2) / 200)) * first)
    assert plain.anchors.first["features"].any()


def test_a_step_adds_consistency_to_the_gradients_of_the_decoder_alone():
    plain, training = (first_step(MomentumConfig(consistency=c, weigh_blocks=False), 0) for c in (0.0, 50.0))
    before = blocks(1, MomentumConfig()).states[0]
    view = view_at(0, 8, PLAIN.seed)
    camera = Photographs().camera(view, downscale_at(0, PLAIN))
    for tensor in before.decoder.tensors().values():
        tensor.requires_grad_()
    rows = cull_anchors(before.anchors, camera)
    added = training.teacher.gradients(before.anchors, rows, before.decoder, camera, 1.0)
    assert len(added) == 12
    assert all(gradient.any() for gradient in added.values())
    alone, pulled = plain.states[0].optimizer, training.states[0].optimizer
    for name, gradient in added.items():
        torch.testing.assert_close(pulled.decoder.first[name], alone.decoder.first[name] + 0.1 * gradient)
    for name, first in alone.anchors.first.items():
        assert torch.equal(pulled.anchors.first[name], first)


def test_turns_follow_from_the_steps_made():
    assert [next_in_turn(done, 3, 4) for done in ([0, 0], [3, 0], [3, 3], [4, 3], [4, 4])] == [0, 1, 0, 1, None]
    assert turn_length(60_000, MomentumConfig()) == 500
    assert turn_length(5, MomentumConfig()) == 1
