"""Captures that cannot become a scene are found before any work, by `vdgs inspect` and by what trains."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from support.captures import TinyScene, look_down, moved, tiny_scene, write_colmap, write_images, write_ply
from support.commands import vdgs
from vdgs.captures import image_files
from vdgs.captures.formats.colmap_records import MAX_OBSERVATIONS
from vdgs.captures.image_checks import check_images, detect_rounding
from vdgs.captures.loading import load_capture
from vdgs.captures.validation import require_valid, validate_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.report.capture_report import inspect_capture, print_report

pytestmark = pytest.mark.slow  # whole reconstructions, runs or trainings

UTM = np.array([500_000.0, 5_000_000.0, 300.0])


@pytest.fixture(scope="module")
def scene() -> TinyScene:
    return tiny_scene()


def with_cameras(scene: TinyScene, pose_of) -> TinyScene:
    """The scene with another pose for every camera: `pose_of(index, camera)`."""
    cameras = {
        name: replace(camera, camera_from_world=pose_of(index, camera))
        for index, (name, camera) in enumerate(scene.cameras.items())
    }
    return replace(scene, cameras=cameras)


def with_points(scene: TinyScene, points: np.ndarray) -> TinyScene:
    return TinyScene(scene.cameras, points, scene.colors[: len(points)])


def below(scene: TinyScene) -> TinyScene:
    return with_cameras(scene, lambda _, camera: look_down(camera.position - [0, 0, 200]))


def at_one_place(scene: TinyScene) -> TinyScene:
    return with_cameras(scene, lambda index, _: look_down(np.array([5.0, 4, 10]), 3 * index, 30 * index))


def turned_about(scene: TinyScene) -> TinyScene:
    """OpenGL's camera axes where OpenCV's are due."""
    return with_cameras(scene, lambda _, camera: np.diag([1.0, -1, -1, 1]) @ camera.camera_from_world)


# --------------------------------------------------------------------------------- cameras and points


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(("model", "extra"), [("PINHOLE", ()), ("SIMPLE_RADIAL", (0.0,))])
def test_a_true_capture_reprojects_onto_itself(tmp_path, scene, text, model, extra):
    write_colmap(tmp_path, scene, text=text, model=model, extra=extra, tracks=True)
    found = validate_capture(load_capture(tmp_path))
    assert found.reprojection_px == pytest.approx(0, abs=1e-6)
    assert found.num_observations == sum(
        min(MAX_OBSERVATIONS, camera.in_frustum(scene.points).sum()) for camera in scene.cameras.values()
    )
    assert not found.problems
    assert not found.warnings


def test_errors_are_in_pixels_as_used_whatever_the_lens(tmp_path, scene):
    """Features moved by one pixel of a 64 px photograph are half a pixel off at half its size."""
    shown = replace(scene, cameras={name: replace(c, cx=c.cx + 1) for name, c in scene.cameras.items()})
    write_colmap(tmp_path, scene, shown=shown, tracks=True)
    assert validate_capture(load_capture(tmp_path)).reprojection_px == pytest.approx(1)
    assert validate_capture(load_capture(tmp_path, CaptureOptions(downscale=2))).reprojection_px == pytest.approx(0.5)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_mirrored_points_are_refused(tmp_path, scene, axis):
    raised = moved(scene, 1.0, np.eye(3), np.array([0, 0, 3.0]))
    mirrored = raised.points * np.where(np.arange(3) == axis, -1, 1)
    write_colmap(tmp_path, with_points(raised, mirrored), shown=raised, tracks=True)
    with pytest.raises(CaptureError, match=r"cannot become a scene(?s:.)*median reprojection error is"):
        require_valid(load_capture(tmp_path))


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (below, "No training camera sees 100% of the sparse points"),
        (turned_about, "100% of the points lie behind a camera, on average"),
        (at_one_place, "All 10 training cameras are at one place"),
        (lambda scene: with_points(scene, np.add(scene.points, [500, 0, 0])), "not of one world"),
        (lambda scene: with_points(scene, scene.points[:1].repeat(50, 0)), "1 distinct sparse point"),
        (lambda scene: replace(scene, cameras=dict(list(scene.cameras.items())[:2])), "1 training photograph"),
    ],
)
def test_what_cannot_work_is_refused_without_tracks(tmp_path, scene, broken, message):
    write_colmap(tmp_path, broken(scene), shown=scene if len(broken(scene).cameras) == 12 else None)
    with pytest.raises(CaptureError, match=message):
        require_valid(load_capture(tmp_path))


def test_one_wrong_pose_is_named(tmp_path, scene):
    wrong = with_cameras(
        scene, lambda index, camera: look_down(camera.position - [0, 0, 200 * (index == 4)], 5, 30 * (index == 4))
        if index == 4 else camera.camera_from_world,
    )  # fmt: skip
    write_colmap(tmp_path, wrong, shown=scene, tracks=True)
    found = validate_capture(load_capture(tmp_path))
    assert not found.problems
    assert any("poses of 1 of 12 photographs are wrong" in each and "frame_004" in each for each in found.warnings)


def test_doubts_are_warnings(tmp_path, scene):
    far = scene.points.copy()
    far[:260] += [60, 0, 0]
    write_colmap(tmp_path / "far", with_points(scene, far))
    assert any("(V = 0)" in each for each in validate_capture(load_capture(tmp_path / "far")).warnings)
    close = with_cameras(scene, lambda index, _: look_down(np.array([5 + 0.018 * index, 4.0, 10])))
    write_colmap(tmp_path / "close", close)
    assert any("depth will be poor" in each for each in validate_capture(load_capture(tmp_path / "close")).warnings)
    write_colmap(tmp_path / "few", with_points(scene, scene.points[:20]))
    assert any("only 20 distinct" in each for each in validate_capture(load_capture(tmp_path / "few")).warnings)


def printed(capture, output: Path) -> str:
    stream = io.StringIO()
    print_report(inspect_capture(capture, output, check_images(capture)), Console(file=stream, width=200))
    return " ".join(stream.getvalue().split())


def test_inspect_says_how_cameras_and_points_were_compared(tmp_path, scene):
    write_colmap(tmp_path / "tracks", scene, tracks=True)
    write_colmap(tmp_path / "bare", scene)
    assert "median reprojection error 0.00 px" in printed(load_capture(tmp_path / "tracks"), tmp_path / "a")
    said = printed(load_capture(tmp_path / "bare"), tmp_path / "b")
    assert "of the points lie in front of and inside a training camera (the capture has no tracks" in said
    report = json.loads((tmp_path / "b" / "report.json").read_text(encoding="utf-8"))
    assert report["reprojection_px"] is None
    assert report["seen_fraction"] > 0.9


@pytest.mark.parametrize("verb", ["inspect", "train-coarse", "run"])
def test_every_verb_that_begins_refuses_it(tmp_path, scene, verb):
    write_colmap(tmp_path / "capture", below(scene), shown=scene)
    done = vdgs(verb, tmp_path / "capture", "--output", tmp_path / "out")
    assert done.returncode == 1
    assert "cannot become a scene" in done.stderr
    assert "V = 0" in done.stderr + " ".join(done.stdout.split())
    if verb == "inspect":  # the figures show what is wrong
        assert (tmp_path / "out" / "visibility_map.png").is_file()
    else:  # nothing that the same command with other settings would stumble over
        assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------------- precision


def test_survey_coordinates_lose_nothing(tmp_path, scene):
    """UTM is seven digits before the point: the scene is that of local coordinates to a millionth of a unit."""
    local, survey = tmp_path / "local", tmp_path / "utm"
    write_colmap(local, scene, tracks=True)
    write_colmap(
        survey, moved(scene, 1.0, np.eye(3), UTM), shown=moved(scene, 1.0, np.eye(3), UTM), images=None, tracks=True
    )
    write_images(survey / "images", scene)
    near, far = load_capture(local), load_capture(survey)
    np.testing.assert_allclose(far.points, near.points, atol=1e-6)
    for one, other in zip(near.views, far.views, strict=True):
        np.testing.assert_allclose(other.camera.camera_from_world, one.camera.camera_from_world, atol=1e-6)
    assert validate_capture(far).reprojection_px == pytest.approx(0, abs=1e-5)
    assert not far.warnings
    np.testing.assert_allclose(near.points.astype(np.float32), near.points, atol=1e-5)


def test_coordinates_that_lost_their_digits_are_told(tmp_path, scene):
    survey = moved(scene, 1.0, np.eye(3), UTM)
    rounded = survey.points.astype(np.float32).astype(np.float64)
    write_colmap(tmp_path, with_points(survey, rounded), shown=scene)
    assert any("rounded to 0.5" in warning for warning in load_capture(tmp_path).warnings)


@pytest.mark.parametrize(("step", "distance"), [(0.5, 40.0), (0.1, 30.0), (10.0, 100.0), (1 / 32, 10.0)])
def test_the_step_of_rounded_coordinates_is_found(step, distance):
    points = np.random.default_rng(0).uniform(0, 1000, (400, 3)) + UTM
    assert detect_rounding(points, distance) == 0
    assert detect_rounding(np.round(points / step) * step, distance) == pytest.approx(step)
    assert detect_rounding(np.round(points / step) * step, 2000 * step) == 0  # finer than a pixel
    terraces = np.column_stack([points[:, :2], np.round(points[:, 2] / 100) * 100])
    assert detect_rounding(terraces, distance) == 0


# ----------------------------------------------------------------------------------------------- masks


@pytest.fixture
def folder(tmp_path, scene) -> Path:
    write_colmap(tmp_path, scene)
    (tmp_path / "masks").mkdir()
    return tmp_path


def write_masks(folder: Path, names, size=(48, 64), keep: int = 255, left_out: int = 0) -> None:
    """Masks that keep the lower half."""
    picture = np.full(size, keep, np.uint8)
    picture[: size[0] // 2] = left_out
    for name in names:
        assert cv2.imwrite(str(folder / "masks" / name), picture)


def test_masks_are_counted(folder, scene):
    write_masks(folder, scene.cameras)
    capture = load_capture(folder)
    assert check_images(capture).masked_fraction == pytest.approx(0.5)
    assert not capture.warnings
    assert "Masks of 12 of 12 photographs; 50.0% masked out" in printed(capture, folder / "out")


def test_each_mask_is_decoded_once_for_its_pixels(folder, scene, monkeypatch):
    write_masks(folder, scene.cameras, left_out=60)
    capture, decoded, decode = load_capture(folder), [], image_files._decode
    monkeypatch.setattr(image_files, "_decode", lambda path: decoded.append(path) or decode(path))
    check_images(capture)
    assert sorted(decoded) == sorted(view.mask_path for view in capture.views)


def test_gray_that_masks_leave_out_is_told(folder, scene):
    """Mattes and numbers of classes, of which other programs keep all but 0; not what compression leaves at edges."""
    write_masks(folder, scene.cameras)
    names = sorted(scene.cameras)
    write_masks(folder, names[3:5], left_out=60)
    [said] = check_images(load_capture(folder)).warnings
    assert f"{names[3]}: 50% of the mask is gray, from 1 to 127 of 255, and left out like black (2 of 12 masks" in said
    ring = np.random.default_rng(0).integers(128, 255, (48, 64), np.uint8)
    ring[:24], ring[23:25] = 0, 90
    for name in names[3:5]:
        cv2.imwrite(str(folder / "masks" / name), ring)
    assert check_images(load_capture(folder)).warnings == ()
    write_masks(folder, names, keep=1)
    assert check_images(load_capture(folder)).warnings == ()


def test_masks_of_some_photographs_are_a_warning(folder, scene):
    write_masks(folder, [*list(scene.cameras)[:1], "of_nothing.png"])
    capture = load_capture(folder)
    assert any("1 of 12 photographs have a mask" in warning for warning in capture.warnings)
    assert any("belong to no photograph and are not used (of_nothing.png)" in each for each in capture.warnings)
    assert check_images(capture).masked_fraction == pytest.approx(0.5 / 12)


def test_a_folder_without_masks_is_told_and_refused_where_it_was_asked_for(folder):
    assert any("holds no masks" in warning for warning in load_capture(folder).warnings)
    (folder / "mine").mkdir()
    with pytest.raises(CaptureError, match="mine: holds no masks, though --masks asks"):
        load_capture(folder, CaptureOptions(masks="mine"))
    with pytest.raises(CaptureError, match="other: no such folder"):
        load_capture(folder, CaptureOptions(masks="other"))


def test_masks_of_other_names_or_shapes_are_refused(folder, scene):
    write_masks(folder, [f"m_{name}" for name in scene.cameras])
    with pytest.raises(CaptureError, match="holds 12 masks, none of them of a photograph"):
        load_capture(folder)
    write_masks(folder, scene.cameras, size=(50, 50))
    with pytest.raises(CaptureError, match=r"frame_000\.png: is 50x50, but its photograph is 64x48"):
        load_capture(folder)
    write_masks(folder, scene.cameras, size=(24, 32))  # the same shape at half the size
    check_images(load_capture(folder))


def test_masks_that_leave_nothing_are_refused_and_masks_of_ones_keep_all(folder, scene):
    write_masks(folder, scene.cameras, keep=0)
    with pytest.raises(CaptureError, match=r"0 of 255\. Turn it round"):
        check_images(load_capture(folder))
    write_masks(folder, scene.cameras, keep=1)
    check_images(load_capture(folder))


def test_masks_that_leave_little_may_be_inverted(folder, scene):
    for name in scene.cameras:
        picture = np.zeros((48, 64), np.uint8)
        picture[:8] = 255
        assert cv2.imwrite(str(folder / "masks" / name), picture)
    assert any("are they inverted?" in each for each in check_images(load_capture(folder)).warnings)


# ----------------------------------------------------------------------------------------- photographs


def test_photographs_that_show_nothing(folder, scene):
    names = list(scene.cameras)
    cv2.imwrite(str(folder / "images" / names[2]), np.zeros((48, 64, 3), np.uint8))
    assert any("one color only" in each and names[2] in each for each in check_images(load_capture(folder)).warnings)
    for name in names:
        cv2.imwrite(str(folder / "images" / name), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(CaptureError, match="every photograph is of one color only"):
        check_images(load_capture(folder))
    for name in names:
        cv2.imwrite(str(folder / "images" / name), np.zeros((48, 64, 4), np.uint8))
    with pytest.raises(CaptureError, match="is transparent everywhere"):
        check_images(load_capture(folder))


def test_copies_of_a_photograph_under_other_names_are_told(folder, scene):
    names, images = list(scene.cameras), folder / "images"
    assert not check_images(load_capture(folder)).warnings
    for one, copy in ((0, 3), (0, 7), (1, 4)):
        shutil.copyfile(images / names[one], images / names[copy])
    told = check_images(load_capture(folder)).warnings
    assert len(told) == 1
    assert told[0].startswith("5 photographs are the same file as another one")
    assert f"({names[0]} = {names[3]} = {names[7]}, {names[1]} = {names[4]})" in told[0]


def test_sizes_that_do_not_fit_the_rest(folder, scene):
    names = list(scene.cameras)
    cv2.imwrite(str(folder / "images" / names[3]), np.zeros((12, 16, 3), np.uint8))
    assert any("not shrunk as the rest" in each and names[3] in each for each in load_capture(folder).warnings)
    for name in names[::2]:
        cv2.imwrite(str(folder / "images" / name), np.zeros((24, 32, 3), np.uint8))
    cv2.imwrite(str(folder / "images" / names[3]), np.zeros((48, 64, 3), np.uint8))
    [said] = [each for each in load_capture(folder).warnings if "not shrunk as the rest" in each]
    assert said.startswith("6 of 12 photographs")
    assert "to 0.5 of the size of their cameras instead of 1 " in said
    cv2.imwrite(str(folder / "images" / names[3]), np.zeros((1, 1, 3), np.uint8))
    with pytest.raises(CaptureError, match=rf"{names[3]}: is 1x1 pixels, too small"):
        load_capture(folder)


def test_shrinking_to_nothing_is_refused(folder):
    with pytest.raises(CaptureError, match=r"would be 3x2 \(.*images/.*\), too few pixels to show anything"):
        load_capture(folder, CaptureOptions(downscale=20))


@pytest.mark.parametrize("gone", ["cameras.bin", "images.bin"])
def test_part_of_a_model_is_named(folder, gone):
    (folder / "sparse" / "0" / gone).unlink()
    with pytest.raises(CaptureError, match=f"but no {gone} that can be read: copy the whole model"):
        load_capture(folder)


def test_a_line_of_features_that_is_cut_off_is_named(tmp_path, scene):
    write_colmap(tmp_path, scene, text=True, tracks=True)
    file = tmp_path / "sparse" / "0" / "images.txt"
    file.write_text(file.read_text(encoding="utf-8").rstrip().rpartition(" ")[0], encoding="utf-8")
    with pytest.raises(CaptureError, match=r"images\.txt: line 25 should read 'POINTS2D"):
        load_capture(tmp_path)


def test_points_beside_transforms_are_judged_by_what_cameras_see(tmp_path, scene):
    write_images(tmp_path / "images", scene)
    flip = np.diag([1.0, -1, -1, 1])
    frames = [
        {"file_path": f"images/{name}", "fl_x": c.fx, "w": c.width, "h": c.height,
         "transform_matrix": np.linalg.inv(c.camera_from_world).tolist()}
        for name, c in scene.cameras.items()
    ]  # fmt: skip
    write_ply(tmp_path / "points3D.ply", scene.points, scene.colors)
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}), encoding="utf-8")
    with pytest.raises(CaptureError, match="OpenGL's axes"):
        require_valid(load_capture(tmp_path))
    for frame in frames:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ flip).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}), encoding="utf-8")
    assert require_valid(load_capture(tmp_path)).seen_fraction > 0.9
