"""Models as a mapper leaves them, of photographs that look down at level ground: poses, points and observations."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from vdgs.sfm.image_metadata import Attitude, attitude_from_gimbal
from vdgs.system.lazy_pycolmap import pycolmap

WIDTH, HEIGHT, FOCAL = 1600, 1200, 1300.0


def flown_model(
    places: np.ndarray, rng: np.random.Generator, bowl: float = 0.0, attitudes: Sequence[Attitude] | None = None,
    focals: Sequence[float] = (FOCAL,),
) -> tuple[pycolmap.Reconstruction, list[SimpleNamespace]]:  # fmt: skip
    """A model of cameras at places [n, 3] over points about height 0, marks off by half a pixel, and photographs with
    the attitudes that a drone records; `true_rotation` is camera_from_enu. Away from the origin the model rises as a
    bowl, by so much times the distance squared. `attitudes` are the cameras', by default eastwards to a degree.
    Lenses of `focals` (pixels) take turns."""
    model, ground = pycolmap.Reconstruction(), _ground(places, rng)
    for number, focal in enumerate(focals, 1):
        params = [focal, WIDTH / 2, HEIGHT / 2, 0.0]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params, camera_id=number)
        )
    seen: list[list[tuple[int, int]]] = [[] for _ in ground]
    photographs = []
    for number, place in enumerate(places, 1):
        drawn = attitude_from_gimbal(90.0, -90.0 + rng.normal(0, 1), rng.normal(0, 1))
        attitude = drawn if attitudes is None else attitudes[number - 1]
        rotation = attitude.camera_from_enu
        rays = (ground - place) @ rotation.T
        lens = (number - 1) % len(focals)
        pixels = focals[lens] * rays[:, :2] / rays[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        shown = np.flatnonzero((rays[:, 2] > 1) & (pixels > 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1))
        for mark, point in enumerate(shown.tolist()):
            seen[point].append((number, mark))
        name = f"{number:03}.jpg"
        marks = pixels[shown] + rng.normal(0, 0.5, (len(shown), 2))
        bent = rotation @ Rotation.from_rotvec([2 * bowl * place[1], -2 * bowl * place[0], 0]).as_matrix().T
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, keypoints=marks, camera_id=lens + 1, image_id=number),
            pycolmap.Rigid3d(np.column_stack([bent, -bent @ _risen(place, bowl)])),
        )
        photographs.append(
            SimpleNamespace(
                name=name, attitude=attitude, true_rotation=rotation, relative_altitude=None, datetime="",
                subsecond=None, face="", altitude=None, attitudes={}, lens=None, size=(WIDTH, HEIGHT), camera="",
            )
        )  # fmt: skip
    for point, track in zip(ground, seen, strict=True):
        if len(track) >= 3:
            elements = [pycolmap.TrackElement(*each) for each in track]
            model.add_point3D(_risen(point, bowl), pycolmap.Track(elements), np.zeros(3, np.uint8))
    model.update_point_3d_errors()
    return model, photographs


def sightings(model: pycolmap.Reconstruction, place: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Photographs that show a place [3] of the model's world, and where, in pixels."""
    found = []
    for image in model.images.values():
        ahead = image.cam_from_world().matrix() @ np.append(place, 1)
        pixel = np.asarray(model.cameras[image.camera_id].img_from_cam(ahead[None])).ravel()
        if (pixel > 0).all() and (pixel < [WIDTH, HEIGHT]).all():
            found.append((image.name, pixel))
    return found


def _ground(places: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    low, high = places.min(axis=0) - 50, places.max(axis=0) + 50
    return np.column_stack([rng.uniform(low[:2], high[:2], (600, 2)), rng.uniform(0, 6, 600)])


def _risen(place: np.ndarray, bowl: float) -> np.ndarray:
    return place + np.array([0, 0, bowl * float(place[:2] @ place[:2])])
