"""DOGS: blocks trained as 3DGS until no more Gaussians are added, then with consensus on those that several hold.

Written from the paper (`dogs.consensus` cites it). Different: only Gaussians that several blocks hold are pulled, so
that one block alone is 3DGS (in the program a block is pulled to what itself had before, too); copies keep the moments
of the block that owned the Gaussian (the program begins again without); a step of consensus comes at least
`MIN_STEPS` times; where penalties adapt, duals follow and residuals are measured by the first penalty. Left out:
pruning by importance before the consensus begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from experiments.baselines.dogs.consensus import Consensus, ConsensusConfig, find_members
from experiments.baselines.dogs.cut import cut_dogs
from experiments.baselines.gaussian_blocks.cut import GaussianCut
from experiments.baselines.gaussian_blocks.training import BlockScene
from experiments.baselines.gs3d.session import state_from_points
from experiments.baselines.gs3d.training import (
    Gs3dProblem,
    Gs3dState,
    from_checkpoint,
    gs3d_train_step,
    to_checkpoint,
)
from experiments.baselines.turns import JointTraining, split_checkpoint, train_in_turns
from vdgs.errors import VdgsError
from vdgs.model.gaussians import Gaussians
from vdgs.partition.blocks import xy_positions
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.checkpoints import Checkpoint, load_latest_checkpoint, save_checkpoint
from vdgs.training.optimizer import AdamMoments
from vdgs.training.session.training_session import restore_or_start

#: So many steps of consensus are made at least (choice): with the published interval a short training had none.
MIN_STEPS = 10


def train_dogs(scene: BlockScene, config: ConsensusConfig | None = None) -> Gaussians:
    """The global Gaussians. Raises what `run_session` raises."""
    points, count = scene.capture.points, scene.config.blocks
    cut = scene.cut(lambda: cut_dogs(points, scene.cameras, count))
    problems = _grow(scene, cut)
    folder = StageFolder(scene.folder.path / "consensus")

    def start() -> DogsTraining:
        states = [_grown_state(scene.block_folder(index)) for index in problems]
        idle = {
            index: _grown_state(scene.block_folder(index)) for index in range(len(cut.blocks)) if index not in problems
        }
        return begin_consensus(cut, dict(zip(problems, states, strict=True)), idle, list(problems.values()), config)

    training = restore_or_start(
        folder, len(problems) * scene.config.iterations, start,
        lambda saved: restore(saved, list(problems.values()), config), "Choose another output folder.", scene.console,
    )  # fmt: skip
    training.move_to(scene.device)
    train_in_turns(folder, training, scene.options, scene.console)
    for index, state in zip(problems, training.states, strict=True):
        stage = scene.block_folder(index)
        status = replace(stage.status(), iteration=state.iteration, iterations=state.iteration, seconds=state.seconds)
        stage.set_status(replace(status, peak_memory_bytes=training.peak_memory_bytes))
    return training.consensus.gaussians.to("cpu")


def _grow(scene: BlockScene, cut: GaussianCut) -> dict[int, Gs3dProblem]:
    """Every block for itself until density control ends; the problems of those with cameras, by block."""
    points, problems = scene.capture.points, {}
    places = xy_positions(points)
    owner = cut.blocks.owner(places)
    for index, views in enumerate(cut.views):
        held = cut.blocks.in_expanded(index, places, owner)
        config = scene.block_config(int((owner == index).sum()), len(points), int(held.sum()))
        start = partial(state_from_points, scene.capture, config, torch.from_numpy(held))
        if not views:
            scene.keep(index, start().gaussians, "no camera shows it")
            save_checkpoint(scene.block_folder(index).checkpoints, to_checkpoint(start()))
            continue
        problems[index] = scene.problem(views, config)
        growth_end = int(config.density.until * config.iterations)
        scene.train(index, replace(problems[index], last=max(growth_end, 1)), start)
    if not problems:
        raise VdgsError(f"{scene.capture.root}: no camera shows any of the blocks. Cut the scene into fewer: --blocks.")
    return problems


def _grown_state(folder: StageFolder) -> Gs3dState:
    saved, _ = load_latest_checkpoint(folder.checkpoints)
    if saved is None:
        raise VdgsError(f"{folder.checkpoints}: holds no whole state. Delete {folder.path} and give the same command.")
    return from_checkpoint(saved)


class DogsTraining(JointTraining):
    """Blocks that agree on what they share."""

    def __init__(
        self, states: Sequence[Gs3dState], problems: Sequence[Gs3dProblem], consensus: Consensus, begun: int
    ) -> None:
        last = problems[0].config.iterations
        interval = max(1, min(consensus.config.interval, (last - begun) // MIN_STEPS))
        super().__init__(states, interval, last)
        self.states, self.consensus, self._begun = list(states), consensus, begun
        self._problems = [
            replace(each, pull=partial(consensus.pull, k)) if len(consensus.members[k].shared) else each
            for k, each in enumerate(problems)
        ]

    def move_to(self, device: str) -> None:
        """Go on on a device."""
        self.blocks = self.states = [state.to(device) for state in self.states]
        self.consensus.move_to(device)

    def step(self, index: int) -> None:
        gs3d_train_step(self.states[index], self._problems[index])

    def end_round(self) -> None:
        done = (self.states[0].iteration - self._begun) / max(self.last - self._begun, 1)
        copies = [state.gaussians for state in self.states]
        self.consensus.step(copies, adapt=done <= self.consensus.config.adapt_until)

    def block_checkpoint(self, index: int) -> Checkpoint:
        return to_checkpoint(self.states[index])

    def shared(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        agreed = self.consensus
        tensors = {f"z.{name}": tensor for name, tensor in agreed.gaussians.tensors().items()}
        for k, (members, duals) in enumerate(zip(agreed.members, agreed.duals, strict=True)):
            held = torch.zeros_like(agreed.gaussians.opacity_logits, dtype=torch.bool).index_fill_(
                0, members.rows, True
            )
            tensors |= {f"held.{k}": held, **{f"dual.{k}.{name}": tensor for name, tensor in duals.items()}}
        return {"rho": agreed.rho, "first_rho": dict(agreed.first_rho), "begun": self._begun}, tensors

    def facts(self) -> dict[str, Any]:
        return {"residuals": self.consensus.residuals, "rho": dict(self.consensus.rho)}

    def size(self) -> str:
        return f"{len(self.consensus.gaussians):,} Gaussians in {len(self.states)} blocks"


def begin_consensus(
    cut: GaussianCut,
    grown: dict[int, Gs3dState],
    idle: dict[int, Gs3dState],
    problems: Sequence[Gs3dProblem],
    config: ConsensusConfig | None = None,
) -> DogsTraining:
    """From blocks that have grown, those that train and those that stay: every block gives the Gaussians of its own
    cell, with their moments, and gets a copy of all in its widened one."""
    parts = []
    for index, state in sorted((grown | idle).items()):
        own = torch.from_numpy(cut.blocks.owner(xy_positions(state.gaussians.means)) == index)
        moments = state.moments
        parts.append([state.gaussians.select(own).tensors()] + [
            {name: tensor[own] for name, tensor in moment.items()} for moment in (moments.first, moments.second)
        ])  # fmt: skip
    whole = [{name: torch.cat([part[i][name] for part in parts]) for name in parts[0][i]} for i in range(3)]
    scene = Gaussians(**whole[0])
    places = xy_positions(scene.means)
    owner = cut.blocks.owner(places)
    members = find_members([torch.from_numpy(cut.blocks.in_expanded(index, places, owner)) for index in grown])
    consensus = Consensus.begin(scene, members, config or ConsensusConfig())
    for state, each in zip(grown.values(), members, strict=True):
        copies, first, second = ({name: tensor[each.rows] for name, tensor in group.items()} for group in whole)
        state.gaussians, state.moments = Gaussians(**copies), AdamMoments(first, second)
        state.gradient, state.views = torch.zeros(len(each.rows)), torch.zeros(len(each.rows))
        state.scratch = {}
    states = list(grown.values())
    return DogsTraining(states, problems, consensus, states[0].iteration)


def restore(saved: Checkpoint, problems: Sequence[Gs3dProblem], config: ConsensusConfig | None = None) -> DogsTraining:
    """The inverse of `DogsTraining.to_checkpoint`, bit for bit. Raises KeyError if something is missing."""
    states, metadata = [from_checkpoint(block) for block in split_checkpoint(saved)], saved.metadata
    agreed = Gaussians(**{name.removeprefix("z."): t for name, t in saved.tensors.items() if name.startswith("z.")})
    members = find_members([saved.tensors[f"held.{k}"] for k in range(len(states))])
    duals = [{name: saved.tensors[f"dual.{k}.{name}"] for name in agreed.tensors()} for k in range(len(states))]
    consensus = Consensus(
        config or ConsensusConfig(), members, agreed, dict(metadata["rho"]), metadata["first_rho"], duals
    )
    return DogsTraining(states, problems, consensus, metadata["begun"])
