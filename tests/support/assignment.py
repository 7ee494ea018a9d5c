"""What the tests of scores and of assignment share: a strip of opaque ground, its blocks and its cameras."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import shapely
import torch

from support.captures import look_down
from vdgs.config.method import AssignmentConfig
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.partition.blocks import Block, Blocks

MODES = ("coverage", "paper", "leave-one-out", "frustum")
RENDERED = MODES[:3]
CONFIG = AssignmentConfig(image_size=48, min_cameras=0)
WIDTH = 24.0


@cache
def scene() -> AnchorModel:
    """Opaque ground 24 wide and 6 deep, anchors in random order."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(0.2, WIDTH, 0.4), np.arange(0.2, 6, 0.4))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    rng.shuffle(ground)
    n, g = len(ground), torch.Generator().manual_seed(0)
    anchors = Anchors(
        positions=torch.from_numpy(ground.astype(np.float32)),
        features=torch.randn(n, 32, generator=g),
        offsets=0.3 * torch.randn(n, 4, 3, generator=g),
        log_scales=torch.full((n, 6), float(np.log(0.6))),
    )
    tensors = Decoder.init_random(4, False, 0, 1, g).tensors()
    tensors["opacity_b2"] = tensors["opacity_b2"] + 3.0  # what is in view is opaque
    tensors["color_b2"] = tensors["color_b2"] + 1.0  # and lighter than the black behind it
    return AnchorModel(
        anchors=anchors, decoder=Decoder.from_tensors(tensors), voxel_size=0.4, background=(0.5, 0.5, 0.5)
    )


def strips(count: int, margin: float = 0.5) -> Blocks:
    """Blocks side by side along x."""
    edges = np.linspace(0, WIDTH, count + 1)
    cores = [shapely.box(a, 0, b, 6) for a, b in pairwise(edges)]
    return Blocks(tuple(Block(core, core.buffer(margin, join_style="mitre")) for core in cores))


def camera(x: float, y: float = 3.0, height: float = 4.0, tilt_deg: float = 0.0) -> Camera:
    pose = look_down(np.array([x, y, height]), tilt_deg, 90.0)
    return Camera(camera_from_world=pose, fx=70.0, fy=70.0, cx=32.0, cy=24.0, width=64, height=48)


def flight() -> list[Camera]:
    return [camera(float(x), tilt_deg=tilt) for x, tilt in zip(np.linspace(1, 23, 9), [0, 20, 0] * 3, strict=True)]


def skyward() -> Camera:
    """A camera beneath which lies the last of four strips, and that sees nothing."""
    return camera(22.0, height=5.0, tilt_deg=180.0)


def hand_made(scores, held=None, mode="coverage") -> ScoreMatrix:
    values = np.array(scores, np.float32)
    held = (values > 0).astype(np.int32) if held is None else np.array(held, np.int32)
    anchors = np.full(values.shape[1], 1000, np.int64)
    return ScoreMatrix(
        mode=mode, scores=values, visible_anchors=held, coverage=values.copy(), anchors=anchors,
        nadir_block=np.zeros(len(values), np.int64),
    )  # fmt: skip
