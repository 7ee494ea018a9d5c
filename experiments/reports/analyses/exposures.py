"""How brightness differs between photographs, and how much of it those before and after tell, from sparse points.

    python -m experiments.reports.analyses.exposures DATA/copr --images images_4

What `--exposure-min-spread` decides by: nothing is trained. Needs a capture with tracks, and photographs in one folder.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from experiments.microbench.hardware_info import describe
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.captures.photometric_gains import collect_point_colors
from vdgs.config.capture_options import CaptureOptions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--images", default="images")
    asked = parser.parse_args()
    views = load_capture(asked.capture, CaptureOptions(images=asked.images)).train_views
    began = time.monotonic()
    with ImageCache(views, 0) as images:
        colors = collect_point_colors(images, lambda _done, _of: None)
    if colors is None:
        raise SystemExit(f"{asked.capture}: does not say which photographs show the same points")
    gains = np.full((len(views), 3), np.nan)
    for index, gain in colors.gains().items():
        gains[index] = gain
    foretold = (gains[:-2] + gains[2:]) / 2
    print(describe())
    print(
        f"{len(gains)} training photographs: of the same places differ by {colors.gain_spread():.2%}, all by "
        f"{words(gains)} (red, green, blue), from the mean of their neighbours by {words(gains[1:-1] - foretold)}; "
        f"{time.monotonic() - began:.1f} s"
    )


def words(gains: np.ndarray) -> str:
    return ", ".join(f"{each:.1%}" for each in np.nanstd(gains, axis=0))


if __name__ == "__main__":
    main()
