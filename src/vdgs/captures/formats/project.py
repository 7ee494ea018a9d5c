"""Projects of photogrammetry programs: what their readers find, and the capture that it makes.

A reader knows one program's files and yields a `Project`: cameras by the names that the program has for photographs,
poses and points in the project's coordinates, and what brings those to latitude, longitude and height. The rest is the
same for all and is done here: photographs are found, the world becomes metres east, north and up, and points come from
the project, or from a PLY beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vdgs.captures.capture import Observations
from vdgs.captures.coordinate_systems import ToGeodetic, UnknownSystem, to_geodetic, unit_without_heights
from vdgs.captures.formats.cloud_worlds import LEAST_SEEN, CloudFrame, Eye, best_frame
from vdgs.captures.formats.colmap_records import sample_observations
from vdgs.captures.formats.las_reader import can_read_las, find_las, las_system, read_las_points
from vdgs.captures.formats.lens_projection import pixel_rays
from vdgs.captures.formats.photograph_sizes import leave_out
from vdgs.captures.formats.ply_reader import read_point_cloud
from vdgs.captures.formats.project_photographs import find_photographs
from vdgs.captures.formats.source_capture import Intrinsics, NoTiePoints, SourceCapture, SourceView, points_command
from vdgs.captures.formats.sparse_points import POINT_CLOUDS, find_point_cloud
from vdgs.captures.georeference import Georef
from vdgs.captures.system_names import is_local_system
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_centers
from vdgs.geometry.geodesy import enu_from_geodetic, median_place

#: Where ODM and PIX4Dmapper put their dense clouds.
_DENSE = ("odm_georeferencing", "*/2_densification/point_cloud", "2_densification/point_cloud")


@dataclass(frozen=True, eq=False, kw_only=True)
class ProjectView:
    """A camera of a project: what its photograph is called there (paths in any form, labels; the best name first), the
    pose [4, 4] in the project's coordinates, and the points that it shows: their indices [m] and pixels [m, 2]."""

    names: tuple[str, ...]
    camera_from_world: np.ndarray
    intrinsics: Intrinsics
    sightings: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Project:
    """A project as its file has it; points [n, 3] float64 and colors [n, 3] uint8, none of either where it has none.

    Its coordinates are those of a system that `to_geodetic` knows, with rotations about the axes of the system where
    the camera is, or metres with z up (`is_metric`), or nothing that is known.
    """

    format: str
    file: Path
    views: tuple[ProjectView, ...]
    points: np.ndarray
    colors: np.ndarray
    to_geodetic: ToGeodetic | None = None
    in_degrees: bool = False
    """Whether the first two coordinates are degrees."""
    is_metric: bool = False
    place: str = ""
    """How the project says where it lies, in words ("Metashape, WGS 84 / UTM zone 32N")."""
    cloud_frames: tuple[CloudFrame, ...] = ()
    """Other coordinates that a PLY beside it may have, and what brings these to latitude, longitude and height, or to
    the project's coordinates where these have no place on Earth."""
    warnings: tuple[str, ...] = ()
    refused: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Why some of its cameras cannot be used, and what these are called."""
    unknown_system: str = ""
    """The coordinate system that it names and that nobody knows; its coordinates are metres then."""
    with_points: tuple[Path, ...] = ()
    """Other files of the program, beside its own, that have points."""
    remedy: str = "Export undistorted photographs with them as a COLMAP model instead"


def project_capture(
    project: Project, root: Path, options: CaptureOptions, *, needs_points: bool = True
) -> SourceCapture:
    """The capture of a project whose photographs lie in `root`, or in the folder that `options` name.

    Raises `CaptureError` where no photograph of it is found or too few of its cameras can be used, and `NoTiePoints`
    for a project without points, unless nothing `needs_points`.
    """
    lost = leave_out(project.refused, len(project.views), project.file, project.remedy, strict=options.strict)
    if not project.views:
        raise CaptureError(f"{project.file}: no camera of it has a pose. Align the photographs, and export it again.")
    _check_sightings(project)
    lost += _without_system(project, options.strict)
    names = [view.names for view in project.views]
    sizes = [(view.intrinsics.width, view.intrinsics.height) for view in project.views]
    found = find_photographs(root, options, names, project.file, sizes)
    world = _world_of(project)
    poses = world.moved_poses([view.camera_from_world for view in project.views])
    points, colors, warnings = world.moved(project.points), project.colors, [*project.warnings, *lost, *found.warnings]
    if not len(points) and needs_points:
        points, colors, note = _cloud_beside(project, root, options.images, poses, world)
        warnings.append(note)
    views = tuple(
        SourceView(
            name=name, camera_from_world=pose, intrinsics=view.intrinsics, observations=_observations(view, points),
            image_path=path,
        )
        for name, path, pose, view in zip(found.names, found.paths, poses, project.views, strict=True)
    )  # fmt: skip
    return SourceCapture(
        source=project.format, images=found.folder, views=tuple(sorted(views, key=lambda view: view.name)),
        points=points, colors=colors, georef=world.georef, original_images=True,
        image_folders=() if found.folder == "." else (root / found.folder,), warnings=tuple(warnings),
    )  # fmt: skip


def _without_system(project: Project, strict: bool) -> list[str]:
    """A warning about a system that is not known; CaptureError where a person is `strict`."""
    if not project.unknown_system:
        return []
    said = f"the coordinate system {project.unknown_system[:80]!r} is not known"
    if strict:
        raise CaptureError(
            f"{project.file}: {said}. Export it in one that has an EPSG code, or leave --strict out to use it without."
        )
    return [f"{said}: {project.place or 'the scene has metres and no place on Earth; --gps TABLE gives one'}."]


def _check_sightings(project: Project) -> None:
    count = len(project.points)
    if any(view.sightings is not None and (view.sightings[0] >= count).any() for view in project.views):
        raise CaptureError(f"{project.file}: photographs show points that it does not have. Export it again.")


def _observations(view: ProjectView, points: np.ndarray) -> Observations | None:
    if view.sightings is None or not len(view.sightings[0]):
        return None
    numbers, pixels = sample_observations(*view.sightings)
    rays = pixel_rays(view.intrinsics, pixels)
    known = np.isfinite(rays).all(axis=1) & np.isfinite(points[numbers]).all(axis=1)
    return Observations(points[numbers[known]], rays[known], numbers[known]) if known.any() else None


# ----------------------------------------------------------------------------------------------------- world


@dataclass(frozen=True, eq=False)
class _World:
    """Where a project lies: metres east, north and up of an origin, where it has a place on Earth."""

    to_geodetic: ToGeodetic | None
    step: np.ndarray
    """Along each coordinate, for the slope of the change; about as long as the scene is wide."""
    georef: Georef | None
    file: Path

    def moved(self, points: np.ndarray) -> np.ndarray:
        return points if self.to_geodetic is None or not len(points) else self.to_enu(self.to_geodetic(points))

    def to_enu(self, geodetic: np.ndarray) -> np.ndarray:
        """Latitude, longitude and height [n, 3] to the world; as they are where it has no place on Earth."""
        if self.georef is None or self.georef.origin is None:
            return geodetic
        with np.errstate(invalid="ignore", over="ignore"):
            return enu_from_geodetic(geodetic, self.georef.origin)

    def moved_poses(self, poses: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Each camera moves as its surroundings do: its rotation by the nearest to the slope of the change there.

        Raises `CaptureError` for a system that mirrors."""
        if self.to_geodetic is None:
            return list(poses)
        stack = np.stack(poses)
        centers = camera_centers(stack)
        ends = [self.moved(centers + sign * step) for step in np.diag(self.step) for sign in (1, -1)]
        slopes = np.stack([(ends[k] - ends[k + 1]) for k in (0, 2, 4)], axis=2)
        left, _, right = np.linalg.svd(slopes / np.linalg.norm(slopes, axis=1, keepdims=True))
        if (np.linalg.det(left @ right) < 0).any():
            raise CaptureError(
                f"{self.file}: the axes of its coordinate system are left-handed (south and west, or north and east), "
                "in which cameras have no rotation. Export it in a system of east and north, such as a zone of UTM."
            )
        turned, places = left @ right, self.moved(centers)
        result = np.tile(np.eye(4), (len(stack), 1, 1))
        result[:, :3, :3] = stack[:, :3, :3] @ np.swapaxes(turned, 1, 2)
        result[:, :3, 3] = -np.einsum("nij,nj->ni", result[:, :3, :3], places)
        return list(result)


