"""Photographs as a drone would bring them: ray cast, with EXIF and XMP, over a generated town."""

from __future__ import annotations

import io
import shutil
import struct
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from support.commands import small_figures
from vdgs.config.sfm_options import SfmRequest
from vdgs.geometry.camera import Camera
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.sfm.image_metadata import ImageMetadata, read_image_metadata
from vdgs.synth.flight_cameras import pose_from_angles
from vdgs.synth.image_renderer import render_image
from vdgs.synth.lighting import SkyMap, make_sky_map
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.town import Town, build_town

if TYPE_CHECKING:
    from vdgs.sfm.sfm_estimate import SfmEstimate

#: Where the town lies: latitude, longitude in degrees, altitude in metres. South and west, where signs go wrong.
ORIGIN = (-33.5, -70.6, 500.0)
WIDTH, HEIGHT, FOCAL = 320, 240, 272.0
FOCAL_MM, SENSOR_MM = 8.5, 10.0
ALTITUDE_M = 45.0


@dataclass(frozen=True, eq=False)
class Flight:
    """Photographs in a folder, and the true cameras that took them (metres east, north, up of `ORIGIN`)."""

    folder: Path
    cameras: list[Camera]

    @property
    def names(self) -> list[str]:
        return [f"DJI_{k + 1:04d}.JPG" for k in range(len(self.cameras))]


def grid(strips: int, each: int, step: float) -> list[Camera]:
    """Cameras that look about straight down from a level grid, strip by strip, each flown the other way round."""
    rng = np.random.default_rng(5)
    cameras = []
    for strip in range(strips):
        for k in range(each):
            along = (k if strip % 2 == 0 else each - 1 - k) - (each - 1) / 2
            place = np.array([step * along, step * (strip - (strips - 1) / 2), ALTITUDE_M + rng.normal(0, 0.5)])
            heading = np.pi / 2 if strip % 2 == 0 else -np.pi / 2
            pose = pose_from_angles(place, np.radians(rng.normal(0, 2)), heading, np.radians(rng.normal(0, 1)))
            cameras.append(
                Camera(
                    camera_from_world=pose, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2, width=WIDTH, height=HEIGHT
                )
            )
    return cameras


@cache
def town_of(extent: float) -> tuple[Town, RayTracer]:
    """The town under flights, so many metres wide."""
    town = build_town(3, extent)
    return town, RayTracer(town.mesh)


@cache
def sky_over(extent: float) -> SkyMap:
    town, tracer = town_of(extent)
    with ThreadPoolExecutor(1) as pool:
        return make_sky_map(tracer, town.terrain, town.zones, extent / 2 + 20, pool)


def fly(folder: Path, cameras: Sequence[Camera], extent: float = 60.0) -> Flight:
    """Take the photographs and write them with what a drone writes."""
    folder.mkdir(parents=True)
    (town, tracer), sky = town_of(extent), sky_over(extent)
    flight = Flight(folder, list(cameras))
    for k, (name, camera) in enumerate(zip(flight.names, cameras, strict=True)):
        pixels = render_image(town, tracer, sky, camera, 1, np.ones(3))
        write_photograph(folder / name, pixels, k, camera.position)
    return flight


def folders_of_steps(flight: Flight, folder: Path) -> dict[str, Path]:
    """Folders as those of a capture of a flight are when each step of its reconstruction begins, but for the first, and
    when it is done (`made`: with its features, matches and models)."""
    from vdgs.sfm import feature_extraction, mapping
    from vdgs.sfm import reconstruct as reconstructing

    output = folder / "capture"
    with small_figures(), pytest.MonkeyPatch.context() as patch:
        for step, module, name in (
            ("matching", reconstructing, "_matches"),
            ("mapping", mapping, "make_models"),
            ("writing", reconstructing, "_write"),
        ):
            patch.setattr(module, name, _after_copying(getattr(module, name), output, folder / step))
        patch.setattr(reconstructing, "estimate_sfm", unestimated)
        patch.setattr(feature_extraction, "is_upsampled", not_upsampled)
        request = SfmRequest(image_folders=(flight.folder,), output=output, threads=1, keep_intermediate=True)
        reconstructing.reconstruct(request, Console(file=io.StringIO()))
    shutil.copytree(output, folder / "done", symlinks=True, ignore=shutil.ignore_patterns(".lock", "work"))
    return {step: folder / step for step in ("matching", "mapping", "writing", "done")} | {"made": output}


def add_what_is_left_out(flight: Flight) -> None:
    """To a card of nine: a photograph that shows nothing, one that is cut off, and a text."""
    gray = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    write_photograph(flight.folder / "gray.jpg", gray, 50, np.array([0.0, 3.0, ALTITUDE_M]))
    (flight.folder / "cut.jpg").write_bytes((flight.folder / flight.names[0]).read_bytes()[:9000])
    (flight.folder / "notes.txt").write_text("windy")


