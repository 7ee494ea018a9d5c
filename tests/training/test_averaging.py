"""The mean of the last models: it is a mean, changes no step, survives being stopped, and is what a stage ends with."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from support.small_training import CONFIG, run, stage, start
from vdgs.config.method import DensifyConfig, TrainConfig
from vdgs.model.anchors import TRAINED_TENSORS
from vdgs.system.checkpoints import load_latest_checkpoint, save_checkpoint
from vdgs.training import from_checkpoint, to_checkpoint, train_step, training_loop
from vdgs.training.weight_averaging import NUM_AVERAGED_MODELS, is_averaged_step

pytestmark = [pytest.mark.xdist_group("averaging"), pytest.mark.slow]

#: Growth ends at iteration 30, the mean begins after 36.
MEAN = replace(CONFIG, swa_fraction=0.4, densify=replace(CONFIG.densify, stop_fraction=0.5))


def tensors_of(anchors, decoder) -> dict[str, np.ndarray]:
    named = {name: getattr(anchors, name) for name in TRAINED_TENSORS} | decoder.tensors()
    return {name: tensor.detach().numpy().copy() for name, tensor in named.items()}


@given(
    iterations=st.integers(1, 5000),
    average=st.just(0.0) | st.floats(1e-3, 0.99),
    until=st.floats(0.0, 0.99),
)
def test_the_mean_is_one_of_many_models_after_growth_and_of_the_last(iterations, average, until):
    config = TrainConfig(iterations=iterations, swa_fraction=average, densify=DensifyConfig(stop_fraction=until))
    counted = [i for i in range(1, iterations + 1) if is_averaged_step(i, config)]
    if average == 0:
        assert counted == []
        return
    window = iterations - max(1 - average, until) * iterations
    assert counted[-1] == iterations
    assert counted[0] > iterations - window
    assert len(set(np.diff(counted))) <= 1  # evenly
    assert min(window - 1, 0.6 * NUM_AVERAGED_MODELS) <= len(counted) <= 2 * NUM_AVERAGED_MODELS


@pytest.fixture(scope="module")
def unsorted():
    """The last models of a run without a mean, and one with it; rows of both stay where they are."""
    plain, averaged = start(MEAN), start(MEAN)
    off, on = stage(replace(MEAN, swa_fraction=0.0)), stage(MEAN)
    models = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_loop, "SORT_INTERVAL", 10**9)
        for iteration in range(1, MEAN.iterations + 1):
            train_step(plain, off)
            train_step(averaged, on)
            if iteration > 36:
                models.append(tensors_of(plain.anchors, plain.decoder))
    return models, averaged


def test_it_is_the_mean_of_the_models_and_changes_none_of_them(unsorted):
    models, averaged = unsorted
    last, result = tensors_of(averaged.anchors, averaged.decoder), tensors_of(*averaged.result())
    assert averaged.model_average is not None
    assert averaged.model_average.count == len(models) == 24
    for name, value in result.items():
        assert np.array_equal(last[name], models[-1][name])
        assert np.allclose(value, np.mean([each[name] for each in models], axis=0), atol=1e-6), name
        assert not np.array_equal(value, last[name]), name


def test_without_it_the_result_is_the_last_model():
    short = replace(CONFIG, iterations=5)
    state = run(start(short), stage(short))
    assert state.model_average is None
    assert state.result() == (state.anchors, state.decoder)


def test_a_stopped_and_continued_run_ends_with_the_same_mean(tmp_path, monkeypatch):
    monkeypatch.setattr(training_loop, "SORT_INTERVAL", 7)
    unbroken = tensors_of(*run(start(MEAN), stage(MEAN)).result())
    state = start(MEAN)
    for stop_at in (20, 37, 38, 50):
        save_checkpoint(tmp_path, to_checkpoint(run(state, stage(MEAN), until=stop_at)))
        saved, _ = load_latest_checkpoint(tmp_path)
        assert saved is not None
        state = from_checkpoint(saved, stage(MEAN))
    continued = tensors_of(*run(state, stage(MEAN)).result())
    assert all(np.array_equal(continued[name], value) for name, value in unbroken.items())


def test_rows_of_the_mean_follow_their_anchors(unsorted, monkeypatch):
    """Put into Morton order within the mean or not: the same anchors have the same means."""

    def by_place(state) -> np.ndarray:
        anchors, _ = state.result()
        rows = np.concatenate([each.reshape(len(anchors), -1).numpy() for each in anchors.tensors().values()], axis=1)
        return rows[np.lexsort(rows.T[:3])]

    # Reordered rows are added up in another order where weights gather gradients: alike, not of the same bits.
    monkeypatch.setattr(training_loop, "SORT_INTERVAL", 45)
    before, within = by_place(unsorted[1]), by_place(run(start(MEAN), stage(MEAN)))
    assert before.shape == within.shape
    assert np.median(np.abs(before - within)) < 1e-3


def test_anchors_that_never_move_keep_their_bits_in_the_mean():
    config = replace(MEAN, densify=replace(MEAN.densify, num_levels=0))
    state = start(config)
    far = state.anchors.positions[:, 0] > 3.5
    state.anchors.positions[far] += torch.tensor([1000.0, 0.0, 0.0])
    before = state.anchors.select(far)
    anchors, _ = run(state, stage(config)).result()
    after = anchors.select(anchors.positions[:, 0] > 500)
    assert all(torch.equal(after.tensors()[name], tensor) for name, tensor in before.tensors().items())
