"""A house on level ground under a row of cameras, and the opaque model that draws it in maps."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console

from support.captures import look_down
from support.commands import small_figures
from support.hand_made_models import model_at, opaque_plane
from vdgs.captures.capture import Capture, View
from vdgs.config.commands import OrthoRequest
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.geometry.map_projection import MapProjection
from vdgs.model.anchor_model import AnchorModel
from vdgs.rendering.ortho import render_ortho
from vdgs.rendering.ortho.nadir_camera import NadirCamera
from vdgs.rendering.ortho.tile_renderer import TileRenderer
from vdgs.runs.run_context import RunContext

#: Far from the middle of its zone: grid north is 1.1 degrees off.
PLACE = (46.95, 7.44, 560.0)
SPACING, ROOF = 0.25, 5.0
#: Where the house stands, in the ground frame: x0, y0, x1, y1.
HOUSE = (2.0, -3.0, 6.0, 1.0)


def surface(x0: float, y0: float, x1: float, y1: float, z: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(x0 + SPACING / 2, x1, SPACING), np.arange(y0 + SPACING / 2, y1, SPACING))
    # Not quite level: which of two splats at one depth comes first is a matter of rounding.
    return np.column_stack([x.ravel(), y.ravel(), z + np.random.default_rng(0).uniform(-0.02, 0.02, x.size)])


def model_of(places: np.ndarray) -> AnchorModel:
    """Opaque splats at these places, each of its own color, flat enough that roofs stay roofs."""
    plane = opaque_plane(spacing=SPACING)
    anchors = model_at(places).anchors
    anchors = replace(
        anchors,
        offsets=torch.zeros_like(anchors.offsets),
        log_scales=torch.full_like(anchors.log_scales, float(np.log(SPACING))),
    )
    return replace(plane, anchors=anchors)


def surveyor_of(model: AnchorModel, capture: Capture, placement: MapProjection, *given, **named) -> TileRenderer:
    return TileRenderer(model, NadirCamera.of(capture, placement), *given, **named)


GROUND, TOP = surface(-10, -10, 10, 10, 0.0), surface(*HOUSE, ROOF)


def capture_of(points: np.ndarray, origin: tuple[float, float, float] | None = PLACE, flying: float = 20.0) -> Capture:
    """Cameras in a row over the scene, looking down; the sparse points as given."""
    views = []
    for number, x in enumerate((-6.0, -2.0, 2.0, 6.0)):
        camera = Camera(
            camera_from_world=look_down(np.array([x, 0.0, flying]), 5.0, 90.0), fx=80.0, fy=80.0, cx=32.0, cy=24.0,
            width=64, height=48,
        )  # fmt: skip
        views.append(
            View(
                name=f"{number}.png",
                camera=camera,
                image_path=Path("images") / f"{number}.png",
                mask_path=None,
                split="train",
            )
        )
    ground = GroundFrame(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description="hand-made", origin_geo=origin
    )
    return Capture(
        root=Path("place"), source="colmap", images="images", views=tuple(views), points=points,
        point_colors=np.zeros((len(points), 3), np.uint8), ground=ground,
    )  # fmt: skip


def draw_maps(run: Path, capture: Capture, model: AnchorModel, *, warning: str = "", **asked) -> Path:
    """`vdgs ortho` of a model and a capture that were never trained; returns the folder of the maps."""
    status = SimpleNamespace(model_id="1-2")
    opened = SimpleNamespace(
        folder=SimpleNamespace(path=run), capture=capture, model=model, name="coarse", status=status, warning=warning
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch, small_figures():
        patch.setattr(RunContext, "open_model", lambda *_, **__: opened)
        request = OrthoRequest(run=run, device="cpu", **asked)
        return render_ortho.render_ortho(RunContext.from_path(run), request, Console(file=sys.stderr, soft_wrap=True))
