"""Sparse points for formats that bring poses but no points: a PLY file or a COLMAP model beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from vdgs.captures.formats.colmap import count_images, find_models, read_colmap
from vdgs.captures.formats.ply_reader import read_point_cloud
from vdgs.captures.formats.source_capture import no_points
from vdgs.captures.name_resolution import match_stem
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_center
from vdgs.geometry.similarity import fit_similarity_robust, is_collinear

#: Names under which a point cloud in the capture's own world is looked for.
POINT_CLOUDS = (
    "points3D.ply", "points3d.ply", "sparse_pc.ply", "point_cloud.ply", "points.ply", "sparse.ply", "pointcloud.ply",
    "input.ply", "fused.ply",
)  # fmt: skip
#: A COLMAP model fits the poses if camera centers agree to this share of their spread (RMS).
MAX_RELATIVE_RMS = 0.02
#: And if the cameras look the same way, in degrees (median).
MAX_TURN_DEG = 10.0


def find_sparse_points(
    root: Path,
    poses: Mapping[str, np.ndarray],
    what: str,
    aliases: Mapping[str, str] | None = None,
    option: str = "",
    *,
    images: str | None = None,
    needs_points: bool = True,
    placed: Callable[[np.ndarray, Path], np.ndarray] = lambda points, _: points,
) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] float64 in the world of `poses` (camera-from-world by image name) and colors [n, 3]
    uint8.

    Taken from a PLY file in that world, else from a COLMAP model of the same photographs, which may live
    in any world: it is brought over by the similarity between the camera centers that both have. `aliases`
    maps names in the COLMAP model to names in `poses`; `option` is what the command line needs beside a model, so
    that its cameras do not replace `poses`; `images` is the folder that `--images` names; `placed` brings the points
    of a PLY into that world where they are in another. Raises `NoTiePoints` if there is nothing, unless nothing
    `needs_points`, and `CaptureError` if there is nothing that fits, in camera centers and in rotations.
    """
    cloud = find_point_cloud(root)
    if cloud is not None:
        return _read_placed(cloud, placed)
    models = find_models(root)
    cloud = None if models else find_point_cloud(root, lone=True)
    if cloud is not None:
        return _read_placed(cloud, placed)
    if not models and not needs_points:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if not models:
        raise no_points(
            root, images, f"{root}: {what} brings",
            f"Or put a point cloud in the same world there as {POINT_CLOUDS[0]}, or a COLMAP model of the same "
            f"photographs as sparse/0 (colmap feature_extractor, exhaustive_matcher, then mapper or "
            f"point_triangulator){option}.",
        )  # fmt: skip
    folder = max(models, key=count_images)
    model = read_colmap(folder)
    theirs = {view.name: camera_center(view.camera_from_world) for view in model.views}
    ours = {name: camera_center(pose) for name, pose in poses.items()}
    pairs = _match(list(theirs), list(ours), aliases or {})
    source = np.array([theirs[a] for a, _ in pairs]).reshape(-1, 3)
    target = np.array([ours[b] for _, b in pairs]).reshape(-1, 3)
    if is_collinear(source) or is_collinear(target):
        raise CaptureError(
            f"{folder}: shares {len(pairs)} photographs with {what}, too few (or all on one line) to bring "
            "its "
            "points into the same world. Image names must agree."
        )
    similarity, inliers = fit_similarity_robust(source, target)
    residual = np.linalg.norm(similarity.apply(source) - target, axis=1)[inliers]
    spread = float(np.sqrt(target.var(axis=0).sum()))
    rms = float(np.sqrt((residual**2).mean()))
    if rms > MAX_RELATIVE_RMS * spread or inliers.mean() < 0.5:
        raise CaptureError(
            f"{folder}: its camera positions disagree with those of {what} (RMS {rms:.3g} over a spread of "
            f"{spread:.3g}, {inliers.sum()} of {len(pairs)} agree); it is another reconstruction or naming."
        )
    turned = {view.name: view.camera_from_world[:3, :3] for view in model.views}
    agreeing = [pair for pair, is_in in zip(pairs, inliers, strict=True) if is_in]
    turns = [poses[b][:3, :3] @ similarity.rotation @ turned[a].T for a, b in agreeing]
    _check_turns(np.array(turns), folder, what)
    return similarity.apply(model.points), model.colors


def _check_turns(turns: np.ndarray, folder: Path, what: str) -> None:
    """Raise CaptureError where cameras of the model look elsewhere than those of the poses, or are rolled against
    them: `turns` [n, 3, 3] are from each camera of the model to that of the poses, and the identity for right ones."""
    cosines = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    angle = float(np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1)))))
    if angle <= MAX_TURN_DEG:
        return
    alike = np.linalg.norm(turns - np.median(turns, axis=0), axis=(1, 2)) < np.radians(MAX_TURN_DEG)
    says = "all alike: the axes of the cameras are of another convention" if alike.mean() > 0.9 else "not all alike"
    raise CaptureError(
        f"{folder}: its cameras are where those of {what} are, but turned against them by {angle:.0f}° ({says}). One "
        "of the two is wrong. Axes of cameras are to be those of the format (in transforms.json x right, y up, z back, "
        "world from camera): export the poses again. Or move the poses away, and the model is read as it is, or the "
        "model, and its points are found anew."
    )


def _read_placed(cloud: Path, placed: Callable[[np.ndarray, Path], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    points, colors = read_point_cloud(cloud)
    return placed(points, cloud), colors


def find_point_cloud(*folders: Path, lone: bool = False) -> Path | None:
    """The point cloud in the first of these folders that has one under a usual name; with `lone`, else the only PLY in
    one of them, whatever it is called."""
    usual = [folder / name for folder in folders for name in POINT_CLOUDS]
    single = [files[0] for files in ([*folder.glob("*.ply")] for folder in folders) if len(files) == 1]
    return next((file for file in (*usual, *(single if lone else ())) if file.is_file()), None)


def _match(theirs: list[str], ours: list[str], aliases: Mapping[str, str]) -> list[tuple[str, str]]:
    """Pairs of names that mean the same photograph: by alias, by full name, else by unique stem."""
    known = set(ours)
    exact = [(aliases.get(name, name), name) for name in theirs]
    pairs = [(name, alias) for alias, name in exact if alias in known]
    if len(pairs) >= 3:
        return pairs
    stems: dict[str, list[str]] = {}
    for name in ours:
        stems.setdefault(match_stem(name), []).append(name)
    unique = {stem: names[0] for stem, names in stems.items() if len(names) == 1}
    by_stem = [(name, match_stem(aliases.get(name, name))) for name in theirs]
    return [(name, unique[stem]) for name, stem in by_stem if stem in unique]
