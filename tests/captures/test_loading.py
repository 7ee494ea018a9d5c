"""From folder to capture: sizes, and every mistake that people make with folders."""

from __future__ import annotations

import re
import subprocess
import sys
import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from support.captures import UP, TinyScene, data_folder, render_plane, tiny_scene, up, write_colmap, write_images
from vdgs.captures import undistortion
from vdgs.captures.formats.lens_projection import fold_radius
from vdgs.captures.formats.source_capture import Intrinsics, SourceView
from vdgs.captures.image_cache import load_image
from vdgs.captures.image_checks import check_images
from vdgs.captures.image_files import decode_image, decode_mask
from vdgs.captures.image_matching import fit_to_image, scale_intrinsics
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import input_folders
from vdgs.captures.pinholes import undistorted_pinhole
from vdgs.captures.undistortion import ImageFile, sampling_map
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.pipeline.image_size import image_sizes
from vdgs.runs.run_settings import with_absolute_paths


def test_options_import_nothing_heavy():
    code = "import sys, vdgs.config.capture_options; print(*{'torch', 'numpy', 'cv2', 'pycolmap'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_a_capture_is_complete(folder, scene):
    capture = load_capture(folder, UP)
    assert (capture.source, capture.images, len(capture.views)) == ("colmap", "images", 12)
    assert [view.split for view in capture.views] == ["test", *["train"] * 7, "test", *["train"] * 3]
    assert [view.name for view in capture.views] == sorted(scene.cameras)
    assert capture.points.dtype == np.float64
    assert capture.warnings == ()
    assert check_images(capture).files == 12


def test_pixels_cameras_and_points_agree(folder, scene):
    """The color of the picture where a point falls is the color of the point."""
    capture = load_capture(folder, UP)
    differences = []
    for view in capture.views:
        image = load_image(view).image.numpy()
        pixels, _ = view.camera.project(capture.points)
        inside = view.camera.in_frustum(capture.points)
        x, y = pixels[inside].astype(int).T
        differences.append(np.abs(image[y, x].astype(int) - capture.point_colors[inside]).mean())
    assert np.mean(differences) < 12


# ------------------------------------------------------------------------------------------- image sizes


def shrink_folder(folder, scene, factor, name):
    (folder / name).mkdir()
    for image in scene.cameras:
        pixels = cv2.imread(str(folder / "images" / image))
        size = (pixels.shape[1] // factor, pixels.shape[0] // factor)
        cv2.imwrite(str(folder / name / image), cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))


def test_cameras_follow_the_actual_image_size(folder, scene):
    shrink_folder(folder, scene, 4, "images_4")
    whole = load_capture(folder, UP)
    quarter = load_capture(folder, up(images="images_4"))
    half = load_capture(folder, up(downscale=2))
    for a, b, c in zip(whole.views, quarter.views, half.views, strict=True):
        assert (b.camera.width, b.camera.height) == (16, 12)
        assert b.camera.fx == pytest.approx(a.camera.fx / 4)
        assert c.camera.cx == pytest.approx(a.camera.cx / 2)
        assert load_image(c).image.shape == (24, 32, 3)


