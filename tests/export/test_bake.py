"""Anchor models baked into explicit Gaussians: what they must keep, and what cannot be kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.hand_made_models import camera_above, model_at
from vdgs.export import bake as bake_module
from vdgs.export.bake import BakeContributions, bake, collect_contributions
from vdgs.export.bake_io import load_residual, save_residual
from vdgs.export.color_refinement import MOST_PIXELS, BakedGaussians, refine_colors, view_residual
from vdgs.export.formats.export_scene import ExportScene
from vdgs.export.formats.gaussian_store import write_store
from vdgs.export.gaussian_optimization import optimize_gaussians
from vdgs.export.novel_cameras import color_iteration_cameras, color_iteration_count, endless_cameras, novel_cameras
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import DecoderWeights, MlpWeights
from vdgs.kernels.spherical_harmonics import num_sh_bases
from vdgs.kernels.torch_ref.ellipsoids import log_covariances
from vdgs.model.anchor_model import AnchorModel, DecoderSpan
from vdgs.model.decode_world import decode_world, gaussian_means
from vdgs.model.decoder import Decoder
from vdgs.model.gaussians import Gaussians, render_gaussians
from vdgs.model.renderer import decode_view, render

pytestmark = pytest.mark.slow

VIEWS = [camera_above(0.3, -0.2), camera_above(-2.0, 1.0, tilt_deg=30.0), camera_above(1.5, 2.0, tilt_deg=-25.0)]


def scattered(n: int = 200, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-3, -3, 0), (3, 3, 0.5), (n, 3))


def blind(decoder: Decoder) -> Decoder:
    """The decoder without a view of where it is seen from."""

    def without(head: MlpWeights) -> MlpWeights:
        w1 = head.w1.clone()
        w1[:, 32:] = 0.0
        return replace(head, w1=w1)

    weights = decoder.weights
    return replace(
        decoder,
        weights=DecoderWeights(without(weights.opacity), without(weights.covariance), without(weights.color)),
    )


def baked(seen: BakeContributions, degree: int = 3, kept: np.ndarray | None = None) -> Gaussians:
    parts = list(bake(seen, np.flatnonzero(seen.pixels > 0) if kept is None else kept, degree))
    return Gaussians(**{name: torch.cat([part.tensors()[name] for part in parts]) for name in parts[0].tensors()})


def drawn(gaussians: Gaussians, model: AnchorModel, camera) -> np.ndarray:
    with torch.no_grad():
        picture, _ = render_gaussians(gaussians, camera, torch.tensor(model.background), gaussians.sh_degree)
    return picture.image.numpy()


def flat(decoder: Decoder) -> Decoder:
    """The decoder of which every second Gaussian has a scale so small that it is 0 in float32."""
    weights = decoder.weights
    b2 = weights.covariance.b2.clone()
    b2.view(-1, 7)[::2, 0] = -200.0
    return replace(decoder, weights=replace(weights, covariance=replace(weights.covariance, b2=b2)))


def test_gaussians_of_no_thickness_are_baked_very_thin():
    model = model_at(scattered())
    model = replace(model, decoder=flat(model.decoder))
    rows, _ = decode_view(model, VIEWS[0])
    assert (decode_world(model.anchors, rows, model.decoder.weights, VIEWS[0]).scales == 0).any()
    gaussians = baked(collect_contributions(model, VIEWS))
    assert all(bool(tensor.isfinite().all()) for tensor in gaussians.tensors().values())
    assert gaussians.log_scales.min().exp() < 1e-6
    with torch.no_grad():
        own = render(model, VIEWS[0]).image.numpy()
    assert np.abs(drawn(gaussians, model, VIEWS[0]) - own).mean() < 0.01


def test_what_is_spawned_is_what_the_kernels_decode():
    model = model_at(scattered())
    k = model.anchors.offsets.shape[1]
    for camera in VIEWS:
        rows, splats = decode_view(model, camera)
        world = decode_world(model.anchors, rows, model.decoder.weights, camera)
        row, offset = splats.source.long() // k, splats.source.long() % k
        assert torch.allclose(world.colors[row, offset], splats.colors, atol=1e-5)
        assert torch.allclose(world.opacities[row, offset], splats.opacities, atol=1e-5)
        assert torch.allclose(world.scales[row, offset].prod(-1), splats.volumes, rtol=1e-3)
        pixels, _ = camera.project(gaussian_means(model.anchors)[rows][row, offset].double().numpy())
        assert np.allclose(pixels, splats.means_px.numpy(), atol=1e-2)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("parts", [(), (80, 0, 120)])
def test_a_model_that_looks_alike_from_everywhere_is_baked_as_it_is(degree, parts):
    model = model_at(scattered())
    model = replace(
        model, decoder=blind(model.decoder), decoder_spans=tuple(DecoderSpan(n, blind(model.decoder)) for n in parts)
    )
    gaussians = baked(collect_contributions(model, VIEWS), degree)
    assert gaussians.shN.shape[1:] == (num_sh_bases(degree) - 1, 3)
    for camera in VIEWS:
        assert np.abs(drawn(gaussians, model, camera) - render(model, camera).image.numpy()).max() < 0.01


def test_more_harmonics_come_nearer_to_a_model_that_looks_different_from_everywhere():
    model = model_at(scattered())
    color = model.decoder.weights.color
    steep = replace(color, w1=torch.cat([color.w1[:, :32], 10 * color.w1[:, 32:]], 1))
    still = blind(model.decoder)
    model = replace(model, decoder=replace(still, weights=replace(still.weights, color=steep)))
    views = [camera_above(x, y, tilt_deg=tilt) for x in (-2, 0, 2) for y in (-2, 0, 2) for tilt in (-30, 0, 30)]
    seen = collect_contributions(model, views)
    errors = []
    for degree in (0, 1, 2, 3):
        gaussians = baked(seen, degree)
        errors.append(np.mean([(drawn(gaussians, model, v) - render(model, v).image.numpy()) ** 2 for v in views]))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.1 * errors[0]


def test_only_what_views_show_is_kept_and_pixels_count_what_is_drawn():
    model = model_at(scattered())
    seen = collect_contributions(model, VIEWS)
    assert 0 < np.count_nonzero(seen.pixels) < seen.pixels.size
    assert seen.pixels.sum() == pytest.approx(sum(float(render(model, v).alpha.sum()) for v in VIEWS), rel=1e-2)
    away = collect_contributions(model, [camera_above(500.0, 500.0)])
    assert not away.pixels.any()
    assert list(bake(away, np.zeros(0, np.int64), 3)) == []
    with pytest.raises(ValueError, match="cameras"):
        collect_contributions(model, [])


def test_parts_do_not_change_what_is_baked(monkeypatch):
    model = model_at(scattered())
    seen = collect_contributions(model, VIEWS)
    kept = np.flatnonzero(seen.pixels > 0)[::3]
    whole, done = baked(seen, 3, kept), list[int]()
    expected = whole.tensors()
    monkeypatch.setattr(bake_module, "ANCHORS_PER_PART", 17)
    parts = list(bake(seen, kept, 3, done.append))
    assert len(parts) > 5
    assert done[-1] == len(kept) == len(whole)
    joined = {name: torch.cat([part.tensors()[name] for part in parts]) for name in whole.tensors()}
    # Ellipsoids as a whole: where two axes are alike, rounding decides where these two point.
    shapes = [log_covariances(each.pop("log_scales"), each.pop("quaternions")) for each in (joined, expected)]
    assert torch.allclose(*shapes, atol=1e-5)
    for name, tensor in expected.items():
        assert torch.allclose(joined[name], tensor, atol=1e-5), name


def test_places_and_numbers_of_what_is_kept():
    model = model_at(scattered())
    seen = collect_contributions(model, VIEWS)
    kept = np.flatnonzero(seen.pixels > 0)
    gaussians = baked(seen, 0, kept)
    assert torch.equal(gaussians.means, gaussian_means(model.anchors).reshape(-1, 3)[torch.from_numpy(kept)])
    assert torch.allclose(gaussians.quaternions.norm(dim=1), torch.ones(len(kept)), atol=1e-5)
    assert all(bool(torch.isfinite(tensor).all()) for tensor in gaussians.tensors().values())


def steep(model: AnchorModel) -> AnchorModel:
    """The model with colors, opacities and shapes that change much with where it is seen from."""

    def steeper(head: MlpWeights) -> MlpWeights:
        return replace(head, w1=torch.cat([head.w1[:, :32], 6 * head.w1[:, 32:]], 1))

    weights = model.decoder.weights
    heads = DecoderWeights(steeper(weights.opacity), steeper(weights.covariance), steeper(weights.color))
    return replace(model, decoder=replace(model.decoder, weights=heads))


def on_disk(seen: BakeContributions, kept: np.ndarray, folder: Path, degree: int = 3) -> BakedGaussians:
    return BakedGaussians(
        seen.model,
        kept,
        write_store(ExportScene(chunks=bake(seen, kept, degree), count=len(kept), degree=degree), folder / "spool"),
    )


def error(shown: BakedGaussians, views: Sequence[Camera]) -> float:
    """Mean squared, of what is baked against what the model shows by it."""
    gaussians = shown.spool.rows(np.arange(len(shown.spool.means)))
    pairs = [(drawn(gaussians, shown.model, view), shown.render_target(view)[0].numpy()) for view in views]
    return float(np.mean([(mine - wanted) ** 2 for mine, wanted in pairs]))


GRID = [camera_above(x, y, tilt_deg=tilt) for x in (-2, 0, 2) for y in (-2, 0, 2) for tilt in (-30, 0, 30)]


@pytest.mark.parametrize("degree", [0, 3])
def test_colors_stand_in_for_opacities_and_shapes_that_change(tmp_path, degree):
    seen = collect_contributions(steep(model_at(scattered())), GRID)
    shown = on_disk(seen, np.flatnonzero(seen.pixels > 0), tmp_path, degree)
    errors, others = [error(shown, GRID)], [error(shown, novel_cameras(GRID, 9))]
    opacities = shown.spool.rows(np.arange(9)).opacity_logits
    for number in range(2):
        refine_colors(shown, [*GRID, *novel_cameras(GRID, number)])
        errors.append(error(shown, GRID))
        others.append(error(shown, novel_cameras(GRID, 9)))
    assert errors == sorted(errors, reverse=True)
    assert others == sorted(others, reverse=True)
    if degree:
        assert errors[-1] < 0.5 * errors[0]
    assert torch.equal(shown.spool.rows(np.arange(9)).opacity_logits, opacities)


def test_a_part_of_a_scene_is_compared_with_that_part(tmp_path):
    model = model_at(scattered())
    model = replace(model, decoder=blind(model.decoder))
    seen = collect_contributions(model, VIEWS)
    part = np.flatnonzero((seen.pixels > 0) & (np.arange(len(seen.pixels)) < len(seen.pixels) // 3))
    shown = on_disk(seen, part, tmp_path)
    before = shown.spool.rows(np.arange(len(part)))
    refine_colors(shown, VIEWS)
    after = shown.spool.rows(np.arange(len(part)))
    # Nothing changes with the direction, so nothing is missing: what was left out is not painted onto what stays.
    assert (after.sh0 - before.sh0).abs().max() < 0.02
    assert np.array_equal(shown.rows_of_anchors(np.arange(len(model.anchors))), np.arange(len(part)))


def test_a_gaussian_that_fills_a_large_photograph_keeps_its_color(tmp_path):
    """More pixels than a float16 counts: what is saved of a view, in memory and in files, stays finite."""
    seen = collect_contributions(model_at(scattered()), GRID)
    shown = on_disk(seen, np.flatnonzero(seen.pixels > 0), tmp_path)
    large = GRID[4].resized(64 * GRID[4].width, 64 * GRID[4].height)
    view = view_residual(shown, large)
    save_residual(tmp_path / "view.npy", view)
    assert view.pixels.max() == load_residual(tmp_path / "view.npy").pixels.max() == MOST_PIXELS
    refine_colors(shown, [large])
    after = shown.spool.rows(np.arange(len(shown.spool.means)))
    assert torch.isfinite(after.sh0).all()
    assert torch.isfinite(after.shN).all()


def test_refining_comes_nearer_and_ends_when_its_time_is_over(tmp_path):
    seen = collect_contributions(steep(model_at(scattered())), GRID)
    shown = on_disk(seen, np.flatnonzero(seen.pixels > 0), tmp_path, degree=1)
    refine_colors(shown, GRID)
    before, means = error(shown, GRID), np.array(shown.spool.means)
    ticks = iter(range(1000))
    passed: list[float] = []
    assert optimize_gaussians(shown, endless_cameras(GRID), 80.0, passed.append, clock=lambda: next(ticks)) == 79
    assert passed == list(range(1, 80))
    assert error(shown, GRID) < 0.9 * before
    assert np.array_equal(shown.spool.rows(np.arange(len(means))).means.numpy(), means)
    optimize_gaussians(shown, endless_cameras(GRID), max_steps=2, center_rate=0.03)
    assert not np.array_equal(shown.spool.means, means)
    assert np.array_equal(shown.spool.rows(np.arange(len(means))).means.numpy(), shown.spool.means)


def test_cameras_between_lie_among_neighbors_that_look_alike_and_are_never_the_same():
    turned = camera_above(0.0, 0.0, tilt_deg=80.0)
    cameras = [*GRID, turned]
    found = [*novel_cameras(cameras, 0), *novel_cameras(cameras, 1)]
    assert len(found) == 2 * len(GRID)  # nobody looks as that one does
    assert len({camera.position.tobytes() for camera in found}) == len(found)
    for camera, own in zip(found, [*GRID, *GRID], strict=True):
        turn = Rotation.from_matrix(camera.camera_from_world[:3, :3] @ own.camera_from_world[:3, :3].T)
        assert 0 < turn.magnitude() <= 3**0.5 * 0.5 * np.arctan(own.width / 2 / own.fx)
        alike = np.array([each.position for each in GRID if own.forward @ each.forward > 0.7])
        assert (camera.position >= alike.min(0) - 1e-9).all()
        assert (camera.position <= alike.max(0) + 1e-9).all()
    assert novel_cameras(VIEWS[:1], 0) == []
    assert [each.position.tolist() for each in novel_cameras(VIEWS, 3)] == [
        each.position.tolist() for each in novel_cameras(VIEWS, 3)
    ]


def test_rounds_look_from_between_and_the_last_one_at_the_photographs_too():
    """A camera without neighbors stays in all of them: nobody else looks there."""
    cameras = [*GRID, camera_above(0.0, 0.0, tilt_deg=80.0)]
    planned = color_iteration_cameras(cameras, 4)
    known = {camera.position.tobytes() for camera in GRID}
    assert [len(each) for each in planned] == [len(cameras)] * 3 + [len(cameras) + len(GRID)]
    for each in planned[:3]:
        assert each[-1].position == pytest.approx(cameras[-1].position)
        assert not known & {camera.position.tobytes() for camera in each[:-1]}
    assert list(planned[3][: len(cameras)]) == cameras
    assert color_iteration_cameras(cameras, 0) == ()
    assert len(color_iteration_cameras(cameras, 1)) == 1
    assert (
        color_iteration_count(None, 10**6),
        color_iteration_count(None, 10**7),
        color_iteration_count(3, 10**7),
    ) == (8, 1, 3)


def test_more_rounds_come_nearer_where_none_of_them_looked(tmp_path):
    seen = collect_contributions(steep(model_at(scattered())), GRID)
    errors = []
    for count in (0, 1, 6):
        (folder := tmp_path / str(count)).mkdir()
        shown = on_disk(seen, np.flatnonzero(seen.pixels > 0), folder)
        for each in color_iteration_cameras(GRID, count):
            refine_colors(shown, each)
        errors.append(error(shown, novel_cameras(GRID, 99)))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.6 * errors[1]


def test_cameras_to_refine_by_never_end_nor_come_again_but_for_those_of_photographs():
    shown = list(islice(endless_cameras(GRID), 4 * len(GRID)))
    places = [camera.position.tobytes() for camera in shown]
    known = {camera.position.tobytes() for camera in GRID}
    of_rounds = {
        camera.position.tobytes() for cameras in color_iteration_cameras(GRID, 6) for camera in cameras
    } - known
    others = [place for place in places if place not in known]
    assert len(others) == len(set(others)) == 2 * len(GRID)
    assert not of_rounds & set(others)
