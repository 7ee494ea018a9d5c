"""Rigs of several cameras that release together, told by their folders: rig1/cam0/0001.jpg and rig1/cam1/0001.jpg.

How the cameras lie to each other comes out of a first model without rigs; a second one then holds each rig together.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
from rich.console import Console

from vdgs.captures.name_resolution import match_key
from vdgs.sfm import incremental_mapper
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.workspace import Workspace, explain_colmap_errors
from vdgs.system.lazy_pycolmap import pycolmap

#: What folders of the cameras of a rig are called. Folders of a memory card (100MEDIA, 101MEDIA) are none.
_SENSOR = re.compile(
    r"(cam|camera|sensor|lens)[ _-]?\w{1,2}|left|right|front|rear|back(ward)?s?|forwards?|nadir|down|up|middle|center",
    re.IGNORECASE,
)
#: Folders share so many names, and so large a share of those of the smaller one, where the cameras release together.
MIN_FRAMES, MIN_SHARED = 3, 0.5


def with_sensors(photographs: Sequence[ImageMetadata]) -> tuple[list[ImageMetadata], list[str]]:
    """The photographs, each with the folder of its camera where that is one of a rig, and what to say of the rigs."""
    folders: dict[str, list[ImageMetadata]] = {}
    for photo in photographs:
        folders.setdefault(str(PurePosixPath(photo.name).parent), []).append(photo)
    rigs: dict[str, dict[str, list[ImageMetadata]]] = {}
    for folder, members in folders.items():
        path = PurePosixPath(folder)
        alike = len({(photo.camera, photo.size, photo.lens) for photo in members}) == 1  # one camera, as it was set
        if _SENSOR.fullmatch(path.name) and alike and not any(photo.is_panorama for photo in members):
            rigs.setdefault(str(path.parent), {})[f"{folder}/"] = members
    sensor_of, notes = dict[str, str](), list[str]()
    for parent, sensors in sorted(rigs.items()):
        together = _together(sensors)
        if len(together) > 1:
            sensor_of |= {photo.name: prefix for prefix in together for photo in sensors[prefix]}
            names = ", ".join(PurePosixPath(prefix).name for prefix in together)
            where = "" if parent == "." else f" in {parent}"
            notes.append(f"{names}{where} have the same names: taken for one rig of {len(together)} cameras.")
    return [replace(photo, sensor=sensor_of.get(photo.name, "")) for photo in photographs], notes


def _together(sensors: Mapping[str, Sequence[ImageMetadata]]) -> list[str]:
    """The folders whose cameras release together with that of most photographs, which comes first."""
    stems = {prefix: {match_key(photo.name[len(prefix) :]) for photo in members} for prefix, members in sensors.items()}
    first = max(sorted(stems), key=lambda prefix: len(stems[prefix]))
    shared = {prefix: len(stems[first] & names) for prefix, names in stems.items()}
    least = {prefix: max(MIN_FRAMES, MIN_SHARED * len(names)) for prefix, names in stems.items()}
    return [first, *(prefix for prefix in sorted(stems) if prefix != first and shared[prefix] >= least[prefix])]


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
