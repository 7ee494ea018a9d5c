"""Which pixels of photographs show sky, along the outlines of what stands before it.

A skyline is coarse: a mast lifts it over a sector of azimuth, with the sky beside the mast. Here the sky above the
skyline grows down into what is smooth and has its color.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.model.envmap import ray_directions, sample_envmap
from vdgs.model.initialization.sky import LOWEST_ELEVATION, MIN_POINTS, PLAIN_ELEVATION, Skyline, above_skyline

#: Photographs are looked at in at most so many pixels along the longer side (choice).
MAX_SIDE_PX = 1024
#: Sky differs from the environment map, in the photograph's own brightness, by at most so much in any channel (choice).
MAX_DIFFERENCE = 0.1
#: Sky apart from the sky above the skyline differs by at most so much in the mean: more is a pale wall (choice).
MAX_OPENING_DIFFERENCE = 0.06
#: Sky changes by at most so much within 3 x 3 pixels, blurred by one pixel: a cable changes more (choice).
MAX_CHANGE = 0.03
#: The borders of objects are not smooth: pixels of the sky's color up to so far from smooth sky are sky (choice).
BORDER_PX = 3
#: No sky is within so many pixels of a sparse point that has others around it, at most so many away (choice).
POINT_PX, CLUSTER_PX = 2, 6
#: Sky apart from the sky above the skyline fills at least such a share of the photograph (choice).
MIN_APERTURE = 0.001


@dataclass(frozen=True, eq=False)
class SkyMask:
    """The sky of a photograph, as packed bits in rows: two bits a pixel."""

    #: Of the whole photograph, in the size of the mask.
    camera: Camera
    _sky: UInt8[np.ndarray, "h packed"]
    _empty: UInt8[np.ndarray, "h packed"]

    @staticmethod
    def of(camera: Camera, sky: Bool[np.ndarray, "h w"], empty: Bool[np.ndarray, "h w"]) -> SkyMask:
        """From masks of the pixels of a camera: what `sky_at` and `empty_at` tell."""
        return SkyMask(camera, np.packbits(sky, axis=1), np.packbits(empty, axis=1))

    def sky_at(self, camera: Camera) -> Bool[Tensor, "h w"]:
        """The pixels behind which is sky, or land too far away for anchors, in a part of the photograph in any size."""
        return self._at(self._sky, camera)

    def empty_at(self, camera: Camera) -> Bool[Tensor, "h w"]:
        """The pixels of the sky that surely show nothing else; as `sky_at`."""
        return self._at(self._empty, camera)

    def _at(self, packed: np.ndarray, camera: Camera) -> Bool[Tensor, "h w"]:
        whole = self.camera
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx * whole.fx + whole.cx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy * whole.fy + whole.cy
        columns = np.clip(np.floor(x).astype(int), 0, whole.width - 1)
        rows = np.clip(np.floor(y).astype(int), 0, whole.height - 1)
        return torch.from_numpy(np.unpackbits(packed[rows], axis=1, count=whole.width)[:, columns].astype(bool))


def find_sky_masks(
    read: Callable[[int], UInt8[Tensor, "h w 3"]],
    cameras: Sequence[Camera],
    skylines: Sequence[Skyline | None],
    envmap: Float[Tensor, "rows columns 3"],
    points: Float[np.ndarray, "n 3"],
) -> tuple[SkyMask | None, ...]:
    """The sky of photographs that have a skyline, None where there is none. `read` gives a photograph, `envmap` about
    what the sky looks like; there is no sky where `points` of the scene are seen."""
    return tuple(
        None if skyline is None else find_sky_mask(read(index), camera, skyline, envmap, points)
        for index, (camera, skyline) in enumerate(zip(cameras, skylines, strict=True))
    )


def find_sky_mask(
    image: UInt8[Tensor, "h w 3"],
    camera: Camera,
    skyline: Skyline,
    envmap: Float[Tensor, "rows columns 3"],
    points: Float[np.ndarray, "n 3"],
) -> SkyMask | None:
    """The sky of one photograph, as `find_sky_masks`."""
    camera = camera.limit_size(MAX_SIDE_PX)
    directions = ray_directions(camera)
    up = directions[..., 2].numpy()
    above = above_skyline(directions, skyline).numpy()
    pixels = cv2.resize(image.numpy(), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    pixels = pixels.astype(np.float32) / 255.0
    smooth = _change(pixels) <= MAX_CHANGE
    apart = pixels - _sky_colors(envmap, directions)
    if (above & smooth).any():  # the photograph's own brightness
        apart -= np.median(apart[above & smooth], axis=0)
    difference = np.abs(apart).max(axis=2)
    alike = (difference <= MAX_DIFFERENCE) & (up > math.sin(PLAIN_ELEVATION))
    shown = _shown_points(points, camera)
    alike &= ~_shows_points(shown)
    count, parts = cv2.connectedComponents((alike & smooth).astype(np.uint8), connectivity=4)
    grows = np.bincount(parts[above & smooth], minlength=count) > 0
    opens = np.bincount(parts[up > 0], minlength=count) > 0
    # What shows below a bridge or through a frame.
    sizes = np.bincount(parts.ravel(), minlength=count)
    opens &= sizes >= MIN_APERTURE * parts.size
    opens &= np.bincount(parts.ravel(), difference.ravel(), minlength=count) <= MAX_OPENING_DIFFERENCE * sizes
    # A white wall or snow before a white sky has points here and there; those at outlines are of what stands there.
    deep = cv2.erode((parts > 0).astype(np.uint8), np.ones((2 * CLUSTER_PX + 1,) * 2, np.uint8)) * shown
    opens &= np.bincount(parts.ravel(), deep.ravel(), minlength=count) < MIN_POINTS
    grows[0] = opens[0] = False
    grown = grows[parts]
    border = cv2.dilate((grows | opens)[parts].astype(np.uint8), np.ones((2 * BORDER_PX + 1,) * 2, np.uint8)) > 0
    sky = above | (border & alike)
    return SkyMask.of(camera, sky, grown & (up > math.sin(LOWEST_ELEVATION))) if sky.any() else None


def _sky_colors(
    envmap: Float[Tensor, "rows columns 3"], directions: Float[Tensor, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """The colors of a map; below the horizon those at the horizon above it, for there the map shows land."""
    lifted = directions.clone()
    lifted[..., 2].clamp_(min=0.01)
    return sample_envmap(envmap.detach().cpu(), lifted / lifted.norm(dim=-1, keepdim=True)).numpy()


def _change(pixels: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """By how much the pixels around each differ, at most, in any channel."""
    blurred, around = cv2.GaussianBlur(pixels, (0, 0), 1.0), np.ones((3, 3), np.uint8)
    return (cv2.dilate(blurred, around) - cv2.erode(blurred, around)).max(axis=2)


def _shown_points(points: Float[np.ndarray, "n 3"], camera: Camera) -> Float[np.ndarray, "h w"]:
    """How many points of the scene lie behind each pixel."""
    shown, (at, depth) = np.zeros((camera.height, camera.width), np.float32), camera.project(points)
    columns, rows = np.floor(at[camera.holds(at, depth)]).astype(int).T
    np.add.at(shown, (rows, columns), 1.0)
    return shown


def _shows_points(shown: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The pixels around points of the scene; not around one or two alone, which are mismatches."""
    many = cv2.boxFilter(shown, -1, (2 * CLUSTER_PX + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
    near = ((shown > 0) & (many > MIN_POINTS - 0.5)).astype(np.uint8)
    return cv2.dilate(near, np.ones((2 * POINT_PX + 1,) * 2, np.uint8)) > 0
