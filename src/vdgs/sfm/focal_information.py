"""How well the photographs of a model tell its focal length by themselves.

Of parallel views they do not, from any number of heights: stretched along the views, with a focal length as many times
as long, a model shows the same pixels. What tells it is how far views differ in direction, more where photographs are
many and points are seen exactly. The normal equations of an adjustment hold all of that.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from vdgs.sfm.capture_writer import placed_images
from vdgs.system.lazy_pycolmap import pycolmap

#: So many observations of a photograph are looked at, and count as so many that are independent: what the model of the
#: lens lacks, where features are found and a rolling shutter move many of a photograph together (choice).
LOOKED_AT, COUNTED = 100, 25
#: Unknowns of a camera that the focal length is told apart from: its pose, and radial distortion by the second and the
#: fourth power.
POSE, RADIAL = 6, 2
#: Directions that nothing holds (the place, the turn and the size of the whole) are held by this share (numerics).
HELD = 1e-12
#: A pixel error below this (pixels) is none of real photographs (choice).
LEAST_PX = 0.05


def focal_deviation(model: pycolmap.Reconstruction) -> float:
    """The standard deviation, as a share, that photographs alone leave of one factor for all focal lengths, with poses,
    points and radial distortion free. Large where they do not tell it; infinite without observations, and for lenses
    that are no perspective ones, which this does not describe."""
    images = [image for image in placed_images(model) if image.num_points3D]
    seen = _observations(model, images)
    if any("FISHEYE" in model.cameras[image.camera_id].model_name for image in images) or len(seen) < POSE:
        return math.inf
    rotations = np.array([image.cam_from_world().rotation.matrix() for image in images])
    shifts = np.array([image.cam_from_world().translation for image in images])
    cameras = {number: k for k, number in enumerate(sorted({image.camera_id for image in images}))}
    lens = np.array([cameras[image.camera_id] for image in images])
    focals = np.array([model.cameras[number].mean_focal_length() for number in cameras])
    image, track = seen[:, 0], seen[:, 1]
    points, point = np.unique(track, return_inverse=True)
    places = np.array([model.points3D[int(number)].xyz for number in points])
    rays = np.einsum("nij,nj->ni", rotations[image], places[point]) + shifts[image]
    focal, depth = focals[lens[image]], rays[:, 2]
    flat = rays[:, :2] / depth[:, None]
    # How a pixel moves with the ray (the distortion itself is left out: it is small), then with all that is unknown.
    by_ray = np.zeros((len(seen), 2, 3))
    by_ray[:, 0, 0] = by_ray[:, 1, 1] = focal / depth
    by_ray[:, :, 2] = -focal[:, None] * flat / depth[:, None]
    by_pose = np.concatenate([by_ray @ _crossed(rays), by_ray * np.median(depth)], axis=2)
    radius = (flat**2).sum(axis=1)
    by_radial = focal[:, None, None] * flat[:, :, None] * np.stack([radius, radius**2], axis=1)[:, None, :]
    by_focal = (focal[:, None] * flat).ravel()
    by_point = np.einsum("nij,njk->nik", by_ray, rotations[image])
    of_poses = _sparse(by_pose, image, len(images))
    of_lenses = _sparse(by_radial, lens[image], len(cameras))
    others = sparse.hstack([of_poses, of_lenses]).tocsc()
    around = _without_points(by_point, point, len(points))
    normal = (others.T @ others - _squared(around @ others)).tocsc()
    scales = np.maximum(normal.diagonal(), 1e-300)
    normal = normal + sparse.diags(HELD * np.maximum(scales, scales.max() * HELD))
    mixed = others.T @ by_focal - (around @ others).T @ (around @ by_focal)
    told = float(by_focal @ by_focal - (around @ by_focal) @ (around @ by_focal) - mixed @ splu(normal).solve(mixed))
    noise = max(LEAST_PX, _noise_px(model, points))
    return noise / math.sqrt(told * COUNTED / LOOKED_AT) if told > 0 else math.inf


def _observations(model: pycolmap.Reconstruction, images: list[pycolmap.Image]) -> np.ndarray:
    """Which image (its place in the list) sees which point (its number), [n, 2]: of points by chance until each image
    has `LOOKED_AT`."""
    numbers = {image.image_id: k for k, image in enumerate(images)}
    counts, found = np.zeros(len(images), int), []
    ids = np.array(sorted(model.points3D))
    for number in np.random.default_rng(0).permutation(ids).tolist():
        views = {numbers[each.image_id] for each in model.points3D[number].track.elements if each.image_id in numbers}
        if len(views) >= 2 and any(counts[k] < LOOKED_AT for k in views):
            found += [(k, number) for k in sorted(views)]
            counts[list(views)] += 1
    return np.array(found, int).reshape(-1, 2)


def _noise_px(model: pycolmap.Reconstruction, points: np.ndarray) -> float:
    """The standard deviation of a pixel along one axis, of the distances of pixels (Rayleigh)."""
    errors = np.array([model.points3D[int(number)].error for number in points])
    errors = errors[errors >= 0]
    return float(np.median(errors)) / 1.177 if len(errors) else LEAST_PX


def _crossed(rays: np.ndarray) -> np.ndarray:
    """Of rays [n, 3] how small turns move them [n, 3, 3]."""
    found = np.zeros((len(rays), 3, 3))
    x, y, z = rays.T
    found[:, 0, 1], found[:, 0, 2], found[:, 1, 0] = z, -y, -z
    found[:, 1, 2], found[:, 2, 0], found[:, 2, 1] = x, y, -x
    return found


def _sparse(blocks: np.ndarray, owner: np.ndarray, count: int) -> sparse.csr_matrix:
    """Blocks [n, 2, k] of so many owners, each [n] beginning at k times its number: [2 n, k count]."""
    n, rows, wide = blocks.shape
    columns = np.repeat(owner[:, None] * wide + np.arange(wide), rows, axis=0).ravel()
    starts = np.arange(n * rows + 1) * wide
    return sparse.csr_matrix((blocks.reshape(-1), columns, starts), shape=(n * rows, count * wide))


def _without_points(by_point: np.ndarray, point: np.ndarray, count: int) -> sparse.csr_matrix:
    """What turns the effects of other unknowns on pixels into the part of them that points can take up [3 count, 2 n]:
    each point's unknowns are made independent."""
    normal = np.zeros((count, 3, 3))
    np.add.at(normal, point, np.einsum("nki,nkj->nij", by_point, by_point))
    normal += np.eye(3) * (HELD * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300)
    half = np.linalg.inv(np.linalg.cholesky(normal))
    blocks = np.einsum("nij,nkj->nki", half[point], by_point)
    return _sparse(blocks, point, count).T.tocsr()


def _squared(matrix: sparse.csr_matrix) -> sparse.csr_matrix:
    return matrix.T @ matrix
