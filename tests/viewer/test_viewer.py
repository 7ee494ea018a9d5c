"""What a viewer draws and says, without a browser: every layer where it belongs, and photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from support.captures import camera_at, look_down
from support.hand_made_models import opaque_plane, quadrants, two_floors
from support.viewer_scene import photographed
from vdgs.evaluation.metrics import to_8bit
from vdgs.evaluation.view_exposures import apply_exposure_numpy, log_luminance
from vdgs.export.lod_bake import CameraTable
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.decode_world import gaussian_means
from vdgs.model.exposure import exposure_matrix
from vdgs.model.lod_scene import LodScene
from vdgs.model.lod_tree import LodTree
from vdgs.model.renderer import render, render_scalar_map, without_aliasing
from vdgs.pipeline import build_lod
from vdgs.runs.visibility_store import with_fade
from vdgs.viewer import viewer_scene
from vdgs.viewer.image_comparison import nearest_view_index, warp_image
from vdgs.viewer.layers import LAYERS, DisplayOptions, Painter
from vdgs.viewer.picking import pick_position
from vdgs.viewer.viewer_scene import ViewerScene
from vdgs.visibility.visibility_counts import count_visibility

pytestmark = pytest.mark.xdist_group("viewer_scene")


# ------------------------------------------------------------------------------------- layers


def shown(scene: ViewerScene, model: AnchorModel, camera: Camera) -> np.ndarray:
    """A picture as the viewer shows it: without aliasing."""
    return to_8bit(render(without_aliasing(model, scene.pixel_at_camera_height), camera).image.numpy())


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("model", ["merged", "both"])
def test_rows_drawn_one_after_another_are_the_whole_picture(scene, layer, model):
    camera, shown = camera_at(0.3, -0.5, tilt=20.0), DisplayOptions(layer, model, 0.4)
    painter = Painter(scene)
    painter.update_depth_range(shown, camera)
    whole = painter.paint(shown, camera, camera)
    rows = [painter.paint(shown, camera.cropped(0, a, camera.width, b), camera) for a, b in ((0, 13), (13, 48))]
    assert np.array_equal(np.concatenate(rows), whole)


def test_layers_show_what_they_say(scene):
    camera, painter = camera_at(0.0, 0.0, 6.0), Painter(scene)
    drawn = {layer: painter.paint(DisplayOptions(layer, min_visibility=0), camera, camera) for layer in LAYERS}
    assert np.array_equal(drawn["color"], shown(scene, scene.model("merged"), camera))
    names = list(drawn)
    for a in names:
        assert all(not np.array_equal(drawn[a], drawn[b]) for b in names if b != a)
    roof, floor = (24, 32), (10, 12)
    assert tuple(drawn["depth"][roof]) != tuple(drawn["depth"][floor])
    assert drawn["alpha"][roof].min() > 240
    west, east = (
        drawn["blocks"][:, :24].reshape(-1, 3).mean(axis=0),
        drawn["blocks"][:, 40:].reshape(-1, 3).mean(axis=0),
    )
    assert np.abs(west - east).max() > 25
    for layer in ("depth", "visibility", "alpha", "error"):
        scale = painter.scale(DisplayOptions(layer))
        assert scale is not None
        assert scale.low < scale.high
    assert painter.scale(DisplayOptions("color")) is None


def test_a_run_with_a_tree_is_drawn_through_it(scene, tmp_path, monkeypatch):
    model, camera = scene.model("merged"), camera_at(0.3, -0.5, 6.0, 20.0)
    monkeypatch.setattr(build_lod, "MAX_LEAF_ANCHORS", 200)
    build_lod.build_tree(tmp_path, model, "1-a", CameraTable([view.camera for view in scene.capture.train_views], 4.0))
    tree = LodScene(LodTree(tmp_path), model.without_anchors())
    assert scene.tree("merged") is None  # and stays so, whichever tests came before
    monkeypatch.setattr(viewer_scene, "find_tree", lambda run: tree if run.name == "merged" else None)
    seen = ViewerScene(scene.run, scene._open)
    seen.__dict__["blocks"] = quadrants()
    for layer in LAYERS:
        painter = Painter(seen)
        whole = Painter(scene).paint(DisplayOptions(layer), camera, camera)
        parts = painter.parts_in_detail(DisplayOptions(layer), camera)
        assert len(parts) == (0 if layer == "error" else len(seen.parts_in_detail("merged", camera)))
        refined = draw_parts(painter, DisplayOptions(layer), camera, parts or [camera])
        assert np.abs(refined.astype(int) - whole).mean() < 3, layer
        quick = painter.paint(DisplayOptions(layer), camera, camera, 200)
        assert 0 < painter.drawn_anchors <= 200
        assert np.abs(quick.astype(int) - whole).mean() < 60, layer
    painter, plain = Painter(seen), DisplayOptions(min_visibility=0)
    exact = painter.paint(plain, camera, camera, full_detail=True)
    assert np.array_equal(exact, shown(scene, model, camera))
    monkeypatch.setattr(viewer_scene, "PART_MAX_ANCHORS", 100)
    parts, kept = painter.parts_in_detail(plain, camera), tree.tree.cached_bytes
    assert len(parts) > 4
    for display in (plain, DisplayOptions(model="both", split=0.4), DisplayOptions(mark_trust=True, min_visibility=3)):
        exact = painter.paint(display, camera, camera, full_detail=True)
        assert np.array_equal(draw_parts(painter, display, camera, parts), exact)  # the parts are all of it, each once
    assert tree.tree.cached_bytes == kept  # what pictures of a moving camera need stays in memory
    for visible in (1, 2, 3, 1, 2, 3):  # visitors share what was read of leaves, whatever fades out for each
        painter.paint(DisplayOptions(min_visibility=visible), parts[0], camera, full_detail=True)
    assert len(seen._detailed_trees) == 1
    assert len({id(seen._faded_tree("merged", visible)) for visible in (1, 2, 3, 1, 2, 3)}) == 3
    near = pick_position(seen.shown("merged"), camera, 32.5, 20.5)
    assert near is not None
    assert np.linalg.norm(near - pick_position(model, camera, 32.5, 20.5)) < 0.3


def draw_parts(painter, display, camera, parts):
    """A picture drawn in full detail from its parts, -1 where none is."""
    drawn = np.full((camera.height, camera.width, 3), -1)
    for part in parts:
        x, y = round(camera.cx - part.cx), round(camera.cy - part.cy)
        drawn[y : y + part.height, x : x + part.width] = painter.paint(display, part, camera, full_detail=True)
    return drawn


def test_what_few_cameras_see_fades_out(scene):
    camera, painter = scene.capture.views[0].camera, Painter(scene)
    everything = painter.paint(DisplayOptions(min_visibility=0), camera, camera)
    assert np.array_equal(everything, shown(scene, scene.model("merged"), camera))
    most = int(scene.visibility("merged").max())
    drawn = painter.paint(DisplayOptions(min_visibility=most), camera, camera)
    faded = with_fade(scene.model("merged"), scene._cameras, most)
    kept = count_visibility(gaussian_means(faded.anchors).flatten(0, 1), scene._cameras) >= most
    assert 0 < kept.double().mean() < 1
    assert (faded.anchors.opacity_factors.flatten()[kept] == 1).all()
    assert np.array_equal(drawn, shown(scene, faded, camera))
    assert not np.array_equal(drawn, everything)
    assert np.array_equal(painter.paint(DisplayOptions(min_visibility=99), camera, camera), drawn)  # no more see any


def test_what_few_cameras_see_is_marked(scene):
    camera, painter, model = scene.capture.views[0].camera, Painter(scene), scene.model("merged")
    marking = DisplayOptions(mark_trust=True, min_visibility=0)
    plain = painter.paint(replace(marking, mark_trust=False), camera, camera)
    counted = scene.visibility("merged")
    for fewer in (8, 0):  # as if as many fewer had flown; at last as it was
        scene._visibility["merged"] = (counted - fewer).clamp(min=0)
        marked = painter.paint(marking, camera, camera).astype(int) - plain
        seen = render_scalar_map(model, scene.visibility("merged"), camera).numpy()
        assert (fewer == 8) == bool((np.abs(marked).max(axis=-1) > 20).mean() > 0.9)
        assert fewer == 8 or np.abs(marked[seen > 6]).mean() < 1
    reddened = painter.scale(marking).colorize(np.arange(4.0)[None])[0].astype(int)
    assert (reddened[0] == reddened[1]).all()
    assert (reddened[3] == 255).all()
    assert len(np.unique(reddened, axis=0)) == 3
    blocks = replace(marking, layer="blocks")
    assert np.array_equal(
        painter.paint(blocks, camera, camera), painter.paint(DisplayOptions("blocks", min_visibility=0), camera, camera)
    )


def test_photographs_that_the_model_draws_itself_show_no_error_and_others_do(scene):
    camera = scene.capture.views[4].camera
    painter, shown = Painter(scene), DisplayOptions("error")
    values = painter._comparison.error_map("merged", camera, camera)
    assert np.isfinite(values).mean() > 0.9
    assert np.nanmax(values) < 0.01
    # The coarse model has no roof: where that is, its picture differs.
    assert np.nanmax(painter._comparison.error_map("coarse", camera, camera)) > 0.05
    assert painter.paint(replace(shown, model="coarse"), camera, camera).shape == (48, 64, 3)


def test_an_exposure_of_the_photograph_is_no_error_of_the_model(tmp_path):
    gains = [0.7, 1.2, 0.8, 1.25, 0.9, 1.1, 0.85, 1.2]
    fitted = torch.tensor(gains)[:, None, None] * torch.eye(3, 4) + 0.02 * torch.tensor([0.0, 0.0, 0.0, 1.0])
    model = two_floors()
    model = replace(model, decoder=replace(model.decoder, exposure=fitted - torch.eye(3, 4)))
    # What all have in common is the scene's; the test photograph is the last of the flight, exposed as the one before.
    own = [exposure_matrix(fitted - torch.eye(3, 4), min(number, 7)).double() for number in range(9)]
    scene = photographed(tmp_path, model, lambda number, image: apply_exposure_numpy(image, own[number]))
    comparison = Painter(scene)._comparison
    for index in (0, 3, 8):
        camera = scene.capture.views[index].camera
        values = comparison.error_map("merged", camera, camera)
        assert np.isfinite(values).mean() > 0.8
        assert np.nanmax(values) < 0.01
    scene.close()


def test_what_is_metered_of_thinner_models_differs_little(scene):
    """The law takes many pictures: they are drawn from as many anchors as visitors can wait for."""
    dense = opaque_plane(spacing=0.03)
    opened = ViewerScene(replace(scene.run, model=dense))
    for camera in (camera_at(0.0, 0.0, 5.0), camera_at(-1.0, 0.5, 6.0, 20.0)):
        level, _ = opened.get_level("merged", camera, 5_000)
        assert len(level.model.anchors) < len(dense.anchors) / 4
        whole, thin = (log_luminance(render(each, camera).image.clamp(0, 1).numpy()) for each in (dense, level.model))
        assert abs(whole - thin) < 0.03


def test_what_is_masked_in_the_photograph_is_no_error_of_the_model(tmp_path):
    mask = np.full((48, 64), 255, np.uint8)
    mask[10:30, 20:50] = 0
    cv2.imwrite(str(tmp_path / "4.mask.png"), mask)

    def spoiled(number: int, image: np.ndarray) -> np.ndarray:
        return np.where(mask[..., None] > 0, image, 1.0 - image)

    scene = photographed(tmp_path, two_floors(), spoiled)
    comparison = Painter(scene)._comparison
    masked, other = (scene.capture.views[index].camera for index in (4, 0))
    values = comparison.error_map("merged", masked, masked)
    assert np.isnan(values[10:30, 20:50]).all()
    assert np.nanmax(values) < 0.01
    assert np.isfinite(values).mean() > 0.7
    assert np.nanmax(comparison.error_map("merged", other, other)) > 0.1  # not masked: an error
    scene.close()


def test_a_newer_model_is_compared_anew(tmp_path):
    model = two_floors()
    scene = photographed(tmp_path, model, lambda number, image: image)
    comparison, camera = Painter(scene)._comparison, scene.capture.views[4].camera
    assert np.nanmax(comparison.error_map("merged", camera, camera)) < 0.01
    # One that happens to lie where the older one lay in memory.
    object.__setattr__(model, "anchors", opaque_plane().anchors)
    scene.replace_run(scene.run)
    assert np.nanmax(comparison.error_map("merged", camera, camera)) > 0.05
    scene.close()


def test_two_models_stand_side_by_side(scene):
    camera, painter = camera_at(0.0, 0.0, 6.0), Painter(scene)
    merged, coarse = (painter.paint(DisplayOptions("color", name), camera, camera) for name in ("merged", "coarse"))
    both = painter.paint(DisplayOptions("color", "both", 0.5), camera, camera)
    assert np.array_equal(both[:, 32:], merged[:, 32:])
    assert np.array_equal(both[:, :31], coarse[:, :31])
    for split, alone in ((0.0, merged), (1.0, coarse)):
        assert np.array_equal(painter.paint(DisplayOptions("color", "both", split), camera, camera), alone)


def test_depth_keeps_its_colors_while_the_camera_moves(scene):
    painter, shown = Painter(scene), DisplayOptions("depth")
    high, low = camera_at(0, 0, 6.0), camera_at(0, 0, 3.0)
    painter.update_depth_range(shown, high)
    before = painter.scale(shown)
    painter.paint(shown, low, low)
    assert painter.scale(shown) is before
    painter.update_depth_range(shown, low)
    after = painter.scale(shown)
    assert after is not None
    assert before is not None
    assert after.high < before.high


# ------------------------------------------------------------------------------------- photographs


def test_a_photograph_lies_over_the_model_however_the_camera_turns(scene):
    taken = scene.capture.views[4].camera
    photograph, there = warp_image(scene, 4, taken)
    assert there.all()
    assert np.abs(photograph.astype(int) - to_8bit(render(scene.model("merged"), taken).image.numpy())).max() <= 1
    turned = Camera(
        camera_from_world=look_down(taken.position, 14.0, 80.0), fx=90.0, fy=90.0, cx=40.0, cy=30.0, width=80, height=60
    )
    photograph, there = warp_image(scene, 4, turned)
    model = to_8bit(render(scene.model("merged"), turned).image.numpy())
    assert 0.2 < there.mean() < 1
    assert np.abs(photograph.astype(int) - model)[there].mean() < 12
    assert not warp_image(scene, 4, replace(turned, camera_from_world=look_down(taken.position, 180.0)))[1].any()


def test_the_photograph_is_left_of_its_slider(scene):
    camera, painter = scene.capture.views[0].camera, Painter(scene)
    picture = painter.paint(DisplayOptions("alpha", image_index=0, image_split=0.25), camera, camera)
    alone = painter.paint(DisplayOptions("alpha"), camera, camera)
    assert np.array_equal(picture[:, 16:], alone[:, 16:])
    assert np.abs(picture[:, :15].astype(int) - warp_image(scene, 0, camera)[0][:, :15]).max() == 0


def test_the_nearest_photograph_is_that_of_the_place_and_direction(scene):
    for index, view in enumerate(scene.capture.views):
        assert nearest_view_index(scene, view.camera) == index


def test_errors_and_moves_look_through_no_sparse_points_again(scene, monkeypatch):
    """Of a large capture that takes longer than a preview, for each part of each picture."""
    fresh, camera, asked = ViewerScene(scene.run), camera_at(0.3, -0.5), []
    real = viewer_scene.camera_height
    monkeypatch.setattr(viewer_scene, "camera_height", lambda capture: asked.append(capture) or real(capture))
    painter, display = Painter(fresh), DisplayOptions("error")
    for first, last in ((0, 20), (20, 48)):
        painter.paint(display, camera.cropped(0, first, camera.width, last), camera)
    assert [nearest_view_index(fresh, view.camera) for view in scene.capture.views] == list(range(9))
    assert asked == [scene.capture]
    fresh.close()


def test_the_newest_photograph_file_is_not_needed_to_look(scene, tmp_path: Path):
    """A photograph that is gone is one layer's trouble."""
    views = tuple(replace(view, image_path=tmp_path / "gone.png") for view in scene.capture.views)
    without = ViewerScene(replace(scene.run, capture=replace(scene.capture, views=views)))
    camera = camera_at(0, 0)
    assert Painter(without).paint(DisplayOptions(), camera, camera).shape == (48, 64, 3)
    from vdgs.errors import CaptureError

    with pytest.raises(CaptureError, match=r"gone\.png"):
        Painter(without).paint(DisplayOptions("error"), camera, camera)
    without.close()
