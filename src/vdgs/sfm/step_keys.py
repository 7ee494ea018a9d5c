"""What each step of a reconstruction depends on: a step whose key is another is done again."""

from __future__ import annotations

from typing import Any

from vdgs.errors import CaptureError
from vdgs.sfm import fisheyes
from vdgs.sfm.feature_extraction import group_by_camera
from vdgs.sfm.focal_decision import should_fix_focal
from vdgs.sfm.image_metadata import RADIAL
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.workspace import cache_key
from vdgs.system.content_digests import ContentDigests
from vdgs.system.records import record_to_dict

#: Of finished captures, which stay good in later versions: another one only where these must be made anew.
FORMAT = "0.1.0"


def step_keys(plan: ReconstructionPlan, digests: ContentDigests) -> dict[str, str]:
    """What each step depends on, each on those before it. All but the last do not depend on what places the scene, but
    models on whether it lets the focal length be held: work that goes on maps anew then, while finished captures are
    placed anew. Raises CaptureError for a photograph that cannot be read."""
    options, positions = plan.request.options, plan.gps_priors
    content = digests.of_all(photo.path for photo in plan.image_list.images)
    if lost := [path for path, digest in content.items() if not digest]:
        raise CaptureError(f"{lost[0]}: cannot be read any more. See to the disk, then run the same command again.")
    files = [
        (photo.name, content[photo.path], photo.width, photo.height, photo.orientation)
        for photo in plan.image_list.images
    ]
    lenses = [photo.lens and photo.lens.focal for photo in plan.image_list.images]
    found = cache_key(
        FORMAT, files, lenses, options.max_image_size, options.max_num_features, *_masked_images(plan, digests),
        *_other_cameras(plan),
    )  # fmt: skip
    matched = cache_key(found, options.num_neighbors, options.exhaustive_max)
    asked = cache_key(matched, options.focal, *_told_lenses(plan))
    mapped = cache_key(asked, should_fix_focal(plan.image_list.images, positions, options)[0])
    capture = cache_key(asked, options.max_output_size)
    points, bars = plan.gcps.points if plan.gcps else (), plan.scale_bars
    told = [positions.image_indices.tolist(), positions.enu.tolist(), positions.gps_std.tolist(), positions.origin]
    known = [record_to_dict(point) for point in points], bars and record_to_dict(bars)
    placed = cache_key(capture, told, known, options.georeference, *_told_systems(plan))
    return {"features": found, "matches": matched, "model": mapped, "capture": capture, "placed": placed}


def _told_systems(plan: ReconstructionPlan) -> list[Any]:
    """What lists and tables say beside metres and their accuracy: the system, whether the unit of heights is guessed,
    which are those of a datum that may be off, what altitudes are over and which accuracies are stated. Heights that
    are said to be metres are those that were only taken as metres, and place the scene otherwise. Empty where nothing
    of it is said."""
    gcps, positions = plan.gcps, plan.gps_priors
    told = list[Any]()
    if gcps is not None:
        told.append((gcps.crs, gcps.unsaid_height_unit_m, gcps.datum_error_m))
    if positions.datum_errors_m.any():
        told.append(positions.datum_errors_m.tolist())
    if plan.request.gps is not None:  # photographs, which say it else, are compared themselves
        told.append((positions.altitude_reference, positions.has_altitudes, positions.are_stated.tolist()))
    return told


def _other_cameras(plan: ReconstructionPlan) -> list[tuple[str, ...]]:
    """Photographs that are converted, or whose lens has another model or whose camera is one of a rig."""
    said = [(photo.name, photo.camera_model, photo.sensor, photo.kind) for photo in plan.image_list.images]
    return [each for each in said if each[1:] != (RADIAL, "", "")]


def _told_lenses(plan: ReconstructionPlan) -> tuple[str, ...]:
    """That a person says a model of lenses which the photographs may contradict otherwise (`fisheyes`); empty where
    they would find the same by themselves, so that what is finished stays."""
    if plan.request.options.camera_model == "auto":
        return ()
    return (RADIAL,) if fisheyes.may_be_found(group_by_camera(plan.image_list.images)) else ()


def _masked_images(plan: ReconstructionPlan, digests: ContentDigests) -> list[tuple[Any, ...]]:
    """Photographs of which something may be left out, and what says so."""
    masked = [photo for photo in plan.image_list.images if photo.may_be_masked]
    content = digests.of_all(photo.mask for photo in masked if photo.mask is not None)
    return [(photo.name, photo.has_alpha_channel, photo.mask and content[photo.mask]) for photo in masked]
