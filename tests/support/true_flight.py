"""A flight whose truth is known, for projects of photogrammetry programs (`metashape_files`, `blocks_files`).

The formulas there and here are the makers', written anew: nothing is shared with the readers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vdgs.captures.formats.lens_projection import ray_pixels
from vdgs.captures.formats.source_capture import SourceCapture
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu

#: Where the flight takes place: north of the Alps, far from the middle of its UTM zone.
ORIGIN = (48.1, 11.9, 540.0)
SIZE = (5472, 3648)


@dataclass(frozen=True)
class Lens:
    """A lens by Metashape's parameters, which mean what its manual says."""

    f: float = 3656.4
    cx: float = 11.7
    cy: float = -27.7
    b1: float = 0.5
    b2: float = -0.3
    k: tuple[float, float, float, float] = (-0.09, -0.076, 0.116, -0.076)
    p: tuple[float, float] = (-0.0013, 0.0021)
    growth: tuple[float, float] = (0.0, 0.0)
    """p3 and p4 of PhotoScan 1.2 to Metashape 1.5."""
    size: tuple[int, int] = SIZE

    def pixels(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Pixels [n, 2], from the corner, of rays with z = 1 (manual, appendix on camera models)."""
        r2 = x**2 + y**2
        d = 1 + sum(k * r2 ** (n + 1) for n, k in enumerate(self.k))
        g = 1 + self.growth[0] * r2 + self.growth[1] * r2**2
        bent_x = x * d + (self.p[0] * (r2 + 2 * x**2) + 2 * self.p[1] * x * y) * g
        bent_y = y * d + (self.p[1] * (r2 + 2 * y**2) + 2 * self.p[0] * x * y) * g
        u = self.size[0] / 2 + self.cx + bent_x * self.f + bent_x * self.b1 + bent_y * self.b2
        return np.stack([u, self.size[1] / 2 + self.cy + bent_y * self.f], axis=1)


@dataclass(frozen=True, eq=False)
class TrueFlight:
    """Rotations [n, 3, 3] (world to camera) and centres [n, 3] in metres east, north, up of ORIGIN; points [m, 3]."""

    names: list[str]
    rotations: np.ndarray
    centers: np.ndarray
    points: np.ndarray
    lens: Lens = field(default_factory=Lens)

    def pixels(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [k, 2] of the points that a photograph shows, and their numbers [k]."""
        x, y, z = ((self.points - self.centers[index]) @ self.rotations[index].T).T
        found = self.lens.pixels(x / z, y / z)
        inside = (np.abs(x / z) < 0.7) & (np.abs(y / z) < 0.48) & (z > 0)
        return found[inside], np.flatnonzero(inside)

    def touch(self, folder: Path) -> None:
        """Empty files with the names of the photographs."""
        for name in self.names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()


def true_flight(count: int = 8, lens: Lens | None = None) -> TrueFlight:
    """Photographs from 100 m, tilted by up to 20°, over rolling ground."""
    generator = np.random.default_rng(3)
    centers = np.column_stack([generator.uniform(-150, 150, (count, 2)), generator.uniform(95, 105, count)])
    rotations = []
    for _ in range(count):
        omega, phi, kappa = generator.uniform(-20, 20), generator.uniform(-20, 20), generator.uniform(-180, 180)
        rotations.append(np.diag([1.0, -1, -1]) @ omega_phi_kappa(omega, phi, kappa))
    points = np.column_stack([generator.uniform(-220, 220, (900, 2)), generator.normal(0, 4, 900)])
    names = [f"DCIM/{100 + index // 4}MEDIA/DJI_{index:04d}.JPG" for index in range(count)]
    return TrueFlight(names, np.stack(rotations), centers, points, lens or Lens())


def omega_phi_kappa(omega: float, phi: float, kappa: float) -> np.ndarray:
    """World to camera, x right and y up, of angles in degrees: M of photogrammetry (Kraus, Bentley's camera models)."""
    o, p, k = (math.radians(angle) for angle in (omega, phi, kappa))
    return np.array(
        [
            [math.cos(p) * math.cos(k), math.cos(o) * math.sin(k) + math.sin(o) * math.sin(p) * math.cos(k),
             math.sin(o) * math.sin(k) - math.cos(o) * math.sin(p) * math.cos(k)],
            [-math.cos(p) * math.sin(k), math.cos(o) * math.cos(k) - math.sin(o) * math.sin(p) * math.sin(k),
             math.sin(o) * math.cos(k) + math.cos(o) * math.sin(p) * math.sin(k)],
            [math.sin(p), -math.sin(o) * math.cos(p), math.cos(o) * math.cos(p)],
        ]
    )  # fmt: skip


def angles_of(rotation: np.ndarray) -> tuple[float, float, float]:
    """Omega, phi, kappa in degrees of a matrix of `omega_phi_kappa`."""
    return (
        math.degrees(math.atan2(-rotation[2, 1], rotation[2, 2])),
        math.degrees(math.asin(rotation[2, 0])),
        math.degrees(math.atan2(-rotation[1, 0], rotation[0, 0])),
    )


def words(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in np.ravel(numbers))


def assert_true(source: SourceCapture, flight: TrueFlight, world=lambda points: points) -> None:
    """Known points fall on the pixels of the maker's formulas within 0.01 px, and cameras are within a millimetre;
    `world` brings the flight's metres to those of the capture."""
    if source.georef is not None and source.georef.origin is not None:
        origin = source.georef.origin
        world = lambda points: enu_from_geodetic(geodetic_from_enu(points, ORIGIN), origin)  # noqa: E731
    assert len(source.views) == len(flight.names)
    views = {view.name: view for view in source.views}
    for index, name in enumerate(flight.names):
        pose = views[name].camera_from_world
        pixels, numbers = flight.pixels(index)
        assert len(numbers) > 50
        seen = world(flight.points[numbers]) @ pose[:3, :3].T + pose[:3, 3]
        found = ray_pixels(views[name].intrinsics, seen[:, :2] / seen[:, 2:])
        assert np.abs(found - pixels).max() < 0.01
        assert np.linalg.norm(-pose[:3, :3].T @ pose[:3, 3] - world(flight.centers[[index]])[0]) < 0.001


def assert_read_or_refused(file: Path, whole: bytes, read: Callable[[], SourceCapture], seed: int) -> None:
    """A file cut off, or with five wrong bytes: a CaptureError, or finite poses; of 150 such files some are refused."""
    generator, refused = np.random.default_rng(seed), 0
    for _ in range(150):
        damaged = bytearray(whole)
        if generator.random() < 0.3:
            damaged = damaged[: generator.integers(0, len(whole))]
        else:
            for place in generator.integers(0, len(whole), 5):
                damaged[place] = generator.integers(0, 256)
        file.write_bytes(bytes(damaged))
        try:
            source = read()
        except CaptureError:
            refused += 1
        else:
            assert all(np.isfinite(view.camera_from_world).all() for view in source.views)
    assert refused > 15
