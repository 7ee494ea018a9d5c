"""COLMAP models: what we read is what was written, and damage ends in a message."""

from __future__ import annotations

import contextlib
import re
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support.advice import advised_words
from support.captures import TinyScene, data_folder, tiny_scene, write_colmap, write_images, write_ply
from vdgs.captures.formats.colmap import has_points, read_colmap
from vdgs.captures.formats.source_capture import CAMERA_MODELS
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

FUZZ = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def assert_same(model, scene: TinyScene) -> None:
    assert [view.name for view in model.views] == list(scene.cameras)
    for view, camera in zip(model.views, scene.cameras.values(), strict=True):
        np.testing.assert_allclose(view.camera_from_world, camera.camera_from_world, atol=1e-12)
        assert view.intrinsics.focal == (camera.fx, camera.fy)
        assert view.intrinsics.principal_point == (camera.cx, camera.cy)
    np.testing.assert_array_equal(model.points, scene.points)
    np.testing.assert_array_equal(model.colors, scene.colors)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(("model", "extra"), [("PINHOLE", ()), ("SIMPLE_PINHOLE", ()), ("SIMPLE_RADIAL", (0.0,))])
def test_reading_is_the_inverse_of_writing(tmp_path, text, model, extra):
    scene = tiny_scene()
    folder = write_colmap(tmp_path, scene, text=text, model=model, extra=extra, images=None)
    assert_same(read_colmap(folder), scene)


def test_pycolmap_reads_the_same_from_our_files(tmp_path):
    scene = tiny_scene(points=20)
    folder = write_colmap(tmp_path, scene, images=None)
    model, theirs = read_colmap(folder), pycolmap.Reconstruction(str(folder))
    poses = {image.name: image.cam_from_world().matrix() for image in theirs.images.values()}
    for view in model.views:
        np.testing.assert_allclose(view.camera_from_world[:3], poses[view.name], atol=1e-12)


@pytest.mark.parametrize("text", [False, True])
def test_models_written_by_pycolmap_are_read(tmp_path, text):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 6
    options.num_points3D = 50
    theirs = pycolmap.synthesize_dataset(options)
    (theirs.write_text if text else theirs.write_binary)(str(tmp_path))
    model = read_colmap(tmp_path)
    poses = {image.name: image.cam_from_world().matrix() for image in theirs.images.values()}
    assert {view.name for view in model.views} == set(poses)
    for view in model.views:
        np.testing.assert_allclose(view.camera_from_world[:3], poses[view.name], atol=1e-9)
    points = np.array([point.xyz for point in theirs.points3D.values()])
    np.testing.assert_allclose(np.sort(model.points, axis=0), np.sort(points, axis=0), atol=1e-9)


def test_points_in_any_order_are_found_by_their_numbers_and_lost_ones_are_not(tmp_path):
    """As in models whose points were merged, and of which some were deleted."""
    scene = tiny_scene()
    folder = write_colmap(tmp_path, scene, text=True, images=None, tracks=True)
    file, lost = folder / "points3D.txt", {3, 17, len(scene.points)}
    head, *lines = file.read_text().splitlines()
    kept = [line for line in reversed(lines) if int(line.split()[0]) not in lost]
    file.write_text("\n".join([head, *kept]) + "\n")
    for view in read_colmap(folder).views:
        numbers = np.flatnonzero(scene.cameras[view.name].in_frustum(scene.points)) + 1
        assert view.observations is not None
        np.testing.assert_array_equal(np.sort(view.observations.point_ids), [k for k in numbers if k not in lost])
        np.testing.assert_allclose(view.observations.points, scene.points[view.observations.point_ids - 1])


def test_camera_models_agree_with_pycolmap():
    for identifier, (name, parameters) in CAMERA_MODELS.items():
        camera = pycolmap.Camera.create_from_model_name(1, name, 100.0, 200, 100)
        assert int(camera.model) == identifier
        assert len(camera.params) == parameters