@given(st.integers(100, 5000), st.integers(100, 5000), st.integers(1, 8), st.booleans())
def test_sizes_that_any_resizer_makes_are_accepted(tmp_path_factory, width, height, factor, up_rounded):
    """Floor, ceil and round of an even division all fit; the camera covers the same field of view."""
    rounding = -1 if up_rounded else 1
    w, h = (rounding * (rounding * side // factor) for side in (width, height))
    view = SourceView(
        name="a.png",
        camera_from_world=np.eye(4),
        intrinsics=Intrinsics("PINHOLE", (width, width, width / 2, height / 2), width, height),
    )
    path = tmp_path_factory.mktemp("sizes") / "a.bmp"
    header = b"BM" + bytes(12) + (40).to_bytes(4, "little") + w.to_bytes(4, "little") + h.to_bytes(4, "little")
    path.write_bytes(header + (1).to_bytes(2, "little") + (24).to_bytes(2, "little") + bytes(24))
    fitted = fit_to_image(view, path)
    assert (fitted.width, fitted.height) == (w, h)
    assert fitted.focal[0] / w == pytest.approx(1)


def test_an_image_of_another_shape_is_named_with_both_sizes(folder, scene):
    name = list(scene.cameras)[3]
    cv2.imwrite(str(folder / "images" / name), np.zeros((64, 48, 3), np.uint8))
    with pytest.raises(CaptureError, match=rf"{name}: is 48x64, but its camera is 64x48.*quarter"):
        load_capture(folder, UP)


def test_a_model_of_photographs_that_exif_turns_asks_for_upright_ones(folder, scene):
    """COLMAP and others apply EXIF's orientation or do not, by version; the file's own pixels are what vdgs reads."""
    name, exif = next(iter(scene.cameras)), Image.Exif()
    exif[0x0112] = 6
    with Image.open(folder / "images" / name) as image:
        image.transpose(Image.Transpose.ROTATE_90).save(folder / "images" / name, exif=exif)
    with pytest.raises(CaptureError, match=rf"{name}: is 48x64, but its camera is 64x48, upright: EXIF.*auto-orient"):
        load_capture(folder, UP)


def test_up_to_ten_images_that_do_not_fit_are_listed(folder, scene):
    for name in scene.cameras:
        cv2.imwrite(str(folder / "images" / name), np.zeros((64, 48, 3), np.uint8))
    with pytest.raises(CaptureError, match=r"12 images cannot be used(?s:.)*frame_009(?s:.)*and 2 more"):
        load_capture(folder, UP)


def test_scaling_keeps_lens_parameters_and_the_field_of_view():
    lens = Intrinsics("OPENCV", (800.0, 810.0, 320.0, 240.0, 0.1, 0.01, 0.001, 0.002), 640, 480)
    half = scale_intrinsics(lens, 320, 240)
    assert half.params == (400.0, 405.0, 160.0, 120.0, 0.1, 0.01, 0.001, 0.002)
    single = scale_intrinsics(Intrinsics("SIMPLE_RADIAL", (800.0, 320.0, 240.0, 0.1), 640, 480), 320, 240)
    assert single == Intrinsics("SIMPLE_RADIAL", (400.0, 160.0, 120.0, 0.1), 320, 240)


# ----------------------------------------------------------------------------------------------- folders


def test_the_largest_shrunk_folder_stands_in_for_images(folder, scene):
    shrink_folder(folder, scene, 4, "images_4")
    shrink_folder(folder, scene, 2, "images_2")
    for image in (folder / "images").iterdir():
        image.unlink()
    (folder / "images").rmdir()
    capture = load_capture(folder, UP)
    assert capture.images == "images_2"
    assert any("images_2 is used instead" in warning for warning in capture.warnings)


@pytest.mark.parametrize("images", ["../gone", "/gone", "gone", ""])
def test_image_folders_that_are_not_there_are_refused(folder, images):
    with pytest.raises(CaptureError, match="no such folder"):
        load_capture(folder, up(images=images))


@pytest.mark.parametrize("given", ["from the capture", "absolute", "from here"])
def test_photographs_may_lie_outside_the_capture(folder, given, monkeypatch):
    """As COLMAP's `--image_path` may; masks too."""
    place = folder.parent / f"{folder.name}-elsewhere"
    (folder / "images").rename(place)
    monkeypatch.chdir(folder.parent)
    masks = folder.parent / f"{folder.name}-masks"
    masks.mkdir()
    for path in place.iterdir():
        with Image.open(path) as image:
            Image.new("L", image.size, 255).save(masks / f"{path.stem}.png")
    named = {"absolute": str(place), "from here": place.name}.get(given, f"../{place.name}")
    options = up(images=named, masks=masks.name)
    capture = load_capture(folder, options)
    assert all(view.mask_path is not None for view in capture.views)
    assert {view.image_path.resolve().parent for view in capture.views} == {place.resolve()}
    assert place.resolve() in [each.resolve() for each in input_folders(capture)]
    kept = with_absolute_paths(options, folder)
    monkeypatch.chdir(folder)
    again = load_capture(folder, kept)
    assert [view.image_path.resolve() for view in again.views] == [view.image_path.resolve() for view in capture.views]


@pytest.mark.parametrize("linked", [False, True])
def test_photographs_are_no_masks_of_themselves(folder, linked):
    """Their dark pixels would be left out, and nothing would tell."""
    if linked:
        (folder / "masks").symlink_to("images")
    with pytest.raises(CaptureError, match="is the photograph itself, not a mask"):
        load_capture(folder, up() if linked else up(masks="images"))


def test_a_text_model_that_is_not_read_is_named(folder):
    (folder / "sparse" / "0" / "images.txt").write_text("# other poses\n")
    (folder / "sparse" / "0" / "cameras.txt").write_text("# other cameras\n")
    assert any("images.txt beside it is not" in warning for warning in load_capture(folder, UP).warnings)


def test_missing_things_are_named(tmp_path, scene):
    with pytest.raises(CaptureError, match="no such folder"):
        load_capture(tmp_path / "nowhere")
    with pytest.raises(CaptureError, match=r"not a capture. Looked for a COLMAP model"):
        load_capture(tmp_path)
    model = write_colmap(tmp_path, scene, images=None)
    with pytest.raises(CaptureError, match="no images/ folder"):
        load_capture(tmp_path, UP)
    (tmp_path / "images_2").mkdir()
    with pytest.raises(
        CaptureError, match=r"12 of 12 images that have a camera are missing.*(?s:.)*frame_000(?s:.)*frame_011"
    ):
        load_capture(tmp_path, UP)
    with pytest.raises(CaptureError, match=r"images_9: no such folder.*Present in the capture: images_2, sparse"):
        load_capture(tmp_path, up(images="images_9"))
    (model / "points3D.bin").unlink()
    with pytest.raises(CaptureError, match="no 3D points"):
        load_capture(tmp_path, UP)


def test_names_match_across_extension_and_case(folder, scene):
    for name in scene.cameras:
        pixels = cv2.imread(str(folder / "images" / name))
        (folder / "images" / name).unlink()
        cv2.imwrite(str(folder / "images" / name.replace("frame", "FRAME").replace(".png", ".JPG")), pixels)
    capture = load_capture(folder, UP)
    assert capture.views[0].image_path.name == "FRAME_000.JPG"


def test_images_without_a_camera_are_a_warning(folder):
    for index in range(7):
        cv2.imwrite(str(folder / "images" / f"spare_{index}.png"), np.zeros((4, 4, 3), np.uint8))
    (warning,) = load_capture(folder, UP).warnings
    assert "7 images have no camera" in warning
    assert "spare_0.png" in warning


def test_symlinked_image_folders_are_fine(tmp_path, scene):
    write_colmap(tmp_path / "capture", scene, images=None)
    write_images(tmp_path / "elsewhere", scene)
    (tmp_path / "capture" / "images").symlink_to(tmp_path / "elsewhere")
    assert len(load_capture(tmp_path / "capture", UP).views) == 12


def test_strays_among_the_points_are_dropped(tmp_path, scene):
    points = scene.points.copy()
    points[0], points[1], points[2] = [np.nan, 0, 0], [1e7, 0, 0], [0, np.inf, 0]
    write_colmap(tmp_path, TinyScene(scene.cameras, points, scene.colors))
    capture = load_capture(tmp_path, UP)
    assert len(capture.points) == len(points) - 3
    assert any("2 points that are not finite and 1 points farther" in warning for warning in capture.warnings)


# ----------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"split": "explicit"}, "brings no split of its own"),
        ({"test_every": 1}, "at least 2"),
        ({"downscale": 0.5}, "at least 1"),
        ({"max_images": 1}, "at least 2"),
    ],
)
def test_options_that_cannot_be_met_are_named(folder, options, message):
    with pytest.raises(CaptureError, match=message):
        load_capture(folder, up(**options))


