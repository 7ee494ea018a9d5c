"""The image cache: right pixels, within its budget, from any thread."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from support.commands import PATIENCE_SECONDS
from vdgs.captures.capture import View
from vdgs.captures.image_cache import ImageCache, load_image
from vdgs.captures.image_files import decode_image, decode_mask, read_header
from vdgs.errors import CaptureError
from vdgs.geometry.camera import Camera

WIDTH, HEIGHT = 60, 41
BYTES = WIDTH * HEIGHT * 3


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def make_view(path: Path, mask: Path | None = None, width: int = WIDTH, height: int = HEIGHT) -> View:
    return View(
        name=path.name,
        camera=Camera(
            camera_from_world=np.eye(4), fx=50.0, fy=50.0, cx=width / 2, cy=height / 2, width=width, height=height
        ),
        image_path=path,
        mask_path=mask,
        split="train",
    )


@pytest.fixture
def views(tmp_path) -> list[View]:
    for index in range(8):
        Image.fromarray(picture(index)).save(tmp_path / f"{index}.png")
    return [make_view(tmp_path / f"{index}.png") for index in range(8)]


def test_pixels_are_those_of_the_file(views):
    with ImageCache(views, 10**6) as cache:
        for index in range(8):
            image, mask = cache.get(index)
            assert image.dtype == torch.uint8
            assert mask is None
            np.testing.assert_array_equal(image.numpy(), picture(index))
        assert cache.get(3).image is cache.get(3).image


@pytest.mark.parametrize("budget", [0, BYTES - 1, BYTES, int(2.5 * BYTES), 100 * BYTES])
def test_the_budget_holds_at_every_moment(views, budget):
    with ImageCache(views, budget, downscales=(1, 2)) as cache:
        for index in [0, 1, 2, 0, 3, 7, 7, 1, 2, 5]:
            for downscale in (1, 2):
                cache.get(index, downscale)
                assert cache.nbytes <= budget
                assert cache.nbytes == sum(kept.nbytes for kept in cache._kept.values())


def test_the_least_recently_used_picture_goes_first(views):
    with ImageCache(views, 2 * BYTES) as cache:
        first = cache.get(0).image
        cache.get(1)
        assert cache.get(0).image is first
        cache.get(2)
        assert set(cache._kept) == {(0, 1), (2, 1)}


def test_downscaled_pictures_and_cameras_have_the_same_size(views):
    with ImageCache(views, 10**6, downscales=(1, 2, 4, 2.5)) as cache:
        for downscale in (1, 2, 4, 2.5):
            camera, image = cache.camera(1, downscale), cache.get(1, downscale).image
            assert image.shape == (camera.height, camera.width, 3)
            assert (camera.width, camera.height) == (int(WIDTH / downscale), int(HEIGHT / downscale))
            assert image.float().mean() == pytest.approx(picture(1).mean(), abs=3)


def test_shrunk_pixels_do_not_depend_on_what_was_cached(views):
    with ImageCache(views, 10**6, downscales=(1, 4)) as warm, ImageCache(views, 0, downscales=(1, 4)) as cold:
        warm.get(2)
        assert torch.equal(warm.get(2, 4).image, cold.get(2, 4).image)


def test_prefetched_pictures_are_ready_and_decoded_once(views, monkeypatch):
    decoded: list[str] = []

    def counting(view):
        decoded.append(threading.current_thread().name)
        return load_image(view)

    monkeypatch.setattr("vdgs.captures.image_cache.load_image", counting)
    with ImageCache(views, 10**6) as cache:
        cache.prefetch([4, 5, 6, 4])
        for index in (4, 5, 6):
            np.testing.assert_array_equal(cache.get(index).image.numpy(), picture(index))
    assert len(decoded) == 3
    assert all(name.startswith("images") for name in decoded[1:])


def test_prefetching_more_than_the_queue_holds_is_harmless(views):
    many = views * 20
    with ImageCache(many, 3 * BYTES) as cache:
        cache.prefetch(range(len(many)))
        for index in range(len(many)):
            np.testing.assert_array_equal(cache.get(index).image.numpy(), picture(index % 8))


def test_errors_in_the_background_are_raised_by_get(views, tmp_path):
    views[2].image_path.write_bytes(b"no image")
    with ImageCache(views, 10**6) as cache:
        cache.prefetch([1, 2, 3])
        cache.get(3)
        for _ in range(2):
            with pytest.raises(CaptureError, match=r"2\.png: cannot be decoded"):
                cache.get(2)
        Image.fromarray(picture(2)).save(views[2].image_path)
        np.testing.assert_array_equal(cache.get(2).image.numpy(), picture(2))


def test_many_threads_get_the_right_pictures(views):
    wrong: list[int] = []
    with ImageCache(views, 3 * BYTES, threads=2) as cache:

        def work(seed: int) -> None:
            for index in np.random.default_rng(seed).integers(0, 8, 40):
                cache.prefetch([(index + 1) % 8])
                if not np.array_equal(cache.get(int(index)).image.numpy(), picture(int(index))):
                    wrong.append(int(index))

        threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE_SECONDS)
        assert not any(thread.is_alive() for thread in threads)
        assert cache.nbytes <= 3 * BYTES
    assert not wrong


def test_a_closed_cache_and_wrong_arguments_say_so(views):
    cache = ImageCache(views, 10**6)
    with pytest.raises(ValueError, match="not announced"):
        cache.get(0, 2)
    with pytest.raises(IndexError):
        cache.get(8)
    cache.prefetch(range(8))
    cache.close()
    cache.close()
    assert cache.nbytes == 0
    with pytest.raises(ValueError, match="closed"):
        cache.get(0)


# ----------------------------------------------------------------------------------------------- kinds


def test_gray_sixteen_bit_alpha_and_palette(tmp_path):
    rgb = picture()
    deep = (rgb.astype(np.uint16) * 257)[:, :, ::-1]
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    np.testing.assert_array_equal(decode_image(tmp_path / "deep.png")[0], rgb)
    Image.fromarray(rgb[:, :, 0]).save(tmp_path / "gray.png")
    np.testing.assert_array_equal(decode_image(tmp_path / "gray.png")[0], np.repeat(rgb[:, :, :1], 3, axis=2))
    alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
    Image.fromarray(np.concatenate([rgb, alpha], axis=2)).save(tmp_path / "opaque.png")
    pixels, opaque = decode_image(tmp_path / "opaque.png")
    np.testing.assert_array_equal(pixels, rgb)
    assert opaque is None
    alpha[:, :20] = 0
    Image.fromarray(np.concatenate([rgb, alpha], axis=2)).save(tmp_path / "holes.png")
    _, opaque = decode_image(tmp_path / "holes.png")
    assert opaque is not None
    np.testing.assert_array_equal(opaque, alpha[:, :, 0] > 0)
    Image.fromarray(rgb).quantize(8).save(tmp_path / "palette.png")
    assert decode_image(tmp_path / "palette.png")[0].shape == rgb.shape
    Image.fromarray(rgb[:, :, 0].astype(np.float32)).save(tmp_path / "heights.tif")
    with pytest.raises(CaptureError, match="F; convert"):
        read_header(tmp_path / "heights.tif")


def test_exif_orientation_is_not_applied(tmp_path):
    """COLMAP reads pixels as stored, and so do we."""
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(picture()).save(tmp_path / "turned.jpg", exif=exif, quality=95)
    assert decode_image(tmp_path / "turned.jpg")[0].shape == (HEIGHT, WIDTH, 3)
    assert read_header(tmp_path / "turned.jpg").width == WIDTH


def test_masks_keep_white_and_shrink_carefully(tmp_path, views):
    keep = np.zeros((HEIGHT, WIDTH), np.uint8)
    keep[:, 31:] = 255
    Image.fromarray(keep).save(tmp_path / "mask.png")
    view = make_view(views[0].image_path, tmp_path / "mask.png")
    with ImageCache([view], 10**6, downscales=(1, 2)) as cache:
        mask, half = cache.get(0).mask, cache.get(0, 2).mask
        assert mask is not None
        assert half is not None
        np.testing.assert_array_equal(mask.numpy(), keep // 255)
        assert not half[:, :16].any()  # column 15 of the half covers 30 and 31: not wholly kept
        assert half[:, 16:].all()
    small = decode_mask(tmp_path / "mask.png", WIDTH // 2, HEIGHT // 2)
    assert small.shape == (HEIGHT // 2, WIDTH // 2)


def test_of_a_photograph_with_a_mask_and_holes_counts_what_both_keep(tmp_path):
    keep, alpha = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    keep[:, 31:], alpha[:20] = 255, 255
    Image.fromarray(keep).save(tmp_path / "mask.png")
    Image.fromarray(np.dstack([picture(), alpha])).save(tmp_path / "holes.png")
    view = make_view(tmp_path / "holes.png", tmp_path / "mask.png")
    np.testing.assert_array_equal(load_image(view).mask.numpy(), (keep & alpha) // 255)
    holes = load_image(make_view(tmp_path / "holes.png")).mask
    np.testing.assert_array_equal(holes.numpy(), alpha // 255)


def test_an_image_that_changed_shape_since_the_check_is_named(views):
    Image.fromarray(picture().transpose(1, 0, 2).copy()).save(views[0].image_path)
    with ImageCache(views, 10**6) as cache, pytest.raises(CaptureError, match="is 41x60 now"):
        cache.get(0)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_damaged_files_end_in_a_picture_or_in_an_error_that_names_them(tmp_path, suffix):
    data = cv2.imencode(suffix, picture())[1].tobytes()
    generator = np.random.default_rng(0)
    complaints = 0
    for trial in range(60):
        damaged = bytearray(data[: generator.integers(0, len(data))] if trial % 2 else data)
        for position in generator.integers(0, max(len(damaged), 1), 5 if len(damaged) else 0):
            damaged[position] ^= 1 << int(generator.integers(0, 8))
        file = tmp_path / f"damaged{suffix}"
        file.write_bytes(bytes(damaged))
        for read in (read_header, decode_image):
            try:
                read(file)
            except CaptureError as error:
                complaints += 1
                assert file.name in str(error)  # noqa: PT017
    assert complaints > 10


def test_what_is_half_transparent_counts_from_the_middle_on(tmp_path):
    pixels = np.full((1, 4, 4), 200, np.uint8)
    pixels[0, :, 3] = [0, 127, 128, 255]
    Image.fromarray(pixels).save(tmp_path / "a.png")
    _, opaque = decode_image(tmp_path / "a.png")
    assert opaque is not None
    assert opaque.tolist() == [[False, False, True, True]]


def test_masks_of_zeros_and_ones_are_masks(tmp_path):
    """As label programs write them; beside 255, 1 is black."""
    for white in (1, 255):
        Image.fromarray(np.array([[0, 1, white]], np.uint8)).save(tmp_path / "m.png")
        assert decode_mask(tmp_path / "m.png", 3, 1).tolist() == [[False, white == 1, True]]
