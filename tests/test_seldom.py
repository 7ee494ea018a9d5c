"""What steers training where few cameras look: how seldom a place is seen, what is left out, what is asked of depth."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from checkerboard import Photographs
from decode_scenes import Scene
from test_decode_adam import CAMERA, ROWS
from test_training import CONFIG, bits, run, start
from test_training import stage as plain_stage
from vdgs.cameras import Camera
from vdgs.captures.sightings import Sightings
from vdgs.kernels import native
from vdgs.model.ground import at_size
from vdgs.model.seldom import Seldom
from vdgs.settings.method import SeldomConfig
from vdgs.storage.checkpoints import load_newest, save_state
from vdgs.training import Stage, from_saved, start_state, to_saved, train_step
from vdgs.training.depths import LEAST_ALPHA, KnownDepths, PixelDepths, roughness
from vdgs.training.thinning import thinned

pytestmark = pytest.mark.xdist_group("training")

PHOTOGRAPHS = Photographs()
PLANE = torch.tensor([[x, y, 0.0] for x in np.arange(-6, 6, 0.25) for y in np.arange(-5, 5, 0.25)], dtype=torch.float32)


def seldom(quantile: float = 0.5) -> Seldom:
    return Seldom(PHOTOGRAPHS.cameras, PLANE, quantile)


@given(quantile=st.floats(0.05, 1.0))
def test_places_seen_at_least_as_often_as_the_quantile_are_left_alone(quantile):
    by = seldom(quantile)
    views, share = native.count_visibility(PLANE, PHOTOGRAPHS.cameras), by.share(PLANE)
    assert torch.equal(share == 0, views >= by.limit)
    assert torch.equal(share == 1, views == 0)
    assert torch.allclose(share, (1 - views / by.limit).clamp(min=0))


def test_starts_that_no_camera_holds_do_not_count():
    far = torch.cat([PLANE, PLANE + 1000.0])
    assert replace(seldom(), starts=far).limit == seldom().limit > 0
    assert torch.equal(Seldom(PHOTOGRAPHS.cameras, PLANE[:0], 0.5).share(PLANE), torch.zeros(len(PLANE)))


def test_a_picture_knows_how_seldom_its_places_are_seen():
    by, camera = seldom(1.0), PHOTOGRAPHS.cameras[0]
    cells = at_size(by.cells(camera), camera.width, camera.height)
    places = torch.from_numpy(camera.unproject(np.full((camera.height, camera.width), 5.0))).reshape(-1, 3).float()
    truth = by.share(places).reshape(camera.height, camera.width)
    assert 0.2 < float((truth == 0).float().mean()) < 0.9
    assert float((cells - truth).abs().mean()) < 0.05
    west = replace(by, starts=PLANE[PLANE[:, 0] < camera.position[0]])
    half = at_size(west.cells(camera), camera.width, camera.height)
    assert torch.equal(half[:, 30:], half[:, 30:31].expand_as(half[:, 30:]))  # no start there: as the nearest
    assert not replace(by, starts=PLANE[:0]).cells(camera).any()


@settings(max_examples=10)
@given(missing=st.floats(0.0, 0.9), seed=st.integers(0, 1000))
def test_of_each_anchor_so_many_gaussians_are_left_out(missing, seed):
    splats = native.decode(*Scene.random(700, seed=2).arguments, CAMERA, ROWS)
    k = 10
    share = torch.where(torch.arange(len(ROWS)) % 2 == 0, missing, 0.0)
    left = thinned(splats, share, k, seed)
    kept = torch.isin(splats.source, left.source)
    for field in fields(splats):
        assert torch.equal(getattr(left, field.name), getattr(splats, field.name)[kept])
    odd = (splats.source.long() // k) % 2 == 1
    assert kept[odd].all()
    count = int((~odd).sum())
    assert abs(float(kept[~odd].float().mean()) - (1 - missing)) < 4 * (0.25 / count) ** 0.5
    assert torch.equal(thinned(splats, share, k, seed).source, left.source)
    assert torch.equal(thinned(splats, torch.zeros(len(ROWS)), k, seed).source, splats.source)


def plane_depth(camera: Camera, normal: tuple[float, float, float], distance: float) -> torch.Tensor:
    """Depth of the plane n·x = distance, in the frame of the camera."""
    x = (torch.arange(camera.width).double() + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height).double() + 0.5 - camera.cy) / camera.fy
    return distance / (normal[0] * x[None] + normal[1] * y[:, None] + normal[2])


GREY = torch.full((40, 48, 3), 128, dtype=torch.uint8)
FULL = torch.ones(40, 48, dtype=torch.float64)


@given(a=st.floats(-0.4, 0.4), b=st.floats(-0.4, 0.4), distance=st.floats(1.0, 50.0), alpha=st.floats(LEAST_ALPHA, 1.0))
def test_any_plane_is_smooth_however_slanted_and_far(a, b, distance, alpha):
    depth = plane_depth(PHOTOGRAPHS.cameras[0], (a, b, 1.0), distance)
    assert float(roughness(alpha * depth, alpha * FULL, GREY, FULL)) < 1e-12


def test_bends_cost_as_seldom_as_their_place_is_seen_and_less_at_edges_of_the_photograph():
    depth = plane_depth(PHOTOGRAPHS.cameras[0], (0.1, 0.2, 1.0), 5.0)
    depth[:, 24:] += 1.0
    cost = float(roughness(depth, FULL, GREY, FULL))
    assert cost > 0
    assert float(roughness(depth, FULL, GREY, 0.25 * FULL)) == pytest.approx(0.25 * cost)
    assert float(roughness(3.0 * depth, FULL, GREY, FULL)) == pytest.approx(cost)  # in any unit
    edge = GREY.clone()
    edge[:, 24:] = 250
    assert float(roughness(depth, FULL, edge, FULL)) < 0.05 * cost
    assert float(roughness(depth, 0.9 * LEAST_ALPHA * FULL, GREY, FULL)) == 0  # nothing there to have a depth


def at_points(weight: float = 1.0) -> PixelDepths:
    rows, columns = torch.tensor([0, 5, 5, 39]), torch.tensor([0, 7, 7, 47])
    return PixelDepths(rows, columns, torch.tensor([4.0, 5.0, 5.5, 6.0]).double(), torch.full((4,), weight).double())


def test_depth_that_agrees_with_the_points_costs_nothing_whatever_its_alpha():
    known = at_points()
    depth = torch.full((40, 48), 5.0).double()
    depth[0, 0], depth[39, 47] = 4.0, 6.0
    other = replace(known, depth=torch.tensor([4.0, 5.0, 5.0, 6.0]).double())
    for alpha in (1.0, 0.6):
        assert float(other.error(alpha * depth, alpha * FULL)) < 1e-12
        assert float(known.error(alpha * depth, alpha * FULL)) == pytest.approx(0.5 / 5.5 / 4)
    assert float(at_points(0.5).error(depth, FULL)) == pytest.approx(0.5 / 5.5 / 8)
    assert float(known.error(0.3 * depth, 0.3 * FULL)) == 0  # no depth there yet


@pytest.mark.parametrize("term", ["points", "smooth"])
def test_the_gradients_of_depth_are_those_of_finite_differences(term):
    g = torch.Generator().manual_seed(3)
    depth = (4.0 + torch.rand(40, 48, generator=g)).double()
    alpha = (0.6 + 0.4 * torch.rand(40, 48, generator=g)).double()
    photograph = torch.randint(0, 255, (40, 48, 3), generator=g, dtype=torch.uint8)
    weight = torch.rand(40, 48, generator=g).double()

    def cost(depth: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        known = at_points()
        return known.error(depth, alpha) if term == "points" else roughness(depth, alpha, photograph, weight)

    leaves = depth.clone().requires_grad_(True), alpha.clone().requires_grad_(True)
    found = torch.autograd.grad(cost(*leaves), leaves)
    for place in [(0, 0), (5, 7), (20, 30), (39, 47)]:
        step = torch.zeros(40, 48).double()
        step[place] = 1e-6
        by_depth = (cost(depth + step, alpha) - cost(depth - step, alpha)) / 2e-6
        by_alpha = (cost(depth, alpha + step) - cost(depth, alpha - step)) / 2e-6
        assert float(found[0][place]) == pytest.approx(float(by_depth), rel=1e-4, abs=1e-9)
        assert float(found[1][place]) == pytest.approx(float(by_alpha), rel=1e-4, abs=1e-9)


def test_points_fall_into_the_pixels_that_show_them_in_every_size_and_part():
    camera = PHOTOGRAPHS.cameras[2]
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-3, 3, (50, 2)), rng.uniform(0, 1, (50, 1))], axis=1)
    pixels, depth = camera.project(points)
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    known = KnownDepths.of(Sightings(points, rays, np.arange(len(points))), camera, seldom())
    for part in (camera, camera.resized(24, 20), camera.cropped(10, 5, 40, 30)):
        where, _ = part.project(points)
        inside = part.sees(points)
        found = known.in_picture(part, None)
        assert np.array_equal(np.stack([found.column, found.row], axis=1), np.floor(where[inside]).astype(int))
        assert np.allclose(found.depth, depth[inside])
        assert torch.equal(found.weight, seldom().share(torch.from_numpy(points[inside]).float()))
    nothing = torch.zeros(camera.height, camera.width, dtype=torch.uint8)
    assert len(known.in_picture(camera, nothing).row) == 0
    assert float(known.in_picture(camera, nothing).error(FULL, FULL)) == 0


EVERYWHERE = SeldomConfig(quantile=1.0)


def seldom_stage(asked: SeldomConfig) -> Stage:
    by = seldom(asked.quantile)
    given = plain_stage(replace(CONFIG, seldom=asked))
    if asked.smooth_weight:
        given = replace(given, seldom_cells=[by.cells(camera) for camera in PHOTOGRAPHS.cameras])
    if asked.depth_weight:
        shown = [PLANE.double().numpy()[camera.sees(PLANE.double().numpy())] for camera in PHOTOGRAPHS.cameras]
        given = replace(
            given,
            known_depths=[
                KnownDepths.of(Sightings(points, _rays(points, camera), np.arange(len(points))), camera, by)
                for points, camera in zip(shown, PHOTOGRAPHS.cameras, strict=True)
            ],
        )
    return replace(given, seldom=by)


def _rays(points: np.ndarray, camera: Camera) -> np.ndarray:
    pixels, _ = camera.project(points)
    return (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)


def begin(given: Stage):
    plain = start()
    return start_state(plain.anchors, plain.decoder, given)


ASKED = {
    "drop": replace(EVERYWHERE, drop=0.5),
    "depth": replace(EVERYWHERE, depth_weight=0.5),
    "smooth": replace(EVERYWHERE, smooth_weight=0.5),
}


@pytest.mark.parametrize("name", ASKED)
def test_what_is_asked_changes_training_and_a_weight_of_nothing_does_not(name):
    given = seldom_stage(ASKED[name])
    asked = bits(run(begin(given), given, until=12))
    plain = run(start(), plain_stage(), until=12)
    assert any(asked[tensor] != value for tensor, value in bits(plain).items() if tensor.startswith("anchors"))
    off = replace(given, config=CONFIG)
    state = run(begin(off), off, until=12)
    assert all(bits(state)[tensor] == value for tensor, value in bits(plain).items() if tensor.startswith("anchors"))


def test_places_that_are_seen_often_train_as_before():
    """With V* at the least V of all, nothing is seldom seen: every term is there, and none of them pulls."""
    asked = replace(SeldomConfig(quantile=0.0), drop=0.5, depth_weight=0.5, smooth_weight=0.5)
    given = seldom_stage(asked)
    known = PLANE[native.count_visibility(PLANE, PHOTOGRAPHS.cameras) > 0]
    assert not given.seldom.share(known).any()
    for view, camera in enumerate(PHOTOGRAPHS.cameras):
        held = camera.sees(known.double().numpy())
        assert not given.known_depths[view].weight.any()
        assert not given.seldom_cells[view].any()
        assert held.any()


def test_a_stopped_run_that_leaves_gaussians_out_continues_with_the_same_bits(tmp_path):
    given = seldom_stage(replace(ASKED["drop"], depth_weight=0.1))
    whole = bits(run(begin(given), given))
    state = run(begin(given), given, until=33)
    save_state(tmp_path, to_saved(state))
    saved, _ = load_newest(tmp_path)
    assert saved is not None
    again = run(from_saved(saved, given), given)
    assert again.seldom is not None
    assert len(again.seldom) == len(again.anchors) > len(begin(given).anchors)
    assert torch.equal(again.seldom, given.seldom.share(again.anchors.positions))
    assert bits(again) == whole


def test_depth_comes_nearer_to_the_points():
    """Photographs of a flat colour leave depth open; the points decide it."""
    given = seldom_stage(replace(EVERYWHERE, depth_weight=1.0))
    open_depth = plain_stage(replace(CONFIG, iterations=200))
    given = replace(given, config=replace(given.config, iterations=200))
    errors = []
    for each in (given, open_depth):
        state = begin(each)
        with torch.no_grad():
            state.anchors.positions[:, 2] += 0.3
            state.anchors.log_scales[:, :3] = 0.0  # offsets reach as far as the error
        run(state, each)
        drawn = _median_depth_error(state)
        errors.append(drawn)
    assert errors[0] < 0.7 * errors[1]


def _median_depth_error(state) -> float:
    from vdgs.model.anchor_model import AnchorModel
    from vdgs.model.render import render

    model = AnchorModel(state.anchors, state.decoder, 0.4, (0.0, 0.0, 0.0), {})
    errors = []
    for camera in PHOTOGRAPHS.cameras:
        drawn = render(model, camera, depth=True)
        assert drawn.depth is not None
        errors.append(((drawn.depth / drawn.alpha.clamp(min=0.5)) - 5.0).abs()[drawn.alpha > 0.5])
    return float(torch.cat(errors).median())


def test_a_step_with_nothing_asked_draws_no_depth(monkeypatch):
    import vdgs.training.loop as loop

    asked = []
    drawing = loop.draw_view
    monkeypatch.setattr(loop, "draw_view", lambda *arguments: asked.append(arguments[4]) or drawing(*arguments))
    train_step(start(), plain_stage())
    train_step(begin(seldom_stage(ASKED["smooth"])), seldom_stage(ASKED["smooth"]))
    assert asked == [False, True]
