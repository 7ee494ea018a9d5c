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
from vdgs.captures.capture_metadata import fingerprint
from vdgs.captures.ground_truth import Truth, has_truth, load_truth
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.evaluation.evaluate_run import visibility_map
from vdgs.geometry.camera import Camera
from vdgs.runs.open_run import open_run
from vdgs.visibility.visibility_counts import visibility_of

#: `truth`: training cameras that truly see the surface. `frusta`: whose frustum holds it, hidden or not, as the paper
#: counts. `model`: whose frustum holds the place that a model draws.
SeenBy = Literal["truth", "frusta", "model"]


@dataclass(frozen=True, eq=False)
class Seen:
    """V of every pixel of a capture's test views."""

    capture: Capture
    #: Camera of a test view -> V [h, w] at its size, NaN where nothing is (sky) or nothing is drawn. Where no training
    #: camera looks a method may only guess: `visibility_map` is NaN there too.
    counted: Callable[[Camera], Float[np.ndarray, "h w"]]
    by: SeenBy
    #: Tells this V from any other: what was measured with another one is measured again.
    identity: str

    def visibility_map(self, camera: Camera) -> Float[np.ndarray, "h w"]:
        """V where some training camera looks, NaN elsewhere."""
        views = self.counted(camera)
        return views if self.by == "model" else np.where(views >= 1, views, np.nan)

    def unseen(self, camera: Camera) -> Bool[np.ndarray, "h w"]:
        """Which pixels show something (no sky, as far as that is known) that no training camera sees."""
        views = self.counted(camera)
        return np.isnan(views) | (np.rint(views) == 0) if self.by == "model" else views == 0


def seen_truly(root: Path, options: CaptureOptions) -> Seen | None:
    """V by the truth beside a generated capture, read with `options`; None where there is none, or where it counts
    other training views than those that are used or does not know a test view."""
    known = _known(root, options)
    if known is None:
        return None
    truth, capture, parts = known
    views = _by_pose(capture.test_views)

    def counted(camera: Camera) -> Float[np.ndarray, "h w"]:
        return truth.visibility_map(views[camera.camera_from_world.tobytes()])

    return Seen(capture, counted, "truth", f"seen at all: {parts}")


def seen_by_frusta(root: Path, options: CaptureOptions) -> Seen | None:
    """How many training cameras hold the true surface at each pixel in their frustum, whatever hides it; None where
    `seen_truly` is."""
    known = _known(root, options)
    if known is None:
        return None
    truth, capture, parts = known
    views, unit = _by_pose(capture.test_views), capture.ground.scale
    cameras = [view.camera for view in capture.train_views]

    def counted(camera: Camera) -> Float[np.ndarray, "h w"]:
        return held_by_frusta(truth, views[camera.camera_from_world.tobytes()], unit, cameras)

    return Seen(capture, counted, "frusta", f"by frusta: {parts}")


def _by_pose(views: Sequence[View]) -> dict[bytes, View]:
    return {view.camera.camera_from_world.tobytes(): view for view in views}


def held_by_frusta(truth: Truth, view: View, unit: float, cameras: Sequence[Camera]) -> Float[np.ndarray, "h w"]:
    """How many of the cameras hold the true surface at each pixel of a view; NaN for sky. `unit`: of the ground frame,
    in a metre."""
    depth = unit * truth.depth_map(view)
    sky = ~np.isfinite(depth)
    places = view.camera.unproject(np.where(sky, 1.0, depth)).reshape(-1, 3)
    held = visibility_of(torch.from_numpy(places), cameras).numpy().reshape(depth.shape)
    return np.where(sky, np.nan, held)


def _known(root: Path, options: CaptureOptions) -> tuple[Truth, Capture, str] | None:
    """The truth of a generated capture, the capture, and what tells it from others; None as in `seen_truly`."""
    if not has_truth(root):
        return None
    truth, capture = load_truth(root), load_capture(root, options)
    known = {kind: {file.stem for file in (truth.folder / kind).glob("*.npz")} for kind in ("depth", "views")}
    counted = known["depth"] == {Path(view.name).stem for view in capture.train_views}
    if not counted or not known["views"] >= {Path(view.name).stem for view in capture.test_views}:
        return None
    parts = ", ".join(f"{name} {crc:08x}" for name, crc in fingerprint(capture).items())
    return truth, capture, parts


def seen_by_model(reference: Path) -> Seen:
    """V as the coarse model of a run draws it. Raises RunError if it is not trained."""
    opened = open_run(reference, "coarse")
    return Seen(opened.capture, visibility_map(opened), "model", str(opened.status.model))