def test_binary_wins_over_text_and_names_may_hold_spaces_and_folders(tmp_path):
    scene = tiny_scene(columns=2, rows=1)
    renamed = TinyScene(
        dict(zip(["a/first flight.png", "b/2.png"], scene.cameras.values(), strict=True)),
        scene.points,
        scene.colors,
    )
    for text in (True, False):
        folder = write_colmap(tmp_path / str(text), renamed, text=text)
        assert [view.name for view in read_colmap(folder).views] == ["a/first flight.png", "b/2.png"]
        capture = load_capture(tmp_path / str(text), CaptureOptions(up="z"))
        assert capture.views[0].image_path.read_bytes()


@pytest.mark.parametrize("name", ["", "..", "/", "a\nb.png"])
def test_names_of_nothing_in_the_image_folder_are_refused(tmp_path, name):
    scene = tiny_scene(columns=1, rows=1)
    bad = TinyScene({name: next(iter(scene.cameras.values()))}, scene.points, scene.colors)
    folder = write_colmap(tmp_path, bad, images=None)
    with pytest.raises(CaptureError, match="inside the image folder"):
        read_colmap(folder)


@pytest.mark.parametrize("above", ["../images/", "/home/u/p/images/", "C:\\p\\images\\", "..\\", "a/../../"])
def test_names_that_lead_out_of_the_image_folder_are_found_in_it_by_their_ends(tmp_path, above):
    """As some exporters write them; nothing outside is read."""
    scene = tiny_scene()
    cameras = {above + name: camera for name, camera in scene.cameras.items()}
    write_colmap(tmp_path, TinyScene(cameras, scene.points, scene.colors), images=None)
    write_images(tmp_path / "images", scene)
    for view in load_capture(tmp_path, CaptureOptions(up="z")).views:
        assert view.image_path == tmp_path / "images" / Path(view.name).name


@pytest.mark.parametrize("tail", ["", ".png", " 02", " 2.5 b"])
def test_images_may_lack_the_lines_of_their_points_whatever_they_are_called(tmp_path, tail):
    """Names of digits alone are numbers too, and are no pixels."""
    scene = tiny_scene()
    cameras = {f"{k:04d}{tail}": camera for k, camera in enumerate(scene.cameras.values())}
    scene = TinyScene(cameras, scene.points, scene.colors)
    folder = write_colmap(tmp_path, scene, text=True, images=None)
    assert_same(read_colmap(folder), scene)
    file = folder / "images.txt"
    poses = [line for line in file.read_text(encoding="utf-8").splitlines() if len(line.split()) > 9]
    file.write_text("\n".join(poses) + "\n", encoding="utf-8")
    assert_same(read_colmap(folder), scene)
    torn = [poses[0], " ".join(["10", "20", "-1"] * 3 + ["30"]), *poses[1:]]
    file.write_text("\n".join(torn) + "\n", encoding="utf-8")
    with pytest.raises(CaptureError, match="line 2 should read"):
        read_colmap(folder)


def test_comments_may_stand_anywhere_in_text_models(tmp_path):
    scene = tiny_scene()
    folder = write_colmap(tmp_path, scene, text=True, images=None)
    for file in folder.iterdir():
        lines = file.read_text(encoding="utf-8").split("\n")
        file.write_text("\ufeff" + "\r\n".join(["  # exported", *lines[:1], "\t#", *lines[1:]]), encoding="utf-8")
    assert_same(read_colmap(folder), scene)


def patched(file: Path, offset: int, data: bytes) -> None:
    content = bytearray(file.read_bytes())
    content[offset : offset + len(data)] = data
    file.write_bytes(bytes(content))


