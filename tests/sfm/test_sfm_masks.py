"""Masks of photographs alone: found beside them, kept out of features, and written with the capture."""

from __future__ import annotations

import io
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps
from rich.console import Console

pytest.importorskip("embreex")
import pycolmap

from support.flights import HEIGHT, WIDTH, Flight, copy_folder, write_photograph
from vdgs.captures.image_cache import load_image
from vdgs.captures.image_files import decode_mask
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import read_digests
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.presets import PRESETS
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.sfm import feature_extraction, incremental_mapper, reconstruct
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.mask_files import encode_mask, read_keep_mask, undistort_mask, write_upright_masks
from vdgs.sfm.reconstruction_plan import plan_reconstruction, print_plan
from vdgs.sfm.run_request import make_sfm_request
from vdgs.sfm.step_keys import step_keys
from vdgs.sfm.workspace import Workspace, silence_colmap

pytestmark = pytest.mark.xdist_group("sfm")

NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)


def console() -> Console:
    return Console(file=io.StringIO(), width=500)


def photographs(folder: Path, *names: str, orientation: int = 1) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        turned = np.roll(NOISE, len(list(folder.rglob("*"))), axis=0)
        write_photograph(folder / name, turned, 0, None, orientation)


def write_mask(file: Path, keep: np.ndarray) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(keep.astype(np.uint8) * 255).save(file)
    return file


