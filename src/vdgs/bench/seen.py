"""How often each pixel of the test views is seen in training: from the truth of a generated capture, with occlusion,
or else as a reference model of the scene draws it. The same for all methods and seeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from vdgs.cameras import Camera
from vdgs.captures.capture import Capture
from vdgs.captures.facts import fingerprint
from vdgs.captures.loading import load_capture
from vdgs.evaluation.of_run import visibility_map
from vdgs.runs.opening import open_run
from vdgs.settings.capture import CaptureOptions
from vdgs.synth.truth import has_truth, load_truth

#: `truth`: training cameras that truly see the surface. `model`: whose frustum holds the place that a model draws.
SeenBy = Literal["truth", "model"]


@dataclass(frozen=True, eq=False)
class Seen:
    """V of every pixel of a capture's test views."""

    capture: Capture
    #: Camera of a test view -> V [h, w] at its size, NaN where nothing is (sky), nothing is drawn, or no training
    #: camera looks: a method may only guess there.
    visibility_map: Callable[[Camera], Float[np.ndarray, "h w"]]
    by: SeenBy
    #: Tells this V from any other: what was measured with another one is measured again.
    identity: str


def seen_truly(root: Path, options: CaptureOptions) -> Seen | None:
    """V by the truth beside a generated capture, read with `options`; None where there is none, or where it counts
    other training views than those that are used or does not know a test view."""
    if not has_truth(root):
        return None
    truth, capture = load_truth(root), load_capture(root, options)
    known = {kind: {file.stem for file in (truth.folder / kind).glob("*.npz")} for kind in ("depth", "views")}
    counted = known["depth"] == {Path(view.name).stem for view in capture.train_views}
    if not counted or not known["views"] >= {Path(view.name).stem for view in capture.test_views}:
        return None
    parts = ", ".join(f"{name} {crc:08x}" for name, crc in fingerprint(capture).items())
    return Seen(capture, _where_seen(truth.visibility_maps(capture)), "truth", f"seen at all: {parts}")


def _where_seen(
    visibility_map: Callable[[Camera], Float[np.ndarray, "h w"]],
) -> Callable[[Camera], Float[np.ndarray, "h w"]]:
    def seen(camera: Camera) -> Float[np.ndarray, "h w"]:
        views = visibility_map(camera)
        return np.where(views >= 1, views, np.nan)

    return seen


def seen_by_model(reference: Path) -> Seen:
    """V as the coarse model of a run draws it. Raises RunError if it is not trained."""
    opened = open_run(reference, "coarse")
    return Seen(opened.capture, visibility_map(opened), "model", str(opened.status.model))
