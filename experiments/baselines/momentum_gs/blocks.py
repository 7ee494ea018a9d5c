"""The blocks of Momentum-GS, in turn in one process: all of them train one decoder, which a teacher follows.

Written from the paper, on this project's anchors and block training. Adapted:

- a block moves the anchors of its own cell, among those around it, which the coarse decoder draws; the program gives
  every block the whole coarse scene and keeps its cell;
- consistency moves the decoder alone; in the program also the features of anchors;
- a block is weighed by its training views as it meets them; the program asks views that are held out for it;
- weights act from when every block has been measured to the end; in the program not in the first 1000 iterations, nor
  where the decoder stays as it is;
- turns are shorter where a block makes fewer than `MIN_ROUNDS` of the published ones.

In the last round the first block alone moves the decoder, so that the others end with the one that draws them
(program).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from experiments.baselines.momentum_gs.guidance import BlockGuidance, BlockWeights, MomentumConfig, MomentumTeacher
from experiments.baselines.turns import JointTraining, split_checkpoint
from vdgs.model.decoder import Decoder
from vdgs.system.checkpoints import Checkpoint
from vdgs.training import TrainingProblem, TrainingState, from_checkpoint, to_checkpoint, train_step
from vdgs.training.training_state import SHARED_TENSORS

#: So many turns has each block at least (choice): a decoder that one block kept for long would forget the others.
MIN_ROUNDS = 12


def turn_length(iterations: int, config: MomentumConfig) -> int:
    """Steps of a turn."""
    return max(1, min(config.interval, iterations // MIN_ROUNDS))


class MomentumTraining(JointTraining):
    """All blocks with one decoder, the bits of which their states share."""

    def __init__(
        self, states: Sequence[TrainingState], problems: Sequence[TrainingProblem], config: MomentumConfig
    ) -> None:
        last = problems[0].config.iterations
        super().__init__(states, turn_length(last, config), last)
        self.states, self.decoder = list(states), states[0].decoder
        for state in states:
            state.decoder = self.decoder
        self.teacher, self.weights = MomentumTeacher(self.decoder, config), BlockWeights(len(states), config)
        self._problems = [
            replace(problem, guidance=BlockGuidance(index, self.teacher, self.weights))
            for index, problem in enumerate(problems)
        ]

    def step(self, index: int) -> None:
        state = self.states[index]
        last_round = state.iteration >= (self.last - 1) // self.interval * self.interval
        set_trainable(self.decoder, self._problems[index], not (last_round and index > 0))
        self.teacher.follow(self.decoder)
        report = train_step(state, self._problems[index])
        self.weights.update(index, state.psnr, report.ssim)

    def end_round(self) -> None:
        """The decoder is shared at all times."""

    def block_checkpoint(self, index: int) -> Checkpoint:
        return to_checkpoint(self.states[index])

    def shared(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        measured = {"psnr": [*map(repr, self.weights.psnr)], "ssim": [*map(repr, self.weights.ssim)]}
        return measured, {f"teacher.{name}": tensor for name, tensor in self.teacher.decoder.tensors().items()}

    def facts(self) -> dict[str, Any]:
        return {"weights": [self.weights.weight(index) for index in range(len(self.states))]}

    def size(self) -> str:
        return f"{sum(len(state.anchors) for state in self.states):,} anchors in {len(self.states)} blocks"


def restore(saved: Checkpoint, problems: Sequence[TrainingProblem], config: MomentumConfig) -> MomentumTraining:
    """The inverse of `MomentumTraining.to_checkpoint`, bit for bit. Raises KeyError if something is missing."""
    states = [from_checkpoint(block, problem) for block, problem in zip(split_checkpoint(saved), problems, strict=True)]
    training = MomentumTraining(states, problems, config)
    for name, tensor in training.teacher.decoder.tensors().items():
        tensor.copy_(saved.tensors[f"teacher.{name}"])
    training.weights.psnr = [*map(float, saved.metadata["psnr"])]
    training.weights.ssim = [*map(float, saved.metadata["ssim"])]
    return training


def set_trainable(decoder: Decoder, problem: TrainingProblem, trains: bool) -> None:
    """Whether the heads move; what no block moves stays."""
    for name, tensor in decoder.tensors().items():
        if not name.startswith(SHARED_TENSORS):
            tensor.requires_grad_(trains and not problem.frozen_decoder)
