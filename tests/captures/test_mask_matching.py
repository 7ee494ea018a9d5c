"""Which masks belong to which photographs: by folders and names, those of a model too, which may be others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.captures import TinyScene, write_colmap, write_images
from vdgs.captures.loading import load_capture


def write_masks(root: Path, scene: TinyScene, named: str) -> None:
    for name, camera in scene.cameras.items():
        keep = np.ones((camera.height, camera.width), np.uint8)
        keep[:10] = 0
        file = root / named.format(name.removesuffix(".png"))
        file.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(file), keep)


@pytest.mark.parametrize(
    "named",
    ["masks/{}.png", "mask/{}.png", "_masks/{}_mask.png", "images/{}_mask.png", "images/{}.png.png", "masks_4/{}.png"],
)
def test_masks_of_a_capture_have_any_usual_name(tmp_path, scene, named):
    write_colmap(tmp_path, scene)
    write_masks(tmp_path, scene, named)
    capture = load_capture(tmp_path)
    assert all(view.mask_path is not None for view in capture.views)
    assert not any("no camera" in warning or "masks by" in warning for warning in capture.warnings)


@pytest.mark.parametrize("named", ["masks/{}.png", "masks/{}.png.png", "images/{}_mask.png", "images/mask_{}.png"])
@pytest.mark.parametrize("in_model", ["images/{}.png", "DCIM/{}.PNG", "{}.JPG"])
def test_masks_are_named_like_photographs_that_the_model_names_otherwise(tmp_path, scene, named, in_model):
    """So are test lists."""
    as_in_model = {name: in_model.format(name.removesuffix(".png")) for name in scene.cameras}
    cameras = {as_in_model[name]: camera for name, camera in scene.cameras.items()}
    write_colmap(tmp_path, replace(scene, cameras=cameras), images=None)
    write_images(tmp_path / "images", scene)
    write_masks(tmp_path, scene, named)
    test = list(scene.cameras)[3]
    (tmp_path / "test.txt").write_text(f"{test}\n")
    capture = load_capture(tmp_path)
    assert {view.name: view.mask_path for view in capture.views} == {
        as_in_model[name]: tmp_path / named.format(name.removesuffix(".png")) for name in scene.cameras
    }
    assert [view.name for view in capture.test_views] == [as_in_model[test]]
    assert not any("no camera" in warning or "masks by" in warning for warning in capture.warnings)


def test_masks_beside_photographs_that_are_not_used_are_named(tmp_path, scene):
    write_colmap(tmp_path, scene)
    stem = next(iter(scene.cameras)).removesuffix(".png")
    for tail in ("Mask", "masked"):  # the second is a masked copy, as BlendedMVS has them
        assert cv2.imwrite(str(tmp_path / f"images/{stem}_{tail}.png"), np.ones((48, 64), np.uint8))
    capture = load_capture(tmp_path)
    assert not any(view.mask_path for view in capture.views)
    (note,) = [warning for warning in capture.warnings if "masks by their names" in warning]
    assert note.startswith("1 images beside ")
    assert f"({stem}_Mask.png)" in note