@pytest.mark.parametrize("downscale", [1.5, 2, 5, 6])
def test_photographs_are_shrunk_by_any_factor(folder, downscale):
    """Sides are rounded down, so that they are not those of the camera to the last digit."""
    for view in load_capture(folder, up(downscale=downscale)).views:
        assert load_image(view).image.shape == (view.camera.height, view.camera.width, 3)


def test_photographs_are_not_shrunk_to_nothing(folder):
    with pytest.raises(CaptureError, match=r"--downscale 7: photographs of 64x48 would be 9x6 .*Give at most 6"):
        load_capture(folder, up(downscale=7))


def test_max_images_keeps_a_compact_patch_and_what_it_sees(folder):
    whole, part = load_capture(folder, UP), load_capture(folder, up(max_images=4))
    assert len(part.views) == 4
    middle = np.median([view.camera.position for view in whole.views], axis=0)
    farthest = max(np.linalg.norm(view.camera.position - middle) for view in part.views)
    left_out = [view for view in whole.views if view.name not in {v.name for v in part.views}]
    assert all(np.linalg.norm(view.camera.position - middle) >= farthest - 1e-9 for view in left_out)
    assert all(any(view.camera.in_frustum(point[None])[0] for view in part.views) for point in part.points)


# ------------------------------------------------------------------------------------- pixels and lenses


