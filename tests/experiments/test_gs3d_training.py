"""Training of 3DGS: deterministic, resumable bit for bit, on the schedules of its paper."""

import io
import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console

from experiments.baselines.gs3d import training as gaussian_training
from experiments.baselines.gs3d.density import DensityConfig
from experiments.baselines.gs3d.model import (
    GaussianModel,
    initialize_gaussians,
)
from experiments.baselines.gs3d.session import train_with_checkpoints
from experiments.baselines.gs3d.training import (
    Gs3dConfig,
    Gs3dLearningRates,
    Gs3dProblem,
    downscale_at,
    from_checkpoint,
    gs3d_train_step,
    initial_state,
    learning_rates_at,
    scene_extent,
    sh_degree_at,
    to_checkpoint,
    train,
)
from support.checkerboard import Photographs
from support.instruction_sets import on_threads
from vdgs.config.executor_options import CheckpointOptions
from vdgs.errors import TrainingDiverged, VdgsError
from vdgs.kernels import cpu
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.checkpoints import load_latest_checkpoint, save_checkpoint

pytestmark = [pytest.mark.xdist_group("gaussian_training"), pytest.mark.slow]

CONFIG = Gs3dConfig(
    iterations=80,
    resolution_schedule=((0, 2), (20, 1)),
    degree_interval=25,
    density=DensityConfig(start=15, interval=10, until=0.75, dense=0.08, reset_interval=40),
)


def stage(config: Gs3dConfig = CONFIG) -> Gs3dProblem:
    return Gs3dProblem(config, Photographs(), 8, scene_extent(Photographs().cameras))


def start(config: Gs3dConfig = CONFIG):
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-4, 4, (300, 2)), np.zeros((300, 1))], axis=1)
    gray = np.full((300, 3), 128, np.uint8)
    return initial_state(initialize_gaussians(points, gray, config.initial_opacity, config.degree))


def run(state, stage_, until: int | None = None):
    train(
        state, stage_,
        stop=lambda: until is not None and state.iteration >= until, after_step=lambda *_: None,
    )  # fmt: skip
    return state


def bits(state) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in to_checkpoint(state).tensors.items()}


@pytest.fixture(scope="module")
def followed():
    """A run, and what each of its steps reported and left."""
    state, counts = start(), {}
    train(
        state, stage(), stop=lambda: False, after_step=lambda s, r: counts.update({s.iteration: (r, len(s.gaussians))})
    )
    return state, counts


@pytest.fixture(scope="module")
def unbroken(followed):
    return followed[0]


def test_training_learns_the_place():
    longer = replace(
        CONFIG, iterations=150, rates=Gs3dLearningRates((9.6e-4, 9.6e-6), 0.015, 7.5e-4, 0.3, 0.03, 0.006),
        density=replace(CONFIG.density, interval=35, until=0.5, reset_interval=1000),
    )  # fmt: skip
    state = run(start(longer), stage(longer))
    photographs, model = Photographs(), GaussianModel(state.gaussians, (0.0, 0.0, 0.0), {})
    errors = []
    for index in range(8):
        picture = model.render(photographs.camera(index)).image
        errors.append(float(((picture - photographs.get(index)[0].float() / 255) ** 2).mean()))
    assert np.mean(errors) < 0.2 * float(torch.var(photographs.get(0)[0].float() / 255))
    assert len(state.gaussians) > 300


def test_a_run_that_is_stopped_and_continued_on_more_and_on_fewer_threads_has_the_same_bits(unbroken, tmp_path):
    state = start()
    for threads, stop_at in ((3, 1), (1, 19), (2, 20), (1, 27), (3, 40), (1, 79), (2, CONFIG.iterations)):
        with on_threads(threads):
            run(state, stage(), until=stop_at)
        assert state.iteration == stop_at
        save_checkpoint(tmp_path, to_checkpoint(state))
        saved, _ = load_latest_checkpoint(tmp_path)
        assert saved is not None
        state = from_checkpoint(saved)
    assert bits(state) == bits(unbroken)


def memory_runs_out(monkeypatch, where: str, at_call: int, module=gaussian_training) -> None:
    """The given function of a module, by name, finds no memory in its call of that number."""
    function, calls = getattr(module, where), itertools.count(1)

    def scarce(*values, **named):
        if next(calls) == at_call:
            raise MemoryError("std::bad_alloc")
        return function(*values, **named)

    monkeypatch.setattr(module, where, scarce)


