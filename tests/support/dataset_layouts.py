"""Captures in the layouts of published data sets, written as their tools write them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import torch

from support.captures import TinyScene, moved, write_images, write_ply

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: DRB axes (down, right, back) of a z-up world whose x is right and y is forward.
DRB = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
#: Keys of intrinsics in transforms files, and what they are of a camera.
KEYS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}


def write_transforms(root: Path, scene: TinyScene, applied: np.ndarray | None = None, **changes) -> dict:
    """As ns-process-data: poses and cloud both in the world after `applied`."""
    world = np.eye(4) if applied is None else applied
    first = next(iter(scene.cameras.values()))
    content: dict = {
        "camera_model": "OPENCV", "w": first.width, "h": first.height, "fl_x": first.fx, "fl_y": first.fy,
        "cx": first.cx, "cy": first.cy, "k1": 0.0, "ply_file_path": "sparse_pc.ply",
        "frames": [
            {"file_path": f"images/{name}", "transform_matrix": (
                world @ np.linalg.inv(camera.camera_from_world) @ OPENGL).tolist()}
            for name, camera in scene.cameras.items()
        ],
    }  # fmt: skip
    if applied is not None:
        content["applied_transform"] = applied[:3].tolist()
    content |= changes
    root.mkdir(parents=True, exist_ok=True)
    (root / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    write_ply(root / "sparse_pc.ply", scene.points @ world[:3, :3].T + world[:3, 3], scene.colors)
    write_images(root / "images", scene)
    return content


def write_blender(root: Path, train: TinyScene, test: TinyScene) -> TinyScene:
    """As Blender's scripts: train/ and test/ with photographs of the same names, one angle, no size, no points.

    Returns the views by the names that a capture gives them.
    """
    both = {}
    for side, part in (("train", train), ("test", test)):
        first = next(iter(part.cameras.values()))
        frames = [
            {"file_path": f"./{side}/{name}", "transform_matrix": (
                np.linalg.inv(camera.camera_from_world) @ OPENGL).tolist()}
            for name, camera in part.cameras.items()
        ]  # fmt: skip
        write_images(root / side, part)
        content = {"camera_angle_x": 2 * np.arctan(first.width / 2 / first.fx), "frames": frames}
        (root / f"transforms_{side}.json").write_text(json.dumps(content))
        both |= {f"{side}/{name}": camera for name, camera in part.cameras.items()}
    write_ply(root / "points3D.ply", train.points, train.colors)
    return TinyScene(both, train.points, train.colors)


def write_mega_nerf(root: Path, scene: TinyScene, scale: float = 50.0) -> TinyScene:
    """As Mega-NeRF's converter: DRB world, moved and scaled.

    NeRF camera axes; original names in mappings.txt.
    """
    drb = moved(scene, 1.0, DRB, np.zeros(3))
    origin = np.mean([camera.position for camera in drb.cameras.values()], axis=0)
    mappings = []
    renamed = {}
    for index, (name, camera) in enumerate(drb.cameras.items()):
        folder = root / ("val" if index % 5 == 0 else "train")
        (folder / "metadata").mkdir(parents=True, exist_ok=True)
        in_drb = (np.linalg.inv(camera.camera_from_world) @ OPENGL)[:3]
        in_drb[:, 3] = (in_drb[:, 3] - origin) / scale
        torch.save(
            {
                "H": camera.height, "W": camera.width, "c2w": torch.tensor(in_drb, dtype=torch.float32),
                "intrinsics": torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy]),
                "distortion": torch.tensor([0.05, 0.0, 0.0, 0.0]),
            },
            folder / "metadata" / f"{index:06d}.pt",
        )  # fmt: skip
        renamed[f"{folder.name}/{index:06d}.png"] = scene.cameras[name]
        mappings.append(f"{name},{index:06d}.pt")
    torch.save({"origin_drb": torch.tensor(origin), "pose_scale_factor": scale}, root / "coordinates.pt")
    (root / "mappings.txt").write_text("\n".join(mappings))
    for name, camera in renamed.items():
        one = TinyScene({Path(name).name: camera}, scene.points, scene.colors)
        write_images(root / name.split("/")[0] / "rgbs", one)
    return TinyScene(renamed, scene.points, scene.colors)


def write_mvsnet(root: Path, scene: TinyScene, cameras: str = "cams", depths: str = "425.0 2.5 192 933.8") -> TinyScene:
    """As BlendedMVS: numbered cameras and photographs, with a masked copy of each.

    Returns the views by the names that a capture gives them.
    """
    (root / cameras).mkdir(parents=True)
    (root / cameras / "pair.txt").write_text(f"{len(scene.cameras)}\n0\n1 1 10.0 \n")
    renamed = {f"{index:08d}.png": camera for index, camera in enumerate(scene.cameras.values())}
    for name, camera in renamed.items():
        pose = "".join(f"{' '.join(map(repr, row.tolist()))} \n" for row in camera.camera_from_world)
        lens = f"{camera.fx} 0.0 {camera.cx} \n0.0 {camera.fy} {camera.cy} \n0.0 0.0 1.0 \n"
        text = f"extrinsic\n{pose}\nintrinsic\n{lens}\n{depths}\n"
        (root / cameras / name.replace(".png", "_cam.txt")).write_text(text)
    images = root / "blended_images"
    write_images(images, TinyScene(renamed, scene.points, scene.colors))
    for name in renamed:
        shutil.copyfile(images / name, images / name.replace(".", "_masked."))
    return TinyScene(renamed, scene.points, scene.colors)


def write_llff(root: Path, scene: TinyScene, images: str = "images") -> None:
    """As imgs2poses.py, from COLMAP's cameras: columns right, down, forward become down, right, backwards."""
    rows = []
    for _, camera in sorted(scene.cameras.items()):
        right, down, forward, place = np.linalg.inv(camera.camera_from_world)[:3].T
        matrix = np.column_stack([down, right, -forward, place, [camera.height, camera.width, camera.fx]])
        rows.append([*matrix.ravel(), 3.0, 20.0])
    write_images(root / images, scene)
    np.save(root / "poses_bounds.npy", np.array(rows))


