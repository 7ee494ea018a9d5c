"""How far the neutral colors of a model are from those that photographs of one exposure would show.

    python -m experiments.reports.analyses.neutral_colors RUN [--every 3]

RUN was trained with --exposure-compensation. One map of colors is fitted to neutral renders of every so many training
photographs, by least squares over the pixels where the scene is opaque and no mask leaves them
out. If the colors are neutral, the map gains nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from experiments.microbench.hardware_info import describe
from vdgs.captures.capture import View
from vdgs.captures.image_cache import ImageCache
from vdgs.model.renderer import Drawable, render
from vdgs.runs.open_run import open_run

MIN_ALPHA = 0.5
#: Colors of the pixels of a render with a one beside them, and of the photograph.
Pixels = tuple[Float[np.ndarray, "p 4"], Float[np.ndarray, "p 3"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--every", type=int, default=3)
    asked = parser.parse_args()
    run = open_run(asked.run)
    model = run.model.without_local_exposure()
    trained = draw(model, run.capture.train_views[:: asked.every])
    held_out = draw(model, run.capture.test_views)
    colors, photographs = (np.concatenate(column) for column in zip(*trained, strict=True))
    best = np.linalg.lstsq(colors, photographs, rcond=None)[0]
    print(describe())
    for name, views in (("training", trained), ("held out", held_out)):
        neutral, mapped = mean_psnr(views, np.eye(4, 3)), mean_psnr(views, best)
        print(f"{name:>9}: {len(views):3} photographs, neutral {neutral:.2f} dB, mapped {mapped:.2f} dB")


def draw(model: Drawable, views: Sequence[View]) -> list[Pixels]:
    """Each view in neutral colors beside its photograph."""
    found = []
    with ImageCache(views, 0) as images:
        for index in range(len(views)):
            raster, photograph = render(model, images.camera(index)), images.get(index)
            counted = raster.alpha >= MIN_ALPHA
            counted &= True if photograph.mask is None else photograph.mask > 0
            colors = raster.image[counted].numpy()
            found.append((np.c_[colors, np.ones(len(colors))], photograph.image[counted].numpy() / 255.0))
    return found


def mean_psnr(views: Sequence[Pixels], colors: Float[np.ndarray, "4 3"]) -> float:
    """Over views whose colors are mapped; in dB."""
    errors = [((np.clip(rendered @ colors, 0, 1) - photograph) ** 2).mean() for rendered, photograph in views]
    return float(np.mean(-10 * np.log10(errors)))


if __name__ == "__main__":
    main()
