"""How brightness differs between photographs, and how much of it those before and after tell, from sparse points.

    python benchmarks/exposures.py DATA/copr --images images_4

What `--exposure-spread` decides by: nothing is trained. Needs a capture with tracks, and photographs in one folder.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from machine import describe
from vdgs.captures.brightness import deviation, gains_of
from vdgs.captures.images import load_picture
from vdgs.captures.loading import load_capture
from vdgs.settings.capture import CaptureOptions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--images", default="images")
    asked = parser.parse_args()
    views = load_capture(asked.capture, CaptureOptions(images=asked.images)).views
    began = time.monotonic()
    gains = gains_of(views, lambda index: load_picture(views[index]).image.numpy())
    if gains is None:
        raise SystemExit(f"{asked.capture}: does not say which photograph shows which point")
    foretold = (gains[:-2] + gains[2:]) / 2
    print(describe())
    print(
        f"{len(gains)} photographs differ by {deviation(gains):.2%} ({words(gains)} in red, green, blue), "
        f"from the mean of their neighbours by {words(gains[1:-1] - foretold)}; {time.monotonic() - began:.1f} s"
    )


def words(gains: np.ndarray) -> str:
    return ", ".join(f"{each:.1%}" for each in np.nanstd(gains, axis=0))


if __name__ == "__main__":
    main()
