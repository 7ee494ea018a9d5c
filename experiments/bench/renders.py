"""Test views that another program rendered, as a row of a table.

    FOLDER/SCENE/SEED/VIEW.png      of seed 0 also FOLDER/SCENE/VIEW.png

They are measured as the others are: the same pixels, the same groups by visibility. What the program was given and what
it cost is not known here.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from experiments.bench.definitions import RENDER_STAGES, BenchMethod
from vdgs.captures.capture import Capture, View
from vdgs.config.typed_paths import expand_home
from vdgs.errors import VdgsError
from vdgs.evaluation.comparison_images import unique_file_stems
from vdgs.evaluation.evaluate_model import evaluate_model
from vdgs.evaluation.evaluate_run import cached_reference_views
from vdgs.evaluation.lpips import load_lpips
from vdgs.evaluation.renderable_model import RenderableModel
from vdgs.system.native_messages import without_decoder_messages
from vdgs.system.tensors import file_size_and_crc32

#: What a row may be called: it also names a folder, and stands in tables of three languages and in a figure.
NAME_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9 .+_()-]*")
#: Missing files that an error names, at most.
MAX_LISTED = 5


def method_from_renders(text: str, known_methods: Iterable[BenchMethod]) -> BenchMethod:
    """A method from NAME=FOLDER. Raises VdgsError if it is not that, if a known method has the name, or without
    the folder."""
    title, _, folder = text.partition("=")
    title, folder = title.strip(), expand_home(folder, Path)
    if not folder or not NAME_PATTERN.fullmatch(title):
        raise VdgsError(
            f"--renders {text!r}: give a name (letters a to z, digits, spaces, . + - _ and brackets) and a folder, as "
            "in OpenSplat=renders/opensplat"
        )
    if not Path(folder).is_dir():
        raise VdgsError(f"--renders {text!r}: {folder!r} is not a folder")
    name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
    if any(name == method.name or title == method.title for method in known_methods):
        raise VdgsError(f"--renders {text!r}: there is a method {title!r} already; choose another name")
    return BenchMethod(
        name, title, lambda config, _: config, RENDER_STAGES, renders=Path(folder),
        differs="rendered by another program; what it was given and what it cost is not known here",
    )  # fmt: skip


def renders_folder(method: BenchMethod, scene: str, seed: int) -> Path | None:
    """Where the renders of a scene and seed are; None where there are none."""
    if method.renders is None:
        return None
    scene_folder = method.renders / scene
    folders = [scene_folder / str(seed)] + [scene_folder] * (seed == 0)
    return next((folder for folder in folders if any(folder.glob("*.png"))), None)


def renders_digest(folder: Path) -> str:
    """What tells these renders from any others."""
    crc = 0
    for file in sorted(folder.glob("*.png")):
        crc = zlib.crc32(f"{file.name} {file_size_and_crc32(file)}".encode(), crc)
    return f"{crc:08x}"


def check_renders(folder: Path, views: Sequence[View]) -> list[Path]:
    """The render of every view, in order. Raises VdgsError, naming files, unless all are there in the size of the
    photographs."""
    files = [folder / f"{stem}.png" for stem in unique_file_stems([view.name for view in views])]
    missing = [f"{file.name} ({view.name})" for file, view in zip(files, views, strict=True) if not file.exists()]
    if missing:
        more = f" and {len(missing) - MAX_LISTED} more" if len(missing) > MAX_LISTED else ""
        raise VdgsError(
            f"{folder}: lacks {len(missing)} of {len(files)} views: {', '.join(missing[:MAX_LISTED])}{more}. Each is "
            "needed under that name, as PNG in the size of the photograph."
        )
    for file, view in zip(files, views, strict=True):
        _read(file, view)
    return files


def measure_renders(capture: Capture, folder: Path, output: Path, lpips_weights: Path | None, console: Console) -> None:
    """Measure the renders against the test photographs; writes an evaluation into `output`, without speed or size.

    Raises what `check_renders` raises.
    """
    views = capture.test_views
    files = check_renders(folder, views)
    by_camera = {id(view.camera): (file, view) for file, view in zip(files, views, strict=True)}
    lpips, note = load_lpips(lpips_weights)
    model = RenderableModel(render=lambda camera: _LoadedRender(_read(*by_camera[id(camera)])), is_timed=False)
    with cached_reference_views(views) as photographs:
        evaluate_model(photographs, model, output, lpips=lpips, lpips_note=note, console=console)


@dataclass(frozen=True)
class _LoadedRender:
    image: Float[Tensor, "h w 3"]


def _read(file: Path, view: View) -> Float[Tensor, "h w 3"]:
    """RGB in [0, 1]; transparency is not looked at."""
    with without_decoder_messages():
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if image is None:
        raise VdgsError(f"{file}: cannot be read as a picture")
    height, width = image.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        raise VdgsError(
            f"{file}: is {width} x {height} pixels, the photograph as it is used here {view.camera.width} x "
            f"{view.camera.height}. Render it in that size."
        )
    return torch.from_numpy(np.ascontiguousarray(image[..., ::-1])).float() / 255.0
