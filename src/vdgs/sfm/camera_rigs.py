"""Rigs of several cameras that release together (`rig_folders`).

How the cameras lie to each other comes out of a first model without rigs; a second one then holds each rig together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

import numpy as np
from rich.console import Console
from rich.markup import escape

from vdgs.errors import CaptureError
from vdgs.sfm import incremental_mapper
from vdgs.sfm.global_mapper import MAX_WORSE_PX
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.panoramas import rig_configs
from vdgs.sfm.reprojection import mean_reprojection_error
from vdgs.sfm.rig_folders import MIN_FRAMES, degrees_from_mean
from vdgs.sfm.workspace import Workspace, explain_colmap_errors
from vdgs.system.lazy_pycolmap import pycolmap

#: In a model without rigs the cameras of one lie to each other as in the mean but for so many degrees, and such a share
#: of their distance to what they see (medians; choice).
MAX_TURNED_DEG, MAX_MOVED_SHARE = 5.0, 0.1
#: A model that holds rigs together has at least such a share of the observations of one that does not (choice).
MIN_SEEN = 0.95


def map_rigs(
    workspace: Workspace,
    photographs: Sequence[ImageMetadata],
    count: int,
    fix_focal: bool,
    threads: int,
    console: Console,
) -> None:
    """Make models again, with the cameras of rigs held together as those that were set aside have them; these are taken
    back, and why is said, where they fit the photographs better, or do not tell how the cameras lie."""
    loose = incremental_mapper.read_models(workspace, workspace.models_aside)[0]
    before = pycolmap.Reconstruction(loose)  # joining changes the model
    why = "no two of them are placed together often enough, and fixed to each other"
    if _join_sensors(workspace, photographs, loose):
        try:
            incremental_mapper.run_mapper(workspace, count, fix_focal, threads, console)
            why = _why_not(before, incremental_mapper.read_models(workspace)[0])
        except CaptureError as error:
            why = str(error)
    if why:
        incremental_mapper.take_models_back(workspace)
        take_rigs_apart(workspace, photographs)
        console.print(f"[yellow]note[/] the cameras of rigs are not held together: {escape(why)}", highlight=False)


def take_rigs_apart(workspace: Workspace, photographs: Sequence[ImageMetadata]) -> None:
    """Let each camera of rigs move on its own in COLMAP's database, as before `map_rigs`: a first model without rigs
    tells how they lie. The views of panoramas stay together."""
    if not any(photo.sensor for photo in photographs):
        return
    views = rig_configs(photographs)
    with explain_colmap_errors(workspace.path), workspace.open_database() as database:
        if sum(rig.num_sensors() > 1 for rig in database.read_all_rigs()) > len(views):
            pycolmap.apply_rig_config(views, database)  # makes all anew: a rig for each camera that these do not name


def _why_not(loose: pycolmap.Reconstruction, rigid: pycolmap.Reconstruction) -> str:
    """Why a model that holds rigs together is not taken in place of one that does not; empty where it is. Cameras that
    are in truth not fixed to each other are placed so, too, but away from what they show."""
    if rigid.num_reg_images() < loose.num_reg_images():
        return "fewer photographs are placed then"
    worse = mean_reprojection_error(rigid) - mean_reprojection_error(loose)
    seen = rigid.compute_num_observations() / loose.compute_num_observations()
    if worse > MAX_WORSE_PX or seen < MIN_SEEN:
        return f"of what photographs show {seen:.0%} are left then, {worse:+.2f} px farther off"
    return ""


def _join_sensors(workspace: Workspace, photographs: Sequence[ImageMetadata], model: pycolmap.Reconstruction) -> bool:
    """Let the cameras of each rig move as one in COLMAP's database, as a model without rigs has them. False where the
    model does not tell how any lie to each other."""
    rigs: dict[str, list[str]] = {}
    for prefix in dict.fromkeys(photo.sensor for photo in photographs if photo.sensor):
        rigs.setdefault(str(PurePosixPath(prefix).parent), []).append(prefix)
    placed = {image.name: image for image in model.images.values() if image.has_pose}
    configs = []
    for prefixes in rigs.values():
        frames = {
            prefix: {name[len(prefix) :]: image for name, image in placed.items() if name.startswith(prefix)}
            for prefix in prefixes
        }
        first = max(prefixes, key=lambda prefix: len(frames[prefix]))
        known = [prefix for prefix in prefixes if _are_fixed(frames[first], frames[prefix], model)]
        if len(known) > 1:
            known.sort(key=lambda prefix: prefix != first)  # COLMAP takes the reference first
            cameras = [pycolmap.RigConfigCamera(ref_sensor=prefix == first, image_prefix=prefix) for prefix in known]
            configs.append(pycolmap.RigConfig(cameras=cameras))
    if not configs:
        return False
    with explain_colmap_errors(workspace.path), workspace.open_database() as database:
        if not any(rig.num_sensors() > 1 for rig in database.read_all_rigs()):
            pycolmap.apply_rig_config(configs, database, model)
    return True


def _are_fixed(
    ones: Mapping[str, pycolmap.Image], others: Mapping[str, pycolmap.Image], model: pycolmap.Reconstruction
) -> bool:
    """Whether two cameras lie to each other in most of their frames about as they do in the mean; false for few."""
    frames = [(ones[name], others[name]) for name in sorted(ones.keys() & others.keys())]
    if len(frames) < MIN_FRAMES:
        return False
    relative = [other.cam_from_world() * one.cam_from_world().inverse() for one, other in frames]
    turned = degrees_from_mean(np.array([each.rotation.matrix() for each in relative]))
    places = np.array([each.translation for each in relative])
    moved = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    away = [incremental_mapper.height_over_points(one, model) for one, _ in frames if one.num_points3D]
    return bool(np.median(turned) < MAX_TURNED_DEG and np.median(moved) < MAX_MOVED_SHARE * np.median(away))


def describe_rigs(model: pycolmap.Reconstruction, unit: str) -> list[str]:
    """How far the cameras of each rig are from its reference."""
    first = {image.camera_id: image.name.rpartition("/")[0] for image in model.images.values()}
    return [
        f"rig: {first[sensor.id]} is {np.linalg.norm(sensor_from_rig.tgt_origin_in_src()):.3g} {unit} from "
        f"{first[rig.ref_sensor_id.id]}."
        for rig in model.rigs.values()
        for sensor, sensor_from_rig in rig.non_ref_sensors.items()
        if sensor_from_rig is not None and sensor.id in first and rig.ref_sensor_id.id in first
    ]
