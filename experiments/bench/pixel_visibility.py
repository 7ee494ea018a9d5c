"""How often each pixel of the test views is seen in training: from the truth of a generated capture, with occlusion,
or else as a reference model of the scene draws it. The same for all methods and seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float

from vdgs.captures.capture import Capture, View
from vdgs.captures.capture_metadata import capture_fingerprint
from vdgs.captures.ground_truth import GroundTruth, has_ground_truth, load_ground_truth
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.evaluation.evaluate_run import make_visibility_map
from vdgs.geometry.camera import Camera
from vdgs.runs.open_run import open_run
from vdgs.visibility.visibility_counts import count_visibility

#: `truth`: training cameras that truly see the surface. `frusta`: whose frustum holds it, hidden or not, as the paper
#: counts. `model`: whose frustum holds the place that a model draws.
VisibilitySource = Literal["truth", "frusta", "model"]


@dataclass(frozen=True, eq=False)
class PixelVisibility:
    """V of every pixel of a capture's test views."""

    capture: Capture
    #: Camera of a test view -> V [h, w] at its size, NaN where nothing is (sky) or nothing is drawn. Where no training
    #: camera looks a method may only guess: `make_visibility_map` is NaN there too.
    count_map: Callable[[Camera], Float[np.ndarray, "h w"]]
    source: VisibilitySource
    #: Tells this V from any other: what was measured with another one is measured again.
    identity: str

    def visibility_map(self, camera: Camera) -> Float[np.ndarray, "h w"]:
        """V where some training camera looks, NaN elsewhere."""
        views = self.count_map(camera)
        return views if self.source == "model" else np.where(views >= 1, views, np.nan)

    def unseen(self, camera: Camera) -> Bool[np.ndarray, "h w"]:
        """Which pixels show something (no sky, as far as that is known) that no training camera sees."""
        views = self.count_map(camera)
        return np.isnan(views) | (np.rint(views) == 0) if self.source == "model" else views == 0


def visibility_from_truth(root: Path, options: CaptureOptions) -> PixelVisibility | None:
    """V by the truth beside a generated capture, read with `options`; None where there is none, or where it counts
    other training views than those that are used or does not know a test view."""
    loaded = _load_truth(root, options)
    if loaded is None:
        return None
    truth, capture, parts = loaded
    views = _by_pose(capture.test_views)

    def count_map(camera: Camera) -> Float[np.ndarray, "h w"]:
        return truth.visibility_map(views[camera.camera_from_world.tobytes()])

    return PixelVisibility(capture, count_map, "truth", f"seen at all: {parts}")


def visibility_from_frusta(root: Path, options: CaptureOptions) -> PixelVisibility | None:
    """How many training cameras hold the true surface at each pixel in their frustum, whatever hides it; None where
    `visibility_from_truth` is."""
    loaded = _load_truth(root, options)
    if loaded is None:
        return None
    truth, capture, parts = loaded
    views, unit = _by_pose(capture.test_views), capture.ground.scale
    cameras = [view.camera for view in capture.train_views]

    def count_map(camera: Camera) -> Float[np.ndarray, "h w"]:
        return count_frusta(truth, views[camera.camera_from_world.tobytes()], unit, cameras)

    return PixelVisibility(capture, count_map, "frusta", f"by frusta: {parts}")


def _by_pose(views: Sequence[View]) -> dict[bytes, View]:
    return {view.camera.camera_from_world.tobytes(): view for view in views}


def count_frusta(truth: GroundTruth, view: View, unit: float, cameras: Sequence[Camera]) -> Float[np.ndarray, "h w"]:
    """How many of the cameras hold the true surface at each pixel of a view; NaN for sky. `unit`: of the ground frame,
    in a metre."""
    depth = unit * truth.depth_map(view)
    sky = ~np.isfinite(depth)
    points = view.camera.unproject(np.where(sky, 1.0, depth)).reshape(-1, 3)
    counts = count_visibility(torch.from_numpy(points), cameras).numpy().reshape(depth.shape)
    return np.where(sky, np.nan, counts)


def _load_truth(root: Path, options: CaptureOptions) -> tuple[GroundTruth, Capture, str] | None:
    """The truth of a generated capture, the capture, and its identity; None as in `visibility_from_truth`."""
    if not has_ground_truth(root):
        return None
    truth, capture = load_ground_truth(root), load_capture(root, options)
    stems = {kind: {file.stem for file in (truth.folder / kind).glob("*.npz")} for kind in ("depth", "views")}
    same_views = stems["depth"] == {Path(view.name).stem for view in capture.train_views}
    if not same_views or not stems["views"] >= {Path(view.name).stem for view in capture.test_views}:
        return None
    parts = ", ".join(f"{name} {crc:08x}" for name, crc in capture_fingerprint(capture).items())
    return truth, capture, parts


def visibility_from_model(reference: Path) -> PixelVisibility:
    """V as the coarse model of a run draws it. Raises RunError if it is not trained."""
    opened = open_run(reference, "coarse")
    return PixelVisibility(opened.capture, make_visibility_map(opened), "model", str(opened.status.model_id))
