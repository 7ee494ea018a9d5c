"""A synthetic site of any size: anchors, cameras over them, blocks side by side, and a COLMAP capture of them.

The site grows with the photographs, so that a place is seen by about as many however large the site is: a flight of
5000 photographs covers two kilometres by two. Half of the anchors lie evenly on the plane, half in dense quarters, as a
coarse model has them where there is texture.
"""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
import torch
from PIL import Image

from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.partition.blocks import Block, Blocks

#: Metres of the side of a site, for each root of a photograph.
EXTENT_A_ROOT = 2000.0 / 5000**0.5
HEIGHT_M, QUARTERS, OFFSETS = 120.0, 40, 10
#: Every third photograph is an oblique.
TILTS_DEG = (0.0, 0.0, 45.0)
#: Of a photograph of the capture on disk, pixels; focal length in widths.
SIZE, FOCAL = (96, 72), 0.75
#: Sparse points of a capture, and sightings, for each photograph.
POINTS_EACH, SEEN_EACH = 200, 2000


def extent_for(cameras: int) -> float:
    """The side in metres of the site that so many photographs cover."""
    return EXTENT_A_ROOT * cameras**0.5


def flight(count: int, width: int = 1200, height: int = 800) -> list[Camera]:
    """Photographs from 120 m in serpentines, every third an oblique of 45 degrees in a random direction."""
    generator = np.random.default_rng(0)
    across = int(np.ceil(count**0.5))
    step = extent_for(count) / across
    return [
        _tilted_camera((index % across + 0.5) * step, (index // across + 0.5) * step,
                 generator.uniform(0, 2 * np.pi), TILTS_DEG[index % len(TILTS_DEG)], width, height)
        for index in range(count)
    ]  # fmt: skip


def _tilted_camera(x: float, y: float, heading: float, tilt_deg: float, width: int, height: int) -> Camera:
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    c, s = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    lean = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    rigid = np.eye(4)
    rigid[:3, :3] = lean @ np.diag([1.0, -1.0, -1.0]) @ turn
    rigid[:3, 3] = -rigid[:3, :3] @ [x, y, HEIGHT_M]
    return Camera(
        camera_from_world=rigid, fx=FOCAL * width, fy=FOCAL * width, cx=width / 2, cy=height / 2, width=width,
        height=height,
    )  # fmt: skip


def random_positions(count: int, extent_m: float, seed: int = 1) -> np.ndarray:
    """Where anchors are, [n, 3] float32, in no order: half evenly, half in quarters, up to 60 m high; a few strays."""
    generator = np.random.default_rng(seed)
    quarters = generator.uniform(0, extent_m, (QUARTERS, 2))
    positions = np.empty((count, 3), np.float32)
    positions[:, :2] = generator.uniform(0, extent_m, (count, 2))
    dense = count // 2
    positions[:dense, :2] = quarters[generator.integers(0, QUARTERS, dense)]
    positions[:dense, :2] += generator.normal(0, extent_m / QUARTERS, (dense, 2))
    positions[:, 2] = 60 * generator.random(count) ** 3
    positions[: count // 2000, :2] *= 1.5
    return positions


def random_model(positions: np.ndarray, extent_m: float) -> AnchorModel:
    """Anchors that are as large as they lie apart, with a decoder that nothing trained."""
    n, g = len(positions), torch.Generator().manual_seed(0)
    spacing = extent_m / n**0.5
    anchors = Anchors(
        positions=torch.from_numpy(positions),
        features=0.5 * torch.randn(n, 32, generator=g),
        offsets=0.5 * torch.randn(n, OFFSETS, 3, generator=g),
        log_scales=torch.full((n, 6), float(np.log(spacing))),
    )
    return AnchorModel(
        anchors=anchors,
        decoder=Decoder.init_random(OFFSETS, False, 0, 1, g),
        voxel_size=spacing,
        background=(0.5, 0.5, 0.5),
    )


def strip_blocks(extent_m: float, count: int) -> Blocks:
    """Blocks side by side along x, widened as by --partition.expansion 0.4."""
    cores = [shapely.box(a, 0, b, extent_m) for a, b in pairwise(np.linspace(0, extent_m, count + 1))]
    return Blocks(tuple(Block(core, core.buffer(0.4 * np.sqrt(core.area / np.pi))) for core in cores))


def write_capture(folder: Path, photographs: int) -> None:
    """A binary COLMAP model with tracks, and small photographs: one file with many names."""
    width, height = SIZE
    cameras, extent = flight(photographs, width, height), extent_for(photographs)
    points = random_positions(POINTS_EACH * photographs, extent, seed=2).astype(np.float64)
    names = [f"flight/drone_{index:05d}.jpg" for index in range(photographs)]
    _write_photographs(folder / "images", names)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    first = cameras[0]
    numbers = struct.pack("<QIiQQ4d", 1, 1, 1, width, height, first.fx, first.fy, first.cx, first.cy)
    (sparse / "cameras.bin").write_bytes(numbers)
    grid = _PointGrid(points, extent, cells=max(1, int(extent / HEIGHT_M)))
    observed = []
    with (sparse / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", photographs))
        for index, camera in enumerate(cameras):
            shown = grid.seen_by(camera, index)
            record = np.zeros(len(shown), [("pixel", "<f8", 2), ("point", "<i8")])
            record["pixel"], record["point"] = camera.project(points[shown])[0], shown + 1
            pose = struct.pack("<I7dI", index + 1, *_quaternion(camera), *camera.camera_from_world[:3, 3], 1)
            file.write(pose + names[index].encode() + b"\0" + struct.pack("<Q", len(shown)) + record.tobytes())
            observed.append(np.stack([shown, np.full(len(shown), index + 1), np.arange(len(shown))], axis=1))
    _write_points(sparse / "points3D.bin", points, np.concatenate(observed))


def _write_points(file: Path, points: np.ndarray, observed: np.ndarray) -> None:
    """Points with their tracks; `observed` are rows of point, number of the image, place in the image."""
    observed = observed[np.argsort(observed[:, 0], kind="stable")]
    tracks = observed[:, 1:].astype("<u4")
    ends = np.searchsorted(observed[:, 0], np.arange(len(points) + 1))
    kind = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    heads = np.zeros(len(points), kind)
    heads["id"], heads["xyz"], heads["rgb"] = np.arange(len(points)) + 1, points, 128
    heads["error"], heads["track"] = 0.5, np.diff(ends)
    with file.open("wb") as stream:
        stream.write(struct.pack("<Q", len(points)))
        for head, (begin, end) in zip(heads, pairwise(ends.tolist()), strict=True):
            stream.write(head.tobytes() + tracks[begin:end].tobytes())


class _PointGrid:
    """Points by cells of the plane, so that a photograph asks only those about it."""

    def __init__(self, points: np.ndarray, extent: float, cells: int) -> None:
        self.points, self.cells, self.edge = points, cells, extent / cells
        cell = (points[:, :2] / self.edge).astype(int).clip(0, cells - 1)
        flat = cell[:, 0] * cells + cell[:, 1]
        self.order = np.argsort(flat, kind="stable")
        self.starts = np.searchsorted(flat[self.order], np.arange(cells * cells + 1))

    def seen_by(self, camera: Camera, seed: int) -> np.ndarray:
        """At most SEEN_EACH of the points in a photograph, by ascending number."""
        column, row = (camera.position[:2] / self.edge).astype(int).clip(0, self.cells - 1)
        near = [
            self.order[self.starts[x * self.cells + y] : self.starts[x * self.cells + y + 1]]
            for x in range(max(0, column - 2), min(self.cells, column + 3))
            for y in range(max(0, row - 2), min(self.cells, row + 3))
        ]
        candidates = np.concatenate(near)
        candidates = candidates[camera.in_frustum(self.points[candidates])]
        return np.sort(np.random.default_rng(seed).permutation(candidates)[:SEEN_EACH])


def _write_photographs(folder: Path, names: list[str]) -> None:
    """One photograph with grain, under all names (hard links: disk space is not what is measured)."""
    generator = np.random.default_rng(3)
    pixels = generator.integers(0, 256, (*SIZE[::-1], 3), np.uint8)
    first = folder / names[0]
    first.parent.mkdir(parents=True)
    Image.fromarray(pixels).save(first, quality=90)
    for name in names[1:]:
        (folder / name).hardlink_to(first)


def _quaternion(camera: Camera) -> np.ndarray:
    """w, x, y, z of the rotation of a camera."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(camera.camera_from_world[:3, :3]).as_quat()
    return np.array([w, x, y, z])
