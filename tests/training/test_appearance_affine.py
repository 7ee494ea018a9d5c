"""The exposure of photographs: about neutral colors, fitted in training, left out of what is drawn, and known of test
photographs from those before and after them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from support.checkerboard import Photographs
from support.hand_made_models import capture_at
from support.small_training import CONFIG, bits, run, stage, start
from vdgs.captures.capture import Capture, View
from vdgs.captures.capture_order import flight_positions
from vdgs.config.method import LearningRateConfig
from vdgs.evaluation.opacity_coverage import RenderedImage
from vdgs.evaluation.view_exposures import (
    AutoExposure,
    ViewExposures,
    apply_exposure_numpy,
    fit_auto_exposure,
    log_luminance,
    make_exposures,
)
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.exposure import (
    MAX_FLIGHT_GAP,
    apply_exposure,
    apply_exposure_backward,
    exposure_matrix,
    interpolate_exposure,
    zero_exposures,
)
from vdgs.model.renderer import render
from vdgs.training import TrainingProblem, from_checkpoint, initial_state, to_checkpoint, train_step
from vdgs.training.exposure_centering import center_exposures, count_exposure, zero_moments

pytestmark = [pytest.mark.xdist_group("training"), pytest.mark.slow]

NEUTRAL = torch.eye(3, 4).double()
GAINS = torch.tensor([0.7, 1.3, 0.8, 1.2, 0.9, 1.1, 0.75, 1.25])


class Unequal(Photographs):
    """The checkerboard, photographed darker and brighter."""

    def get(self, index: int, downscale: int = 1):
        picture, mask = super().get(index, downscale)
        return (picture.float() * 0.7 * GAINS[index]).clamp(0, 255).to(torch.uint8), mask


@given(seed=st.integers(0, 1000), images=st.integers(1, 12), masked=st.booleans())
def test_no_map_of_neutral_colors_is_nearer_to_all_photographs(seed, images, masked):
    """Least squares over the counted pixels: after centering the best map of neutral colors is none."""
    generator = torch.Generator().manual_seed(seed)
    departures = 0.2 * torch.randn(images, 3, 4, generator=generator).double()
    pictures = torch.rand(images, 24, 36, 3, generator=generator)
    alpha = torch.rand(24, 36, generator=generator)
    mask = (torch.rand(24, 36, generator=generator) > 0.2).to(torch.uint8) if masked else None
    moments = zero_moments(torch.device("cpu"))
    for departure, picture in zip(departures, pictures, strict=True):
        count_exposure(moments, departure, picture, alpha, mask)
    center_exposures(departures, moments)
    assert (moments == 0).all()
    counted = (alpha >= 0.5) & (torch.ones(24, 36) if mask is None else mask).bool()
    pixels = pictures[:, counted].double()  # so small pictures are counted whole
    shown = torch.stack([apply_exposure(p[None], exposure_matrix(departures, i))[0] for i, p in enumerate(pixels)])
    colors = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=2).flatten(0, 1)
    best = torch.linalg.lstsq(colors, shown.flatten(0, 1)).solution.T
    assert torch.allclose(best, NEUTRAL, atol=1e-4)


def test_the_way_back_of_an_exposure_is_that_of_autograd():
    generator = torch.Generator().manual_seed(3)
    picture = torch.rand(9, 14, 3, generator=generator).double().requires_grad_()
    exposure = (torch.eye(3, 4) + 0.2 * torch.randn(3, 4, generator=generator)).double().requires_grad_()
    gradient = torch.randn(9, 14, 3, generator=generator).double()
    expected = torch.autograd.grad(apply_exposure(picture, exposure), (picture, exposure), gradient)
    found = apply_exposure_backward(picture.detach(), exposure.detach(), gradient)
    assert torch.allclose(found[0], expected[0])
    assert torch.allclose(found[1], expected[1])


def test_where_nothing_is_counted_no_exposure_moves():
    departures = random_departures(2)
    moments = zero_moments(torch.device("cpu"))
    count_exposure(moments, departures[0], torch.rand(8, 8, 3), torch.zeros(8, 8), None)
    before = departures.clone()
    center_exposures(departures, moments)
    assert torch.equal(departures, before)


def test_an_older_file_of_departures_from_their_mean_keeps_its_exposures():
    departures = random_departures(8).float()
    tensors = start(CONFIG).decoder.tensors() | {"exposure": departures}
    decoder = Decoder.from_tensors(tensors)
    for image in range(8):
        expected = NEUTRAL.float() + departures[image] - departures.mean(0)
        assert torch.allclose(decoder.exposure_for_image(image), expected, atol=1e-6)
    assert torch.equal(Decoder.from_tensors(decoder.tensors()).exposure, decoder.exposure)


def test_neutral_exposures_change_no_color():
    picture = torch.rand(5, 7, 3)
    assert torch.equal(apply_exposure(picture, exposure_matrix(zero_exposures(4), 2)), picture)


def test_an_exposure_maps_colors():
    picture = torch.rand(5, 7, 3)
    model = torch.tensor([[2.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.0], [0.0, 0.5, 0.5, -0.1]])
    red, green, blue = picture.unbind(-1)
    expected = torch.stack([2 * red + 0.1, green, 0.5 * green + 0.5 * blue - 0.1], dim=-1)
    assert torch.allclose(apply_exposure(picture, model), expected, atol=1e-6)


def random_departures(images: int, seed: int = 0) -> torch.Tensor:
    return 0.2 * torch.randn(images, 3, 4, generator=torch.Generator().manual_seed(seed)).double()


@given(places=st.sets(st.integers(0, 40), min_size=1), place=st.integers(0, 40))
def test_what_drifts_evenly_along_a_flight_is_known_between_its_photographs(places, place):
    images = {number: image for image, number in enumerate(sorted(places))}
    start, drift = random_departures(2)
    departures = torch.stack([start + number * drift for number in sorted(places)])
    nearest = min(places, key=lambda number: abs(number - place))
    found = interpolate_exposure(departures, images, place)
    if abs(nearest - place) > MAX_FLIGHT_GAP:
        assert torch.equal(found, NEUTRAL)
    elif min(places) <= place <= max(places):
        assert torch.allclose(found, NEUTRAL + start + place * drift, atol=1e-12)
    else:
        assert torch.equal(found, exposure_matrix(departures, images[nearest]))


def test_a_photograph_with_an_exposure_has_its_own_and_one_far_from_all_none():
    departures = random_departures(3)
    images = {2: 0, 3: 2, 30: 1}
    for place, image in images.items():
        assert torch.equal(interpolate_exposure(departures, images, place), exposure_matrix(departures, image))
    assert torch.equal(interpolate_exposure(departures, images, 38), exposure_matrix(departures, 1))
    for far in (39, 3 + MAX_FLIGHT_GAP + 1, 30 - MAX_FLIGHT_GAP - 1):
        assert torch.equal(interpolate_exposure(departures, images, far), NEUTRAL)
    assert torch.equal(interpolate_exposure(departures, {}, 2), NEUTRAL)


def test_photographs_of_a_folder_follow_each_other_as_their_numbers_do():
    names = ["b/DJI_10.JPG", "b/DJI_2.JPG", "a/7.jpg", "DJI_3.JPG", "b/DJI_1_2.JPG", "b/c/DJI_4.JPG", "b/DJI_1.JPG",
             "b/DJI_02.JPG", "b/x.JPG"]  # fmt: skip
    found = flight_positions(names)
    assert list(found) != names
    assert found.keys() == {*names}
    assert sorted((name for name in names if found[name].flight == "b"), key=lambda name: found[name].number) == [
        "b/DJI_1.JPG", "b/DJI_1_2.JPG", "b/DJI_02.JPG", "b/DJI_2.JPG", "b/DJI_10.JPG", "b/x.JPG"
    ]  # fmt: skip
    assert flight_positions(["train/2.jpg", "val/3.jpg", "train/10.jpg"])["val/3.jpg"] == ("", 1)
    assert [found[name].number for name in ("a/7.jpg", "DJI_3.JPG", "b/c/DJI_4.JPG")] == [0, 0, 0]
    assert len({place.flight for place in found.values()}) == 4


def flown(**splits: str) -> Capture:
    """Photographs of two flights; t trains, x tests."""
    pose = Camera(camera_from_world=np.eye(4), fx=60.0, fy=60.0, cx=32.0, cy=24.0, width=64, height=48)
    views = [
        View(
            name=f"{flight}/{number}.jpg",
            camera=pose,
            image_path=Path(f"{number}.jpg"),
            mask_path=None,
            split="train" if letter == "t" else "test",
        )
        for flight, letters in splits.items()
        for number, letter in enumerate(letters)
    ]
    return replace(capture_at(None), views=tuple(sorted(views, key=lambda view: view.name)))


def nothing() -> Anchors:
    return Anchors(torch.zeros(0, 3), torch.zeros(0, 32), torch.zeros(0, 2, 3), torch.zeros(0, 6))


class Lit(ViewExposures):
    """Exposures over a place whose views are as light as they say."""

    def __init__(self, capture: Capture, departures: torch.Tensor, light: Callable[[View], float]):
        plain = Decoder.init_random(2, False, 0, 0, torch.Generator())
        decoder = replace(plain, exposure=departures.float())
        super().__init__(
            AnchorModel(anchors=nothing(), decoder=decoder, voxel_size=0.4, background=(0.0, 0.0, 0.0)), capture
        )
        self._light = light

    def _render_small(self, view: View) -> np.ndarray:
        return np.full((4, 6, 3), self._light(view))


def test_test_views_have_the_exposure_between_their_neighbors_of_the_same_flight():
    capture = flown(a="tttxxxtttttt", b="x", c="xt")
    names = [view.name for view in capture.train_views]
    assert names[:3] == ["a/0.jpg", "a/1.jpg", "a/10.jpg"]  # rows of a model are in another order than the flight
    departures = random_departures(len(names)).float().double()
    found = Lit(capture, departures, lambda view: 0.5)
    views = {view.name: view for view in capture.views}

    def own(name: str) -> torch.Tensor:
        return exposure_matrix(departures, names.index(name))

    for name in names:
        assert torch.equal(found(views[name]), own(name))
    between = [0.75 * own("a/2.jpg") + 0.25 * own("a/6.jpg"), 0.25 * own("a/2.jpg") + 0.75 * own("a/6.jpg")]
    assert torch.allclose(found(views["a/3.jpg"]), between[0], atol=1e-12)
    assert torch.allclose(found(views["a/5.jpg"]), between[1], atol=1e-12)
    assert torch.equal(found(views["b/0.jpg"]), NEUTRAL)
    assert torch.equal(found(views["c/0.jpg"]), own("c/1.jpg"))


@pytest.mark.parametrize("slope", [-0.6, 0.0])
def test_a_camera_that_meters_exposes_what_is_brighter_less(slope):
    """Light changes at random from view to view, and the exposure drifts beside."""
    capture = flown(a="ttxtttxttttxtttxttttxtt")
    light = dict(
        zip([view.name for view in capture.views], np.random.default_rng(0).uniform(0.2, 0.3, 23), strict=True)
    )

    def gain(view: View) -> float:
        return 1.5 * light[view.name] ** slope * np.exp(0.02 * int(Path(view.name).stem))

    views = capture.train_views
    fitted = torch.tensor([gain(view) for view in views])[:, None, None] * torch.eye(3, 4)
    fitted /= fitted.mean(0)[0, 0]  # what all have in common is the scene's
    found = Lit(capture, fitted - torch.eye(3, 4), lambda view: light[view.name])
    assert found.auto_exposure.slope == pytest.approx(slope, abs=0.02)
    for view in capture.test_views:
        wanted = gain(view) / np.mean([gain(other) for other in views])
        assert found(view)[1, 1] == pytest.approx(wanted, rel=0.01 if slope else 0.001)
        assert torch.equal(found(view), found(view)[0, 0] * torch.eye(3, 4, dtype=torch.float64))


def test_a_model_without_exposures_has_none():
    plain = Decoder.init_random(2, False, 0, 0, torch.Generator())
    model = AnchorModel(anchors=nothing(), decoder=plain, voxel_size=0.4, background=(0.0, 0.0, 0.0))
    assert make_exposures(model, flown(a="tx")) is None


def test_the_middle_of_a_picture_is_metered_whatever_its_size():
    picture = np.full((48, 64, 3), 0.2)
    picture[16:32, 20:44] = 0.6
    whole = np.log(picture.mean())
    assert log_luminance(picture) > whole + 0.2
    assert log_luminance(np.repeat(np.repeat(picture, 2, 0), 2, 1)) == pytest.approx(log_luminance(picture), abs=0.01)
    assert log_luminance(0.5 * picture) == pytest.approx(log_luminance(picture) - np.log(2), abs=0.01)
    assert np.isfinite(log_luminance(np.zeros((4, 4, 3))))


@given(st.floats(-1.5, 1.0), st.integers(0, 1000))
def test_the_law_of_metering_is_learnt_or_left(slope, seed):
    rng = np.random.default_rng(seed)
    brighter = rng.normal(0, 0.2, 40)
    assert fit_auto_exposure(brighter, slope * brighter).slope == pytest.approx(np.clip(slope, -1, 0), abs=1e-6)
    assert fit_auto_exposure(brighter, slope * brighter).gain(0.0) == 1.0
    alone, metered_too = fit_auto_exposure(brighter, slope * brighter).residual_error
    assert alone == pytest.approx(abs(slope) * np.sqrt(np.mean(brighter**2)))
    beyond = abs(slope - np.clip(slope, -1, 0))
    assert metered_too == pytest.approx(beyond * np.sqrt(np.mean(brighter**2)), abs=1e-9)
    noise = rng.normal(0, 0.2, 40)
    unrelated = fit_auto_exposure(brighter, noise - brighter * (noise @ brighter) / (brighter @ brighter))
    assert unrelated.slope == 0.0
    assert fit_auto_exposure(brighter[:7], -brighter[:7]).slope == 0.0
    assert fit_auto_exposure(np.zeros(40), noise).slope == 0.0
    steep = AutoExposure(-0.5, 0.3)
    assert steep.gain(5.0) == steep.gain(0.3) < 1 < steep.gain(-0.3)


@given(seed=st.integers(0, 1000))
def test_a_picture_is_exposed_as_in_training_and_neutral_leaves_every_bit(seed):
    generator = torch.Generator().manual_seed(seed)
    picture, model = torch.rand(5, 7, 3, generator=generator), NEUTRAL + random_departures(1, seed)[0]
    found = apply_exposure_numpy(picture.numpy(), model)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, apply_exposure(picture.double(), model).numpy(), atol=1e-6)
    assert np.array_equal(apply_exposure_numpy(picture.numpy(), NEUTRAL), picture.numpy())


def test_before_another_background_the_exposed_scene_stays_as_it_is():
    """Exposed, then put before black: as if its own colors were exposed and black stood behind them."""
    scene, alpha = torch.rand(5, 7, 3).numpy(), torch.rand(5, 7).numpy()
    behind, model = (0.2, 0.4, 0.6), NEUTRAL + 0.5 * random_departures(1)[0]
    rendered = RenderedImage(alpha[..., None] * scene + (1 - alpha[..., None]) * np.float32(behind), alpha, behind)
    black = rendered.with_exposure(model).over_background((0.0, 0.0, 0.0))
    expected = (alpha[..., None] * apply_exposure_numpy(scene, model)).clip(0, 1) * 255
    assert np.abs(black - expected).max() < 0.501
    assert replace(rendered, background=None).with_exposure(model).background is None


def fitted(config=CONFIG, kind: str = "coarse") -> tuple:
    """A state whose photographs have exposures, and its stage."""
    plain = start(config)
    decoder = replace(plain.decoder, exposure=zero_exposures(8))
    given_stage: TrainingProblem = replace(stage(config), images=Unequal(), kind=kind)
    return initial_state(plain.anchors, decoder, given_stage), given_stage


def test_the_gradient_is_that_of_finite_differences():
    state, _ = fitted()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        state.decoder.exposure.copy_(0.1 * torch.randn(8, 3, 4, generator=generator))
    picture, target = torch.rand(40, 48, 3, generator=generator), torch.rand(40, 48, 3, generator=generator)

    def cost(departures: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        return ((apply_exposure(image, exposure_matrix(departures, 3)) - target.double()) ** 2).sum()

    leaves = state.decoder.exposure.detach().double().requires_grad_(True), picture.double().requires_grad_(True)
    found = torch.autograd.grad(cost(*leaves), leaves)
    for which, place in ((0, (3, 0, 1)), (0, (3, 2, 3)), (0, (5, 1, 1)), (1, (4, 5, 1))):
        step = torch.zeros_like(leaves[which])
        step[place] = 1e-6
        moved = [[each + sign * step if i == which else each for i, each in enumerate(leaves)] for sign in (1, -1)]
        slope = (cost(*moved[0]) - cost(*moved[1])) / 2e-6
        assert float(found[which][place]) == pytest.approx(float(slope.detach()), rel=1e-4, abs=1e-6)


def test_photographs_of_unequal_brightness_are_told_from_the_scene():
    rates = {name: (3 * first, 3 * last) for name, (first, last) in asdict(CONFIG.lr).items()}
    config = replace(CONFIG, iterations=120, lr=LearningRateConfig(**rates | {"exposure": (0.005, 5e-4)}))
    config = replace(config, model=replace(config.model, appearance_dim=0))
    state, unequal = fitted(config)
    plain = run(start(config), replace(stage(config), images=Unequal()))
    run(state, unequal)
    brightness = torch.tensor(
        [float(state.decoder.exposure_for_image(i).detach()[:, :3].sum(1).mean()) for i in range(8)]
    )
    assert float(torch.corrcoef(torch.stack([brightness, GAINS]))[0, 1]) > 0.9

    def error(trained) -> float:
        """Against the place as it is, at the mean brightness."""
        model = AnchorModel(
            anchors=trained.anchors, decoder=trained.decoder, voxel_size=0.4, background=(0.0, 0.0, 0.0)
        )
        truth, errors = Photographs(), []
        for index, camera in enumerate(truth.cameras):
            picture = truth.get(index)[0] * (0.7 / 255)
            errors.append(float(((render(model, camera).image - picture) ** 2).mean()))
        return sum(errors)

    assert error(state) < error(plain)


def test_exposures_are_centered_after_each_pass_but_the_last_step():
    config = replace(CONFIG, iterations=24)
    state, unequal = fitted(config)
    counted = []
    for _ in range(24):
        train_step(state, unequal)
        counted.append(float(state.exposure_moments[3:].trace()))
    assert counted[7] == counted[15] == 0 < min(counted[14], counted[23])


def test_a_state_with_exposures_of_an_older_version_is_refused():
    state, unequal = fitted(replace(CONFIG, iterations=30))
    saved = to_checkpoint(run(state, unequal, until=9))
    older = {name.replace("exposure_departures", "exposure"): tensor for name, tensor in saved.tensors.items()}
    assert len(older) == len(saved.tensors)
    with pytest.raises(KeyError, match="exposure_departures"):
        from_checkpoint(replace(saved, tensors=older), unequal)


def test_blocks_take_exposures_as_they_are():
    state, block = fitted(kind="block")
    assert state.exposure_moments is None
    with torch.no_grad():
        state.decoder.exposure.copy_(torch.linspace(-0.1, 0.1, 96).reshape(8, 3, 4))
    before = state.decoder.exposure.clone()
    for _ in range(3):
        train_step(state, block)
    assert torch.equal(state.decoder.exposure, before)
    neutral, _ = fitted(kind="block")
    for _ in range(3):
        train_step(neutral, block)
    assert bits(neutral)["anchors.features"] != bits(state)["anchors.features"]  # but they count


def test_a_stopped_run_and_a_file_keep_them(tmp_path):
    short = replace(CONFIG, iterations=30)
    state, unequal = fitted(short)
    whole = bits(run(state, unequal))
    state, _ = fitted(short)
    run(state, unequal, until=17)
    again = run(from_checkpoint(to_checkpoint(state), unequal), unequal)
    assert bits(again) == whole
    AnchorModel(anchors=again.anchors, decoder=again.decoder, voxel_size=0.4, background=(0.0, 0.0, 0.0)).save(
        tmp_path / "model.safetensors"
    )
    read = AnchorModel.load(tmp_path / "model.safetensors")
    assert torch.equal(read.decoder.exposure, again.decoder.exposure)
    assert read.decoder.exposure.abs().max() > 0
    neutral = replace(read, decoder=replace(read.decoder, exposure=None))
    camera = Photographs().camera(0)
    assert torch.equal(render(read, camera).image, render(neutral, camera).image)
