"""A place that a model has itself photographed, opened as the viewer opens a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from support.captures import camera_at
from support.hand_made_models import opaque_plane
from vdgs.captures.capture import Capture, View
from vdgs.evaluation.metrics import to_8bit
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import render
from vdgs.runs.open_run import OpenedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StatusRecord
from vdgs.viewer.viewer_scene import ViewerScene

PLACE = (46.95, 7.44, 560.0)


def photographed(folder: Path, model: AnchorModel, change: Callable[[int, np.ndarray], np.ndarray]) -> ViewerScene:
    """Nine photographs that a model has itself drawn, each changed by its number, all of them masked where a mask
    `N.mask.png` lies beside; the last one tests."""
    views = []
    for number, (x, y) in enumerate((x, y) for x in (-1.5, 0.0, 1.5) for y in (-1.5, 0.0, 1.5)):
        camera, file = camera_at(x, y, 4.0, 8.0, 40.0 * number), folder / f"{number}.png"
        cv2.imwrite(str(file), to_8bit(change(number, render(model, camera).image.numpy()))[..., ::-1])
        mask = file.with_suffix(".mask.png")
        views.append(
            View(
                name=file.name,
                camera=camera,
                image_path=file,
                mask_path=mask if mask.exists() else None,
                split="test" if number == 8 else "train",
            )
        )
    points = model.anchors.positions.double().numpy()
    ground = GroundFrame(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description="hand-made", origin_geo=PLACE
    )
    capture = Capture(
        root=folder, source="colmap", images=".", views=tuple(views), points=points,
        point_colors=np.full((len(points), 3), 99, np.uint8), ground=ground,
    )  # fmt: skip
    run = OpenedRun(
        folder=RunFolder(folder / "run"),
        model=model,
        model_path=folder / "model",
        name="merged",
        status=StatusRecord(),
        key="key",
        warning="",
        capture=capture,
    )
    coarse = replace(run, model=opaque_plane(), name="coarse")
    return ViewerScene(run, lambda name: coarse)
