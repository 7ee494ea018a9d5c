"""Detail that a map takes from the photographs: where they see the place, and without borders of tiles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.captures import look_down
from support.mapped_house import GROUND, model_of, surveyor_of
from vdgs.captures.capture import Capture
from vdgs.geometry.map_projection import MapProjection
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.decoder import Decoder
from vdgs.model.renderer import render
from vdgs.rendering.ortho import detail_transfer
from vdgs.rendering.ortho.detail_transfer import DetailTransfer
from vdgs.rendering.ortho.pixel_grid import PixelGrid

pytestmark = pytest.mark.slow

pytest.importorskip("pyproj")


def pattern(places: np.ndarray) -> np.ndarray:
    """A fine weave of the ground, -1 or 1, by x and y."""
    return np.sign(np.sin(places[..., 0] * 2 * np.pi / 0.9) * np.sin(places[..., 1] * 2 * np.pi / 0.9))


def photographed(capture: Capture, model: AnchorModel, folder: Path, woven: float) -> Capture:
    """Photographs of the model on disk, the ground (not the roof) woven with detail that the model does not have."""
    views = []
    for view in capture.views:
        sharp = view.camera.resized(320, 240)
        drawn = render(model, sharp, depth=True)
        places = sharp.unproject(drawn.median_depth.numpy())
        low = (places[..., 2] < 1.0)[..., None]
        image = (drawn.image.numpy() + woven * low * pattern(places)[..., None]).clip(0, 1)
        Image.fromarray((image * 255 + 0.5).astype(np.uint8)).save(folder / view.name)
        views.append(replace(view, camera=sharp, image_path=folder / view.name))
    return replace(capture, views=tuple(views))


@pytest.mark.parametrize("woven", [0.0, 0.06])
def test_detail_comes_from_the_photographs_where_they_see_the_place(house, tmp_path, woven):
    capture, model = house
    capture = photographed(capture, model, tmp_path, woven)
    grid = PixelGrid(-3.0, 5.0, 0.08, 120, 100)
    placement, sharpener = MapProjection.of(capture.ground, "local"), DetailTransfer(model, capture)
    plain = surveyor_of(model, capture, placement).render_tile(grid)
    sharp = surveyor_of(model, capture, placement, detail_transfer=sharpener).render_tile(grid)
    sharpener.close()
    np.testing.assert_array_equal(sharp.heights, plain.heights)
    gained = (sharp.colors.astype(float) - plain.colors).mean(axis=-1) / 255
    x = grid.left + (np.arange(120) + 0.5) * 0.08
    y = grid.top - (np.arange(100) + 0.5) * 0.08
    ground = plain.heights < 1.0
    if not woven:
        assert np.abs(gained).mean() < 0.01
        return
    detail = pattern(np.stack(np.meshgrid(x, y), axis=-1))
    assert np.corrcoef(gained[ground], detail[ground])[0, 1] > 0.7
    assert np.abs(gained[~ground]).mean() < 0.35 * np.abs(gained[ground]).mean()


def test_photographs_far_away_change_no_detail(house, tmp_path, monkeypatch):
    capture, model = house
    capture = photographed(capture, model, tmp_path, 0.06)
    away = look_down(np.array([900.0, 0.0, 20.0]))
    far = tuple(replace(view, camera=replace(view.camera, camera_from_world=away)) for view in capture.views)
    grid, placement = PixelGrid(-3.0, 5.0, 0.16, 60, 50), MapProjection.of(capture.ground, "local")
    asked, trust = [], detail_transfer._trust
    monkeypatch.setattr(detail_transfer, "_trust", lambda camera, at: asked.append(camera) or trust(camera, at))
    colors = []
    for views in (capture.views, (*far, *capture.views)):
        sharpener = DetailTransfer(model, replace(capture, views=views))
        colors.append(surveyor_of(model, capture, placement, detail_transfer=sharpener).render_tile(grid).colors)
        sharpener.close()
    np.testing.assert_array_equal(*colors)
    assert not any(camera.position[0] > 100 for camera in asked)


def gray(places: np.ndarray) -> AnchorModel:
    """The same splats, all of one gray."""
    model = model_of(places)
    tensors = {name: tensor.clone() for name, tensor in model.decoder.tensors().items()}
    tensors["color_w2"].zero_()
    tensors["color_b2"].zero_()
    return replace(model, decoder=Decoder.from_tensors(tensors))


def misted(capture: Capture, folder: Path) -> Capture:
    """Photographs, whose own brightness waves smoothly with the place and is another in each."""
    views = []
    for number, view in enumerate(capture.views):
        sharp = view.camera.resized(320, 240)
        x, y, _ = np.moveaxis(sharp.unproject(np.full((240, 320), sharp.position[2])), -1, 0)
        light = 0.5 + 0.1 * np.sin(2 * np.pi * (x + 0.3 * number) / 4.1) * np.cos(2 * np.pi * y / 5.3)
        Image.fromarray((light[..., None].repeat(3, axis=2) * 255 + 0.5).astype(np.uint8)).save(folder / view.name)
        views.append(replace(view, camera=sharp, image_path=folder / view.name))
    return replace(capture, views=tuple(views))


@pytest.mark.parametrize("most", [12, 2])
def test_detail_knows_no_borders_of_tiles(house, tmp_path, monkeypatch, most):
    """Also where only some of the photographs are looked up."""
    monkeypatch.setattr(detail_transfer, "_MAX_VIEWS", most)
    capture, _ = house
    capture, model = misted(capture, tmp_path), gray(GROUND)
    sharpener = DetailTransfer(model, capture)
    surveyor = surveyor_of(model, capture, MapProjection.of(capture.ground, "local"), detail_transfer=sharpener)
    grid = PixelGrid(-8.0, 4.0, 0.08, 200, 100)
    whole = surveyor.render_tile(grid).colors
    joined = np.zeros_like(whole)
    for column, row, part in grid.tiles(50):
        joined[row : row + part.height, column : column + part.width] = surveyor.render_tile(part).colors
    sharpener.close()
    assert np.ptp(whole[..., 0].astype(int)) > 10
    off = np.abs(joined.astype(int) - whole)
    assert off.max() <= 1
    assert (off > 0).mean() < 0.01