def matrixcity_frames(scene: TinyScene, block: str, unit: float) -> list[dict]:
    frames = []
    for index, camera in enumerate(scene.cameras.values()):
        pose = np.linalg.inv(camera.camera_from_world) @ OPENGL
        pose[:3, 3] /= unit
        frames.append(
            {
                "file_path": f"../../{block}/{index:04d}.png",
                "frame_index": index,
                "transform_matrix": pose.tolist(),
            }
        )
    return frames


def halves(scene: TinyScene, first: int = 9) -> tuple[TinyScene, TinyScene]:
    """The first views and the others, named as MatrixCity names them."""
    items = list(scene.cameras.items())
    parts = []
    for part in (items[:first], items[first:]):
        cameras = {f"{index:04d}.png": camera for index, (_, camera) in enumerate(part)}
        parts.append(TinyScene(cameras, scene.points, scene.colors))
    return parts[0], parts[1]


def write_matrixcity(root: Path, train: TinyScene, test: TinyScene) -> TinyScene:
    """As published for a city: pose/<block>/transforms_*.json in units of 100 m, images in the blocks' folders above.

    `root` is CITY/pose/<block>. Returns the views by the names that a capture gives them.
    """
    city, first = root.parents[1], next(iter(train.cameras.values()))
    intrinsics = {key: getattr(first, name) for key, name in KEYS.items()}
    intrinsics["camera_angle_x"] = 2 * np.arctan(first.width / 2 / first.fx)
    root.mkdir(parents=True)
    both = {}
    for side, part, block in (("train", train, "train/block_1"), ("test", test, "test/block_1_test")):
        content = intrinsics | {"frames": matrixcity_frames(part, block, 100.0)}
        (root / f"transforms_{side}.json").write_text(json.dumps(content))
        write_images(city / block, part)
        both |= {f"{block}/{name}": camera for name, camera in part.cameras.items()}
    write_ply(root / "points3D.ply", train.points / 100, train.colors)
    return TinyScene(both, train.points, train.colors)
