"""Two photographs turned so that what both show lies in the same row of both (Fusiello et al., 2000).

Both are drawn anew by cameras that look the same way, with x along the line between them: a point at depth z then lies
f · B / z columns further left in the second, B the distance of the two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vdgs.geometry.camera import Camera

#: Pairs that would have to be turned further than this from where they look together are not used: its cosine.
MIN_FACING_COSINE = 0.7
#: A corner of a photograph this flat to the common plane would make the picture endless.
MIN_CORNER_DEPTH = 0.15
#: A turned picture may have at most so many times the pixels of the photograph.
MAX_AREA_RATIO = 4.0
MIN_SIDE_PX = 16


@dataclass(frozen=True, eq=False, kw_only=True)
class RectifiedPair:
    """The common picture plane of two cameras."""

    #: World to the common axes: x along the baseline, z where both look.
    rotation: Float[np.ndarray, "3 3"]
    #: Distance between the cameras, and the common focal length in pixels.
    baseline: float
    focal: float
    #: Principal points: the columns of the first and the second, the row of both.
    columns: tuple[float, float]
    row: float
    width: int
    height: int

    @staticmethod
    def of(first: Camera, second: Camera) -> RectifiedPair | None:
        """None where the two stand too close, or one behind the other, for a common plane."""
        along = second.position - first.position
        baseline = float(np.linalg.norm(along))
        if not baseline > 0:
            return None
        x = along / baseline
        z = first.forward + second.forward
        z = z - x * (x @ z)
        facing = float(np.linalg.norm(z)) / 2
        if facing < MIN_FACING_COSINE:
            return None
        z = z / (2 * facing)
        rotation = np.stack([x, np.cross(z, x), z])
        boxes = [_corners(camera, rotation, first.fx) for camera in (first, second)]
        if boxes[0] is None or boxes[1] is None:
            return None
        (left_a, top_a, right_a, low_a), (left_b, top_b, right_b, low_b) = boxes[0], boxes[1]
        top, low = max(top_a, top_b), min(low_a, low_b)
        width, height = int(np.ceil(max(right_a - left_a, right_b - left_b))), int(np.ceil(low - top))
        if min(width, height) < MIN_SIDE_PX or width * height > MAX_AREA_RATIO * first.width * first.height:
            return None
        return RectifiedPair(
            rotation=rotation, baseline=baseline, focal=first.fx, columns=(-left_a, -left_b), row=-top, width=width,
            height=height,
        )  # fmt: skip

    def homography_to_image(self, camera: Camera, which: int) -> Float[np.ndarray, "3 3"]:
        """The homography from pixel indices of the common picture to those of a photograph (0 the first, 1 the
        second)."""
        matrix = np.array([[self.focal, 0, self.columns[which]], [0, self.focal, self.row], [0, 0, 1.0]])
        turn = camera.camera_from_world[:3, :3] @ self.rotation.T
        homography = _intrinsics(camera) @ turn @ np.linalg.inv(matrix)
        center = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # index 0 is the pixel whose center is at 0.5
        return np.linalg.inv(center) @ homography @ center

    def disparity(self, depth: float) -> float:
        """Columns by which a point at this depth lies further left in the second picture."""
        return self.focal * self.baseline / depth + self.columns[0] - self.columns[1]

    def depth(self, disparity: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """The inverse of `disparity` at every pixel; 0 where the two rays do not meet in front."""
        shift = disparity - (self.columns[0] - self.columns[1])
        depth: np.ndarray = np.where(shift > 1e-6, self.focal * self.baseline / np.maximum(shift, 1e-6), 0.0)
        return depth


def _intrinsics(camera: Camera) -> Float[np.ndarray, "3 3"]:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def _corners(
    camera: Camera, rotation: Float[np.ndarray, "3 3"], focal: float
) -> tuple[float, float, float, float] | None:
    """Left, top, right and bottom of a photograph on the common plane, about the principal point; None where a corner
    looks away from it."""
    ends = np.array([[x, y, 1.0] for x in (0, camera.width) for y in (0, camera.height)])
    rays = ends @ np.linalg.inv(_intrinsics(camera)).T @ camera.camera_from_world[:3, :3] @ rotation.T
    if (rays[:, 2] <= MIN_CORNER_DEPTH).any():
        return None
    plane = focal * rays[:, :2] / rays[:, 2:]
    return (*plane.min(0), *plane.max(0))
