"""Panoramas of 360° of the generated town: six pictures around a place, resampled to one equirectangular picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from support.flights import add_xmp, sky_over, town_of, write_photograph
from vdgs.geometry.camera import Camera
from vdgs.synth.image_renderer import render_image

#: Right, down and forward of the six pictures in east, north, up where the panorama looks north.
_SIDES = (
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)), ((0, -1, 0), (0, 0, -1), (1, 0, 0)), ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((0, 1, 0), (0, 0, -1), (-1, 0, 0)), ((1, 0, 0), (0, 1, 0), (0, 0, 1)), ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
)  # fmt: skip


def heading(degrees: float) -> np.ndarray:
    """World from the world of a panorama that is turned clockwise from north, [3, 3]."""
    sin, cos = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    return np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])


def panorama(place: np.ndarray, degrees: float, width: int, extent: float) -> np.ndarray:
    """An equirectangular picture [width / 2, width, 3] from a place (east, north, up), its middle towards a heading."""
    (town, tracer), side = town_of(extent), width // 3
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(width // 2) + 0.5) / (width // 2))
    longitude, latitude = 2 * np.pi * (u - 0.5), np.pi * (0.5 - v)
    rays = np.stack(
        [np.sin(longitude) * np.cos(latitude), np.cos(longitude) * np.cos(latitude), np.sin(latitude)], axis=-1
    )
    found = np.zeros((*u.shape, 3), np.uint8)
    best = np.argmax([rays @ np.array(axes[2], float) for axes in _SIDES], axis=0)
    for number, axes in enumerate(_SIDES):
        pose = np.eye(4)
        pose[:3, :3] = np.array(axes, float) @ heading(degrees).T
        pose[:3, 3] = -pose[:3, :3] @ place
        focal = side / 2 / 1.04  # a little more than 90 degrees, for the pixels at the edges
        camera = Camera(camera_from_world=pose, fx=focal, fy=focal, cx=side / 2, cy=side / 2, width=side, height=side)
        pixels = render_image(town, tracer, sky_over(extent), camera, 1, np.ones(3))
        local = rays @ np.array(axes, float).T
        here = best == number
        x, y = (focal * local[..., k] / np.where(here, local[..., 2], 1) + side / 2 - 0.5 for k in (0, 1))
        shown = cv2.remap(pixels, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC)
        found[here] = shown[here]
    return found


def fisheye(around: np.ndarray, side: int, focal: float, bend: tuple[float, ...], tilt_deg: float) -> np.ndarray:
    """What a fisheye (OpenCV's k1 to k4) shows of a panorama, tilted from straight down to the middle of that."""
    angles = np.linspace(0, np.pi / 2, 2000)
    radii = focal * angles * (1 + sum(k * angles ** (2 * n + 2) for n, k in enumerate(bend)))
    x, y = np.meshgrid(np.arange(side) + 0.5 - side / 2, np.arange(side) + 0.5 - side / 2)
    radius = np.maximum(np.hypot(x, y), 1e-9)
    angle = np.interp(radius, radii, angles, right=np.nan)
    local = np.stack([np.sin(angle) * x / radius, np.sin(angle) * y / radius, np.cos(angle)], axis=-1)
    sin, cos = np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg))
    right, ahead, up = np.moveaxis(local @ np.array([[1, 0, 0], [0, -cos, -sin], [0, sin, -cos]]), -1, 0)
    longitude, latitude = np.arctan2(right, ahead), np.arcsin(np.clip(up, -1, 1))
    width = around.shape[1]
    column = np.nan_to_num((longitude / (2 * np.pi) + 0.5) * width - 0.5, nan=-9).astype(np.float32)
    row = np.nan_to_num((0.5 - latitude / np.pi) * width / 2 - 0.5, nan=-9).astype(np.float32)
    return cv2.remap(around, column, row, cv2.INTER_CUBIC)


def walk(folder: Path, places: Sequence[np.ndarray], width: int, extent: float = 60.0) -> list[float]:
    """Take panoramas, with their XMP; returns their headings."""
    folder.mkdir(parents=True)
    headings = [float(37 * k % 360) for k in range(len(places))]
    for k, (place, degrees) in enumerate(zip(places, headings, strict=True)):
        file = folder / f"PANO_{k + 1:04d}.JPG"
        write_photograph(file, panorama(place, degrees, width, extent), k, place, xmp="")
        add_xmp(file, b'<rdf:Description GPano:ProjectionType="equirectangular"/>')
    return headings
