"""What a run remembers of its capture, so that it is never continued or measured on another one unawares."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vdgs.captures.capture import Capture, View
from vdgs.captures.ground_truth import has_ground_truth, load_ground_truth
from vdgs.captures.off_path import OFF_PATH_FOLDER
from vdgs.errors import RunError
from vdgs.system.documents import CaptureMetadata


def capture_metadata(capture: Capture) -> CaptureMetadata:
    """What capture.json and a model say about where they come from."""
    ground = capture.ground
    return {
        "root": str(capture.root), "source": capture.source, "images": capture.images,
        "training_views": [view.name for view in capture.train_views],
        "test_views": [view.name for view in capture.test_views],
        "points": len(capture.points),
        "ground_frame": {
            "scale": ground.scale, "rotation": ground.rotation.tolist(), "translation": ground.translation.tolist(),
            "metric": ground.metric, "how": ground.description, "origin_geo": ground.origin_geo,
            "axes_geo": ground.axes_geo,
        },
        "warnings": list(capture.warnings),
        "fingerprint": capture_fingerprint(capture),
    }  # fmt: skip


def capture_fingerprint(capture: Capture) -> dict[str, int]:
    """CRC-32 of each part of a capture that results depend on. Photographs count by name and size in bytes: to read
    thousands of them whenever a run is opened takes too long. Masks, which often keep their size, count by content:
    5000 take half a second; of 1.5 MB each, which is much for a mask, 7 s. Without masks there is no part of theirs."""
    parts = {
        "choice of training and test photographs": _crc(*(f"{view.name}:{view.split}" for view in capture.views)),
        "photographs": _photographs_crc(capture.views),
        "cameras or ground frame": _crc(*(_camera_bytes(view) for view in capture.views)),
        "sparse points": _crc(capture.points.tobytes(), capture.point_colors.tobytes()),
    }
    if masks := _masks(capture):
        parts["masks"] = _crc(*(f"{name}:{_content_crc(mask)}" for name, mask in masks.items()))
    return parts


def _photographs_crc(views: Sequence[View]) -> int:
    """CRC-32 of photographs by their names and sizes in bytes."""
    return _crc(*(f"{view.name}:{view.image_path.stat().st_size}" for view in views))


def off_path_crc(capture: Capture) -> int:
    """CRC-32 of all that figures of the off-path views depend on beside the model: names, cameras, and what the files
    of photographs, masks and truth hold. They may change while a run stays as it is, since they never train. They are
    few: they are read."""
    folder, parts = capture.root / OFF_PATH_FOLDER, list[str | bytes]()
    truth = load_ground_truth(folder) if has_ground_truth(folder) else None
    for view in capture.off_path_views:
        of_truth = [] if truth is None else truth.files(view.name)
        of_mask = [] if view.mask_path is None else [view.mask_path]
        contents = [[_content_crc(file) for file in files] for files in ([view.image_path], of_mask, of_truth)]
        parts += [f"{view.name}:{contents}", _camera_bytes(view)]
    return _crc(f"truth {truth is not None}", *parts)


def check_same_capture(source: Path, before: CaptureMetadata | Mapping[str, Any] | None, capture: Capture) -> None:
    """Raise RunError, naming what changed, unless `capture` is the one that `before` (`capture_metadata`) describes."""
    known = (before or {}).get("fingerprint")
    if not isinstance(known, Mapping):
        raise RunError(
            f"{source}: does not say which capture the run belongs to. It is damaged; begin another run: "
            "vdgs run CAPTURE --output RUN"
        )
    now = capture_fingerprint(capture)
    changed = [part for part in {**now, **known} if known.get(part) != now.get(part)]
    if changed:
        raise RunError(
            f"{capture.root}: is not the capture that {source} was made from any more; changed: {', '.join(changed)}. "
            "Restore the capture as it was (or the former version of vdgs, where that read the same files otherwise), "
            "or begin another run: vdgs run CAPTURE --output RUN"
        )


def _masks(capture: Capture) -> dict[str, Path]:
    """The masks of photographs, by the names of these."""
    return {view.name: view.mask_path for view in capture.views if view.mask_path is not None}


def _content_crc(file: Path) -> int:
    """CRC-32 of what a file holds."""
    status = file.stat()
    return _read_crc(file, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=100_000)
def _read_crc(file: Path, size: int, time_ns: int) -> int:
    """Of a file as it is since a time: a command takes the fingerprint of its capture several times."""
    return zlib.crc32(file.read_bytes())


def _camera_bytes(view: View) -> bytes:
    camera = view.camera
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
    return camera.camera_from_world.tobytes() + np.array(numbers, np.float64).tobytes()


def _crc(*parts: str | bytes) -> int:
    crc = 0
    for part in parts:
        crc = zlib.crc32(part.encode() if isinstance(part, str) else part, crc)
    return crc
