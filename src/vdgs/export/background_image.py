"""What a scene shows behind its Gaussians, as a picture of the whole sphere for programs that take one."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from vdgs.errors import VdgsError
from vdgs.evaluation.metrics import to_8bit
from vdgs.model.envmap import sample_envmap
from vdgs.runs.open_run import OpenedRun
from vdgs.system.atomic_files import write_atomic

#: Rows of the picture; twice as many columns.
_ROWS = 1024


def check_background(run: OpenedRun, path: Path) -> None:
    """Raise VdgsError unless the scene has an environment map and the file is named as a PNG."""
    if path.suffix.lower() != ".png":
        raise VdgsError(f"--background {path}: is written as PNG; name a file that ends in .png.")
    if run.model.envmap is None:
        raise VdgsError(
            f"--background {path}: {run.summary} has no environment map, only one color behind it. Training makes one "
            "where photographs show sky, or with --model.background-model envmap."
        )


def write_background(run: OpenedRun, path: Path) -> None:
    """Write an equirectangular picture: its middle shows +x of the ground frame (east), columns go clockwise as seen
    from above, rows from straight up to straight down."""
    envmap = run.model.envmap
    assert envmap is not None
    azimuth = math.pi - (torch.arange(2 * _ROWS, device="cpu") + 0.5) * (math.pi / _ROWS)
    elevation = math.pi / 2 - (torch.arange(_ROWS, device="cpu")[:, None] + 0.5) * (math.pi / _ROWS)
    across, up = elevation.cos(), elevation.sin().expand(_ROWS, 2 * _ROWS)
    directions = torch.stack([across * azimuth.cos(), across * azimuth.sin(), up], dim=-1)
    picture = Image.fromarray(to_8bit(sample_envmap(envmap.detach().cpu(), directions).numpy()))
    written_by = PngInfo()
    written_by.add_text("Software", "vdgs")  # by which it may be overwritten
    write_atomic(path, lambda temporary: picture.save(temporary, format="PNG", pnginfo=written_by))
