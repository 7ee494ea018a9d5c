"""Before points of a project with poses are found: what there is to do, and how long it takes. Nothing is written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from rich.console import Console

from vdgs.config.capture_options import CaptureOptions
from vdgs.config.ranges import check_ranges
from vdgs.config.sfm_options import SfmRequest
from vdgs.geometry.camera import camera_centers
from vdgs.kernels import default_num_threads
from vdgs.sfm.focal_length import Lens
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.posed_capture import check_posed_output, near_pairs
from vdgs.sfm.posed_photographs import PosedPhotographs, read_posed_photographs
from vdgs.sfm.preflight import make_preflight_report
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.sfm_estimate import SfmEstimate, estimate_sfm

#: What placing points with the poses held takes of the mapping that finds poses too.
MAPPING_SHARE = 0.2


def plan_posed_capture(request: SfmRequest, options: CaptureOptions) -> tuple[ReconstructionPlan, SfmEstimate]:
    """The work on a project of another program, by estimate. Raises what reading the project raises, and VdgsError for
    an output that is something else."""
    check_ranges(request)
    photographs = read_posed_photographs(request, options)
    check_posed_output(photographs)
    images = ImageList(request.image_folders, tuple(_with_lenses(photographs)), (), 0, photographs.warnings)
    positions = _positions(photographs)
    plan = ReconstructionPlan(
        request=request, image_list=images, gps_priors=positions, preflight=make_preflight_report(images, positions),
        threads=request.threads or default_num_threads(),
        pairs=len(near_pairs(photographs, request.options.num_neighbors)),
    )  # fmt: skip
    estimate = estimate_sfm(plan)
    steps = dict(estimate.steps)
    steps["mapping"] *= MAPPING_SHARE
    return plan, replace(estimate, steps=steps)


def print_posed_plan(plan: ReconstructionPlan, estimate: SfmEstimate, console: Console) -> None:
    for warning in plan.image_list.notes:
        console.print(f"[yellow]note[/] {warning}", highlight=False)
    console.print(
        f"{len(plan.image_list.images)} photographs, poses and lenses as they are given: features, about "
        f"{plan.pairs} pairs, about {estimate.points:,} points, photographs without distortion\n"
        f"{estimate.text(plan.threads)}", highlight=False,
    )  # fmt: skip


def _with_lenses(photographs: PosedPhotographs) -> Iterator[ImageMetadata]:
    for view in photographs.views:
        lens = view.file.intrinsics
        yield replace(
            photographs.metadata(view),
            lens=Lens(float(np.mean(lens.focal)) / max(lens.width, lens.height), "the project"),
        )


def _positions(photographs: PosedPhotographs) -> GpsPriors:
    """Where the cameras are, in the coordinates of the project."""
    poses = np.stack([view.view.camera_from_world for view in photographs.views])
    centers = camera_centers(poses)
    georef = photographs.source.georef
    origin = georef.origin if georef is not None and georef.origin is not None else (0.0, 0.0, 0.0)
    return GpsPriors(
        image_indices=np.arange(len(centers)), enu=centers, gps_std=np.ones((len(centers), 3)), origin=origin,
        altitude_reference="", source="the project", notes=(),
    )  # fmt: skip