def _world_of(project: Project) -> _World:
    if project.to_geodetic is None:
        local = Georef(None, "", project.place) if project.is_metric else None
        return _World(None, np.ones(3), local, project.file)
    stack = np.stack([view.camera_from_world for view in project.views])
    centers = camera_centers(stack)
    geodetic = project.to_geodetic(centers)
    if not np.isfinite(geodetic).all() or (np.abs(geodetic[:, 0]) > 90).any():
        raise CaptureError(
            f"{project.file}: {project.place} has no place on Earth for some of its cameras, such as "
            f"{np.round(centers[0], 3).tolist()}. Is the coordinate system another one? Export it again."
        )
    latitude, longitude, altitude = median_place(geodetic)
    step = np.array([1e-4, 1e-4, 10.0]) if project.in_degrees else np.full(3, 10.0)
    return _World(
        project.to_geodetic, step, Georef((latitude, longitude, round(altitude)), "", project.place), project.file
    )


# ---------------------------------------------------------------------------------------------------- points


def _cloud_beside(
    project: Project, root: Path, images: str | None, poses: Sequence[np.ndarray], world: _World
) -> tuple[np.ndarray, np.ndarray, str]:
    """Points and colors of a PLY, LAS or LAZ beside a project that its cameras see, in the world, and a note on it."""
    find_points = points_command(project.file if project.file.parent == root else root, images)
    dense = [folder for each in _DENSE for folder in sorted(root.glob(each))]
    cloud = find_point_cloud(root, project.file.parent, lone=True)
    las = find_las((root, project.file.parent, *dense))
    if cloud is None and can_read_las():
        cloud = las
    cloud = cloud or find_point_cloud(*dense, lone=True)
    if cloud is None:
        named = ", ".join(str(file) for file in project.with_points)
        more = f" Or give the project itself, which has tie points: {named}." if named else ""
        more += f" {las} is not read: it needs pip install 'vdgs[geo]'." if las is not None else ""
        if several := sorted(
            {each.name for folder in (root, project.file.parent, *dense) for each in folder.glob("*.ply")}
        ):
            more += f" Several are there ({', '.join(several[:3])}): call the one that is meant {POINT_CLOUDS[0]}."
        raise NoTiePoints(
            f"{project.file}: brings poses but no 3D points, from which the scene starts. This finds them, with the "
            f"poses as they are: {find_points}\nOr put a point cloud in the same coordinates beside it, as a PLY, LAS "
            f"or LAZ file.{more}"
        )
    is_ply = cloud.suffix.lower() == ".ply"
    points, colors = (read_point_cloud if is_ply else read_las_points)(cloud)
    frames: list[CloudFrame] = [] if is_ply else _own_frames(cloud, world)
    frames.append(("of the project", world.moved))
    frames += [(name, _after(change, world)) for name, change in project.cloud_frames]
    frames.append(("of the scene", lambda points: points))
    eyes = [Eye(pose, view.intrinsics) for pose, view in zip(poses, project.views, strict=True)]
    (what, change), seen = best_frame(points, eyes, frames)
    if seen < LEAST_SEEN:
        raise NoTiePoints(
            f"{cloud}: its points are not where the cameras of {project.file.name} look ({seen:.0%} fall into "
            "photographs, at best): it is in other coordinates, or of another project. Export it in the project's own, "
            f"or move it away and find points anew: {find_points}"
        )
    with np.errstate(all="ignore"):
        moved = change(points)
    return moved, colors, f"the project has no points; those of {cloud.name} are used (coordinates {what})."


def _own_frames(las: Path, world: _World) -> list[CloudFrame]:
    """The coordinates that the header of a LAS or LAZ file names, where the world has a place on Earth. Of systems in
    feet that say nothing of heights, these are in feet or in metres."""
    if world.georef is None or world.georef.origin is None:
        return []
    system = las_system(las)
    if system is None or is_local_system(system):
        return []
    try:
        ways = [False] if unit_without_heights(system) == 1 else [True, False]
        found = [to_geodetic(system, las, "its header", heights_as_xy=way) for way in ways]
    except UnknownSystem:
        return []
    return [(f"of {name}", _after(change, world)) for change, name in found]


def _after(change: Callable[[np.ndarray], np.ndarray], world: _World) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: world.to_enu(change(points))
