"""Pictures of the test views that another program rendered, as a row of a table.

    FOLDER/SCENE/SEED/PHOTOGRAPH.png        of seed 0 also FOLDER/SCENE/PHOTOGRAPH.png

They are measured as the others are: the same pixels, the same groups by visibility. What the program was given and what
it cost is not known here.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from vdgs.bench.definitions import PICTURES, Method
from vdgs.captures.capture import Capture, View
from vdgs.errors import VdgsError
from vdgs.evaluation.evaluate import EvaluationSettings, MeasuredModel, evaluate
from vdgs.evaluation.lpips import load_lpips
from vdgs.evaluation.of_run import cached_photographs
from vdgs.evaluation.saving import file_stems
from vdgs.tensor_files import size_and_checksum


def method_of_pictures(text: str) -> Method:
    """A method from NAME=FOLDER. Raises VdgsError if it is not that, or if the folder is not there."""
    title, equals, folder = text.partition("=")
    name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
    if not equals or not name:
        raise VdgsError(f"--renders {text!r}: give a name and a folder, as in OpenSplat=renders/opensplat")
    if not Path(folder).is_dir():
        raise VdgsError(f"--renders {text!r}: {folder!r} is not a folder")
    return Method(
        name, title.strip(), lambda config, _: config, PICTURES, pictures=Path(folder),
        differs="pictures that another program rendered; what it was given and what it cost is not known here",
    )  # fmt: skip


def folder_of_pictures(method: Method, scene: str, seed: int) -> Path | None:
    """Where the pictures of a scene and seed are; None where there are none."""
    if method.pictures is None:
        return None
    of_scene = method.pictures / scene
    if (of_scene / str(seed)).is_dir():
        return of_scene / str(seed)
    return of_scene if seed == 0 and any(of_scene.glob("*.png")) else None


def identity(folder: Path) -> str:
    """What tells these pictures from any others."""
    crc = 0
    for file in sorted(folder.glob("*.png")):
        crc = zlib.crc32(f"{file.name} {size_and_checksum(file)}".encode(), crc)
    return f"{crc:08x}"


def check_pictures(folder: Path, views: Sequence[View]) -> list[Path]:
    """The picture of every view, in order. Raises VdgsError, naming the file, unless all are there in the size of the
    photographs."""
    files = [folder / f"{stem}.png" for stem in file_stems([view.name for view in views])]
    for file, view in zip(files, views, strict=True):
        if not file.exists():
            raise VdgsError(
                f"{file}: is not there. The test view {view.name} is needed under that name, as PNG, "
                f"{view.camera.width} x {view.camera.height} pixels."
            )
        _read(file, view)
    return files


def measure_pictures(
    capture: Capture, folder: Path, output: Path, lpips_weights: Path | None, bins: int, console: Console
) -> None:
    """Measure the pictures against the test photographs; writes an evaluation into `output`, without speed or size.

    Raises what `check_pictures` raises.
    """
    views = capture.test_views
    files = check_pictures(folder, views)
    of_camera = {id(view.camera): (file, view) for file, view in zip(files, views, strict=True)}
    lpips, note = load_lpips(lpips_weights)
    model = MeasuredModel(lambda camera: _Picture(_read(*of_camera[id(camera)])), timed=False)
    with cached_photographs(views) as photographs:
        evaluate(
            photographs, model, output,
            lpips=lpips, lpips_note=note, console=console, settings=EvaluationSettings(visibility_bins=bins),
        )  # fmt: skip


@dataclass(frozen=True)
class _Picture:
    image: Float[Tensor, "h w 3"]


def _read(file: Path, view: View) -> Float[Tensor, "h w 3"]:
    """RGB in [0, 1]; transparency is not looked at."""
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if picture is None:
        raise VdgsError(f"{file}: cannot be read as a picture")
    height, width = picture.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        raise VdgsError(
            f"{file}: is {width} x {height} pixels, the photograph as it is used here {view.camera.width} x "
            f"{view.camera.height}. Render it in that size."
        )
    return torch.from_numpy(np.ascontiguousarray(picture[..., ::-1])).float() / 255.0
