"""What the tests of the evaluation share: synthetic photographs, real ones where there are any."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from vdgs.captures.capture import View
from vdgs.captures.image_files import decode_mask
from vdgs.evaluation import metrics
from vdgs.geometry.camera import Camera


def photograph(rng: np.random.Generator, height: int = 48, width: int = 64) -> np.ndarray:
    """Smooth colors with some detail, uint8 [h, w, 3], no pixel saturated."""
    coarse = rng.uniform(0.15, 0.85, (5, 6, 3))
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return ((smooth + rng.normal(0, 0.02, smooth.shape)).clip(0.05, 0.95) * 255).astype(np.uint8)


def noisy(image: np.ndarray, rng: np.random.Generator, sigma: float = 0.05) -> np.ndarray:
    """The image as a poor render shows it."""
    return ((image / 255 + rng.normal(0, sigma, image.shape)).clip(0, 1) * 255 + 0.5).astype(np.uint8)


def view(name: str, width: int = 64, height: int = 48, shift: float = 0.0, mask: Path | None = None) -> View:
    pose = np.eye(4)
    pose[0, 3] = shift
    camera = Camera(camera_from_world=pose, fx=60.0, fy=60.0, cx=width / 2, cy=height / 2, width=width, height=height)
    return View(name=name, camera=camera, image_path=Path("images") / name, mask_path=mask, split="test")


def load_mask(view: View) -> np.ndarray | None:
    camera = view.camera
    return None if view.mask_path is None else decode_mask(view.mask_path, camera.width, camera.height)


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR in dB over all kept pixels and channels, as an evaluation puts it together."""
    return metrics.psnr_from_mse(metrics.masked_mean(metrics.squared_error(image, reference), mask))


def ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Mean SSIM over the kept pixels, likewise."""
    return metrics.masked_mean(metrics.ssim_map(image, reference, mask), mask)


def as_render(image: np.ndarray) -> SimpleNamespace:
    """What a renderer returns, from an 8-bit image."""
    return SimpleNamespace(image=torch.from_numpy(image.astype(np.float32) / 255))


def real_photographs(capture: str, count: int) -> list[np.ndarray]:
    """Photographs of a real capture at a quarter of its size; skips the test where there is none."""
    data = os.environ.get("VDGS_DATA") or Path(__file__).parents[3] / "shared" / "data"
    files = sorted((Path(data) / capture / "images_4").glob("*"))[:count]
    if len(files) < count:
        pytest.skip(f"no capture {capture} in {data}")
    return [np.ascontiguousarray(cv2.imread(str(file))[..., ::-1]) for file in files]
