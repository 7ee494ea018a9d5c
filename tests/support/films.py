"""Films as drones write them: H.264 with subtitles, of given pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.synth.flight_cameras import pose_from_angles

#: Where the films were taken: latitude, longitude in degrees, altitude in metres.
ORIGIN = (-33.5, -70.6, 500.0)


def write_film(
    file: Path,
    pictures: Iterable[np.ndarray],
    fps: float = 10.0,
    subtitles: Sequence[str] = (),
    metadata: Mapping[str, str] | None = None,
    moments: Sequence[float] | None = None,
    rotation: int = 0,
    x264: str = "",
    pixels: str = "yuv420p",
    start_s: float = 0.0,
) -> None:
    """Pictures [h, w, 3] uint8, each with its subtitle where there are any; `moments` are seconds, not even ones;
    the film's clock shows `start_s` at its first frame."""
    import av

    options = {"movflags": "use_metadata_tags"} if file.suffix.lower() in (".mp4", ".mov") else {}
    with av.open(str(file), "w", options=options) as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        coding = "subrip" if file.suffix.lower() == ".mkv" else "mov_text"
        words = container.add_mux_stream(coding) if subtitles else None
        for number, picture in enumerate(pictures):
            if not number:
                stream.set_display_rotation(rotation)
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = pixels
                stream.options = {"crf": "12", "preset": "ultrafast", "x264-params": x264}
                stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
            moment = round(1000 * (start_s + (number / fps if moments is None else moments[number])))
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = moment, Fraction(1, 1000)
            container.mux(stream.encode(frame))
            if words is not None:
                text = subtitles[number].encode()
                packet = av.Packet(len(text).to_bytes(2, "big") + text if coding == "mov_text" else text)
                packet.stream, packet.time_base = words, Fraction(1, 1000)
                packet.pts = packet.dts = moment
                packet.duration = round(1000 / fps)
                container.mux(packet)
        container.mux(stream.encode(None))


def panorama(width: int = 1200, height: int = 200, seed: int = 1) -> np.ndarray:
    """Something with corners to move over, uint8 [h, w, 3]."""
    rng = np.random.default_rng(seed)
    layers = [rng.uniform(20, 120, (height // cell, width // cell, 3)).astype(np.float32) for cell in (10, 4)]
    grown = [cv2.resize(layer, (width, height), interpolation=cv2.INTER_CUBIC) for layer in layers]
    return sum(grown).clip(0, 255).astype(np.uint8)


def crops(picture: np.ndarray, lefts: Iterable[float], size: tuple[int, int] = (200, 160)) -> list[np.ndarray]:
    """Views of so many pixels (width, height) whose left edges are at these columns."""
    width, height = size
    return [
        cv2.warpAffine(picture, np.float32([[1, 0, -left], [0, 1, -20]]), (width, height), flags=cv2.INTER_LINEAR)
        for left in lefts
    ]


def relief_film(file: Path, *, strips: int, each: int, spacing: int, step: float) -> list[Camera]:
    """A flight in strips over plates at several heights as a film of 320 x 240 pixels with positions, of which two
    frames in three are blurred; returns the true camera of each frame (metres east, north, up of `ORIGIN`). `step` is
    how many metres the drone moves in a frame, `spacing` how many frames it flies from a strip of `each` to the next.
    """
    cameras, rng = list[Camera](), np.random.default_rng(3)
    for strip in range(strips):
        for k in range(each + (spacing if strip + 1 < strips else 0)):
            along, beside = min(k, each - 1), max(0, k - each + 1)
            x = (along if strip % 2 == 0 else each - 1 - along) - (each - 1) / 2
            y = spacing * strip + beside - spacing * (strips - 1) / 2
            place = np.array([step * x, step * y, 45 + 0.3 * np.sin(k / 5)])
            pose = pose_from_angles(place, np.radians(rng.normal(0, 1)), np.pi / 2, np.radians(rng.normal(0, 1)))
            cameras.append(Camera(camera_from_world=pose, fx=272, fy=272, cx=160, cy=120, width=320, height=240))
    plates = [(np.array([-80.0, -60, 0]), panorama(800, 600))]
    for seed in range(40):
        corner = rng.uniform([-50, -40, 2], [45, 35, 14])
        plates.append((corner, panorama(*rng.integers(30, 70, 2).tolist(), seed=seed)))
    plates.sort(key=lambda plate: plate[0][2])
    pictures = [_draw(camera, plates) for camera in cameras]
    pictures = [cv2.blur(picture, (7, 1)) if k % 3 else picture for k, picture in enumerate(pictures)]
    words = [
        f'<font size="28">SrtCnt : {k + 1}, DiffTime : 100ms\n2026-06-01 10:00:{k // 10:02d},{k % 10}00\n[iso : 100] '
        f"[focal_len: 29.40] [latitude: {latitude:.6f}] [longitude: {longitude:.6f}] [rel_alt: "
        f"{camera.position[2]:.3f} abs_alt: {altitude:.3f}] [gb_yaw: 0.0 gb_pitch: -90.0 gb_roll: 0.0] </font>"
        for k, camera in enumerate(cameras)
        for latitude, longitude, altitude in geodetic_from_enu(camera.position[None], ORIGIN)
    ]
    write_film(file, pictures, 10.0, words)
    return cameras


def _draw(camera: Camera, plates: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """What a camera sees of level plates, the highest last, of which a pixel is 20 cm wide."""
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    lens = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    pose = camera.camera_from_world
    for corner, texture in plates:
        world_from_pixel = np.array([[0.2, 0, corner[0]], [0, 0.2, corner[1]], [0, 0, corner[2]], [0, 0, 1]])
        camera_from_pixel = lens @ pose[:3] @ world_from_pixel
        size = camera.width, camera.height
        seen = cv2.warpPerspective(texture, camera_from_pixel, size, flags=cv2.INTER_LINEAR)
        there = cv2.warpPerspective(np.full(texture.shape[:2], 255, np.uint8), camera_from_pixel, size)
        picture = np.where(there[..., None] > 127, seen, picture)
    return picture
