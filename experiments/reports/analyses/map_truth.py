"""Maps of a generated capture against the truth: heights and colours by rays from straight above.

    vdgs synth town --size toy --truth --seed 0
    vdgs run town --output run --preset laptop
    vdgs ortho run --crs source --output maps
    python -m experiments.reports.analyses.map_truth town maps

The town is built again from the options in its capture.md; its world is that of the capture (`--crs source`).
"""

from __future__ import annotations

import json
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import rasterio

from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.synth.image_renderer import pixel_sample_offsets, radiance
from vdgs.synth.lighting import make_sky_map, tone_map
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.town import build_town

#: From how high rays start, and samples per pixel.
SKY_M, SAMPLES = 300.0, 4


def main(town_folder: Path, maps: Path) -> None:
    drawn_in = json.loads((maps / "map.json").read_text(encoding="utf-8"))["crs"]
    if drawn_in != "source":
        sys.exit(
            f"{maps}: is drawn in {drawn_in}, the truth is in the capture's own coordinates: vdgs ortho --crs source"
        )
    note = (town_folder / "capture.md").read_text(encoding="utf-8")
    seed, extent = (float(re.search(rf"^- {name}: (.*)$", note, re.M).group(1)) for name in ("seed", "extent_m"))
    with rasterio.open(maps / "dsm.tif") as file:
        heights, transform, nothing = file.read(1).astype(np.float64), file.transform, file.nodata
    with rasterio.open(maps / "orthophoto.tif") as file:
        colours = np.moveaxis(file.read()[:3], 0, -1)
    with rasterio.open(maps / "visibility.tif") as file:
        seen = file.read(1)
    height, image = true_map(int(seed), extent, transform, heights.shape)
    flying = flying_height(town_folder)
    shown = heights != nothing
    for least in (1, 3, 5, 10):
        kept = shown & (seen >= least) & np.isfinite(height)
        error = np.abs(heights - height)[kept] / flying
        squared = ((colours[kept].astype(np.float64) - image[kept]) ** 2).mean()
        print(
            f"V >= {least}: {kept.mean():.0%} of the pixels; height: median |error| {np.median(error):.4f} of the "
            f"flying height ({np.median(error) * flying:.3f} m), within 2 %: {(error <= 0.02).mean():.1%}; "
            f"orthophoto: {10 * np.log10(255**2 / squared):.2f} dB"
        )
    edges(heights, height, shown & (seen >= 5), abs(transform.a))


def true_map(seed: int, extent: float, transform, shape) -> tuple[np.ndarray, np.ndarray]:
    """Height [h, w] and colours [h, w, 3] uint8 at the pixels of a map."""
    town = build_town(seed, extent)
    tracer = RayTracer(town.mesh)
    with ThreadPoolExecutor(2) as pool:
        sky = make_sky_map(tracer, town.terrain, town.zones, extent / 2 + 40, pool)
    pitch = abs(transform.a)
    height, image = np.empty(shape), np.empty((*shape, 3), np.uint8)
    down = np.array([0, 0, -1], np.float32)
    offsets = pixel_sample_offsets(SAMPLES)
    for row in range(shape[0]):
        columns = np.arange(shape[1]) + 0.5
        places = np.stack([columns, np.full(shape[1], row + 0.5)], 1)[:, None] + np.vstack([[[0, 0]], offsets])
        x, y = transform * (places[..., 0].ravel(), places[..., 1].ravel())
        origins = np.stack([x, y, np.full(len(x), SKY_M)], 1).astype(np.float32)
        light, hits = radiance(town, tracer, sky, origins, np.broadcast_to(down, origins.shape), pitch / SKY_M)
        distance = np.where(hits.triangle >= 0, hits.distance, np.nan).reshape(shape[1], -1)
        height[row] = SKY_M - distance[:, 0]
        image[row] = (tone_map(light.reshape(shape[1], -1, 3)[:, 1:].mean(1)) * 255 + 0.5).astype(np.uint8)
    return height, image


def flying_height(town_folder: Path) -> float:
    """Median height of the training cameras above the median sparse point, metres of the capture's world."""
    capture = load_capture(town_folder, CaptureOptions())
    centres = np.array([view.camera.position for view in capture.train_views])
    return float(np.median(centres[:, 2]) - np.median(capture.points[:, 2])) / capture.ground.scale


def edges(heights: np.ndarray, truth: np.ndarray, kept: np.ndarray, pitch: float) -> None:
    """How far from true roof edges the map has its own: steps of more than 2 m between neighbours."""
    from scipy.ndimage import distance_transform_edt

    def steps(values: np.ndarray) -> np.ndarray:
        found = np.zeros(values.shape, bool)
        across, along = np.abs(np.diff(values, axis=1)) > 2, np.abs(np.diff(values, axis=0)) > 2
        found[:, 1:] |= across
        found[1:] |= along
        return found & kept

    mine, true = steps(np.where(kept, heights, np.nan)), steps(truth)
    if mine.any() and true.any():
        away, beside = (distance_transform_edt(~to)[of] for to, of in ((mine, true), (true, mine)))
        print(
            f"roof edges (V >= 5, steps over 2 m): of the true ones {(away <= 1).mean():.0%} have one of the map's "
            f"within a pixel ({pitch:g}), {(away <= 2).mean():.0%} within two; of the map's "
            f"{(beside <= 1).mean():.0%} and {(beside <= 2).mean():.0%} have a true one"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
