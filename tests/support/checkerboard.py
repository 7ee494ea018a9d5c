"""A colored checkerboard plane photographed from above: the smallest place that training can learn."""

from __future__ import annotations

import numpy as np
import torch

from vdgs.geometry.camera import Camera

SIZE = (48, 40)


class Photographs:
    """Eight views from above of a colored checkerboard plane, ray cast exactly."""

    def __init__(self) -> None:
        self.cameras = [self._camera(x, y) for x in (-2.0, -0.7, 0.7, 2.0) for y in (-1.0, 1.0)]

    @staticmethod
    def _camera(x: float, y: float) -> Camera:
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = -pose[:3, :3] @ np.array([x, y, 5.0])
        width, height = SIZE
        return Camera(camera_from_world=pose, fx=40.0, fy=40.0, cx=width / 2, cy=height / 2, width=width, height=height)

    def camera(self, index: int, downscale: int = 1) -> Camera:
        return self.cameras[index].resized(SIZE[0] // downscale, SIZE[1] // downscale)

    def get(self, index: int, downscale: int = 1):
        camera = self.camera(index, downscale)
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        x = camera.position[0] + (u - camera.cx) / camera.fx * 5
        y = camera.position[1] - (v - camera.cy) / camera.fy * 5
        checks = (np.floor(x) + np.floor(y)) % 2
        picture = np.stack([0.2 + 0.6 * checks, 0.5 + 0.1 * x, 0.5 + 0.1 * y], axis=-1)
        return torch.from_numpy((picture.clip(0, 1) * 255).astype(np.uint8)), None

    def prefetch(self, indices, downscale: int = 1) -> None:
        pass
