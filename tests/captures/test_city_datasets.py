"""Mega-NeRF and MatrixCity: written here as their tools write them, read as one scene."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from support.captures import (
    TinyScene,
    assert_sees_the_scene,
    moved,
    write_colmap,
    write_images,
    write_ply,
)
from support.dataset_layouts import (
    DRB,
    halves,
    matrixcity_frames,
    write_matrixcity,
    write_mega_nerf,
)
from vdgs.captures.format_dispatch import read_source
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word

# -------------------------------------------------------------------------------------------- Mega-NeRF


@pytest.mark.parametrize("points", ["ply", "colmap", "colmap of the originals"])
def test_mega_nerf(tmp_path, scene, points):
    """The split is the shipped one, down is x, and points may come from a COLMAP model in any world."""
    renamed = write_mega_nerf(tmp_path, scene)
    if points == "ply":
        write_ply(tmp_path / "points3D.ply", scene.points @ DRB.T, scene.colors)
    else:
        of = scene if "originals" in points else TinyScene(
            {Path(name).name: camera for name, camera in renamed.cameras.items()}, scene.points, scene.colors
        )  # fmt: skip
        angle = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
        write_colmap(tmp_path, moved(of, 0.07, angle, np.array([1.0, 2, 3])), images=None)
    capture = load_capture(tmp_path)
    assert capture.source == "mega-nerf"
    assert capture.ground.metric
    assert {view.name for view in capture.test_views} == {n for n in renamed.cameras if n.startswith("val/")}
    assert_sees_the_scene(capture, renamed)
    back = capture.points - np.median(capture.points, axis=0)
    np.testing.assert_allclose(back, scene.points - np.median(scene.points, axis=0), atol=1e-3)


def test_a_cloud_of_mega_nerf_may_be_in_the_world_of_its_poses(tmp_path, scene):
    """Photographs tell which, and a note says it; a cloud of another place is refused."""
    write_mega_nerf(tmp_path, scene)
    there = torch.load(tmp_path / "coordinates.pt", weights_only=True)
    origin, scale = there["origin_drb"].numpy(), float(there["pose_scale_factor"])
    down = scene.points @ DRB.T
    for points, said in ((down, ""), ((down - origin) / scale, "in the world of its poses"), (down / scale, "divided")):
        write_ply(tmp_path / "points3D.ply", points, scene.colors)
        capture = load_capture(tmp_path)
        assert any(said and said in note for note in capture.warnings) is bool(said)
        back = capture.points - np.median(capture.points, axis=0)
        np.testing.assert_allclose(back, scene.points - np.median(scene.points, axis=0), atol=1e-3)
    write_ply(tmp_path / "points3D.ply", down + np.array([0, 5e3, 0]), scene.colors)
    with pytest.raises(CaptureError, match=r"not where the cameras look .*in metres, x down(?s:.)*vdgs sfm"):
        load_capture(tmp_path)


def test_mistakes_in_mega_nerf_folders_are_named(tmp_path, scene):
    write_mega_nerf(tmp_path, scene)
    with pytest.raises(CaptureError, match=r"brings no 3D points(?s:.)*points3D\.ply"):
        load_capture(tmp_path)
    write_ply(tmp_path / "points3D.ply", scene.points @ DRB.T, scene.colors)
    file = tmp_path / "train" / "metadata" / "000001.pt"
    whole = file.read_bytes()
    for content in (whole[:100], b"", b"not torch at all", whole[:-60]):
        file.write_bytes(content)
        with pytest.raises(CaptureError, match=r"000001\.pt: cannot be read as a torch file .*Copy it again") as said:
            load_capture(tmp_path)
        assert "weights_only" not in str(said.value)  # torch advises to let code in the file run
    torch.save({"H": np.float64(48)}, file)
    with pytest.raises(CaptureError, match=r"000001\.pt: holds other things than tensors.* Save it anew") as refused:
        load_capture(tmp_path)
    assert "\x1b" not in str(refused.value)
    torch.save({"H": 48, "W": 64}, file)
    with pytest.raises(CaptureError, match="needs 'intrinsics'"):
        load_capture(tmp_path)
    file.write_bytes(whole)
    gone = sorted((tmp_path / "train" / "rgbs").glob("*.png"))[:7]
    for image in gone:
        image.unlink()
    with pytest.raises(CaptureError, match=r"[67] of 12 images .* are missing(?s:.)*000002(?s:.)*UrbanScene3D"):
        load_capture(tmp_path)


@pytest.mark.parametrize("changed", ["nothing", "pose", "both"])
def test_a_photograph_in_both_folders_of_mega_nerf_only_tests(tmp_path, scene, changed):
    """It is the same by its pose or by its bytes; of another pose and content, its number means another photograph."""
    write_mega_nerf(tmp_path, scene)
    write_ply(tmp_path / "points3D.ply", scene.points @ DRB.T, scene.colors)
    train, val = tmp_path / "train", tmp_path / "val"
    pose = torch.load(train / "metadata/000001.pt", weights_only=True)["c2w"]
    content = torch.load(val / "metadata/000000.pt", weights_only=True)
    torch.save(content | ({} if changed == "nothing" else {"c2w": pose}), train / "metadata/000000.pt")
    other = (train / "rgbs/000001.png") if changed == "both" else (val / "rgbs/000000.png")
    shutil.copy(other, train / "rgbs/000000.png")
    capture = load_capture(tmp_path)
    notes = [note for note in capture.warnings if "train/000000.png: among the photographs for training and" in note]
    assert (len(capture.train_views), len(capture.test_views)) == ((10, 3) if changed == "both" else (9, 3))
    assert len(notes) == (changed != "both")


def test_mega_nerf_without_its_test_photographs_is_refused(tmp_path, scene):
    write_mega_nerf(tmp_path, scene)
    write_ply(tmp_path / "points3D.ply", scene.points @ DRB.T, scene.colors)
    for image in (tmp_path / "val/rgbs").iterdir():
        image.unlink()
    with pytest.raises(CaptureError, match=r"val: none of its 3 test photographs is there\.(?s:.*)val/rgbs/000005"):
        load_capture(tmp_path)
    assert len(load_capture(tmp_path, CaptureOptions(split="every")).test_views) == 2
    shutil.rmtree(tmp_path / "val/metadata")
    with pytest.raises(CaptureError, match=r"no photograph is left to test on .*--split every"):
        load_capture(tmp_path)


def test_a_foreign_colmap_model_is_refused(tmp_path, scene):
    write_mega_nerf(tmp_path, scene)
    shuffled = np.random.default_rng(0).permutation(list(scene.cameras))
    others = dict(zip(shuffled.tolist(), scene.cameras.values(), strict=True))
    write_colmap(tmp_path, TinyScene(others, scene.points, scene.colors), images=None)
    with pytest.raises(CaptureError, match="disagree"):
        load_capture(tmp_path)


# -------------------------------------------------------------------------------------------- MatrixCity


def test_matrixcity_pose_folder(tmp_path, scene):
    """pose/<block>/transforms_train.json: units of 100 m, images found above, in their blocks."""
    train, test = halves(scene)
    root = tmp_path / "aerial" / "pose" / "block_A"
    both = write_matrixcity(root, train, test)
    capture = load_capture(root)
    assert capture.source == "matrixcity"
    assert capture.ground.metric
    assert (len(capture.train_views), len(capture.test_views)) == (9, 3)
    assert_sees_the_scene(capture, both)
    np.testing.assert_allclose(np.ptp(capture.points, axis=0), np.ptp(scene.points, axis=0), rtol=1e-9)
    files = [root / f"transforms_{side}.json" for side in ("train", "test")]
    contents = [json.loads(file.read_text()) for file in files]
    contents[1]["frames"].append(contents[0]["frames"][8])
    files[1].write_text(json.dumps(contents[1]))
    twice = load_capture(root)
    assert (len(twice.train_views), len(twice.test_views)) == (8, 4)
    assert any(
        "0008.png: among the photographs for training and among those for the test" in warning
        for warning in twice.warnings
    )
    for k in range(7):
        (tmp_path / "aerial" / "train" / "block_1" / f"000{k}.png").unlink()
    with pytest.raises(CaptureError, match=r"7 of 13 images .* are missing(?s:.)*0003\.png(?s:.)*Unpack the \.tar"):
        load_capture(root)


@pytest.mark.parametrize(
    ("path", "is_city"),
    [
        ("block_3/train/{name}", False), ("train/block_3/{name}", False), ("train/block_a/{number}.png", True),
        ("../../train/block_3/{number}.png", True), ("small_city/aerial/{name}", True),
        ("../../train/big_high_block_1/{number}.png", True), ("block_all/{number}.png", False),
    ],
)  # fmt: skip
def test_only_matrixcitys_own_paths_have_its_unit(tmp_path, scene, path, is_city):
    """block_3 is also what a part of any survey is called."""
    for side, part in zip(("train", "test"), halves(scene), strict=True):
        first = next(iter(part.cameras.values()))
        frames = matrixcity_frames(part, "", 1.0)
        for k, frame in enumerate(frames):
            name = f"{side}_{k}.png"
            frame["file_path"] = path.replace("train", side).format(name=name, number=f"{k + 9 * (side == 'test'):04d}")
            image = tmp_path / frame["file_path"].removeprefix("../../")
            write_images(image.parent, TinyScene({image.name: first}, scene.points, scene.colors))
            del frame["frame_index"]
        content = {"camera_angle_x": 2 * np.arctan(first.width / 2 / first.fx), "frames": frames}
        (tmp_path / f"transforms_{side}.json").write_text(json.dumps(content))
    write_ply(tmp_path / "points3D.ply", scene.points, scene.colors)
    source = read_source(tmp_path, CaptureOptions())
    assert len(source.views) == 12
    assert (source.world is not None and source.world.metric) == is_city


def test_matrixcity_blocks(tmp_path, scene):
    """train/<block>/transforms.json: metres, the rotation divided by 100, images in rgb/."""
    train, test = halves(scene)
    first = next(iter(scene.cameras.values()))
    for part, block in ((train, "train/block_1"), (test, "test/block_1_test")):
        frames = []
        for frame in matrixcity_frames(part, block, 1.0):
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] *= 0.01
            frames.append({"frame_index": frame["frame_index"], "rot_mat": pose.tolist()})
        (tmp_path / block).mkdir(parents=True)
        content = {"camera_angle_x": 2 * np.arctan(first.width / 2 / first.fx), "frames": frames}
        (tmp_path / block / "transforms.json").write_text(json.dumps(content))
        write_images(tmp_path / block / "rgb", part)
    write_ply(tmp_path / "points3D.ply", scene.points, scene.colors)
    capture = load_capture(tmp_path)
    assert capture.ground.metric
    both = {f"train/block_1/rgb/{n}": c for n, c in train.cameras.items()}
    both |= {f"test/block_1_test/rgb/{n}": c for n, c in test.cameras.items()}
    assert_sees_the_scene(capture, TinyScene(both, scene.points, scene.colors))
    np.testing.assert_allclose(np.ptp(capture.points, axis=0), np.ptp(scene.points, axis=0), rtol=1e-9)
    with pytest.raises(
        CaptureError, match=rf"is one block of MatrixCity\..* above train/: {re.escape(shell_word(tmp_path))}$"
    ):
        load_capture(tmp_path / "train/block_1")
    with pytest.raises(CaptureError, match=r"is one block of MatrixCity\..* above train/: CITY, with it as CITY/train"):
        load_capture(tmp_path / "test/block_1_test")