def left_half(height: int = 120, width: int = 160) -> np.ndarray:
    """What keeps the left half and, to tell up from down, an upper corner of the right one."""
    keep = np.zeros((height, width), bool)
    keep[:, : width // 2] = True
    keep[: height // 4, 3 * width // 4 :] = True
    return keep


# ------------------------------------------------------------------------------------------------- finding


@pytest.mark.parametrize(
    ("asked", "names", "masks"),
    [
        pytest.param(".", "{}.jpg", "masks/{}.png", id="beside them"),
        pytest.param(".", "images/{}.jpg", "masks/{}.jpg.png", id="images and masks"),
        pytest.param("images", "images/{}.jpg", "masks/{}.jpg", id="images alone are named"),
        pytest.param(".", "100 MEDIA/é{}.jpg", "100 MEDIA/masks/e\u0301{}.png", id="in folders of a card"),
        pytest.param(".", "DCIM/100/{}.jpg", "Masks/DCIM/100/{}.png", id="in a tree of their own"),
        pytest.param(".", "rgb/{}.jpg", "mask/{}.png", id="beside a folder of any name"),
        pytest.param(".", "site/final/train/rgb/{}.jpg", "site/final/train/mask/{}.png", id="as NeRF-OSR has them"),
    ],
)
def test_masks_beside_photographs_are_masks(tmp_path, asked, names, masks):
    photographs(tmp_path, *(names.format(k) for k in range(4)))
    for k in range(3):
        write_mask(tmp_path / masks.format(k), left_half())
    found = collect_images([tmp_path / asked])
    assert len(found.images) == 4
    assert (found.excluded, found.other_files) == ((), 0)
    assert [photo.mask and photo.mask.name for photo in found.images] == [
        *(Path(masks.format(k)).name for k in range(3)), None,
    ]  # fmt: skip
    assert any("3 of 4 photographs have a mask" in note for note in found.notes)
    said = console()
    print_plan(
        plan_reconstruction(SfmRequest(image_folders=(tmp_path / asked,), output=tmp_path.parent / "new")), "", said
    )
    assert "3 of 4 photographs have one" in said.file.getvalue()


def test_of_photographs_of_one_name_each_has_a_mask_of_its_own(tmp_path):
    photographs(tmp_path, *(f"{name}/{k}.{kind}" for name, kind in (("rgb", "jpg"), ("nir", "tif")) for k in range(2)))
    flat = write_mask(tmp_path / "masks/0.png", left_half())
    with pytest.raises(CaptureError, match=r"\((nir|rgb)/0\.png; 0\.png is there\)"):
        collect_images([tmp_path])
    flat.unlink()
    for folder in ("rgb", "nir"):
        write_mask(tmp_path / "masks" / folder / "0.png", left_half())
    masks = {photo.name: photo.mask for photo in collect_images([tmp_path]).images}
    assert {name: mask and mask.parent.name for name, mask in masks.items()} == {
        "rgb/0.jpg": "rgb", "nir/0.tif": "nir", "rgb/1.jpg": None, "nir/1.tif": None,
    }  # fmt: skip


def test_masks_of_nothing_and_of_other_shapes_are_named(tmp_path):
    photographs(tmp_path, *(f"{k}.jpg" for k in range(3)))
    mask = write_mask(tmp_path / "masks/0_legs.png", left_half())
    with pytest.raises(CaptureError, match=r"masks: holds 1 masks, none of them .*\(0\.png; 0_legs\.png is there\)"):
        collect_images([tmp_path])
    write_mask(tmp_path / "masks/0.png", left_half())
    assert any(
        "1 masks belong to no photograph" in note and mask.name in note for note in collect_images([tmp_path]).notes
    )
    wrong = write_mask(tmp_path / "masks/1.png", left_half(160, 120))
    with pytest.raises(CaptureError, match=r"1\.png: is 120x160, but its photograph 1\.jpg is 160x120"):
        collect_images([tmp_path])
    wrong.unlink()
    alone = tmp_path / "alone"
    photographs(alone, *(f"masks/{k}.jpg" for k in range(3)))
    assert len(collect_images([alone]).images) == 3  # of masks, at the carnival


def test_gray_masks_are_told_before_work_begins(tmp_path):
    photographs(tmp_path, *(f"{k}.jpg" for k in range(9)))
    for k in range(9):
        mask = write_mask(tmp_path / f"masks/{k}.png", left_half())
    assert not collect_images([tmp_path]).notes
    pixels = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
    for k in range(9):
        cv2.imwrite(str(tmp_path / f"masks/{k}.png"), np.maximum(pixels, 60))
    assert any("44% of the mask is gray" in note for note in collect_images([tmp_path]).notes)


def test_other_folders_of_masks_are_asked_of_captures_only(tmp_path):
    options = CaptureOptions(masks="legs")
    training = PRESETS["laptop"].training
    with pytest.raises(VdgsError, match="--masks legs: names a folder of a capture"):
        make_sfm_request(
            RunRequest(capture=tmp_path, output=tmp_path / "run", preset="laptop", options=options, training=training)
        )


# --------------------------------------------------------------------------------------------------- using


@pytest.mark.parametrize("orientation", range(1, 9))
def test_masks_turn_with_their_photographs(tmp_path, orientation):
    photographs(tmp_path, "0.jpg", "1.jpg", "2.jpg", orientation=orientation)
    write_mask(tmp_path / "masks/0.png", left_half())
    with Image.open(tmp_path / "0.jpg") as stored:
        exif = stored.getexif()
    Image.fromarray(left_half().astype(np.uint8)).save(tmp_path / "turned.png", exif=exif)
    with Image.open(tmp_path / "turned.png") as image:
        truth = np.array(ImageOps.exif_transpose(image)) > 0
    (tmp_path / "turned.png").unlink()
    found = collect_images([tmp_path]).images
    assert np.array_equal(read_keep_mask(found[0]), truth)
    assert read_keep_mask(found[1]) is None
    if orientation >= 5:  # as programs write it that turn photographs themselves
        write_mask(tmp_path / "masks/0.png", truth)
        assert np.array_equal(read_keep_mask(found[0]), truth)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("compression", [None, "tiff_lzw"])
def test_tiffs_and_their_masks_are_turned_upright_once(tmp_path, orientation, compression):
    exif, folder = Image.Exif(), tmp_path / "photos"
    exif[0x0112] = orientation
    turn = {3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}.get(orientation)
    for k in range(3):
        (folder / "masks").mkdir(parents=True, exist_ok=True)
        for file, picture in (
            (folder / f"{k}.tif", Image.fromarray(np.roll(NOISE, k, axis=0))),
            (folder / f"masks/{k}.tif", Image.fromarray(left_half().astype(np.uint8) * 255)),
        ):
            stored = picture if turn is None else picture.transpose(turn)
            stored.save(file, exif=exif, compression=compression)
    found = collect_images([folder]).images
    assert [photo.size for photo in found] == [(160, 120)] * 3
    assert all(np.array_equal(read_keep_mask(photo), left_half()) for photo in found)
    work = Workspace(tmp_path / "work")
    assert feature_extraction.write_upright_images(work, found, 2) == []
    pixels = pycolmap.Bitmap.read(work.images / found[0].name, True).to_array()
    assert np.array_equal(pixels, NOISE)


def test_transparency_is_a_mask_and_both_count(tmp_path):
    for k in range(3):
        alpha = np.where(left_half() | (k == 2), 255, 0).astype(np.uint8)
        Image.fromarray(np.dstack([np.roll(NOISE, k, axis=0), alpha])).save(tmp_path / f"{k}.png")
    upper = np.zeros((120, 160), bool)
    upper[:60] = True
    write_mask(tmp_path / "masks/1.png", upper)
    first, second, third = collect_images([tmp_path]).images
    assert np.array_equal(read_keep_mask(first), left_half())
    assert np.array_equal(read_keep_mask(second), left_half() & upper)
    assert read_keep_mask(third) is None
    said = console()
    print_plan(plan_reconstruction(SfmRequest(image_folders=(tmp_path,), output=tmp_path.parent / "new")), "", said)
    assert "1 of 3 photographs have one; 3 have an alpha channel" in said.file.getvalue()


@pytest.fixture
def masked(nine, tmp_path) -> Flight:
    """The nine, two of them with masks."""
    (tmp_path / "card").mkdir()
    for name in nine.names:
        os.link(nine.folder / name, tmp_path / "card" / name)
    for name in nine.names[:2]:
        write_mask(tmp_path / f"card/masks/{name}.png", left_half(HEIGHT, WIDTH))
    return Flight(tmp_path / "card", nine.cameras)


@pytest.mark.slow
def test_features_lie_where_masks_are_white(masked, tmp_path):
    silence_colmap()
    collection = collect_images([masked.folder])
    seen = (collection.images[0], collection.images[5])
    black = write_mask(tmp_path / "black.png", np.zeros((HEIGHT, WIDTH), bool))
    seen = (*seen, replace(collection.images[1], mask=black))
    work, kinds = Workspace(tmp_path / "work"), feature_extraction.group_by_camera(seen)
    feature_extraction.create_database(work, kinds)
    feature_extraction.write_upright_images(work, seen, 1)
    write_upright_masks(work, seen, 1)
    options = SfmOptions(max_image_size=240, max_num_features=500)
    counts = feature_extraction.extract_features(work, kinds, options, 1, console())
    database = pycolmap.Database.open(work.database)
    found = {image.name: image.image_id for image in database.read_all_images()}
    x, y = np.asarray(database.read_keypoints(found[seen[0].name]))[:, :2].T
    database.close()
    assert left_half(HEIGHT, WIDTH)[y.astype(int), x.astype(int)].all()
    assert 0 < counts[seen[0].name] < counts[seen[1].name]
    assert counts[seen[2].name] == 0
    with pytest.raises(CaptureError, match="shows only 0 features where its mask is white"):
        feature_extraction.images_without_features(seen, counts)


@pytest.mark.slow
def test_masks_are_written_with_the_capture_and_what_depends_on_them_is_done_again(nine_begun, masked, tmp_path):
    output, keys = tmp_path / "capture", []
    request = SfmRequest(
        image_folders=(masked.folder,), output=output, threads=1, options=SfmOptions(max_output_size=200)
    )
    first = masked.folder / f"masks/{masked.names[0]}.png"
    for change in (lambda: None, lambda: write_mask(first, ~left_half(HEIGHT, WIDTH)), first.unlink):
        change()
        keys.append(step_keys(plan_reconstruction(request), read_digests(output)))
    for step in ("features", "matches", "model", "capture"):
        assert len({each[step] for each in keys}) == 3

    copy_folder(nine_begun["writing"], output)
    write_mask(first, left_half(HEIGHT, WIDTH))
    prepared, work = plan_reconstruction(request), Workspace(output / "work")
    write_upright_masks(work, prepared.image_list.images, 1)
    model = incremental_mapper.read_models(work)[0]
    write_mask(output / "masks/old.png", left_half())  # of other masks
    reconstruct._write(prepared, work, model, model, "key", console())
    writer, lenses = reconstruct.capture_writer, reconstruct._lenses(model)
    pinholes = {number: writer.straight_camera(lens, 200) for number, lens in lenses.items()}
    writer.write_model(output, model, pinholes)
    capture = load_capture(output)
    names = {view.name: view.mask_path and view.mask_path.name for view in capture.views}
    assert names == {name: f"{name}.png" if k < 2 else None for k, name in enumerate(masked.names)}
    assert len(list((output / "masks").iterdir())) == 2
    picture, size = load_image(capture.views[0]), capture.views[0].camera.full_size
    assert tuple(picture.mask.shape) == size[::-1]
    truth = decode_mask(first, *size)
    assert (picture.mask.numpy().astype(bool) == truth).mean() > 0.97
    quarter = load_capture(output, CaptureOptions(images="images_4")).views[0]
    assert load_image(quarter).mask.float().mean() == pytest.approx(truth.mean(), abs=0.05)


def test_what_is_transparent_in_a_mask_is_not_kept(tmp_path):
    """Whether it is white below, 16 bits deep, gray with an alpha channel, or the photograph itself, cut out."""
    left = np.arange(8) < 4
    alpha = np.where(left, 255, 0).astype(np.uint8)
    dark = np.random.default_rng(0).integers(0, 100, (6, 8, 3)).astype(np.uint8)
    white = np.full((6, 8), 255, np.uint8)
    flat = np.broadcast_to(alpha, (6, 8))
    upper = np.where(np.arange(6)[:, None] < 3, white, 0)
    for pixels, expected in (
        (np.dstack([white, white, white, flat]), np.broadcast_to(left, (6, 8))),
        (np.dstack([upper, upper, upper, flat]), (upper > 0) & left),
        (np.dstack([dark, flat]), np.broadcast_to(left, (6, 8))),
        (np.dstack([white, white, white, white]), np.full((6, 8), True)),
    ):
        for deep in (pixels, pixels.astype(np.uint16) * 257):
            cv2.imwrite(str(tmp_path / "mask.png"), deep)
            np.testing.assert_array_equal(decode_mask(tmp_path / "mask.png", 8, 6), expected)
    Image.fromarray(np.dstack([white, flat]), "LA").save(tmp_path / "mask.png")
    np.testing.assert_array_equal(decode_mask(tmp_path / "mask.png", 8, 6), np.broadcast_to(left, (6, 8)))


def test_of_pixels_that_are_shrunk_together_all_must_be_kept(tmp_path):
    """And of those that lie outside the photograph, none is."""
    keep = np.ones((6, 8), bool)
    keep[0, 0] = keep[5, 6] = False
    (tmp_path / "mask.png").write_bytes(encode_mask(keep))
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(6.0)), axis=-1).astype(np.float32)
    straight = undistort_mask(tmp_path / "mask.png", grid, (10, 6))
    np.testing.assert_array_equal(straight, np.pad(keep, ((0, 0), (0, 2))))
    halved = undistort_mask(tmp_path / "mask.png", grid, (5, 3))
    np.testing.assert_array_equal(halved, straight.reshape(3, 2, 5, 2).all(axis=(1, 3)))