def test_truncated_images_are_found_before_training(folder, scene):
    names = sorted(scene.cameras)
    for name in names[4:6]:
        file = folder / "images" / name
        file.write_bytes(file.read_bytes()[:-200])
    capture = load_capture(folder, UP)
    with pytest.raises(
        CaptureError, match=f"2 of 12 photographs or their masks cannot be used(?s:.)*{names[4]}(?s:.)*{names[5]}"
    ):
        check_images(capture)


def test_truncated_jpegs_are_found_too(folder, scene):
    name = sorted(scene.cameras)[2]
    big = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", big)[1].tobytes()
    (folder / "images" / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(CaptureError, match="truncated"):
        check_images(load_capture(folder, UP))


def test_gray_photographs_and_masks_of_sixteen_bits_pass_the_check(folder, scene):
    """PNG and TIFF of either byte order; one of a single color is told, and 32 bits are refused on sight."""
    first, second, third, *_ = sorted(scene.cameras)
    deep = {name: (render_plane(scene.cameras[name])[..., 0].astype(np.uint16)) * 257 for name in (first, second)}
    cv2.imwrite(str(folder / "images" / first), deep[first])
    (folder / "images" / second).unlink()
    tiff = (folder / "images" / second).with_suffix(".tif")
    Image.frombytes("I;16B", (64, 48), deep[second].astype(">u2").tobytes()).save(tiff)
    cv2.imwrite(str(folder / "images" / third), np.full((48, 64), 40_000, np.uint16))
    keep = np.zeros((48, 64), np.uint16)
    keep[:, :32] = 65_535
    (folder / "masks").mkdir()
    cv2.imwrite(str(folder / "masks" / first), keep)
    checked = check_images(load_capture(folder, UP))
    assert (checked.files, checked.masked_fraction) == (13, pytest.approx(0.5 / 12))
    assert [each for each in checked.warnings if "one color only" in each] == [
        f"photographs of one color only, which teach nothing but that: 1 ({third})."
    ]
    Image.fromarray(deep[second].astype(np.int32)).save(tiff)
    with pytest.raises(CaptureError, match=r"\.tif: has the color mode I; convert it to 8-bit RGB"):
        load_capture(folder, UP)


def test_a_header_that_is_no_image_is_named(folder, scene):
    name = sorted(scene.cameras)[0]
    (folder / "images" / name).write_bytes(b"<html>404</html>")
    with pytest.raises(CaptureError, match=f"{name}: not an image that can be read"):
        load_capture(folder, UP)


def test_distorted_cameras_are_undone_without_being_asked_and_said(tmp_path, scene):
    write_colmap(tmp_path, scene, model="SIMPLE_RADIAL", extra=(0.05,))
    capture = load_capture(tmp_path, UP)
    assert all(view.image_path.parent == tmp_path / "undistorted" / "images" for view in capture.views)
    assert any("lens distortion (SIMPLE_RADIAL) were undistorted into" in each for each in capture.warnings)
    assert {each.images for each in image_sizes(capture, UP)} == {"images"}


@pytest.mark.parametrize(("model", "extra"), [("SIMPLE_RADIAL", (-0.12,)), ("OPENCV", (-0.1, 0.02, 0.004, -0.003))])
def test_undistorting_gives_the_pinhole_picture(tmp_path, model, extra):
    """Pictures are bent by the forward model here; straightened, they equal the pinhole renderings."""
    import pycolmap

    scene = tiny_scene(columns=2, rows=2, width=160, height=120)
    write_colmap(tmp_path, scene, model=model, extra=extra)
    for name, camera in scene.cameras.items():
        params = (camera.fx, camera.cx, camera.cy, *extra) if model == "SIMPLE_RADIAL" else (
            camera.fx, camera.fy, camera.cx, camera.cy, *extra)  # fmt: skip
        lens = pycolmap.Camera(model=model, width=160, height=120, params=list(params))
        x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
        rays = np.asarray(lens.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))
        wide = replace(camera, cx=160.0, cy=120.0, width=320, height=240)
        grid = (rays * [camera.fx, camera.fy] + [160.0, 120.0] - 0.5).astype(np.float32).reshape(120, 160, 2)
        bent = cv2.remap(render_plane(wide), grid[..., 0], grid[..., 1], cv2.INTER_CUBIC)
        cv2.imwrite(str(tmp_path / "images" / name), bent[:, :, ::-1])
    half = np.zeros((120, 160), np.uint8)
    half[:, :80] = 255
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "frame_002.png"), half)
    capture = load_capture(tmp_path, up(undistort=True))
    assert any("undistorted into" in warning for warning in capture.warnings)
    for view in capture.views:
        truth = replace(view.camera, camera_from_world=scene.cameras[view.name].camera_from_world)
        straight = decode_image(view.image_path)[0].astype(float)
        assert np.abs(straight - render_plane(truth)).mean() < 3.0
    mask = load_image(capture.views[2]).mask
    assert mask is not None
    assert mask.float().mean() == pytest.approx(0.5, abs=0.03)
    assert mask[:, :60].all()
    assert [view.mask_path is not None for view in capture.views] == [False, False, True, False]
    written = {file: file.stat().st_mtime_ns for file in (tmp_path / "undistorted").rglob("*.jpg")}
    again = load_capture(tmp_path, up(undistort=True))
    assert len(again.views) == len(written) == 4
    assert all(file.stat().st_mtime_ns == time for file, time in written.items())