@pytest.mark.parametrize(
    ("file", "offset", "data", "message"),
    [
        ("cameras.bin", 0, struct.pack("<Q", 1 << 60), "announced"),
        ("images.bin", 0, struct.pack("<Q", 1 << 60), "announced"),
        ("points3D.bin", 0, struct.pack("<Q", 1 << 60), "announced"),
        ("cameras.bin", 12, struct.pack("<i", 77), "camera 1: number 77 is no camera model that is supported"),
        ("cameras.bin", 16, struct.pack("<Q", 0), "image size of 0x48"),
        ("cameras.bin", 16, struct.pack("<Q", 200_000), "image size of 200000x48"),
        ("cameras.bin", 32, struct.pack("<d", -50.0), "focal length"),
        ("cameras.bin", 32, struct.pack("<d", float("nan")), "not numbers"),
        ("cameras.bin", 48, struct.pack("<d", 1e9), "principal point"),
        ("images.bin", 12, struct.pack("<d", 3.0), "unit quaternion"),
        ("images.bin", 12, struct.pack("<d", float("nan")), "unit quaternion"),
        ("images.bin", 44, struct.pack("<d", float("inf")), "finite"),
        ("images.bin", 68, struct.pack("<I", 99), "name a camera that is not"),
        ("points3D.bin", 51, struct.pack("<Q", 1 << 61), "past the end"),
    ],
)
def test_silly_values_are_named(tmp_path, file, offset, data, message):
    folder = write_colmap(tmp_path, tiny_scene(), images=None)
    patched(folder / file, offset, data)
    one_pose = message in ("unit quaternion", "finite")
    if one_pose:  # the others of the model are used
        model = read_colmap(folder)
        assert re.search(f"left out.*{message}", model.notes[0])
        assert len(model.views) == len(tiny_scene().cameras) - 1
    with pytest.raises(CaptureError, match=message) as caught:
        read_colmap(folder, strict=one_pose)
    assert file.split(".")[0] in str(caught.value)


@pytest.mark.parametrize(
    ("text", "camera", "message"),
    [
        (False, struct.pack("<IiQQ2d", 99, 17, 4000, 2000, 4000, 2000), r"17 \(EQUIRECTANGULAR\) .* vdgs sfm IMAGES"),
        (False, struct.pack("<IiQQ4d", 99, 1, 0, 0, 50, 50, 0, 0), "camera 99 has an image size of 0x0"),
        (True, b"99 EQUIRECTANGULAR 4000 2000 4000 2000\n", "'EQUIRECTANGULAR' with 2 parameters .* vdgs sfm IMAGES"),
        (True, b"99 MINE 4000 2000 1 2 3\n", "'MINE' with 3 parameters is no camera model"),
    ],
)
def test_a_camera_that_cannot_be_used_matters_where_an_image_uses_it(tmp_path, text, camera, message):
    folder = write_colmap(tmp_path, tiny_scene(), text=text, images=None)
    file = folder / f"cameras{'.txt' if text else '.bin'}"
    whole = file.read_bytes()
    if not text:
        whole = struct.pack("<Q", struct.unpack_from("<Q", whole)[0] + 1) + whole[8:]
    file.write_bytes(whole + camera)
    assert_same(read_colmap(folder), tiny_scene())
    if text:
        images = folder / "images.txt"
        images.write_text(re.sub(r" \d+ (frame_000\.png)", r" 99 \1", images.read_text()))
    else:
        patched(folder / "images.bin", 68, struct.pack("<I", 99))
    with pytest.raises(CaptureError, match=message):
        read_colmap(folder)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("text", [False, True])
@FUZZ
@given(data=st.data())
def test_damaged_files_end_in_a_message_or_a_model(tmp_path, stem, text, data):
    """Truncation, flipped bits and inserted bytes never crash, hang or exhaust memory."""
    folder = write_colmap(tmp_path, tiny_scene(columns=2, rows=2, points=6), text=text, images=None)
    file = folder / (stem + (".txt" if text else ".bin"))
    content = bytearray(file.read_bytes())
    kind = data.draw(st.sampled_from(["truncate", "flip", "insert", "count"]))
    position = data.draw(st.integers(0, len(content) - 1))
    if kind == "truncate":
        content = content[:position]
    elif kind == "flip":
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    elif kind == "insert":
        content[position:position] = data.draw(st.binary(min_size=1, max_size=16))
    else:
        content[:8] = struct.pack("<Q", data.draw(st.integers(0, (1 << 64) - 1)))
    file.write_bytes(bytes(content))
    model = None
    with contextlib.suppress(CaptureError):
        model = read_colmap(folder)
    if model is None:
        with pytest.raises(CaptureError, match=re.escape(str(folder))):
            read_colmap(folder)
        return
    for view in model.views:
        rotation = view.camera_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.isfinite(view.camera_from_world).all()
    assert len(model.points) == len(model.colors)