def unestimated(_plan: object) -> SfmEstimate:
    """Instead of an estimate, for which three photographs are searched and matched."""
    from vdgs.sfm.sfm_estimate import SfmEstimate

    return SfmEstimate(steps={}, slowdown=1.0, points=0, probed=())


def not_upsampled(*_: int) -> bool:
    """Instead of `is_upsampled`, which is true of small photographs and of few: 300 features of each for 1100, which
    take four times as long to find and match."""
    return False


def _after_copying(function: Callable, of: Path, to: Path) -> Callable:
    def copied(*arguments):
        copy_folder(of, to)
        return function(*arguments)

    return copied


def copy_folder(of: Path, to: Path) -> None:
    shutil.copytree(of, to, symlinks=True, ignore=shutil.ignore_patterns(".lock"))


def sightings(cameras: Sequence[Camera], points: np.ndarray, extent: float = 60.0) -> list[dict[int, np.ndarray]]:
    """For each place over the town (x, y) the pixels [2] at which cameras, by their numbers, see its ground; and, under
    -1, the place on the ground itself [3]."""
    tracer = town_of(extent)[1]
    found = []
    for x, y in points:
        above = np.array([[x, y, 300.0]], np.float32)
        ground = above[0] - [0, 0, tracer.intersect(above, np.array([[0, 0, -1]], np.float32)).distance[0]]
        seen = {-1: np.asarray(ground, np.float64)}
        for k, camera in enumerate(cameras):
            away = ground - camera.position
            hit = tracer.intersect(camera.position[None].astype(np.float32), away[None].astype(np.float32))
            if camera.in_frustum(ground[None])[0] and abs(hit.distance[0] - 1) < 1e-3:
                seen[k] = camera.project(ground[None])[0][0]
        found.append(seen)
    return found


def write_photograph(
    file: Path,
    pixels: np.ndarray,
    number: int,
    enu: np.ndarray | None,
    orientation: int = 1,
    xmp: str | None = None,
    model: str = "Drone",
    error_m: float | None = None,
    focal_mm: float = FOCAL_MM,
) -> None:
    """A JPEG with EXIF, its place (wrong by `error_m`) where `enu` is given, and XMP."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Maker", model, orientation
    details = exif.get_ifd(0x8769)
    details[0x9003] = f"2026:06:01 10:{number // 60:02d}:{number % 60:02d}"
    details[0x920A] = focal_mm
    shown = 4 * max(pixels.shape[:2])  # as where photographs were made smaller
    details[0xA002], details[0xA003] = shown, shown * 3 // 4
    details[0xA20E], details[0xA210] = shown / SENSOR_MM, 4
    if enu is not None:
        latitude, longitude, altitude = geodetic_from_enu(np.asarray(enu)[None], ORIGIN)[0]
        gps = exif.get_ifd(0x8825)
        gps[1], gps[2] = ("S" if latitude < 0 else "N"), sexagesimal(latitude)
        gps[3], gps[4] = ("W" if longitude < 0 else "E"), sexagesimal(longitude)
        gps[5], gps[6] = (b"\x01" if altitude < 0 else b"\x00"), abs(altitude)
        if error_m is not None:
            gps[0x1F] = error_m
        xmp = xmp or (
            f'drone-dji:RelativeAltitude="+{enu[2]:.2f}" drone-dji:GimbalPitchDegree="-90.0" '
            'drone-dji:GimbalYawDegree="90.0" drone-dji:GimbalRollDegree="0.0"'
        )
    Image.fromarray(pixels).save(file, "JPEG", quality=95, subsampling=0, exif=exif)
    if xmp is not None:
        add_xmp(file, f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description {xmp}/></x:xmpmeta>'.encode())


def add_xmp(file: Path, packet: bytes) -> None:
    """Put an XMP segment right behind the first marker of a JPEG."""
    content, body = file.read_bytes(), b"http://ns.adobe.com/xap/1.0/\x00" + packet
    file.write_bytes(content[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + content[2:])


def sexagesimal(degrees: float) -> tuple[float, float, float]:
    whole = abs(degrees)
    minutes = (whole - int(whole)) * 60
    return float(int(whole)), float(int(minutes)), round((minutes - int(minutes)) * 60, 6)


def small_photographs(folder: Path, names: Sequence[str]) -> list[ImageMetadata]:
    """Photographs of noise without a position, which say that they were taken 40, 41, ... m over the take-off."""
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    for k, name in enumerate(names):
        pixels = np.roll(noise, k, axis=0)
        write_photograph(folder / name, pixels, k, None, xmp=f'drone-dji:RelativeAltitude="+{40 + k}.0"')
    return [read_image_metadata(folder / name, name) for name in names]
