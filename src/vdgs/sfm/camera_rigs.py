"""Rigs of several cameras that release together (`rig_folders`).

How the cameras lie to each other comes out of a first model without rigs; a second one then holds each rig together.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from rich.console import Console

from vdgs.sfm import incremental_mapper
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.rig_folders import MIN_FRAMES
from vdgs.sfm.workspace import Workspace, explain_colmap_errors
from vdgs.system.lazy_pycolmap import pycolmap


def map_rigs(
    workspace: Workspace,
    photographs: Sequence[ImageMetadata],
    count: int,
    fix_focal: bool,
    threads: int,
    console: Console,
) -> None:
    """Make models again, with the cameras of rigs held together as those that were set aside have them; these are taken
    back where they place more photographs, or do not tell."""
    loose = incremental_mapper.read_models(workspace, aside=True)[0]
    before = loose.num_reg_images()  # joining changes the model
    if _join_sensors(workspace, photographs, loose):
        incremental_mapper.run_mapper(workspace, count, fix_focal, threads, console)
        if incremental_mapper.read_models(workspace)[0].num_reg_images() >= before:
            return
    incremental_mapper.take_models_back(workspace)


def _join_sensors(workspace: Workspace, photographs: Sequence[ImageMetadata], model: pycolmap.Reconstruction) -> bool:
    """Let the cameras of each rig move as one in COLMAP's database, as a model without rigs has them. False where the
    model does not tell how any lie to each other."""
    rigs: dict[str, list[str]] = {}
    for prefix in dict.fromkeys(photo.sensor for photo in photographs if photo.sensor):
        rigs.setdefault(str(PurePosixPath(prefix).parent), []).append(prefix)
    placed = {image.name for image in model.images.values() if image.has_pose}
    configs = []
    for prefixes in rigs.values():
        frames = {prefix: {name[len(prefix) :] for name in placed if name.startswith(prefix)} for prefix in prefixes}
        first = max(prefixes, key=lambda prefix: len(frames[prefix]))
        known = [prefix for prefix in prefixes if len(frames[first] & frames[prefix]) >= MIN_FRAMES]
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