def test_the_biggest_of_several_models_is_used(tmp_path):
    whole = tiny_scene()
    part = TinyScene(dict(list(whole.cameras.items())[:3]), whole.points[:50], whole.colors[:50])
    write_colmap(tmp_path, part, images=None, sparse="sparse/0")
    write_colmap(tmp_path, whole, sparse="sparse/1")
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert len(capture.views) == len(whole.cameras)
    assert any("several sparse models" in warning for warning in capture.warnings)


@pytest.mark.parametrize("text", [False, True])
def test_points_of_the_other_kind_are_read_where_there_are_no_others(tmp_path, text):
    """As where someone converted a part of the model."""
    scene, kinds = tiny_scene(), (".txt", ".bin") if text else (".bin", ".txt")
    folder = write_colmap(tmp_path, scene, text=text)
    other = write_colmap(tmp_path / "other", scene, images=None, text=not text)
    (folder / f"points3D{kinds[0]}").unlink()
    (other / f"points3D{kinds[1]}").rename(folder / f"points3D{kinds[1]}")
    assert has_points(folder)
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert len(capture.points) == len(scene.points)
    assert any(f"points3D{kinds[1]} is used; there is no points3D{kinds[0]}" in note for note in capture.warnings)
    (folder / f"points3D{kinds[1]}").write_bytes(b"1 x\n" if kinds[1] == ".txt" else bytes([9] * 20))
    write_ply(folder / "points3D.ply", scene.points[:40], scene.colors[:40])
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert len(capture.points) == 40
    assert any(f"points3D{kinds[1]}" in note and "It is not used" in note for note in capture.warnings)
    (folder / f"points3D{kinds[1]}").unlink()
    assert not has_points(folder)


def test_a_larger_model_without_a_number_is_named_with_what_uses_it(tmp_path):
    whole = tiny_scene()
    part = TinyScene(dict(list(whole.cameras.items())[:3]), whole.points[:50], whole.colors[:50])
    write_colmap(tmp_path, part, images=None, sparse="sparse/0")
    write_colmap(tmp_path, whole, sparse="sparse/geo")
    write_colmap(tmp_path, part, images=None, sparse="sparse/old")
    [note] = [note for note in load_capture(tmp_path, CaptureOptions(up="z")).warnings if "vdgs run" in note]
    assert note.startswith("sparse/geo holds 12 images, and sparse/0, which is read, 3.")
    capture, images = advised_words("vdgs run WORD --images WORD --output RUN", note)
    assert len(load_capture(Path(capture), CaptureOptions(images=images, up="z")).views) == 12


@pytest.mark.capture
@pytest.mark.parametrize("name", ["brighton", "copr", "seneca"])
def test_real_models_agree_with_pycolmap(name):
    folder = data_folder(name) / "sparse" / "0"
    model, theirs = read_colmap(folder), pycolmap.Reconstruction(str(folder))
    assert len(model.points) == len(theirs.points3D)
    poses = {image.name: image.cam_from_world().matrix() for image in theirs.images.values()}
    assert {view.name for view in model.views} == set(poses)
    for view in model.views:
        np.testing.assert_allclose(view.camera_from_world[:3], poses[view.name], atol=1e-12)


@pytest.mark.parametrize("text", [True, False])
def test_names_may_be_in_the_letters_of_windows(tmp_path, text):
    scene = tiny_scene()
    cameras = {f"Flächen/{name}": camera for name, camera in scene.cameras.items()}
    scene = TinyScene(cameras, scene.points, scene.colors)
    folder = write_colmap(tmp_path, scene, text=text, images=None)
    file = folder / f"images.{'txt' if text else 'bin'}"
    plain = file.read_bytes()
    file.write_bytes(plain.replace("ä".encode(), "ä".encode("cp1252")))
    assert file.read_bytes() != plain
    assert_same(read_colmap(folder), scene)
