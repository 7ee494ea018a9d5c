"""Training: deterministic, resumable bit for bit, loud when it diverges."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from support.checkerboard import Photographs
from support.instruction_sets import on_threads
from support.small_training import BLACK, CONFIG, bits, run, stage, start
from vdgs.config.method import InitConfig, LearningRateConfig
from vdgs.errors import TrainingDiverged, VdgsError
from vdgs.kernels import cpu
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.model.initialization.initialize import initialize_anchors
from vdgs.model.renderer import render
from vdgs.system.checkpoints import load_latest_checkpoint, save_checkpoint
from vdgs.training import downscale_at, from_checkpoint, to_checkpoint, train_step, view_at
from vdgs.training.crops import Crop, crop_at
from vdgs.training.optimizer import learning_rates_at
from vdgs.training.training_step import step_unseen_anchors

pytestmark = [pytest.mark.xdist_group("training"), pytest.mark.slow]


@pytest.fixture(scope="module")
def unbroken():
    return run(start(), stage())


def test_training_learns_the_place():
    rates = LearningRateConfig(**{name: (3 * first, 3 * last) for name, (first, last) in asdict(CONFIG.lr).items()})
    state = run(start(longer := replace(CONFIG, iterations=160, lr=rates)), stage(longer))
    model = AnchorModel(anchors=state.anchors, decoder=state.decoder, voxel_size=0.4, background=BLACK)
    photographs = Photographs()
    errors = []
    for index in range(8):
        picture = render(model, photographs.camera(index), image_index=index).image
        errors.append(float(((picture - photographs.get(index)[0].float() / 255) ** 2).mean()))
    before = float(torch.var(photographs.get(0)[0].float() / 255))
    assert np.mean(errors) < 0.2 * before
    assert len(state.anchors) > len(start().anchors)


def test_a_run_that_is_stopped_and_continued_on_more_and_on_fewer_threads_has_the_same_bits(unbroken, tmp_path):
    state = start()
    for threads, stop_at in ((3, 1), (1, 13), (2, 20), (1, 33), (3, 59), (1, CONFIG.iterations)):
        with on_threads(threads):
            run(state, stage(), until=stop_at)
        assert state.iteration == stop_at
        save_checkpoint(tmp_path, to_checkpoint(state))
        saved, _ = load_latest_checkpoint(tmp_path)
        assert saved is not None
        state = from_checkpoint(saved, stage())
    assert bits(state) == bits(unbroken)


def test_the_factor_of_offsets_multiplies_their_rates_alone():
    first, last = CONFIG.lr.offsets
    faster = replace(CONFIG, lr=replace(CONFIG.lr, offsets=(4 * first, 4 * last)))
    assert bits(run(start(), replace(stage(), offset_rate_factor=4.0), until=5)) == bits(run(start(), stage(faster), 5))


def test_another_seed_is_another_run(unbroken):
    config = replace(CONFIG, seed=1, iterations=10)
    assert bits(run(start(config), stage(config))) != bits(run(start(), stage(replace(CONFIG, iterations=10))))


def test_every_view_is_used_once_an_epoch():
    for epoch in range(3):
        assert sorted(view_at(epoch * 7 + i, 7, seed=3) for i in range(7)) == list(range(7))


@given(
    shares=st.lists(st.floats(0.0, 50.0), min_size=1, max_size=12).filter(lambda each: sum(each) > 1e-3),
    seed=st.integers(0, 1000),
)
def test_views_come_in_proportion_to_their_shares(shares, seed):
    count, given_shares = len(shares), tuple(shares)
    expected = np.array(shares) * count / sum(shares)
    for epoch in range(3):
        drawn = [view_at(epoch * count + i, count, seed, given_shares) for i in range(count)]
        times = np.bincount(drawn, minlength=count)
        assert (np.abs(times - expected) < 1 + 1e-9).all()  # rounded down or up


def test_over_many_epochs_shares_are_kept():
    shares = (0.0, 1.0, 1.5, 4.0)
    drawn = [view_at(i, 4, 0, shares) for i in range(4000)]
    assert np.allclose(np.bincount(drawn, minlength=4) / 4000, np.array(shares) / sum(shares), atol=0.01)
    assert drawn == [view_at(i, 4, 0, shares) for i in range(4000)]


def test_the_resolution_schedule():
    assert [downscale_at(i, CONFIG) for i in (0, 29, 30, 59)] == [2, 2, 1, 1]


def test_parameters_state_and_statistics_stay_aligned(unbroken):
    n = len(unbroken.anchors)
    tensors = {name: t for name, t in to_checkpoint(unbroken).tensors.items() if "decoder" not in name}
    assert {t.shape[0] for t in tensors.values()} == {n}


def test_anchors_that_no_camera_sees_keep_their_bits():
    state = start()
    far = state.anchors.positions[:, 0] > 3.5
    state.anchors.positions[far] += torch.tensor([1000.0, 0.0, 0.0])
    before = state.anchors.select(far)
    run(state, stage(), until=9)
    after = state.anchors.select(state.anchors.positions[:, 0] > 500)
    assert all(torch.equal(before.tensors()[name], after.tensors()[name]) for name in before.tensors())


@pytest.mark.parametrize("crops", [None, (Crop(0.0, 0.1, 0.5, 0.6),) * 8])
def test_anchors_are_seen_by_the_pictures_that_hold_their_centers(crops):
    config = replace(CONFIG, densify=replace(CONFIG.densify, stats_start=0, start=1000))
    seen_by = replace(stage(config), crops=crops)
    state = start(config)
    expected = torch.zeros(len(state.anchors))
    for iteration in range(12):
        camera = Photographs().camera(view_at(iteration, 8, 0), downscale_at(iteration, config))
        crop = crop_at(crops, 0, iteration)
        part = camera.cropped(*crop.pixels(camera.width, camera.height))
        expected += torch.from_numpy(part.in_frustum(state.anchors.positions.double().numpy()))
        train_step(state, seen_by)
    assert torch.equal(state.statistics.seen, expected)
    assert 0 < float(expected.mean()) < 12


def test_transparent_anchors_go_where_they_are_seen_and_stay_just_outside_of_all_pictures():
    config = replace(CONFIG, densify=replace(CONFIG.densify, grad_threshold=1e9))
    state, nothing = start(config), replace(stage(config), frozen_decoder=True)
    with torch.no_grad():
        state.decoder.weights.opacity.w2[:] = 0.0
        state.decoder.weights.opacity.b2[:] = -1.0  # no Gaussian is drawn
    for tensor in state.decoder.tensors().values():
        tensor.requires_grad_(False)
    before = state.anchors.positions.clone()
    cameras = Photographs().cameras
    times = cpu.count_visibility(before, cameras)
    beside = torch.zeros(len(before), dtype=torch.bool)
    for camera in cameras:
        beside[cpu.cull(before, state.anchors.log_scales, camera)] = True
    beside &= times == 0
    run(state, nothing)
    left = {tuple(place) for place in state.anchors.positions.tolist()}
    stays = torch.tensor([tuple(place) in left for place in before.tolist()])
    assert beside.sum() > 3
    assert stays[times == 0].all()
    assert not stays[times > 1].any()
    assert (times > 1).sum() > 100


@pytest.mark.parametrize("first_seen", [0, 10_000])
def test_the_first_step_of_an_anchor_is_the_same_whenever_it_is_seen_first(first_seen):
    """An anchor that was never seen keeps everything; seen first, it moves as it would have at once."""
    config = replace(CONFIG, iterations=20_000, lr=LearningRateConfig(features=(0.01, 0.01), log_scales=(0.01, 0.01)))
    state = start(config)
    state.iteration = first_seen
    before = state.anchors.select(torch.arange(len(state.anchors)))
    one_view = replace(stage(replace(config, densify=replace(config.densify, stop_fraction=0.0))), num_images=1)
    train_step(state, one_view)
    updates = state.optimizer.updates
    assert set(updates.tolist()) == {0, 1}
    for name, rate in (("features", 0.01), ("log_scales", 0.01)):
        moved = (getattr(state.anchors, name) - getattr(before, name)).abs()
        assert not moved[updates == 0].any()
        assert 0.99 * rate < float(moved.max()) < 1.01 * rate


def test_dense_adam_moves_what_a_view_does_not_show_along_its_moments():
    """All anchors, one photograph a step: parameters and moments are those of torch's Adam on whole tensors."""
    config = replace(
        CONFIG, optimizer="adam", densify=replace(CONFIG.densify, stop_fraction=0.0), resolution_schedule=((0.0, 1),)
    )
    state, given = start(config), replace(stage(config), frozen_decoder=True)
    far = state.anchors.positions[:, 0] > 2.5  # the last views alone show it
    before = state.anchors.select(far)
    for _ in range(9):
        train_step(state, given)
    assert set(state.optimizer.updates.tolist()) == {9}
    last, moments = state.anchors.select(torch.arange(len(far))), state.optimizer.anchors
    first = {name: t.clone() for name, t in moments.first.items()}
    second = {name: t.clone() for name, t in moments.second.items()}
    nothing = torch.empty(0, dtype=torch.int64)
    rates = learning_rates_at(config.lr, 9 / config.iterations)
    step_unseen_anchors(state.anchors, nothing, state.optimizer.anchor_states(state.anchors, rates, 1.0), 10)
    for name in ("features", "offsets", "log_scales"):
        m, v = 0.9 * first[name], 0.999 * second[name]
        step = rates[name] * (m / (1 - 0.9**10)) / ((v / (1 - 0.999**10)).sqrt() + 1e-15)
        torch.testing.assert_close(getattr(state.anchors, name), getattr(last, name) - step, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(moments.first[name], m)
        torch.testing.assert_close(moments.second[name], v)
    assert not torch.equal(before.features, last.select(far).features)


def test_visible_and_dense_adam_are_one_where_all_is_seen():
    """The first step moves what it shows, and nothing else has a moment to follow."""
    states = [start(replace(CONFIG, optimizer=adam)) for adam in ("sparse-adam", "adam")]
    for state, adam in zip(states, ("sparse-adam", "adam"), strict=True):
        train_step(state, stage(replace(CONFIG, optimizer=adam)))
    visible, dense = (bits(state) for state in states)
    assert {name for name in visible if visible[name] != dense[name]} == {"updates.anchors"}


def test_a_parameter_that_is_not_a_number_stops_training():
    state = start()
    with torch.no_grad():
        state.decoder.weights.color.w2[:] = float("nan")
    with pytest.raises(TrainingDiverged, match="iteration 1"):
        train_step(state, stage())


METADATA = ModelMetadata(version="0.1.0", iterations=20, key="0123", block=2, views=7, decoder="own")


def test_a_model_is_loaded_as_it_was_saved(unbroken, tmp_path):
    model = AnchorModel(
        anchors=unbroken.anchors, decoder=unbroken.decoder, voxel_size=0.4, background=BLACK, metadata=METADATA
    )
    model.save(tmp_path / "model.safetensors")
    again = AnchorModel.load(tmp_path / "model.safetensors")
    assert again.metadata == METADATA
    camera = Photographs().camera(3)
    assert torch.equal(render(again, camera).image, render(model, camera).image)


@pytest.mark.parametrize("damage", ["truncate", "text", "nan", "missing"])
def test_a_damaged_model_is_refused(unbroken, tmp_path, damage):
    path = tmp_path / "model.safetensors"
    anchors = unbroken.anchors
    if damage == "nan":
        anchors = replace(anchors, features=anchors.features * float("nan"))
    AnchorModel(anchors=anchors, decoder=unbroken.decoder, voxel_size=0.4, background=BLACK).save(path)
    if damage == "truncate":
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "text":
        path.write_text("not a model")
    elif damage == "missing":
        path.unlink()
    with pytest.raises(VdgsError, match=r"model\.safetensors"):
        AnchorModel.load(path)


def test_anchors_start_on_the_voxel_grid():
    points = np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [5.0, 5.0, 5.0]])
    colors = np.array([[255, 0, 0], [0, 0, 0], [0, 255, 0]], np.uint8)
    anchors, voxel = initialize_anchors(points, colors, [], InitConfig(voxel_size=1.0, from_colors=True), 10)
    assert voxel == 1.0
    assert anchors.positions.tolist() == [[0, 0, 0], [5, 5, 5]]
    torch.testing.assert_close(anchors.features[:, :3], torch.tensor([[0.0, -1, -1], [-1, 1, -1]]))


def test_points_far_from_all_others_start_no_anchor():
    ground = np.random.default_rng(0).uniform(-5, 5, (500, 3)) * [1, 1, 0.02]
    deep = np.array([[0.0, 0.0, -300.0], [0.1, 0.0, -300.0]])
    points, colors = np.concatenate([ground, deep]), np.zeros((502, 3), np.uint8)
    kept, _ = initialize_anchors(points, colors, [], InitConfig(voxel_size=0.1), 10)
    assert float(kept.positions[:, 2].min()) > -1
    everything, _ = initialize_anchors(points, colors, [], InitConfig(voxel_size=0.1, outlier_distance=0.0), 10)
    assert float(everything.positions[:, 2].min()) == pytest.approx(-300)


def test_one_distinct_point_is_too_few():
    with pytest.raises(VdgsError, match="distinct sparse point"):
        initialize_anchors(np.zeros((4, 3)), np.zeros((4, 3), np.uint8), [], InitConfig(), 10)
