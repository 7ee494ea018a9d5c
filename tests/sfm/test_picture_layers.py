"""Pictures of depth, classes and normals beside photographs are none of these; photographs of such names are."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from vdgs.sfm.find_images import find_files

RANDOM = np.random.default_rng(0)
COLORS = RANDOM.integers(0, 256, (24, 32, 3), np.uint8)
DEPTH = RANDOM.integers(0, 9000, (24, 32)).astype(np.uint16)
CLASSES = RANDOM.integers(0, 5, (24, 32, 1), np.uint8).repeat(3, 2) * 50
VECTORS = RANDOM.normal(size=(24, 32, 3))
NORMALS = np.round((VECTORS / np.linalg.norm(VECTORS, axis=2, keepdims=True) + 1) * 127.5).astype(np.uint8)
NORMALS[:8] = 0
GRAY = (DEPTH >> 6).astype(np.uint8)
PALETTE = cv2.applyColorMap(GRAY, cv2.COLORMAP_INFERNO)[..., ::-1]


def write(folder: Path, pictures: dict[str, np.ndarray], camera: str = "") -> None:
    for name, pixels in pictures.items():
        image = Image.fromarray(pixels)
        exif = image.getexif()
        if camera and name.startswith(camera):
            exif[0x0110] = "FC6310"
        image.save(folder / name, exif=exif)


@pytest.mark.parametrize(
    ("photograph", "other", "pixels", "kind"),
    [
        ("{}_rgb.png", "{}_depth.png", DEPTH, "depth"),
        ("{}.jpg", "{}_depth.png", DEPTH, "depth"),
        ("frame-{}.color.png", "frame-{}.depth.png", DEPTH, "depth"),
        ("frame{}.jpg", "depth{}.png", DEPTH, "depth"),
        ("rgb_{}.png", "distance_to_image_plane_{}.tif", DEPTH, "depth"),
        ("img_{}.png", "img_{}_disparity.png", GRAY, "depth"),
        ("{}.jpg", "{}_depth.png", GRAY[..., None].repeat(3, 2), "depth"),  # one value in three channels
        ("DJI_{}.JPG", "DJI_{}_depth.jpg", GRAY[..., None].repeat(3, 2), "depth"),
        ("{}.jpg", "{}_depth.png", PALETTE, "depth"),
        ("rgb_{}.png", "semantic_segmentation_{}.png", CLASSES, "classes"),
        ("DJI_{}.JPG", "DJI_{}.instance.png", CLASSES[..., 0], "classes"),
        ("{}.png", "{}_normal.png", NORMALS, "normals"),
    ],
)
def test_layers_beside_photographs_are_left_out(tmp_path, photograph, other, pixels, kind):
    numbers = [f"{k:06d}" for k in range(1, 5)]
    write(tmp_path, {photograph.format(k): COLORS for k in numbers} | {other.format(k): pixels for k in numbers[:3]})
    write(tmp_path, {other.format("000009"): pixels})  # of no photograph
    found = find_files([tmp_path])
    assert sorted(found.named) == sorted([*(photograph.format(k) for k in numbers), other.format("000009")])
    first = other.format(numbers[0])
    assert found.left_out[first] == (
        f"is a picture of {kind}, by its name and pixels, of {photograph.format(numbers[0])} beside it"
    )


@pytest.mark.parametrize(
    ("pictures", "camera"),
    [
        ({f"depth_{k}.jpg": COLORS for k in range(4)}, ""),  # nothing beside them
        ({f"depth_{k}.png": DEPTH for k in range(4)}, ""),
        ({f"{name}_{k}.jpg": COLORS for k in range(4) for name in ("img", "depth")}, ""),
        ({f"{name}_{k}.jpg": COLORS for k in range(4) for name in ("img", "normal")}, ""),
        ({f"{name}_{k}.jpg": COLORS for k in range(4) for name in ("img", "seg")}, ""),
        ({f"img_{k}.png": COLORS for k in range(4)} | {f"depth_{k}.png": DEPTH for k in range(4)}, "depth"),
        ({f"{name}_{k}.png": DEPTH for k in range(4) for name in ("img", "depth")}, ""),
        ({f"{name}_{k}.png": GRAY[..., None].repeat(3, 2) for k in range(4) for name in ("img", "depth")}, ""),
        ({f"img_{k}.png": COLORS for k in range(4)} | {f"adepth_{k}.png": DEPTH for k in range(4)}, ""),
    ],
)
def test_photographs_of_such_names_stay(tmp_path, pictures, camera):
    write(tmp_path, pictures, camera)
    found = find_files([tmp_path])
    assert sorted(found.named) == sorted(pictures)
    assert not found.left_out
