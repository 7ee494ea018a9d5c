"""Sets of Blender's scripts (transforms_train.json): written here as these write them, read as one scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.captures import TinyScene, assert_sees_the_scene, moved
from support.dataset_layouts import halves, write_blender
from vdgs.captures.format_dispatch import read_source
from vdgs.captures.formats.json_poses import axis_rotation
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word

Change = Callable[[dict], None]


@pytest.fixture
def both(tmp_path: Path, scene: TinyScene) -> TinyScene:
    return write_blender(tmp_path, *halves(scene))


def change_files(root: Path, change: Change) -> None:
    """Change what each pose file says of its frames."""
    for file in root.glob("transforms_*.json"):
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            change(frame)
        file.write_text(json.dumps(content))


def write_names(path: Callable[[str], str]) -> Change:
    def change(frame: dict) -> None:
        frame["file_path"] = path(frame["file_path"].removeprefix("./"))

    return change


@pytest.mark.parametrize(
    ("name", "on_disk"),
    [
        (lambda name: f"./{name}", ".png"),
        (lambda name: f"./{name.removesuffix('.png')}", ".png"),
        (lambda name: f"./{name.removesuffix('.png')}", ".JPG"),
        (lambda name: f"./{name.removesuffix('.png')}", ".tif"),
        (lambda name: name.replace(".png", ".jpg"), ".JPG"),
        (lambda name: "C:\\Users\\me\\" + name, ".png"),
        (lambda name: f"/home/me/set/{name}", ".png"),
        (lambda name: f"file:///home/me/set/{name}", ".png"),
        (lambda name: name.replace("0", "%30"), ".png"),
        (lambda name: f"../{name}".replace("/", "\\"), ".png"),
    ],
)
def test_names_are_found_as_in_transforms_json(tmp_path, both, name, on_disk):
    """Without extension, in other case, and by paths of other machines; train and test have photographs of one name."""
    change_files(tmp_path, write_names(name))
    for image in (*tmp_path.glob("train/*.png"), *tmp_path.glob("test/*.png")):
        image.rename(image.with_suffix(on_disk))
    capture = load_capture(tmp_path)
    assert [len(capture.train_views), len(capture.test_views)] == [9, 3]
    assert_sees_the_scene(capture, both, lambda view: view.replace(on_disk, ".png"))


def test_names_without_extension_may_hold_a_dot(tmp_path, both):
    change_files(tmp_path, write_names(lambda name: name.removesuffix(".png").replace("/", "/v1.2_")))
    for image in (*tmp_path.glob("train/*.png"), *tmp_path.glob("test/*.png")):
        image.rename(image.with_name(f"v1.2_{image.name}"))
    assert_sees_the_scene(load_capture(tmp_path), both, lambda view: view.replace("v1.2_", ""))


@pytest.mark.parametrize("path", ["%2e%2e/outside/{}", "%2e%2e%2Foutside/{}", "%2e%2e", "%2F"])
def test_paths_as_in_a_uri_lead_out_of_no_set(tmp_path, scene, path):
    """What climbs is left out of them too."""
    write_blender(tmp_path / "set", *halves(scene))
    change_files(tmp_path / "set", write_names(lambda name: path.format(name)))
    (tmp_path / "outside").mkdir()
    for side in ("train", "test"):
        (tmp_path / "set" / side).rename(tmp_path / "outside" / side)
    with pytest.raises(CaptureError, match=r"12 of 12 images .* are missing"):
        load_capture(tmp_path / "set")


@pytest.mark.parametrize("inside", [True, False])
def test_photographs_may_lie_in_another_folder(tmp_path, both, inside):
    """The remedy that the error names works, and the error speaks of no archives, which such sets do not have."""
    place = tmp_path / "set" if inside else tmp_path.parent / f"{tmp_path.name}-elsewhere"
    place.mkdir()
    for side in ("train", "test"):
        (tmp_path / side).rename(place / side)
    with pytest.raises(CaptureError, match=r"12 of 12 images .* are missing(?s:.)*train/0003\.png") as error:
        load_capture(tmp_path)
    assert ".tar" not in str(error.value)
    capture = load_capture(tmp_path, CaptureOptions(images="set" if inside else str(place)))
    assert_sees_the_scene(capture, both)


def test_one_photograph_is_not_taken_for_two_of_its_name(tmp_path, both):
    """In the folder of the training photographs, 0001.png is none of the test photographs."""
    with pytest.raises(
        CaptureError, match=r"train/0000\.png and test/0000\.png would both be .*folder above .*--images"
    ):
        load_capture(tmp_path, CaptureOptions(images="train"))


def test_a_test_file_without_frames_is_none(tmp_path, both):
    file = tmp_path / "transforms_test.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"frames": []}))
    capture = load_capture(tmp_path)
    assert len(capture.views) == 9
    assert len(capture.test_views) > 0
    (tmp_path / "transforms_train.json").write_text(json.dumps({"frames": []}))
    with pytest.raises(CaptureError, match=r"transforms_train\.json: must hold a list 'frames'"):
        load_capture(tmp_path)


@pytest.mark.parametrize("gone", [1, 2, 3])
def test_photographs_of_the_test_file_that_are_gone_are_replaced_by_no_others(tmp_path, both, gone):
    """Where some are left, figures are of these, and a note says so; where none is, a person chooses what to test on,
    also where points are still to be found."""
    for image in sorted((tmp_path / "test").iterdir())[:gone]:
        image.unlink()
    if gone < 3:
        capture = load_capture(tmp_path)
        assert {view.name for view in capture.test_views} == {f"test/000{k}.png" for k in range(gone, 3)}
        said = f"transforms_test.json: {gone} of its 3 test photographs are missing"
        assert any(said in note for note in capture.warnings)
        return
    for needs_points in (True, False):
        with pytest.raises(
            CaptureError, match=r"transforms_test\.json: none of its 3 test photographs is there"
        ) as said:
            read_source(tmp_path, CaptureOptions(), needs_points=needs_points)
    assert "test/0002.png" in str(said.value)
    every = load_capture(tmp_path, CaptureOptions(split="every", test_every=3))
    assert [view.name for view in every.test_views] == [f"train/000{k}.png" for k in (0, 3, 6)]
    (tmp_path / "mine.txt").write_text("train/0004.png")
    mine = load_capture(tmp_path, CaptureOptions(test_list=tmp_path / "mine.txt"))
    assert [view.name for view in mine.test_views] == ["train/0004.png"]
    (tmp_path / "mine.txt").rename(tmp_path / "test.txt")  # as a list that the capture brings does
    assert [view.name for view in load_capture(tmp_path).test_views] == ["train/0004.png"]


def test_without_test_file_the_validation_is_the_test(tmp_path, both):
    content = (tmp_path / "transforms_test.json").read_text()
    (tmp_path / "transforms_val.json").write_text(content)
    capture = load_capture(tmp_path)
    wanted = [view.name for view in capture.test_views]
    assert not any("transforms_val" in note for note in capture.warnings)
    (tmp_path / "transforms_test.json").unlink()
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.test_views] == wanted
    assert len(capture.train_views) == 9
    assert any("no transforms_test.json" in note and "transforms_val.json are for" in note for note in capture.warnings)


def test_transparency_of_a_set_with_points_is_said(tmp_path, both):
    assert not any("transparent" in note for note in load_capture(tmp_path).warnings)
    for image in (*tmp_path.glob("train/*.png"), *tmp_path.glob("test/*.png")):
        with Image.open(image) as photograph:
            transparent = photograph.convert("RGBA")
        transparent.save(image)
    (note,) = [note for note in load_capture(tmp_path).warnings if "transparent" in note]
    assert f"vdgs sfm {shell_word(tmp_path)} --output CAPTURE makes it white" in note


def test_masks_that_frames_name_are_used(tmp_path, both):
    (tmp_path / "m").mkdir()

    def name_mask(frame: dict) -> None:
        frame["mask_path"] = f"m/{frame['file_path'].removeprefix('./').replace('/', '_')}"
        with Image.open(tmp_path / frame["file_path"]) as photograph:
            Image.new("L", photograph.size, 255).save(tmp_path / frame["mask_path"])

    change_files(tmp_path, name_mask)
    masks = {view.name: view.mask_path for view in load_capture(tmp_path).views}
    assert {name: mask and mask.name for name, mask in masks.items()} == {
        name: name.replace("/", "_") for name in masks
    }
    (tmp_path / "m/train_0003.png").unlink()
    with pytest.raises(CaptureError, match=r"train_0003\.png: no such mask, though 0003\.png is said to have it"):
        load_capture(tmp_path)


@pytest.mark.parametrize("scale", [0.01, 0.5, 30.0])
def test_scaled_cameras_are_the_same_cameras(tmp_path, both, scale):
    """At 0.01 too, which is the scale of MatrixCity's rotations; a script may have scaled some only."""

    def enlarge(frame: dict) -> None:
        if int(Path(frame["file_path"]).stem) % 2:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([scale] * 3 + [1])).tolist()

    change_files(tmp_path, enlarge)
    assert_sees_the_scene(load_capture(tmp_path), both)


@pytest.mark.parametrize("degrees", [0, 25, 90])
def test_worlds_that_are_not_blenders_have_the_up_that_cameras_see(tmp_path, scene, degrees):
    """COLMAP's worlds lie anyhow, and converters write them as sets of Blender too."""
    turn = axis_rotation(0, degrees)
    write_blender(tmp_path, *halves(moved(scene, 0.3, turn, np.zeros(3))))
    capture = load_capture(tmp_path)
    up = capture.ground.rotation[2] @ turn[:, 2]
    assert np.degrees(np.arccos(min(up, 1.0))) < 3
    said = [note for note in capture.warnings if "another up" in note]
    assert [f"{degrees + 1} degrees" in note or f"{degrees} degrees" in note for note in said] == [True] * bool(degrees)
    assert load_capture(tmp_path, CaptureOptions(up="z")).ground.rotation[2] == pytest.approx((0, 0, 1))
