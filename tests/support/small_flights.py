"""Flights of small photographs, and what is said of them before work begins."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from support.flights import write_photograph
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.preflight import make_preflight_report

COUNT = 6


def pixels(number: int, width: int = 160, height: int = 120) -> np.ndarray:
    rough = np.random.default_rng(number).integers(0, 255, (height // 4, width // 4, 3), np.uint8)
    return cv2.resize(rough, (width, height), interpolation=cv2.INTER_CUBIC)


def flight(folder: Path, count: int = COUNT, orientation: int = 1) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"DJI_{k + 1:04d}.JPG" for k in range(count)]
    for k, name in enumerate(names):
        place = np.array((10.0 * (k % 3), 12.0 * (k // 3), 40.0))
        write_photograph(folder / name, pixels(k), k, place, orientation)
    return names


def picture(file: Path, shown: np.ndarray, **more) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(shown).save(file, **more)


def half(height: int = 120, width: int = 160) -> np.ndarray:
    keep = np.full((height, width), 255, np.uint8)
    keep[: height // 2] = 0
    return keep


def said(found: ImageList) -> list[str]:
    return make_preflight_report(found, read_gps_priors(found.images, None, (1.0, 2.0))).warnings