def test_photographs_of_a_lens_that_folds_over_within_them_are_cut_and_a_warning_says_so(tmp_path):
    write_colmap(tmp_path, tiny_scene(columns=2, rows=2, width=80, height=60), model="SIMPLE_RADIAL", extra=(-0.9,))
    capture = load_capture(tmp_path, up(undistort=True))
    (said,) = [warning for warning in capture.warnings if "folds over" in warning]
    assert re.search(r"SIMPLE_RADIAL .* of 80x60 pixels: (\d+)% of each photograph is left out", said)
    lens = Intrinsics("SIMPLE_RADIAL", (capture.views[0].camera.fx, 40.0, 30.0, -0.9), 80, 60)
    for view in capture.views:
        camera = view.camera
        assert np.hypot(camera.cx / camera.fx, camera.cy / camera.fy) < 0.99 * fold_radius(lens)


def test_the_map_of_a_lens_is_made_once_for_all_its_photographs(tmp_path, monkeypatch):
    """Two lenses in turn, as a rig of two cameras takes them; nothing is made where all is written already."""
    lenses = [Intrinsics("SIMPLE_RADIAL", (58.0, 32.0, 24.0, bend), 64, 48) for bend in (-0.1, -0.05)]
    plain = Intrinsics("PINHOLE", (58.0, 58.0, 32.0, 24.0), 64, 48)
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    photographs = []
    for index, lens in enumerate([*lenses, plain] * 4):
        file = tmp_path / f"{index:02d}.png"
        assert cv2.imwrite(str(file), picture)
        photographs.append(ImageFile(file.name, file, None, lens))
    asked = []
    monkeypatch.setattr(undistortion, "sampling_map", lambda *lens: asked.append(lens[0]) or sampling_map(*lens))
    straight = undistortion.undistort(tmp_path / "straight", photographs)
    assert asked == lenses
    assert [photo.name for photo in straight] == [photo.name for photo in photographs]
    for photo, before in zip(straight, photographs, strict=True):  # each by its own lens, whose sizes differ
        lens = before.intrinsics
        assert photo.intrinsics == (undistorted_pinhole(lens) if lens.is_distorted else lens)
        assert decode_image(photo.path)[0].shape[1::-1] == (photo.intrinsics.width, photo.intrinsics.height)
    assert undistortion.undistort(tmp_path / "straight", photographs) == straight
    assert asked == lenses


