"""The environment map as a picture for other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from support.hand_made_models import model_at
from vdgs.errors import VdgsError
from vdgs.export.background_image import check_background, write_background
from vdgs.export.formats import registry

PLAIN = model_at(np.zeros((1, 3)))


def test_the_middle_looks_east_and_the_right_half_south(tmp_path: Path) -> None:
    # Of rows above, red; columns from west over south, east and north: green.
    envmap = torch.zeros(16, 64, 3)
    envmap[:8, :, 0], envmap[:, :, 1] = 1.0, torch.tensor([0.0, 0.25, 0.5, 0.75]).repeat_interleave(16)
    run = SimpleNamespace(model=replace(PLAIN, decoder=replace(PLAIN.decoder, envmap=envmap)))
    write_background(run, tmp_path / "sky.png")  # type: ignore[arg-type]
    registry.check_ours(tmp_path / "sky.png")  # it may be written again
    picture = np.asarray(Image.open(tmp_path / "sky.png"))
    assert picture.shape == (1024, 2048, 3)
    north_east, south_east, south_west, north_west = (picture[300, k * 512 + 256, 1] for k in (1, 2, 3, 0))
    assert [south_west, south_east, north_east, north_west] == [0, 64, 128, 191]
    assert (picture[300, :, 0] == 255).all()
    assert (picture[700, :, 0] == 0).all()


def test_a_scene_without_sky_is_refused_before_any_work() -> None:
    run = SimpleNamespace(model=PLAIN, summary="coarse model")
    with pytest.raises(VdgsError, match="has no environment map"):
        check_background(run, Path("sky.png"))  # type: ignore[arg-type]
    with pytest.raises(VdgsError, match=r"ends in \.png"):
        check_background(run, Path("sky.jpg"))  # type: ignore[arg-type]