def train_in(folder: StageFolder):
    folder.path.mkdir(exist_ok=True)
    console = Console(file=io.StringIO())
    saved, _ = load_latest_checkpoint(folder.checkpoints)
    state = start() if saved is None else from_checkpoint(saved)
    train_with_checkpoints(folder, state, stage(), CheckpointOptions(), console)
    return state


@pytest.mark.parametrize("where", ["render_gaussians", "_allocate_gradients"])
def test_where_memory_runs_out_before_anything_moves_no_step_is_lost(where, unbroken, tmp_path, monkeypatch):
    folder = StageFolder(tmp_path / "gaussians")
    with monkeypatch.context() as scarcity:
        memory_runs_out(scarcity, where, 38)
        with pytest.raises(VdgsError, match=r"out of memory with .* The checkpoint of iteration 37 is saved in"):
            train_in(folder)
    assert bits(train_in(folder)) == bits(unbroken)


def test_where_memory_runs_out_within_a_step_nothing_half_moved_is_saved(tmp_path, monkeypatch):
    folder = StageFolder(tmp_path / "gaussians")
    memory_runs_out(monkeypatch, "adam_rows", 3 * 5, module=cpu)  # four of the tensors have moved, or three
    with pytest.raises(VdgsError, match="There is no checkpoint yet"):
        train_in(folder)


def test_another_seed_is_another_run():
    short = replace(CONFIG, iterations=10)
    other = replace(short, seed=1)
    assert bits(run(start(other), stage(other))) != bits(run(start(), stage(short)))


def test_growth_keeps_everything_aligned(followed):
    state, counts = followed
    assert len({tensor.shape[0] for tensor in to_checkpoint(state).tensors.values()}) == 1
    decided = [iteration for iteration, (report, _) in counts.items() if report.cloned is not None]
    assert decided == [20, 30, 40, 50]  # not at 60, where density control ends (program)
    for iteration in decided:
        report, after = counts[iteration]
        assert after == counts[iteration - 1][1] + report.cloned + report.split - report.pruned
    assert counts[80][1] == counts[50][1]
    assert sum(report.cloned for report, _ in counts.values() if report.cloned) > 0
    assert sum(report.split for report, _ in counts.values() if report.split) > 0


def test_bands_of_color_are_released_one_after_the_other_and_opacities_are_reset_with_their_moments():
    assert [sh_degree_at(i, CONFIG) for i in (0, 24, 25, 50, 75, 79)] == [0, 0, 1, 2, 3, 3]
    state = run(start(), stage(), until=25)
    assert not state.gaussians.shN.any()
    run(state, stage(), until=39)
    assert float(state.gaussians.opacity_logits.sigmoid().max()) > 0.05
    gs3d_train_step(state, stage())
    assert float(state.gaussians.opacity_logits.sigmoid().max()) <= 0.01 + 1e-6
    assert not state.moments.first["opacity_logits"].any()
    assert state.moments.first["means"].any()
    run(state, stage(), until=50)
    assert state.gaussians.shN[:, :3].any()
    assert not state.gaussians.shN[:, 3:].any()


def test_where_density_control_ends_opacities_stay():
    last = replace(CONFIG, density=replace(CONFIG.density, until=0.25, reset_interval=20))  # at step 20
    assert float(run(start(), stage(last), until=20).gaussians.opacity_logits.sigmoid().max()) > 0.05


def test_the_schedules():
    assert [downscale_at(i, Gs3dConfig()) for i in (0, 249, 250, 499, 500, 9999)] == [4, 4, 2, 2, 1, 1]
    config = Gs3dConfig(iterations=100, rates=Gs3dLearningRates())
    assert learning_rates_at(config, 3.0, 0)["means"] == pytest.approx(3 * 1.6e-4)
    assert learning_rates_at(config, 3.0, 50)["means"] == pytest.approx(3 * 1.6e-5)
    assert learning_rates_at(config, 3.0, 100)["means"] == pytest.approx(3 * 1.6e-6)
    assert learning_rates_at(config, 3.0, 100)["sh0"] == pytest.approx(20 * learning_rates_at(config, 9.0, 0)["shN"])


def test_a_loss_that_is_not_a_number_stops_training():
    with pytest.raises(TrainingDiverged, match="iteration 1"):
        gs3d_train_step(start(), replace(stage(), background=(float("nan"), 0.0, 0.0)))
