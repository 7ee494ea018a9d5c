"""How much of the exposure of a photograph those before and after it tell, from the colours of sparse points.

    python benchmarks/exposures.py DATA/copr --images images_4

log colour of point p in photograph i = gain of i + colour of p, fitted by turns; a photograph's gain is then compared
with the mean of its neighbours' in the order of names. Needs a COLMAP model with tracks, and photographs in one folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from machine import describe

ROUNDS = 60
#: Photographs are blurred by so many pixels: points are not found to the pixel.
BLUR_PX = 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--images", default="images")
    asked = parser.parse_args()
    model = pycolmap.Reconstruction(str(asked.capture / "sparse" / "0"))
    photographs = sorted(model.images.values(), key=lambda image: image.name)
    seen = [colours(image, model, asked.capture / asked.images) for image in photographs]
    image = np.concatenate([np.full(len(points), k) for k, (points, _) in enumerate(seen)])
    _, point = np.unique(np.concatenate([points for points, _ in seen]), return_inverse=True)
    gains = fitted(image, point, np.concatenate([values for _, values in seen]), len(photographs))
    foretold = (gains[:-2] + gains[2:]) / 2
    print(describe())
    print(
        f"{len(gains)} photographs: gains deviate by {words(gains.std(0))} (red, green, blue); from the mean of their "
        f"neighbours by {words((gains[1:-1] - foretold).std(0))}"
    )


def colours(image: pycolmap.Image, model: pycolmap.Reconstruction, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The points [m] that a photograph shows and the logarithm of their colours in it [m, 3]."""
    file = next(file for file in folder.iterdir() if file.stem == Path(image.name).stem)
    pixels = cv2.GaussianBlur(cv2.imread(str(file))[..., ::-1].astype(np.float32), (0, 0), BLUR_PX)
    scale = pixels.shape[1] / model.cameras[image.camera_id].width
    points = [each for each in image.points2D if each.has_point3D()]
    places = (scale * np.array([each.xy for each in points]).reshape(-1, 2)).astype(int)
    inside = ((places >= 0) & (places < pixels.shape[1::-1])).all(1)
    numbers = np.array([each.point3D_id for each in points], np.int64)
    return numbers[inside], np.log(pixels[places[inside, 1], places[inside, 0]] + 4.0)


def fitted(image: np.ndarray, point: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Gains [count, 3] of photographs, 0 in the mean."""
    gains = np.zeros((count, 3))
    for _ in range(ROUNDS):
        colour = means(values - gains[image], point, int(point.max()) + 1)
        gains = means(values - colour[point], image, count)
        gains -= gains.mean(0)
    return gains


def means(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    held = np.maximum(np.bincount(group, minlength=count), 1)
    return np.stack([np.bincount(group, column, count) / held for column in values.T], 1)


def words(deviations: np.ndarray) -> str:
    return ", ".join(f"{each:.1%}" for each in deviations)


if __name__ == "__main__":
    main()
