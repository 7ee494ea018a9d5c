"""Four blocks about the origin, and small anchor models made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
import torch

from support.captures import look_down
from vdgs.captures.capture import Capture, View
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.partition.blocks import Block, Blocks

OFFSETS = 2


def quadrants(core: float = 4.0, ring: float = 1.0) -> Blocks:
    """Block 0: x, y < 0; 1: x < 0 < y; 2: y < 0 < x; 3: x, y > 0; each widened by `ring`."""
    cores = [
        shapely.box(min(x, 0), min(y, 0), max(x, 0), max(y, 0)) for x in (-core, core) for y in (-core, core)
    ]  # fmt: skip
    return Blocks(tuple(Block(each, each.buffer(ring, join_style="mitre")) for each in cores))


def quadrant_of(places: np.ndarray) -> np.ndarray:
    """What `quadrants` should say of places off the axes."""
    return 2 * (places[:, 0] > 0) + (places[:, 1] > 0)


def model_at(positions: np.ndarray, seed: int = 0, decoder_seed: int = 0) -> AnchorModel:
    """Anchors [n, 3] with random features, each different; a random decoder."""
    g, n = torch.Generator().manual_seed(seed), len(positions)
    anchors = Anchors(
        positions=torch.from_numpy(np.asarray(positions, np.float32).reshape(n, 3)),
        features=torch.randn(n, 32, generator=g),
        offsets=0.1 * torch.randn(n, OFFSETS, 3, generator=g),
        log_scales=0.1 * torch.randn(n, 6, generator=g) - 1.0,
    )
    decoder = Decoder.init_random(OFFSETS, False, 0, 0, torch.Generator().manual_seed(decoder_seed))
    return AnchorModel(
        anchors=anchors,
        decoder=decoder,
        voxel_size=0.1,
        background=(0.1, 0.2, 0.3),
        metadata=ModelMetadata(version="plane"),
    )


def opaque_plane(spacing: float = 0.2, half: float = 3.0) -> AnchorModel:
    """The square |x|, |y| < half at z = 0 covered by opaque splats of different colors."""
    line = np.arange(-half + spacing / 2, half, spacing)
    x, y = np.meshgrid(line, line)
    model = model_at(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))
    anchors = replace(
        model.anchors,
        offsets=torch.zeros_like(model.anchors.offsets),
        log_scales=torch.full_like(model.anchors.log_scales, float(np.log(spacing))),
    )
    tensors = {name: t.clone() for name, t in model.decoder.tensors().items()}
    for head, bias in (("opacity", 4.0), ("covariance", 0.0)):
        tensors[f"{head}_w2"].zero_()
        tensors[f"{head}_b2"].fill_(bias)
    tensors["covariance_b2"].view(OFFSETS, 7)[:, 3] = 1.0  # the unit quaternion
    return replace(model, anchors=anchors, decoder=Decoder.from_tensors(tensors))


def camera_above(x: float, y: float, altitude: float = 4.0, tilt_deg: float = 0.0, yaw_deg: float = 0.0) -> Camera:
    pose = look_down(np.array([x, y, altitude]), tilt_deg, yaw_deg)
    return Camera(camera_from_world=pose, fx=60.0, fy=60.0, cx=32.0, cy=24.0, width=64, height=48)


def ground(origin: tuple[float, float, float] | None) -> GroundFrame:
    return GroundFrame(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description="hand-made", origin_geo=origin
    )


def capture_at(origin: tuple[float, float, float] | None) -> Capture:
    cameras = [camera_above(0.3, -0.2), camera_above(-2.0, 1.0, tilt_deg=30.0), camera_above(1.5, 2.0)]
    views = [
        View(name=f"{n}.png", camera=camera, image_path=Path("images") / f"{n}.png", mask_path=None, split="train")
        for n, camera in enumerate(cameras)
    ]
    points = np.zeros((1, 3))
    return Capture(
        root=Path("place"), source="colmap", images="images", views=tuple(views), points=points,
        point_colors=np.zeros((1, 3), np.uint8), ground=ground(origin),
    )  # fmt: skip


def two_floors() -> AnchorModel:
    """A plane of opaque splats, and a roof of 1.6 x 1.6 above its middle."""
    ground, roof = opaque_plane(), opaque_plane(half=0.8)
    lifted = replace(roof.anchors, positions=roof.anchors.positions + torch.tensor([0.0, 0.0, 1.5]))
    tensors = {name: torch.cat([t, lifted.tensors()[name]]) for name, t in ground.anchors.tensors().items()}
    return replace(ground, anchors=type(ground.anchors)(**tensors))
