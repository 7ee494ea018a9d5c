"""The cameras of a run, saved so that they can be drawn where the capture is not.

RUN/cameras.json is written when the coarse stage begins, and belongs to the capture that capture.json describes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture, View
from vdgs.captures.capture_metadata import capture_fingerprint
from vdgs.captures.capture_root import capture_root
from vdgs.captures.output_guard import input_folders
from vdgs.errors import RunError
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json, write_json
from vdgs.system.documents import CaptureMetadata, JsonObject


@dataclass(frozen=True, eq=False, kw_only=True)
class RunCameras:
    """The cameras of a capture by the names of their photographs, in the ground frame."""

    train: tuple[tuple[str, Camera], ...]
    test: tuple[tuple[str, Camera], ...]
    ground: GroundFrame
    #: The median of the sparse points: what a film turns about.
    scene_center: Float[np.ndarray, "3"]
    #: How high the training cameras fly (`captures.camera_height`).
    camera_height: float
    #: Where the capture lies, and the folders that hold its photographs and masks: nothing is written there.
    root: Path
    input_folders: tuple[Path, ...]

    @property
    def cameras(self) -> list[Camera]:
        """The training cameras."""
        return [camera for _, camera in self.train]


def run_cameras_of_capture(capture: Capture) -> RunCameras:
    """The cameras of a capture that is there."""
    return RunCameras(
        train=tuple((view.name, view.camera) for view in capture.train_views),
        test=tuple((view.name, view.camera) for view in capture.test_views), ground=capture.ground,
        scene_center=np.median(capture.points, axis=0), camera_height=camera_height(capture), root=capture.root,
        input_folders=tuple(input_folders(capture)),
    )  # fmt: skip


def save_run_cameras(run: RunFolder, capture: Capture) -> None:
    """Save the cameras of a capture in its run."""
    ground, root = capture.ground, capture.root.resolve()
    relative = cache(partial(_relative_to, root))
    write_json(
        run.cameras_file,
        {
            "fingerprint": capture_fingerprint(capture),
            "ground_frame": {
                "scale": ground.scale, "rotation": ground.rotation.tolist(), "translation": ground.translation.tolist(),
                "metric": ground.metric, "how": ground.description, "origin_geo": ground.origin_geo,
                "axes_geo": ground.axes_geo, "accuracy": ground.accuracy, "method": ground.method,
            },
            "middle": np.median(capture.points, axis=0).tolist(),
            "camera_height": camera_height(capture),
            "input_folders": [relative(folder) for folder in input_folders(capture)],
            "views": [_view_to_dict(view) | _files(view, relative) for view in capture.views],
        },
    )  # fmt: skip


def load_run_cameras(run: RunFolder, capture: CaptureMetadata | None) -> RunCameras | None:
    """The saved cameras, if they are of the capture that a model describes; None where there are none. RunError if the
    file is damaged."""
    if not run.cameras_file.exists():
        return None
    record = read_json(run.cameras_file)
    root = capture_root(Path(run.settings().capture_path))
    try:
        if record["fingerprint"] != (capture or {}).get("fingerprint"):
            return None
        views = [(each["split"], _view_from_dict(each)) for each in record["views"]]
        return RunCameras(
            train=tuple(view for split, view in views if split == "train"),
            test=tuple(view for split, view in views if split == "test"),
            ground=_ground_from_dict(record["ground_frame"]),
            scene_center=np.array(record["middle"], np.float64),
            camera_height=float(record["camera_height"]),
            root=root,
            input_folders=tuple(root / str(folder) for folder in record["input_folders"]),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RunError(
            f"{run.cameras_file}: is damaged ({error}). Delete it; the cameras are then read from the capture."
        ) from error


def _relative_to(root: Path, folder: Path) -> str:
    """A folder relative to the root of the capture, so that it is found where the capture was moved to; absolute where
    it lies elsewhere."""
    absolute = folder.absolute()
    for path in (absolute, absolute.resolve()):
        if path.is_relative_to(root):
            return path.relative_to(root).as_posix()
    return str(absolute)


def _ground_from_dict(frame: JsonObject) -> GroundFrame:
    rotation, translation = (np.array(frame[name], np.float64) for name in ("rotation", "translation"))
    # What older versions did not write has its default.
    origin, axes = (None if geo is None else tuple(geo) for geo in (frame["origin_geo"], frame.get("axes_geo")))
    return GroundFrame(
        scale=float(frame["scale"]), rotation=rotation, translation=translation, metric=bool(frame["metric"]),
        description=str(frame["how"]), origin_geo=origin, axes_geo=axes,
        accuracy=str(frame.get("accuracy", "")), method=str(frame.get("method", "")),
    )  # fmt: skip


def _view_to_dict(view: View) -> JsonObject:
    camera = view.camera
    return {
        "name": view.name, "split": view.split, "camera_from_world": camera.camera_from_world.tolist(),
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "width": camera.width, "height": camera.height,
    }  # fmt: skip


def _files(view: View, relative: Callable[[Path], str]) -> JsonObject:
    """Where the photograph and its mask lie, by the paths of their folders relative to the capture."""
    files = {"file": view.image_path, "mask": view.mask_path}
    return {name: f"{relative(file.parent)}/{file.name}" for name, file in files.items() if file is not None}


def _view_from_dict(record: JsonObject) -> tuple[str, Camera]:
    pose = np.array(record["camera_from_world"], np.float64).reshape(4, 4)
    fx, fy, cx, cy = (float(record[key]) for key in ("fx", "fy", "cx", "cy"))
    return str(record["name"]), Camera(
        camera_from_world=pose, fx=fx, fy=fy, cx=cx, cy=cy, width=int(record["width"]), height=int(record["height"])
    )
