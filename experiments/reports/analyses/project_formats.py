"""Whether a project of another program trains as the same flight does as a COLMAP model.

    PYTHONPATH=src:tests:. python experiments/reports/analyses/project_formats.py FOLDER [--iterations 400] [--seeds 0 1 2]

Ten photographs (400x300) of a generated town, taken with a bent lens, are written as a project of each program by the
writers of the tests, with the same sparse points: those of the ground that the photographs show. Each is read, its
photographs undistorted, and the global model trained from each seed; PSNR is that of the two held-out photographs.
RealityScan's XMP and Bundler know no place, and Bundler two radial terms alone: they have COLMAP models of their own to
be held against.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from support import flights, project_writers
from support.blocks_files import blocks_xml
from support.captures import write_ply
from support.known_flight import BentLens, KnownFlight
from support.metashape_files import chunk_from_enu, metashape_xml
from support.true_flight import Lens, TrueFlight

import vdgs
from vdgs.captures.capture import Capture
from vdgs.captures.formats.brown_lens import brown_intrinsics, unproject_pixels
from vdgs.captures.image_files import decode_image
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu, median_place

NUM_POINTS = 4000
BENT = BentLens(focal=340.0, center=(203.0, 148.0), k=(-0.08, 0.02, -0.004, 0.0), p=(0.001, -0.0006), size=(400, 300))
RADIAL = BentLens(focal=340.0, center=(200.0, 150.0), k=(-0.08, 0.02, 0.0, 0.0), p=(0.0, 0.0), size=(400, 300))


def fly(folder: Path, lens: BentLens) -> KnownFlight:
    """Photographs in images/, and the cameras and points of the ground that they show."""
    flown = flights.fly(folder / "straight", flights.grid(2, 5, 9.0))
    x, y = np.meshgrid(np.arange(400) + 0.5, np.arange(300) + 0.5)
    bent = brown_intrinsics((lens.focal, lens.focal), lens.center, lens.size, lens.k, lens.p)
    rays = unproject_pixels(bent, np.stack([x.ravel(), y.ravel()], axis=1))
    grid = (rays * 340.0 + [200.0, 150.0] - 0.5).reshape(300, 400, 2).astype(np.float32)
    (folder / "images").mkdir()
    rng, points, colors = np.random.default_rng(0), [], []
    tracer = flights.town_of(60.0)[1]
    for name, camera in zip(flown.names, flown.cameras, strict=True):
        pixels = np.asarray(Image.open(flown.folder / name))
        picture = cv2.remap(pixels, grid[..., 0], grid[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        Image.fromarray(picture).save(folder / "images" / name, "JPEG", quality=95, subsampling=0)
        at = rng.uniform(0, (400, 300), (NUM_POINTS // len(flown.names), 2))
        ray = np.column_stack([(at - (200, 150)) / 340, np.ones(len(at))]) @ camera.camera_from_world[:3, :3]
        start = np.broadcast_to(camera.position.astype(np.float32), ray.shape).copy()
        hit = tracer.intersect(start, ray.astype(np.float32))
        met = np.isfinite(hit.distance)
        points.append(camera.position + ray[met] * hit.distance[met, None])
        colors.append(pixels[at[met, 1].astype(int), at[met, 0].astype(int)])
    poses = np.stack([camera.camera_from_world for camera in flown.cameras])
    return KnownFlight(flown.names, poses, np.concatenate(points), np.concatenate(colors), lens)


def as_true_flight(flight: KnownFlight) -> TrueFlight:
    lens, (width, height) = flight.lens, flight.lens.size
    theirs = Lens(
        f=lens.focal, cx=lens.center[0] - width / 2, cy=lens.center[1] - height / 2, b1=0.0, b2=0.0, k=lens.k,
        p=(lens.p[1], lens.p[0]), size=lens.size,
    )  # fmt: skip
    return TrueFlight(flight.names, flight.poses[:, :3, :3], flight.centers, flight.points, theirs)


def write_placed_colmap(folder: Path, flight: KnownFlight) -> None:
    """The model in metres about the place that readers of projects take, with georef.json."""
    latitude, longitude, altitude = median_place(geodetic_from_enu(flight.centers, flights.ORIGIN))
    origin = (latitude, longitude, float(round(altitude)))

    def moved(places: np.ndarray) -> np.ndarray:
        return enu_from_geodetic(geodetic_from_enu(places, flights.ORIGIN), origin)

    poses = flight.poses.copy()
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], moved(flight.centers))
    write_colmap(folder, replace(flight, poses=poses, points=moved(flight.points)))
    told = dict(zip(("origin_lat_deg", "origin_lon_deg", "origin_alt_m"), origin, strict=True))
    (folder / "georef.json").write_text(json.dumps(told))


def write_colmap(folder: Path, flight: KnownFlight) -> None:
    """A model in text, with sightings."""
    from scipy.spatial.transform import Rotation

    lens, sparse = flight.lens, folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    k1, k2, k3, _ = lens.k
    values = [lens.focal, lens.focal, *lens.center, k1, k2, *lens.p, k3, 0, 0, 0]
    (sparse / "cameras.txt").write_text(f"1 FULL_OPENCV 400 300 {' '.join(map(repr, values))}\n")
    lines, tracks = [], [""] * len(flight.points)
    for number, (name, pose) in enumerate(zip(flight.names, flight.poses, strict=True), 1):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        lines.append(" ".join(map(str, [number, w, x, y, z, *pose[:3, 3].tolist(), 1, name])))
        shown = np.flatnonzero(flight.shows(number - 1))
        lines.append(
            " ".join(
                f"{u} {v} {k + 1}"
                for (u, v), k in zip(flight.pixels(number - 1)[shown].tolist(), shown.tolist(), strict=True)
            )
        )
        for index, k in enumerate(shown.tolist()):
            tracks[k] += f" {number} {index}"
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    places = [
        f"{k + 1} {' '.join(map(repr, point.tolist()))} {' '.join(map(str, color.tolist()))} 0.1{tracks[k]}"
        for k, (point, color) in enumerate(zip(flight.points, flight.colors, strict=True))
    ]
    (sparse / "points3D.txt").write_text("\n".join(places) + "\n")


def write_metashape(folder: Path, flight: KnownFlight) -> None:
    (folder / "cameras.xml").write_text(metashape_xml(as_true_flight(flight)))
    write_ply(folder / "points.ply", chunk_from_enu(flight.points), flight.colors)


def write_realityscan(folder: Path, flight: KnownFlight) -> None:
    """A table in UTM, which the information beside the cloud names."""
    code, poses, points, centers = project_writers.utm_flight(flight)
    project_writers.write_realityscan_csv(folder / "cameras.csv", flight, centers, poses)
    write_ply(folder / "points.ply", points, flight.colors)
    (folder / "points.ply.rsInfo").write_text(f'<Model globalCoordinateSystemName="{code.lower()} - WGS 84 / UTM"/>')


def write_xmp(folder: Path, flight: KnownFlight) -> None:
    project_writers.write_realityscan_xmp(folder / "images", flight)
    write_ply(folder / "points.ply", flight.points, flight.colors)


def write_pix4d(folder: Path, flight: KnownFlight) -> None:
    file = project_writers.write_pix4d(folder / "flight", flight)
    offset = np.loadtxt(file.with_name("flight_offset.xyz"))
    write_ply(folder / "points.ply", project_writers.utm_flight(flight)[2] - offset, flight.colors)


def write_odm_report(folder: Path, flight: KnownFlight) -> None:
    project_writers.write_odm_report(folder, flight)
    write_ply(folder / "points.ply", project_writers.utm_flight(flight)[2], flight.colors)


def write_blocks(folder: Path, flight: KnownFlight) -> None:
    (folder / "block.xml").write_text(blocks_xml(as_true_flight(flight)))


WRITERS: dict[str, Callable[[Path, KnownFlight], object]] = {
    "COLMAP": write_placed_colmap,
    "Metashape": write_metashape,
    "BlocksExchange": write_blocks,
    "RealityScan CSV": write_realityscan,
    "OpenSfM": project_writers.write_opensfm,
    "ODM report": write_odm_report,
    "OPF": project_writers.write_opf,
    "PIX4Dmapper": write_pix4d,
    "COLMAP, no place": write_colmap,
    "RealityScan XMP": write_xmp,
    "COLMAP, no place, k1 k2": write_colmap,
    "Bundler": project_writers.write_bundler,
}


def train(capture: Capture, iterations: int, seed: int) -> float:
    """PSNR of the held-out photographs in dB, of the mean over all pixels at once."""
    settings = replace(vdgs.preset("laptop").training, iterations=iterations, seed=seed)
    scene = vdgs.train(capture, settings)
    errors = []
    for view in capture.test_views:
        pixels, _ = decode_image(view.image_path)
        drawn = np.asarray(vdgs.render(scene, view.camera).rgb)
        errors.append(np.square(drawn.clip(0, 1) * 255 - pixels).mean())
    return float(10 * np.log10(255**2 / np.mean(errors)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--only", nargs="*", default=list(WRITERS))
    given = parser.parse_args()
    made = {lens: fly(given.folder / name, lens) for name, lens in (("bent", BENT), ("radial", RADIAL))}
    for name in given.only:
        lens = RADIAL if name in ("COLMAP, no place, k1 k2", "Bundler") else BENT
        folder = given.folder / name.replace(" ", "-")
        folder.mkdir()
        shutil.copytree(given.folder / ("radial" if lens is RADIAL else "bent") / "images", folder / "images")
        WRITERS[name](folder, made[lens])
        capture = vdgs.load_capture(folder, undistort=True)
        found = [train(capture, given.iterations, seed) for seed in given.seeds]
        print(
            f"| {name} | {len(capture.points)} | {np.mean(found):.2f} | {' '.join(f'{each:.2f}' for each in found)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
