"""Which rays of the photographs pass above the scene, and the environment map that these photographs make of it.

The skyline of a camera is the elevation, in every direction of the compass, up to which it sees sparse points. What is
above shows sky, or land too far away for anchors. Rays that lead down steeply show ground, with or without points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.model.envmap import ray_angles, ray_directions, row_elevations

#: Sectors of a skyline; each also counts the points of its two neighbors (choice).
SECTORS = 90
#: So many points must reach the skyline: one or two alone are mismatches (choice).
MIN_POINTS = 3
#: No ray is above the scene that leads down by more than this (choice: 5 degrees, where the ground is eleven flying
#: heights away).
LOWEST_ELEVATION = -math.radians(5.0)
#: Below this nothing but the mean color is behind the scene; down to it the map fades into that color (choice).
PLAIN_ELEVATION = -math.radians(30.0)
#: A capture shows sky where so large a share of its pixels looks above horizon and skyline (choice).
MIN_SKY_SHARE = 0.002
#: Edge of a cell of the environment map in pixels of the photographs, and its columns at least and at most (choice).
CELL_PX, MIN_COLUMNS, MAX_COLUMNS = 4.0, 256, 2048
#: Photographs that the first environment map is made of.
MAX_IMAGES = 200
#: Rows and columns of rays by which the share of sky in a photograph is found.
_GRID = (24, 32)

Skyline = Float[Tensor, " sectors"]


def find_skyline(position: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 3"]) -> Skyline:
    """Elevations in radians up to which the points lie around a position, by sector of azimuth from -pi."""
    away = points - position
    elevation = np.arctan2(away[:, 2], np.hypot(away[:, 0], away[:, 1]))
    sector = _sector(torch.from_numpy(np.arctan2(away[:, 1], away[:, 0]))).numpy()
    owner = np.concatenate([(sector + step) % SECTORS for step in (-1, 0, 1)])
    order = np.lexsort((-np.tile(elevation, 3), owner))
    first = np.searchsorted(owner[order], np.arange(SECTORS))
    counts = np.bincount(owner, minlength=SECTORS)
    skyline = np.full(SECTORS, LOWEST_ELEVATION)
    held = counts >= MIN_POINTS
    ranked = np.tile(elevation, 3)[order[first[held] + MIN_POINTS - 1]]
    skyline[held] = np.maximum(ranked, LOWEST_ELEVATION)
    return torch.from_numpy(skyline).float()


def _sector(azimuth: Tensor) -> Tensor:
    return ((azimuth + math.pi) * (SECTORS / (2 * math.pi))).long().clamp_(0, SECTORS - 1)


def above_skyline(directions: Float[Tensor, "*n 3"], skyline: Skyline) -> Bool[Tensor, "*n"]:
    """Which rays of unit directions pass above a skyline."""
    azimuth, elevation = ray_angles(directions)
    return elevation > skyline.to(directions.device)[_sector(azimuth)]


def sky_above(skyline: Skyline, camera: Camera) -> Bool[Tensor, "h w"]:
    """Which pixels of a camera look above a skyline."""
    return above_skyline(ray_directions(camera), skyline)


def find_skylines(
    find_points: Callable[[], Float[np.ndarray, "n 3"]], cameras: Sequence[Camera]
) -> tuple[tuple[Skyline | None, ...], bool]:
    """The skyline of every camera that has a ray so high that it may show sky, None for the others; and whether enough
    of all rays pass above horizon and skyline for the photographs to show sky. Points are not asked for where all
    cameras look down."""
    found, share, points = list[Skyline | None](), 0.0, None
    for camera in cameras:
        directions = ray_directions(camera.resized(_GRID[1], _GRID[0]))
        if float(directions[..., 2].max()) <= math.sin(LOWEST_ELEVATION):
            found.append(None)
            continue
        points = find_points() if points is None else points
        skyline = find_skyline(camera.position, points)
        above = above_skyline(directions, skyline)
        share += float((above & (directions[..., 2] > 0)).float().mean()) / len(cameras)
        found.append(skyline)
    return tuple(found), share >= MIN_SKY_SHARE


def in_sky(
    points: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], skylines: Sequence[Skyline | None]
) -> Bool[np.ndarray, " n"]:
    """Which points more than half of the cameras that hold them in their pictures see above horizon and skyline."""
    sky = np.zeros(len(points), bool)
    # What lies below all cameras is below all horizons.
    higher = np.flatnonzero(points[:, 2] > min((camera.position[2] for camera in cameras), default=np.inf))
    places = points[higher]
    held, above = np.zeros(len(places), np.int64), np.zeros(len(places), np.int64)
    for camera, skyline in zip(cameras, skylines, strict=True):
        inside = np.flatnonzero(camera.in_frustum(places))
        held[inside] += 1
        if skyline is not None:
            rays = torch.from_numpy(places[inside] - camera.position).float()
            rays = rays / rays.norm(dim=-1, keepdim=True)
            above[inside] += (above_skyline(rays, skyline) & (rays[:, 2] > 0)).numpy()
    sky[higher] = 2 * above > held
    return sky


def initial_envmap(
    read: Callable[[int], tuple[Tensor, Tensor | None, Camera]],
    skies: Sequence[Callable[[Camera], Bool[Tensor, "h w"]] | None],
    cameras: Sequence[Camera],
    background: tuple[float, float, float],
) -> Float[Tensor, "rows columns 3"]:
    """The mean of what photographs show in their skies, smoothly continued to where none looks; `background` below 30
    degrees under the horizon. `read` gives a photograph [h, w, 3] uint8, its mask and its camera; `skies` tell which
    pixels of a photograph's camera are sky, None: none are."""
    focal = float(np.median([camera.fx for camera in cameras]))
    columns = int(np.clip(round(2 * math.pi * focal / CELL_PX / 64), MIN_COLUMNS // 64, MAX_COLUMNS // 64)) * 64
    rows = columns // 4
    total = np.zeros((rows * columns, 4))
    shown = [index for index, sky in enumerate(skies) if sky is not None]
    for index in (shown[i] for i in np.unique(np.linspace(0, len(shown) - 1, min(len(shown), MAX_IMAGES)).astype(int))):
        image, mask, camera = read(index)
        find_sky = skies[index]
        assert find_sky is not None
        directions = ray_directions(camera)
        above = find_sky(camera)
        if mask is not None:
            above &= mask > 0
        azimuth, elevation = (each[above].double() for each in ray_angles(directions))
        up = (elevation.abs() * (2 / math.pi)).sqrt().copysign(elevation)
        row = ((1 - up) / 2 * (rows - 1)).round().long()
        cell = (row * columns + ((azimuth / math.pi + 1) / 2 * columns).round().long() % columns).numpy()
        colors = image[above].numpy() / 255.0
        for channel in range(3):
            total[:, channel] += np.bincount(cell, colors[:, channel], len(total))
        total[:, 3] += np.bincount(cell, minlength=len(total))
    sums = total.reshape(rows, columns, 4)
    below = (row_elevations(rows).numpy() < PLAIN_ELEVATION)[:, None] & (sums[..., 3] == 0)
    sums[below] = [*background, 1.0]
    # Land is continued by land: by what is surely below the horizon.
    land = int((row_elevations(rows) > LOWEST_ELEVATION / 2).sum())
    if not sums[:land, :, 3].any():  # masked, or looked for in vain
        sums[:land] = [*background, 1.0]
    return torch.from_numpy(np.concatenate([_fill(sums[:land]), _fill(sums[land:])])).float().contiguous()


def _fill(total: Float[np.ndarray, "h w 4"]) -> Float[np.ndarray, "h w 3"]:
    """Mean colors from sums and counts; where the count is 0, those of larger cells (pull and push), four times as
    wide and twice as high: skies differ more from row to row."""
    seen = total[..., 3:] > 0
    means = total[..., :3] / np.maximum(total[..., 3:], 1e-12)
    if seen.all():
        return means
    if total.shape[0] < 4 or total.shape[1] < 4:
        return np.where(seen, means, total[..., :3].sum((0, 1)) / max(total[..., 3].sum(), 1e-12))
    known = np.concatenate([np.where(seen, means, 0), seen], axis=2)
    half = max(1, total.shape[1] // 4), total.shape[0] // 2
    coarse = _fill(cv2.resize(known, half, interpolation=cv2.INTER_AREA))
    wrapped = np.concatenate([coarse[:, -1:], coarse, coarse[:, :1]], axis=1)
    large = cv2.resize(wrapped, (total.shape[1] + 8, total.shape[0]), interpolation=cv2.INTER_LINEAR)[:, 4:-4]
    return np.where(seen, means, large)
