"""The truth about a generated capture, written beside it and read again for measuring.

truth/
  flight.json          how unevenly the flight sees the place: mean, quantiles and Gini of V with occlusion
  cameras.npz          names and true poses of all photographs, gains of their exposure
  points.npz           true place of every sparse point, who truly sees it, whether it is an outlier
  views/NAME.npz       per test and validation photograph: depth, and V with occlusion, per pixel (uint16)
  depth/NAME.npz       depth of every training photograph, without what moves
  masks/NAME.png       per training photograph, where things move (`--num-moving-objects`, `--moving-water`): black is
                       what moves and its shadow, also without the other truth

Views from where nobody flew (`captures.off_path`) have a folder of their own, with or without the other truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from vdgs.captures.capture import View
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.system.array_files import DAMAGED_FILE_ERRORS

_FOLDER = "truth"
#: Depth is stored as its logarithm in so many steps between its bounds; 0 is sky.
_STEPS = 65534


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Truth by photograph name, read from disk when asked for. Names may come with or without their extension."""

    folder: Path

    def depth(self, name: str) -> Float[np.ndarray, "h w"]:
        """True depth along the viewing axis at pixel centers, float32 m (to 1 in 5,000 or better); inf for sky.

        Raises VdgsError if this photograph's depth was not written.
        """
        views = self._file("views", name)
        stored = _read(views if views.is_file() else self._file("depth", name), ("depth", "depth_bounds"))
        return unpack_depth(stored["depth"], stored["depth_bounds"])

    def visibility(self, name: str) -> Float[np.ndarray, "h w"]:
        """How many training photographs truly see the surface at each pixel, float32; NaN for sky.

        Raises VdgsError unless this is a test or validation photograph of a capture written with its truth.
        """
        stored = _read(self._file("views", name), ("depth", "visibility"))
        return np.where(stored["depth"] == 0, np.nan, stored["visibility"]).astype(np.float32)

    def files(self, name: str) -> list[Path]:
        """The files that hold the truth of a photograph."""
        return [file for kind in ("views", "depth") if (file := self._file(kind, name)).is_file()]

    def depth_map(self, view: View) -> Float[np.ndarray, "h w"]:
        """The true depth in metres at the size at which the view is used (nearest pixel); inf for sky."""
        return self._at_size(self.depth(view.name), view.camera)

    def has_depth(self, view: View) -> bool:
        """Whether this photograph's depth was written."""
        return bool(self.files(view.name))

    def visibility_map(self, view: View) -> Float[np.ndarray, "h w"]:
        """The true visibility at the size at which the view is used (nearest pixel)."""
        return self._at_size(self.visibility(view.name), view.camera)

    @staticmethod
    def _at_size(values: np.ndarray, camera: Camera) -> np.ndarray:
        if values.shape == (camera.height, camera.width):
            return values
        return cv2.resize(values, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST_EXACT)

    def _file(self, kind: str, name: str) -> Path:
        return self.folder / kind / f"{Path(name).stem}.npz"


def has_ground_truth(capture_root: Path) -> bool:
    """Whether a capture was generated and written with its truth."""
    return (Path(capture_root) / _FOLDER / "views").is_dir()


def load_ground_truth(capture_root: Path) -> GroundTruth:
    """The truth of a generated capture. Raises VdgsError if it was written without."""
    folder = Path(capture_root) / _FOLDER
    if not has_ground_truth(capture_root):
        raise VdgsError(f"{folder}: no truth here. Only generated captures have it: vdgs synth OUTPUT --truth.")
    return GroundTruth(folder)


def pack_depth(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth [h, w] in metres (inf: sky) as uint16 and its bounds [2]: log-spaced, so that the error is relative."""
    sky = ~np.isfinite(depth)
    if sky.all():
        return np.zeros(depth.shape, np.uint16), np.array([1.0, 1.0])
    low, high = float(depth[~sky].min()), float(depth[~sky].max())
    span = np.log(high / low) or 1.0
    steps = np.log(np.where(sky, low, depth).astype(np.float64) / low) / span * (_STEPS - 1)
    return np.where(sky, 0, np.round(steps) + 1).astype(np.uint16), np.array([low, high])


def unpack_depth(packed: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """The inverse of `pack_depth`, float32."""
    low, high = float(bounds[0]), float(bounds[1])
    span = np.log(high / low) or 1.0
    depth = low * np.exp((packed.astype(np.float64) - 1) / (_STEPS - 1) * span)
    return np.where(packed == 0, np.inf, depth).astype(np.float32)


def _read(file: Path, wanted: tuple[str, ...]) -> dict[str, np.ndarray]:
    try:
        with np.load(file, allow_pickle=False) as stored:
            return {name: stored[name] for name in wanted}
    except FileNotFoundError:
        raise VdgsError(
            f"{file}: not there. Generate the capture with --truth; visibility is known for test and validation "
            "photographs only."
        ) from None
    except DAMAGED_FILE_ERRORS as error:
        raise VdgsError(f"{file}: is damaged ({error}). Generate the capture again.") from None
