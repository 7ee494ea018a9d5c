"""The sky of photographs along the outlines of what stands before it, and that nothing opaque grows there."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from support.hand_made_models import camera_above
from vdgs.geometry.camera import Camera
from vdgs.model.envmap import ray_directions, row_elevations
from vdgs.model.initialization.sky import LOWEST_ELEVATION, find_skyline
from vdgs.model.initialization.sky_masks import SkyMask, find_sky_mask

SKY, GROUND = (0.62, 0.74, 0.92), (0.32, 0.42, 0.2)
#: A camera 12 m high that looks level; between two pylons at 30 m the sparse points reach far above the horizon.
CAMERA = camera_above(0.0, 0.0, 12.0, 90.0, 0.0).resized(320, 240)
PYLONS = np.concatenate([np.column_stack([np.full(60, x), np.full(60, 30.0), np.linspace(0, 24, 60)]) for x in (-4, 4)])


def photograph(camera: Camera = CAMERA, cable: bool = False, wall: tuple[float, float, float] | None = None):
    """A photograph [h, w, 3] uint8 with the noise of a camera, and which of its pixels are sky."""
    directions = ray_directions(camera).double().numpy()
    sky = directions[..., 2] > 0
    pixels = np.where(sky[..., None], SKY, GROUND)
    across, up = 30 * directions[..., 0] / directions[..., 1], 30 * directions[..., 2] / directions[..., 1] + 12
    for shape in [(np.abs(np.abs(across) - 4) < 0.5) & (up < 24), *([np.abs(up - 18) < 0.08] if cable else [])]:
        pixels[shape], sky = (0.3, 0.2, 0.2), sky & ~shape
    if wall is not None:
        shape = (np.abs(across) < 2) & (up < 16)
        pixels[shape], sky = wall, sky & ~shape
    noisy = pixels * 255 + np.random.default_rng(0).normal(0, 1.5, pixels.shape)
    return torch.from_numpy(noisy.clip(0, 255).astype(np.uint8)), sky


def sky_mask(image: torch.Tensor, points: np.ndarray = PYLONS) -> SkyMask:
    rows = row_elevations(64)[:, None, None] > 0
    envmap = torch.where(rows, torch.tensor(SKY), torch.tensor(GROUND)).expand(64, 256, 3)
    found = find_sky_mask(image, CAMERA, find_skyline(CAMERA.position, PYLONS), envmap, points)
    assert found is not None
    return found


def test_sky_between_pylons_is_sky_and_what_stands_before_it_is_not() -> None:
    image, sky = photograph()
    found = sky_mask(image)
    shown, empty = found.sky_at(CAMERA).numpy(), found.empty_at(CAMERA).numpy()
    assert (shown & sky).sum() > 0.98 * sky.sum()
    assert (empty & sky).sum() > 0.9 * sky.sum()
    # Below the horizon, where no points are, lies what is too far away for anchors.
    high = ray_directions(CAMERA)[..., 2].numpy() > 0
    assert (shown & ~sky & high).sum() < 0.005 * sky.sum()
    assert not (empty & ~sky).any()


def test_a_cable_of_a_pixel_is_no_empty_sky() -> None:
    image, sky = photograph(cable=True)
    plain = photograph()[1]
    cable = plain & ~sky
    assert 200 < cable.sum() < 1000  # one or two pixels thick
    found = sky_mask(image)
    assert not (found.empty_at(CAMERA).numpy() & cable).any()
    assert (found.empty_at(CAMERA).numpy() & sky).sum() > 0.85 * sky.sum()


@pytest.mark.parametrize("color", [(0.75, 0.74, 0.72), (0.62, 0.74, 0.92)])
def test_a_wall_is_no_sky_by_its_color_or_its_points(color: tuple[float, float, float]) -> None:
    image, sky = photograph(wall=color)
    wall = np.argwhere(photograph()[1] & ~sky)
    assert len(wall)
    x = np.random.default_rng(1).uniform((-2, 12), (2, 16), (4000, 2))
    points = np.column_stack([x[:, 0], np.full(len(x), 30.0), x[:, 1]])
    empty = sky_mask(image, np.concatenate([PYLONS, points])).empty_at(CAMERA).numpy()
    assert empty[tuple(wall.T)].mean() < 0.03


def test_snow_before_a_white_sky_with_points_here_and_there_is_no_sky() -> None:
    """An edge parts it from the sky, and no three of its points lie together."""
    rng, up = np.random.default_rng(1), ray_directions(CAMERA)[..., 2].numpy()
    snow = (up > 0) & (up < math.sin(math.radians(8)))
    image = np.where(snow, 240, np.where(up > 0, 255, 90))[..., None] + rng.normal(0, 1, (*up.shape, 3))
    x, elevation = rng.uniform(-100, 100, 1800), np.full(1800, 8.0)
    elevation[1600:] = rng.uniform(0, 8, 200)  # the others are along the ridge
    z = 12 + np.hypot(x, 100) * np.tan(np.radians(elevation))
    points = np.column_stack([x, np.full(1800, 100.0), z])
    skyline, white = find_skyline(CAMERA.position, points), torch.ones(64, 256, 3)
    found = find_sky_mask(torch.from_numpy(image.clip(0, 255).astype(np.uint8)), CAMERA, skyline, white, points)
    assert found is not None
    assert found.sky_at(CAMERA).numpy()[snow].mean() < 0.2


def test_snow_that_is_plainly_darker_than_the_sky_is_no_opening_though_it_has_no_points() -> None:
    up = ray_directions(CAMERA)[..., 2].numpy()
    snow = (up > 0) & (up < math.sin(math.radians(8)))
    noise = np.random.default_rng(1).normal(0, 1, (*up.shape, 3))
    image = np.where(snow, 232, np.where(up > 0, 252, 90))[..., None] + noise
    x = np.linspace(-100, 100, 1600)
    ridge = np.column_stack([x, np.full(1600, 100.0), 12 + np.hypot(x, 100) * np.tan(np.radians(8.0))])
    skyline, white = find_skyline(CAMERA.position, ridge), torch.full((64, 256, 3), 252 / 255)
    found = find_sky_mask(torch.from_numpy(image.clip(0, 255).astype(np.uint8)), CAMERA, skyline, white, ridge)
    assert found is not None
    assert found.sky_at(CAMERA).numpy()[snow].mean() < 0.2


def test_no_ground_is_empty_sky() -> None:
    """Water and fog below the horizon that look like sky: the map may be behind them, but they may be solid."""
    gray = torch.from_numpy(np.full((240, 320, 3), [int(255 * c) for c in SKY], np.uint8))
    found = sky_mask(gray)
    low = ray_directions(CAMERA)[..., 2] < math.sin(LOWEST_ELEVATION)
    assert not found.empty_at(CAMERA)[low].any()


def test_parts_of_a_photograph_in_other_sizes_show_its_sky() -> None:
    found = sky_mask(photograph()[0])
    whole, half = found.sky_at(CAMERA), CAMERA.resized(160, 120)
    assert torch.equal(found.sky_at(CAMERA.cropped(13, 7, 101, 93)), whole[7:93, 13:101])
    assert torch.equal(found.sky_at(half), whole[1::2, 1::2])
    assert torch.equal(found.sky_at(half.cropped(5, 3, 50, 40)), whole[1::2, 1::2][3:40, 5:50])
