"""Heights of a map against sparse points of the capture that training never had.

    python -m experiments.reports.analyses.map_points hold CAPTURE FOLDER --every 5      # FOLDER: the capture without every fifth point
    vdgs run FOLDER --images images_4 --preset laptop --blocks 4 --output run
    python -m experiments.reports.analyses.map_points compare FOLDER run/maps

FOLDER links to the photographs and holds the points that were left out in held_out.npy: those with tracks of at least
three photographs and a reprojection error below a pixel, for others are no truth. `compare` also takes CAPTURE in place
of FOLDER: then the points are those that training began from, which says less.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pycolmap
import rasterio

from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.geometry.map_projection import MapProjection

HELD, FOLDER = "held_out.npy", Path("sparse/0")
LEAST_TRACK, MOST_ERROR_PX = 3, 1.0


def good(point: pycolmap.Point3D) -> bool:
    return point.track.length() >= LEAST_TRACK and point.error < MOST_ERROR_PX


def hold(capture: Path, folder: Path, every: int) -> None:
    """Write the capture without some of its points."""
    model = pycolmap.Reconstruction(str(capture / FOLDER))
    held = [number for number in sorted(model.points3D)[::every] if good(model.points3D[number])]
    places = np.array([model.points3D[number].xyz for number in held])
    for number in held:
        model.delete_point3D(number)
    (folder / FOLDER).mkdir(parents=True)
    model.write(str(folder / FOLDER))
    np.save(folder / HELD, places)
    for each in capture.iterdir():
        if each.name != "sparse":
            (folder / each.name).symlink_to(each.resolve())
    print(f"{folder}: without {len(held):,} of {len(held) + len(model.points3D):,} points")


def held_out(folder: Path) -> np.ndarray:
    """The points to compare with, in the world of the capture [n, 3]."""
    if (folder / HELD).exists():
        held: np.ndarray = np.load(folder / HELD)
        return held
    print(f"{folder} has no {HELD}: these are points that training began from")
    model = pycolmap.Reconstruction(str(folder / FOLDER))
    return np.array([point.xyz for point in model.points3D.values() if good(point)])


def compare(folder: Path, maps: Path) -> None:
    """Print how far the surface of the map is from the points."""
    said = json.loads((maps / "map.json").read_text(encoding="utf-8"))
    capture = load_capture(folder, CaptureOptions())
    ground = capture.ground.to_ground(held_out(folder))
    with rasterio.open(maps / "dsm.tif") as file:
        crs = said["crs"] if said["crs"] in ("local", "source", "enu") else str(file.crs)
        heights, inverse, nothing = file.read(1).astype(np.float64), ~file.transform, file.nodata
    with rasterio.open(maps / "visibility.tif") as file:
        seen = file.read(1)
    places = MapProjection.of(capture.ground, crs).project(ground)
    column, row = (np.floor(each).astype(int) for each in inverse * (places[:, 0], places[:, 1]))
    inside = (column >= 0) & (row >= 0) & (column < heights.shape[1]) & (row < heights.shape[0])
    column, row, places = column[inside], row[inside], places[inside]
    found, v = heights[row, column], seen[row, column]
    centres = np.array([view.camera.position for view in capture.train_views])
    flying = float(np.median(centres[:, 2]) - np.median(capture.points[:, 2]))
    flying *= MapProjection.of(capture.ground, crs).similarity_at(ground.mean(0)).scale
    print(f"{len(places):,} points on the map, flying height {flying:.1f} {said['unit']}")
    for least in (1, 3, 5, 10):
        kept = (found != nothing) & (v >= least)
        error = np.abs(found - places[:, 2])[kept]
        print(
            f"V >= {least}: {kept.sum():,} points; median |error| {np.median(error):.3f} {said['unit']}, "
            f"{np.median(error) / flying:.2%} of the flying height; within 2 %: {(error <= 0.02 * flying).mean():.1%}; "
            f"median of the differences {np.median((found - places[:, 2])[kept]):+.3f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    first = verbs.add_parser("hold")
    first.add_argument("capture", type=Path)
    first.add_argument("folder", type=Path)
    first.add_argument("--every", type=int, default=5)
    second = verbs.add_parser("compare")
    second.add_argument("folder", type=Path)
    second.add_argument("maps", type=Path)
    asked = parser.parse_args()
    if asked.verb == "hold":
        hold(asked.capture, asked.folder, asked.every)
    else:
        compare(asked.folder, asked.maps)


if __name__ == "__main__":
    main()
