"""Tiny captures for tests: a textured plane seen by a grid of drone cameras, written in the formats people
have.

    scene = tiny_scene()
    write_colmap(folder, scene)          # images/, sparse/0/*.bin
    capture = load_capture(folder, CaptureOptions(up="z"))

The pictures are true renderings of the plane z = 0, so that cameras, points and pixels agree.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from vdgs.config.capture_options import CaptureOptions
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame

if TYPE_CHECKING:
    from vdgs.captures.capture import Capture

MODEL_IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4}
#: How the z of a tiny scene's files is told to be up.
UP = CaptureOptions(up="z")


def up(**options: Any) -> CaptureOptions:
    """That with other options."""
    return replace(UP, **options)


@dataclass(frozen=True)
class TinyScene:
    """Cameras by image name, points [n, 3] and colors [n, 3] uint8, in one world (z up unless moved)."""

    cameras: dict[str, Camera]
    points: np.ndarray
    colors: np.ndarray


def ground_color(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth texture of the plane, [..., 3] uint8."""
    waves = [np.sin(0.7 * x + 0.2 * y), np.sin(0.5 * y - 0.3 * x + 1), np.cos(0.4 * x) * np.cos(0.6 * y)]
    return (127.5 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)


def look_down(position: np.ndarray, tilt_deg: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    """camera_from_world [4, 4] of a camera above the plane, looking down but for `tilt_deg`."""
    yaw, tilt = np.radians(yaw_deg), np.radians(tilt_deg)
    forward = np.array([np.sin(tilt) * np.sin(yaw), np.sin(tilt) * np.cos(yaw), -np.cos(tilt)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return pose


def camera_at(x: float, y: float, z: float = 4.0, tilt: float = 0.0, yaw: float = 0.0, width: int = 64) -> Camera:
    """A camera of 4 to 3 and 53° across at a place, looking down but for its tilt (degrees)."""
    height = width * 3 // 4
    return Camera(
        camera_from_world=look_down(np.array([x, y, z]), tilt, yaw), fx=width, fy=width, cx=width / 2, cy=height / 2,
        width=width, height=height,
    )  # fmt: skip


def tiny_scene(
    columns: int = 4, rows: int = 3, width: int = 64, height: int = 48, altitude: float = 10.0,
    points: int = 400, seed: int = 0,
) -> TinyScene:  # fmt: skip
    """A grid of slightly tilted cameras over a plane with low bumps; everything is drawn from `seed`."""
    generator = np.random.default_rng(seed)
    cameras = {}
    for row in range(rows):
        for column in range(columns):
            position = np.array([3.0 * column, 3.0 * row, altitude + generator.uniform(-0.3, 0.3)])
            pose = look_down(position, generator.uniform(0, 8), generator.uniform(0, 360))
            camera = Camera(
                camera_from_world=pose, fx=0.9 * width, fy=0.9 * width, cx=width / 2, cy=height / 2, width=width,
                height=height,
            )  # fmt: skip
            cameras[f"frame_{len(cameras):03d}.png"] = camera
    low, high = np.array([-4.0, -4.0]), np.array([3.0 * columns + 1, 3.0 * rows + 1])
    flat = generator.uniform(low, high, (points, 2))
    cloud = np.column_stack([flat, generator.normal(0, 0.05, points)])
    return TinyScene(cameras, cloud, ground_color(cloud[:, 0], cloud[:, 1]))


def render_plane(camera: Camera) -> np.ndarray:
    """The plane z = 0 as the camera sees it, [h, w, 3] uint8; the sky is white."""
    intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return _rendered(camera.camera_from_world.astype(float).tobytes(), **intrinsics).copy()


@lru_cache(maxsize=200)  # many tests take the same scene
def _rendered(pose: bytes, **intrinsics: Any) -> np.ndarray:
    camera = Camera(camera_from_world=np.frombuffer(pose).reshape(4, 4), **intrinsics)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    directions = rays @ camera.camera_from_world[:3, :3]
    distance = -camera.position[2] / np.where(directions[..., 2] < -1e-6, directions[..., 2], np.nan)
    hit = camera.position + distance[..., None] * directions
    seen = np.isfinite(distance)
    color = ground_color(np.nan_to_num(hit[..., 0]), np.nan_to_num(hit[..., 1]))
    return np.where(seen[..., None], color, np.uint8(255))


def to_source(frame: GroundFrame, points: np.ndarray) -> np.ndarray:
    """The inverse of `GroundFrame.to_ground`."""
    return ((points - frame.translation) / frame.scale) @ frame.rotation


def moved(scene: TinyScene, scale: float, rotation: np.ndarray, translation: np.ndarray) -> TinyScene:
    """The same scene in another world: x' = scale * rotation @ x + translation."""
    cameras = {}
    for name, camera in scene.cameras.items():
        pose = np.eye(4)
        pose[:3, :3] = camera.camera_from_world[:3, :3] @ rotation.T
        pose[:3, 3] = -pose[:3, :3] @ (scale * rotation @ camera.position + translation)
        cameras[name] = replace(camera, camera_from_world=pose)
    return TinyScene(cameras, scale * scene.points @ rotation.T + translation, scene.colors)


def write_images(folder: Path, scene: TinyScene, shown: TinyScene | None = None) -> None:
    """One rendering per camera. `shown` is the scene with z up, where `scene` was moved."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, camera in (shown or scene).cameras.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), render_plane(camera)[:, :, ::-1])


def write_colmap(
    root: Path, scene: TinyScene, *, text: bool = False, model: str = "PINHOLE",
    extra: tuple[float, ...] = (), images: str | None = "images", sparse: str = "sparse/0",
    shown: TinyScene | None = None, tracks: bool = False,
) -> Path:  # fmt: skip
    """The scene as a COLMAP capture, one camera per image, `extra` its lens. Returns the model's folder.

    With `tracks`, images say which points they show: those that fall into the pictures of `shown` (or `scene`).
    """
    folder = root / sparse
    folder.mkdir(parents=True, exist_ok=True)
    features = {
        name: _features(camera, (shown or scene).points, tracks) for name, camera in (shown or scene).cameras.items()
    }
    (_write_text if text else _write_binary)(folder, scene, model, extra, features)
    if images is not None:
        write_images(root / images, scene, shown)
    return folder


def _features(camera: Camera, points: np.ndarray, tracks: bool) -> list[tuple[float, float, int]]:
    """x, y and the number of the point of what a picture shows; without tracks one feature of no point."""
    unmatched = [(1.0, 2.0, -1)]
    pixels, seen = camera.project(points)[0], camera.in_frustum(points)
    return unmatched + [(*pixels[index], int(index) + 1) for index in np.flatnonzero(seen)] if tracks else unmatched


def _parameters(camera: Camera, model: str, extra: tuple[float, ...]) -> tuple[float, ...]:
    single = model.startswith("SIMPLE")
    focal = (camera.fx,) if single else (camera.fx, camera.fy)
    return (*focal, camera.cx, camera.cy, *extra)


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """w, x, y, z of a rotation matrix: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a - e - i, 0, 0, 0],
            [b + d, e - a - i, 0, 0],
            [c + g, f + h, i - a - e, 0],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    values, vectors = np.linalg.eigh(k)
    x, y, z, w = vectors[:, np.argmax(values)]
    return np.array([w, x, y, z])


Features = dict[str, list[tuple[float, float, int]]]


def _write_binary(folder: Path, scene: TinyScene, model: str, extra: tuple[float, ...], features: Features) -> None:
    cameras, images = struct.pack("<Q", len(scene.cameras)), struct.pack("<Q", len(scene.cameras))
    for index, (name, camera) in enumerate(scene.cameras.items(), 1):
        values = _parameters(camera, model, extra)
        cameras += struct.pack("<IiQQ", index, MODEL_IDS[model], camera.width, camera.height)
        cameras += struct.pack(f"<{len(values)}d", *values)
        pose = camera.camera_from_world
        images += struct.pack("<I7dI", index, *quaternion_of(pose[:3, :3]), *pose[:3, 3], index)
        images += name.encode() + b"\0" + struct.pack("<Q", len(features[name]))
        images += b"".join(struct.pack("<ddq", *feature) for feature in features[name])
    points = struct.pack("<Q", len(scene.points))
    for index, (point, color) in enumerate(zip(scene.points, scene.colors, strict=True), 1):
        points += struct.pack("<Q3d3Bd", index, *point, *color, 0.5) + struct.pack("<Q", 0)
    for stem, data in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{stem}.bin").write_bytes(data)


def _write_text(folder: Path, scene: TinyScene, model: str, extra: tuple[float, ...], features: Features) -> None:
    cameras, images, points = ["# cameras"], ["# images"], ["# points"]
    for index, (name, camera) in enumerate(scene.cameras.items(), 1):
        values = " ".join(repr(float(value)) for value in _parameters(camera, model, extra))
        cameras.append(f"{index} {model} {camera.width} {camera.height} {values}")
        pose = camera.camera_from_world
        numbers = " ".join(repr(float(value)) for value in (*quaternion_of(pose[:3, :3]), *pose[:3, 3]))
        shown = " ".join(f"{float(x)!r} {float(y)!r} {point}" for x, y, point in features[name])
        images += [f"{index} {numbers} {index} {name}", shown]
    for index, (point, color) in enumerate(zip(scene.points, scene.colors, strict=True), 1):
        words = [*(repr(float(value)) for value in point), *(str(int(value)) for value in color)]
        points.append(f"{index} {' '.join(words)} 0.5")
    for stem, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{stem}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_ply(file: Path, points: np.ndarray, colors: np.ndarray, *, text: bool = False) -> None:
    """Vertices x y z red green blue, ascii or little-endian."""
    kind = "ascii" if text else "binary_little_endian"
    header = f"ply\nformat {kind} 1.0\ncomment a cloud\nelement vertex {len(points)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    if text:
        rows = [
            f"{float(p[0])!r} {float(p[1])!r} {float(p[2])!r} {c[0]} {c[1]} {c[2]}"
            for p, c in zip(points, colors, strict=True)
        ]
        file.write_text(header + "\n".join(rows) + "\n", encoding="ascii")
        return
    body = b"".join(struct.pack("<3d3B", *p, *c) for p, c in zip(points, colors, strict=True))
    file.write_bytes(header.encode() + body)


def data_folder(name: str, *needed: str) -> Path:
    """A real capture by name ("copr"), from $VDGS_DATA or ../shared/data; skips the test where it, or what is `needed`
    of it beside its model, is not there."""
    base = Path(os.environ.get("VDGS_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
    for each in ("sparse", *needed):
        if not (base / name / each).exists():
            pytest.skip(f"no {each} of the real capture {name!r} in {base} (set VDGS_DATA)")
    return base / name


def assert_sees_the_scene(capture: Capture, scene: TinyScene, rename=lambda name: name) -> None:
    """Every point falls on the same pixel as in the scene that was written."""
    assert len(capture.views) == len(scene.cameras)
    assert len(capture.points) == len(scene.points)
    np.testing.assert_array_equal(capture.point_colors, scene.colors)
    for view in capture.views:
        camera = scene.cameras[rename(view.name)]
        expected, depth = camera.project(scene.points)
        found, _ = view.camera.project(capture.points)
        front = depth > 1
        np.testing.assert_allclose(found[front], expected[front], atol=1e-3)
