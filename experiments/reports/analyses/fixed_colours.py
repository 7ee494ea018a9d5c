"""How much of what photographs show of a place one colour could explain: a bound for files without changing colours.

    python -m experiments.reports.analyses.fixed_colours CAPTURE --images images_4

Each sparse point is looked up in the photographs that it was matched in: the mean colour of a few pixels about it, so
that neither noise nor detail counts. The one colour that says most of a photograph which was not looked at is the mean
of the others, held against each in turn: a model with fixed colours will hardly do better, at the points, on views that
it was not trained on. Printed raw, and with each photograph's exposure corrected by an affine map of each channel.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from scipy.ndimage import uniform_filter

LEAST_TRACK, MOST_ERROR_PX = 5, 1.0
#: Times that exposures are fitted to the means, and these taken again.
TURNS = 5


def observations(capture: Path, folder: str, window: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each observation the point [o], the photograph [o] and the colour there [o, 3] from 0 to 1."""
    model = pycolmap.Reconstruction(str(capture / "sparse" / "0"))
    good = {i for i, p in model.points3D.items() if p.track.length() >= LEAST_TRACK and p.error < MOST_ERROR_PX}
    points, photographs, colours = list[int](), list[int](), list[np.ndarray]()
    for number, view in enumerate(model.images.values()):
        file = next(iter((capture / folder).glob(Path(view.name).stem + ".*")), None)
        if file is None:
            continue
        picture = np.asarray(Image.open(file).convert("RGB"), np.float32) / 255
        picture = uniform_filter(picture, (window, window, 1))
        shrunk = picture.shape[1] / view.camera.width
        for seen in view.points2D:
            if seen.has_point3D() and seen.point3D_id in good:
                column, row = (int(each * shrunk) for each in seen.xy)
                if 0 <= row < picture.shape[0] and 0 <= column < picture.shape[1]:
                    points.append(seen.point3D_id)
                    photographs.append(number)
                    colours.append(picture[row, column])
    return np.unique(points, return_inverse=True)[1], np.array(photographs), np.array(colours, np.float64)


def left_out(points: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """What the other observations of the same point have in the mean [o, 3]."""
    counts = np.bincount(points)[points, None]
    sums = np.stack([np.bincount(points, colours[:, c])[points] for c in range(3)], 1)
    return (sums - colours) / (counts - 1)


def corrected(points: np.ndarray, photographs: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """The colours with each photograph's channels moved affinely to what the others show."""
    found = colours.copy()
    for _ in range(TURNS):
        others = left_out(points, found)
        for number in np.unique(photographs):
            rows = photographs == number
            for c in range(3):
                slope, offset = np.polyfit(colours[rows, c], others[rows, c], 1)
                found[rows, c] = slope * colours[rows, c] + offset
    return found


def psnr(points: np.ndarray, colours: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(left_out(points, colours) - colours).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--images", default="images")
    parser.add_argument("--window", type=int, default=5, help="side of the square whose mean is taken, pixels")
    asked = parser.parse_args()
    points, photographs, colours = observations(asked.capture, asked.images, asked.window)
    print(
        f"{asked.capture.name}: {points.max() + 1:,} points in {len(np.unique(photographs))} photographs, "
        f"{len(points):,} times; one colour each: {psnr(points, colours):.2f} dB, exposure corrected "
        f"{psnr(points, corrected(points, photographs, colours)):.2f} dB"
    )


if __name__ == "__main__":
    main()