def test_the_mask_of_a_straightened_photograph_holds_what_its_mask_and_it_show(tmp_path, monkeypatch):
    """Neither what is transparent, nor what is masked, nor, of a wider picture, what lies beside the photograph."""
    lens, wide = Intrinsics("SIMPLE_RADIAL", (58.0, 32.0, 24.0, -1e-6), 64, 48), (58.0, 58.0, 48.0, 24.0)
    picture = np.full((48, 64, 4), 255, np.uint8)
    picture[:16, :, 3] = 0
    masked = np.full((48, 64), 255, np.uint8)
    masked[32:] = 0
    image, mask = tmp_path / "a.png", tmp_path / "a.mask.png"
    assert cv2.imwrite(str(image), picture)
    assert cv2.imwrite(str(mask), masked)
    monkeypatch.setattr(undistortion, "undistorted_pinhole", lambda _: Intrinsics("PINHOLE", wide, 96, 48))
    (straight,) = undistortion.undistort(tmp_path / "straight", [ImageFile("a.png", image, mask, lens)])
    expected = np.zeros((48, 96), bool)
    expected[16:32, 16:80] = True
    assert straight.mask is not None
    np.testing.assert_array_equal(decode_mask(straight.mask, 96, 48), expected)


def test_a_damaged_photograph_has_no_sound_copy(tmp_path):
    """Cut off and filled with zeros, it decodes; its copy without distortion would be a whole file."""
    file, lens = tmp_path / "a.jpg", Intrinsics("SIMPLE_RADIAL", (500.0, 320.0, 240.0, -0.05), 640, 480)
    picture = cv2.resize(np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8), (640, 480))
    whole = cv2.imencode(".jpg", picture)[1].tobytes()
    file.write_bytes(whole)
    photographs, half = [ImageFile("a.jpg", file, None, lens)], len(whole) // 2
    undistortion.undistort(tmp_path / "straight", photographs)
    file.write_bytes(whole[:half] + bytes(len(whole) - half))
    with pytest.raises(CaptureError, match=r"a\.jpg"):
        undistortion.undistort(tmp_path / "straight", photographs)
    assert not (tmp_path / "straight" / "a.jpg.json").exists()


def test_a_map_takes_little_more_memory_than_itself():
    lens = Intrinsics("OPENCV", (900.0, 905.0, 640.0, 480.0, -0.1, 0.02, 0.004, -0.003), 1280, 960)
    pinhole = undistorted_pinhole(lens)
    tracemalloc.start()
    whole = sampling_map(lens, pinhole)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert whole.shape == (pinhole.height, pinhole.width, 2)
    assert peak < whole.nbytes + 100 * undistortion.STRIP_PX
    np.testing.assert_array_equal(sampling_map(lens, pinhole, strip_px=7 * pinhole.width), whole)


@pytest.mark.capture
@pytest.mark.parametrize(("name", "test", "train", "points"), [
    ("brighton", 3, 15, 20512), ("copr", 5, 33, 47015), ("seneca", 21, 145, 102770),
])  # fmt: skip
def test_real_captures_load_whole(name, test, train, points):
    capture = load_capture(data_folder(name, "images_4"), CaptureOptions(images="images_4"))
    assert (len(capture.test_views), len(capture.train_views), len(capture.points)) == (test, train, points)
    assert capture.warnings == ()
    assert capture.ground.metric
    assert check_images(capture, 5).files == 5
