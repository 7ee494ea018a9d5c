"""A flight of known truth, for readers of other programs' projects: cameras, a bent lens, points, a place on Earth.

The lens is projected here by its formula, and not by the package: what a reader makes of a file is held against it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from support.captures import look_down
from vdgs.captures.formats.source_capture import SourceCapture
from vdgs.geometry.geodesy import ecef_from_geodetic, geodetic_from_enu

#: Latitude, longitude in degrees, height in metres: south and west, where signs go wrong.
ORIGIN = (-33.5, -70.6, 500.0)


@dataclass(frozen=True)
class BentLens:
    """Brown's lens in pixels from the corner of the image; p as OpenCV orders them: p[1] goes with r² + 2x²."""

    focal: float = 700.0
    aspect: float = 1.0
    center: tuple[float, float] = (413.0, 291.5)
    k: tuple[float, float, float, float] = (-0.11, 0.034, -0.008, 0.0)
    p: tuple[float, float] = (0.0011, -0.0007)
    size: tuple[int, int] = (800, 600)

    def project(self, local: np.ndarray) -> np.ndarray:
        """Pixels [n, 2] of points [n, 3] in the axes of the camera (x right, y down, z forward)."""
        x, y = (local[:, :2] / local[:, 2:]).T
        r2 = x * x + y * y
        radial = 1 + sum(k * r2 ** (n + 1) for n, k in enumerate(self.k))
        p1, p2 = self.p
        u = x * radial + p2 * (r2 + 2 * x * x) + 2 * p1 * x * y
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([self.focal * u + self.center[0], self.focal * self.aspect * v + self.center[1]], axis=1)


@dataclass(frozen=True)
class MeasuredLens(BentLens):
    """VisualSFM's: of a pixel at m from the middle, in focal lengths, the ray is m (1 + radial m²)."""

    radial: float = 0.12
    center: tuple[float, float] = (400.0, 300.0)

    def project(self, local: np.ndarray) -> np.ndarray:
        rays = local[:, :2] / local[:, 2:]
        length = np.linalg.norm(rays, axis=1)
        bent = length.copy()
        for _ in range(60):
            bent -= (bent * (1 + self.radial * bent**2) - length) / (1 + 3 * self.radial * bent**2)
        return rays * (bent / np.maximum(length, 1e-12))[:, None] * self.focal + self.center


@dataclass(frozen=True)
class EquidistantLens(BentLens):
    """AliceVision's, by its source (Equidistant::project, DistortionRadialK3PT): a circle of so many pixels is as far
    off the axis as half the shorter side of the sensor, in millimetres, is long in focal lengths."""

    k: tuple[float, float, float, float] = (-0.05, 0.02, -0.004, 0.0)
    p: tuple[float, float] = (0.0, 0.0)
    sensor: tuple[float, float] = (36.0, 25.0)
    circle: float = 280.0

    def project(self, local: np.ndarray) -> np.ndarray:
        focal_mm = self.focal * self.sensor[0] / max(self.size)
        angle = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
        radius = angle / (0.5 * min(self.sensor) / focal_mm)
        k1, k2, k3, _ = self.k
        radius = radius * (1 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6) / (1 + k1 + k2 + k3)
        around = np.arctan2(local[:, 1], local[:, 0])
        return self.circle * np.stack([np.cos(around) * radius, np.sin(around) * radius], axis=1) + self.center


@dataclass(frozen=True)
class FixedAtOneLens(BentLens):
    """AliceVision's pinhole with radialk3pt, which leaves the radius one as it is."""

    p: tuple[float, float] = (0.0, 0.0)

    def project(self, local: np.ndarray) -> np.ndarray:
        return (super().project(local) - self.center) / (1 + sum(self.k)) + self.center


@dataclass(frozen=True, eq=False)
class KnownFlight:
    """Poses (camera from world [n, 4, 4]) and points [m, 3] in metres east, north, up of `ORIGIN`."""

    names: list[str]
    poses: np.ndarray
    points: np.ndarray
    colors: np.ndarray
    lens: BentLens

    @property
    def centers(self) -> np.ndarray:
        return centers_of(self.poses)

    def local(self, index: int, poses: np.ndarray | None = None) -> np.ndarray:
        """All points in the axes of a camera."""
        pose = (self.poses if poses is None else poses)[index]
        return self.points @ pose[:3, :3].T + pose[:3, 3]

    def pixels(self, index: int) -> np.ndarray:
        return self.lens.project(self.local(index))

    def shows(self, index: int) -> np.ndarray:
        """Which points a photograph shows, [m] bool; far outside it the polynomials of the lens fold over."""
        local, pixels = self.local(index), self.pixels(index)
        near = np.linalg.norm(local[:, :2], axis=1) < 1.2 * local[:, 2]
        return near & ((pixels >= 0) & (pixels < self.lens.size)).all(axis=1)

    def write_photographs(self, folder: Path) -> None:
        """A gray photograph for each camera."""
        folder.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", self.lens.size, (120, 120, 120)).save(folder / "one.tmp", "JPEG")
        for name in self.names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((folder / "one.tmp").read_bytes())
        (folder / "one.tmp").unlink()


def known_flight(lens: BentLens | None = None, strips: int = 3, each: int = 4) -> KnownFlight:
    rng = np.random.default_rng(11)
    places = [(14.0 * k, 18.0 * s, 60.0 + rng.normal(0, 2)) for s in range(strips) for k in range(each)]
    poses = [
        look_down(np.array(place) - (21.0, 18.0, 0.0), rng.uniform(-12, 25), 180.0 * (k % 2) + rng.uniform(-20, 20))
        for k, place in enumerate(places)
    ]
    points = np.column_stack([rng.uniform(-30, 30, (200, 2)), rng.uniform(-2, 6, 200)])
    colors = rng.integers(0, 256, (200, 3)).astype(np.uint8)
    names = [f"DJI_{k + 1:04d}.JPG" for k in range(len(poses))]
    return KnownFlight(names, np.array(poses), points, colors, lens or BentLens())


def with_lens(flight: KnownFlight, **changes: object) -> KnownFlight:
    return replace(flight, lens=replace(flight.lens, **changes))  # type: ignore[arg-type]


def centers_of(poses: np.ndarray) -> np.ndarray:
    return -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


def poses_of(source: SourceCapture, flight: KnownFlight) -> np.ndarray:
    """The poses of a capture as it was read, in the order of the flight's photographs."""
    known = {view.name.rsplit("/", 1)[-1]: view.camera_from_world for view in source.views}
    return np.array([known[name] for name in flight.names])


def ecef(enu: np.ndarray, origin: tuple[float, float, float] = ORIGIN) -> np.ndarray:
    """Places in metres about an origin, as places on Earth."""
    return ecef_from_geodetic(geodetic_from_enu(enu, origin))
