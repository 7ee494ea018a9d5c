"""`vdgs.write_capture`: pictures and cameras of a program, as a capture that is read back with the same poses."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import vdgs
from support.captures import tiny_scene
from vdgs.captures.capture import View
from vdgs.captures.image_files import decode_image, decode_mask
from vdgs.errors import CaptureError, VdgsError

SCENE = tiny_scene()
CAMERAS = list(SCENE.cameras.values())
#: Every second picture is of half the size.
CAMERAS = [each.resized(each.width // 2, each.height // 2) if k % 2 else each for k, each in enumerate(CAMERAS)]
IMAGES = [
    np.random.default_rng(k).integers(0, 256, (each.height, each.width, 3), np.uint8) for k, each in enumerate(CAMERAS)
]


def read(folder: Path) -> vdgs.Capture:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return vdgs.load_capture(folder)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_what_is_written_is_read_with_the_same_poses_and_pixels(tmp_path, kind):
    keep = np.ones(IMAGES[1].shape[:2], bool)
    keep[:5] = False
    folder = vdgs.write_capture(
        tmp_path / "a" / "capture", (kind(each) for each in IMAGES), CAMERAS, points=kind(SCENE.points),
        point_colors=kind(SCENE.colors), masks=[kind(keep) if k == 1 else None for k in range(len(CAMERAS))],
    )  # fmt: skip
    assert folder == tmp_path / "a" / "capture"
    assert [each.name for each in folder.parent.iterdir()] == ["capture"]
    capture = read(folder)
    ground = capture.ground
    assert len(capture.views) == len(CAMERAS)
    for view, camera, image in zip(capture.views, CAMERAS, IMAGES, strict=True):
        assert np.array_equal(decode_image(view.image_path)[0], image)
        lens = (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy, view.camera.width, view.camera.height)
        assert lens == (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        assert np.allclose(ground.to_ground(camera.position[None])[0], view.camera.position, atol=1e-6)
        turned = view.camera.camera_from_world[:3, :3] @ ground.rotation
        assert np.allclose(turned, camera.camera_from_world[:3, :3], atol=1e-6)
    assert np.allclose(ground.to_ground(SCENE.points), capture.points, atol=1e-6)
    assert np.array_equal(capture.point_colors, SCENE.colors)
    assert [view.mask_path is not None for view in capture.views] == [k == 1 for k in range(len(CAMERAS))]
    assert np.array_equal(decode_mask(capture.views[1].mask_path, keep.shape[1], keep.shape[0]), keep)


def test_its_own_folder_is_replaced_and_no_other(tmp_path):
    folder = vdgs.write_capture(tmp_path / "c", IMAGES, CAMERAS, points=SCENE.points)
    before = sorted(folder.rglob("*"))
    with pytest.raises(ValueError, match=r"an image .* for each of the"):  # nothing is lost of what was there
        vdgs.write_capture(folder, IMAGES[:2], CAMERAS, points=SCENE.points)
    assert sorted(folder.rglob("*")) == before
    names = [f"north/{k}.png" for k in range(len(CAMERAS))]
    vdgs.write_capture(folder, IMAGES, CAMERAS, points=SCENE.points, names=names)
    assert {view.name for view in read(folder).views} == set(names)
    assert [each.name for each in tmp_path.iterdir()] == ["c"]
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(VdgsError, match=r"did not write \(notes\.txt\)\. Give a new or an empty folder"):
        vdgs.write_capture(folder, IMAGES, CAMERAS, points=SCENE.points)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(VdgsError, match="is a file"):
        vdgs.write_capture(tmp_path / "file", IMAGES, CAMERAS)


def test_without_points_the_next_step_is_said(tmp_path):
    vdgs.write_capture(tmp_path / "c", IMAGES, CAMERAS)
    with pytest.raises(CaptureError, match=r"vdgs sfm .*/c --output CAPTURE"):
        vdgs.load_capture(tmp_path / "c")


def test_what_does_not_fit_is_said(tmp_path):
    ortho = replace(CAMERAS[0], model="orthographic")
    for kind, words, call in (
        (TypeError, r"images\[0\] must be uint8, 0 to 255, not float64", {"images": [each / 255 for each in IMAGES]}),
        (ValueError, r"images\[0\] must be \[.*3\], as its camera", {"images": IMAGES[::-1]}),
        (ValueError, "for each of the", {"images": [*IMAGES, IMAGES[0]]}),
        (ValueError, "cameras is empty", {"images": [], "cameras": []}),
        (VdgsError, "cameras must be pinhole ones", {"cameras": [ortho, *CAMERAS[1:]]}),
        (ValueError, r"points must be \[n, 3\]", {"points": SCENE.points[:, :2]}),
        (VdgsError, "points must be finite", {"points": SCENE.points * np.nan}),
        (ValueError, "point_colors must be", {"points": SCENE.points, "point_colors": SCENE.colors[:3]}),
        (ValueError, r"masks\[0\] must be", {"masks": [np.ones((3, 3), bool)] * len(CAMERAS)}),
        (VdgsError, "is no name of a picture", {"names": ["../a.png"] * len(CAMERAS)}),
        (VdgsError, "is no name of a picture", {"names": ["a.jpg"] * len(CAMERAS)}),
        (VdgsError, "some are equal", {"names": ["a.png"] * len(CAMERAS)}),
    ):
        with pytest.raises(kind, match=words):
            vdgs.write_capture(tmp_path / "c", **{"images": IMAGES, "cameras": CAMERAS} | call)
        assert not any(tmp_path.iterdir())


def test_a_view_with_an_array_for_its_file_is_refused():
    for wrong in ({"image_path": IMAGES[0]}, {"image_path": "a.png"}, {"mask_path": IMAGES[0]}):
        with pytest.raises(TypeError, match=r"_path must be pathlib\.Path, not \w+: vdgs\.write_capture"):
            View(**{"name": "a", "camera": CAMERAS[0], "image_path": Path("a"), "mask_path": None, "split": "train"}
                 | wrong)  # fmt: skip
