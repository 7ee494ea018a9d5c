"""Photographs of other kinds: HEIC, raw, 16 bits, CMYK and profiles, decoded alike by one function."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin, TiffTags

from support.raw_writer import write_dng
from vdgs.captures import optional_decoders
from vdgs.captures.capture_dates import date_taken
from vdgs.captures.color_profiles import ADOBE_RGB, matrix_profile
from vdgs.captures.image_files import decode_image, find_images, read_header, verify_image
from vdgs.captures.image_tags import read_tags
from vdgs.captures.tiff_orientation import without_orientation
from vdgs.errors import CaptureError

COLORS = np.array([[200, 100, 50], [60, 160, 90], [40, 70, 190], [128, 128, 128], [240, 240, 240], [30, 30, 30]])
WIDE = 32
#: Primaries x, y of red, green and blue, and about its exponent.
DISPLAY_P3 = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)), 2.2


def patches(colors: np.ndarray = COLORS, height: int = 120) -> np.ndarray:
    """Upright bars of these colors, [h, w, 3] uint8."""
    return np.broadcast_to(colors.astype(np.uint8).repeat(WIDE, axis=0), (height, WIDE * len(colors), 3)).copy()


def middles(pixels: np.ndarray) -> np.ndarray:
    """The mean color in the middle of each bar."""
    rows = slice(pixels.shape[0] // 4, pixels.shape[0] * 3 // 4)
    return np.array(
        [pixels[rows, WIDE * k + 8 : WIDE * k + 24].reshape(-1, 3).mean(axis=0) for k in range(len(COLORS))]
    )


def in_space(space: tuple, colors: np.ndarray = COLORS) -> np.ndarray:
    """The values of sRGB colors in another space of primaries and exponent, by the definition of both."""
    primaries, exponent = space

    def matrix(places) -> np.ndarray:
        columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in places]).T
        return columns * np.linalg.solve(columns, np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290]))

    values = colors / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    other = linear @ (np.linalg.inv(matrix(primaries)) @ matrix([(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)])).T
    return np.round(255 * other.clip(0, 1) ** (1 / exponent))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
@pytest.mark.parametrize(("name", "space"), [("Adobe RGB (1998)", ADOBE_RGB), ("Display P3", DISPLAY_P3)])
def test_colors_of_profiles_become_those_of_srgb(tmp_path, suffix, name, space):
    file = tmp_path / f"a{suffix}"
    more = {".jpg": {"quality": 98, "subsampling": 0}, ".webp": {"lossless": True}}.get(suffix, {})
    Image.fromarray(patches(in_space(space))).save(file, icc_profile=matrix_profile(name, *space), **more)
    assert read_tags(file).kind == (f"WebP, {name}" if suffix == ".webp" else name)
    assert middles(decode_image(file)[0]) == pytest.approx(COLORS, abs=3)


def test_a_profile_of_srgb_changes_no_bit(tmp_path):
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for name, more in (
        ("plain.jpg", {}),
        ("marked.jpg", {"icc_profile": profile}),
        ("broken.jpg", {"icc_profile": b"x" * 200}),
    ):
        Image.fromarray(patches()).save(tmp_path / name, quality=90, **more)
        assert read_tags(tmp_path / name).kind == ""
        assert np.array_equal(decode_image(tmp_path / name)[0], decode_image(tmp_path / "plain.jpg")[0])


def test_adobe_rgb_is_known_by_exif_alone(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.fromarray(patches(in_space(ADOBE_RGB))).save(tmp_path / "_DSC1.JPG", quality=98, subsampling=0, exif=exif)
    assert read_tags(tmp_path / "_DSC1.JPG").kind == "Adobe RGB (1998)"
    assert middles(decode_image(tmp_path / "_DSC1.JPG")[0]) == pytest.approx(COLORS, abs=3)


@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
def test_photographs_without_exif_s_interoperability_are_read(tmp_path, monkeypatch, suffix):
    """Pillow before 13 has no empty directory for them: it raises KeyError."""
    get_ifd = Image.Exif.get_ifd

    def as_before(exif: Image.Exif, tag: int) -> dict:
        found = get_ifd(exif, tag)
        if tag == 0xA005 and not found:
            raise KeyError(tag)
        return found

    monkeypatch.setattr(Image.Exif, "get_ifd", as_before)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9003] = "2026:06:23 16:31:59"
    Image.fromarray(patches()).save(tmp_path / f"a{suffix}", exif=exif)
    assert read_tags(tmp_path / f"a{suffix}").kind == ""
    assert middles(decode_image(tmp_path / f"a{suffix}")[0]) == pytest.approx(COLORS, abs=3)


def test_transparency_stays_beside_a_profile(tmp_path):
    pixels = np.dstack([patches(in_space(DISPLAY_P3)), np.full((120, WIDE * len(COLORS)), 255, np.uint8)])
    pixels[:60, :, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=matrix_profile("P3", *DISPLAY_P3))
    found, opaque = decode_image(tmp_path / "a.png")
    assert middles(found) == pytest.approx(COLORS, abs=3)
    assert opaque is not None
    assert not opaque[:60].any()
    assert opaque[60:].all()


@pytest.mark.parametrize("missing", [1, 2])
def test_colors_become_srgb_where_a_file_lacks_its_end_marker(tmp_path, missing):
    """As decoders themselves refuse it: what passes the check is decoded too."""
    file = tmp_path / "a.jpg"
    profile = matrix_profile("Display P3", *DISPLAY_P3)
    Image.fromarray(patches(in_space(DISPLAY_P3))).save(file, quality=98, subsampling=0, icc_profile=profile)
    expected = decode_image(file)[0]
    file.write_bytes(file.read_bytes()[:-missing])
    verify_image(file)
    assert np.array_equal(decode_image(file)[0], expected)


def test_cmyk_becomes_rgb(tmp_path):
    Image.fromarray(patches()).convert("CMYK").save(tmp_path / "print.jpg", quality=98, subsampling=0)
    assert read_header(tmp_path / "print.jpg").mode == "CMYK"
    assert read_tags(tmp_path / "print.jpg").kind == "CMYK"
    assert middles(decode_image(tmp_path / "print.jpg")[0]) == pytest.approx(COLORS, abs=4)
    assert verify_image(tmp_path / "print.jpg").has_content


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", [None, "tiff_lzw", "I;16", "profile"])
def test_tiffs_are_taken_as_their_files_have_them(tmp_path, orientation, kind):
    """As all others are, although Pillow and OpenCV turn them upright by themselves."""
    file, exif = tmp_path / "a.tif", Image.Exif()
    exif[0x0112] = orientation
    pixels = patches()
    pixels[:60] //= 2
    expected = pixels
    if kind == "I;16":
        expected = pixels[..., :1].repeat(3, axis=2)
        Image.fromarray(pixels[..., 0].astype(np.uint16) * 257).save(file, exif=exif)
    elif kind == "profile":
        Image.fromarray(pixels).save(file, exif=exif, icc_profile=matrix_profile("Display P3", *DISPLAY_P3))
        plain = tmp_path / "plain.png"
        Image.fromarray(pixels).save(plain, icc_profile=matrix_profile("Display P3", *DISPLAY_P3))
        expected = decode_image(plain)[0]
    else:
        Image.fromarray(pixels).save(file, exif=exif, compression=kind)
    found, header = read_tags(file), read_header(file)
    assert found.tags[0x0112] == orientation
    assert (found.width, found.height) == (header.width, header.height) == (WIDE * len(COLORS), 120)
    assert np.array_equal(decode_image(file)[0], expected)
    assert verify_image(file).has_content


@pytest.mark.parametrize("kind", [TiffTags.BYTE, TiffTags.SHORT, TiffTags.LONG, TiffTags.LONG8])
@pytest.mark.parametrize("values", ["<u2", ">u2"])
def test_the_orientation_of_a_tiff_is_set_by_its_type_and_order_of_bytes(tmp_path, kind, values):
    """Half a number would be another one, or none."""
    file, tags = tmp_path / "a.tif", TiffImagePlugin.ImageFileDirectory_v2()
    tags.tagtype[0x0112], tags[0x0112] = kind, b"\x06" if kind == TiffTags.BYTE else 6
    gray = patches()[..., 0]
    Image.fromarray((gray.astype(np.uint16) * 257).astype(values)).save(file, tiffinfo=tags)
    assert file.read_bytes()[:2] == (b"II" if values == "<u2" else b"MM")
    assert read_tags(file).tags[0x0112] in (6, b"\x06")
    upright = without_orientation(np.fromfile(file, np.uint8)).tobytes()
    with Image.open(io.BytesIO(upright)) as image:
        assert image.getexif()[0x0112] in (1, b"\x01")
    assert np.array_equal(decode_image(file)[0], gray[..., None].repeat(3, axis=2))


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("gray", [False, True])
def test_16_bits_become_8(tmp_path, suffix, gray):
    import cv2

    pixels = patches().astype(np.uint16) * 257
    file = tmp_path / f"a{suffix}"
    cv2.imwrite(str(file), pixels[..., 0] if gray else pixels[..., ::-1])
    assert read_tags(file).kind == "16 bits a channel"
    expected = COLORS[:, :1].repeat(3, axis=1) if gray else COLORS
    assert np.array_equal(middles(decode_image(file)[0]), expected)


def test_16_bits_become_the_nearest_of_8(tmp_path):
    import cv2

    deep = np.random.default_rng(0).integers(0, 2**16, (50, 40, 3), dtype=np.uint16)
    deep.flat[:4] = 0, 128, 129, 65535
    cv2.imwrite(str(tmp_path / "a.png"), deep[..., ::-1])
    assert np.array_equal(decode_image(tmp_path / "a.png")[0], np.rint(deep / 257))


def test_12_bits_in_16_are_refused_with_the_remedy(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "a.tif"), patches()[..., 0].astype(np.uint16) * 16)
    with pytest.raises(CaptureError, match=r"no value above 3840 of 65535.*Scale"):
        decode_image(tmp_path / "a.tif")


@pytest.mark.parametrize("orientation", [1, 6])
def test_heic_is_read_with_its_tags_and_turned_once(tmp_path, orientation):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "Phone", orientation
    exif.get_ifd(0x8769)[0x9003] = "2026:06:01 10:00:00"
    shown = patches(in_space(DISPLAY_P3))
    stored = Image.fromarray(np.ascontiguousarray(np.rot90(shown)) if orientation == 6 else shown)
    profile = matrix_profile("Display P3", *DISPLAY_P3)
    stored.save(tmp_path / "IMG_1.HEIC", quality=95, chroma=444, icc_profile=profile, exif=exif.tobytes())
    tags = read_tags(tmp_path / "IMG_1.HEIC")
    assert (tags.width, tags.height, tags.tags.get(0x0112, 1)) == (shown.shape[1], shown.shape[0], 1)
    assert (tags.kind, tags.tags[0x0110]) == ("HEIC, Display P3", "Phone")
    assert middles(decode_image(tmp_path / "IMG_1.HEIC")[0]) == pytest.approx(COLORS, abs=4)
    assert date_taken(tmp_path / "IMG_1.HEIC") == "2026:06:01 10:00:00"
    assert verify_image(tmp_path / "IMG_1.HEIC").has_content
    (tmp_path / "IMG_1.HEIC").rename(tmp_path / "IMG_1.JPG")  # as some phones call it
    assert middles(decode_image(tmp_path / "IMG_1.JPG")[0]) == pytest.approx(COLORS, abs=4)


def test_raw_files_are_developed_alike(tmp_path):
    """Colors by daylight's white balance whatever the camera thought, and half the light is half as bright."""
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.DNG", patches(), orientation=6, lat_lon=(-33.5, -70.6), xmp=b'<r d:RelativeAltitude="40"/>')
    write_dng(tmp_path / "b.DNG", patches(), as_shot=(0.7, 1.0, 0.3))
    write_dng(tmp_path / "c.DNG", patches(), exposure=0.5)
    one, other, dark = (decode_image(tmp_path / name)[0] for name in ("a.DNG", "b.DNG", "c.DNG"))
    assert middles(one) == pytest.approx(COLORS, abs=2)
    assert np.array_equal(one, other)
    linear = [np.mean(((middles(each)[3:5] / 255 + 0.055) / 1.055) ** 2.4) for each in (one, dark)]
    assert linear[1] / linear[0] == pytest.approx(0.5, abs=0.02)
    tags = read_tags(tmp_path / "a.DNG")
    assert (tags.kind, tags.width, tags.height, tags.tags[0x0112]) == ("raw", WIDE * len(COLORS), 120, 6)
    assert (tags.gps[1], float(tags.gps[2][0]), tags.xmp_packet) == ("S", 33.0, b'<r d:RelativeAltitude="40"/>')
    assert date_taken(tmp_path / "a.DNG") == "2026:06:01 10:00:00"
    assert read_header(tmp_path / "a.DNG").width == WIDE * len(COLORS)


def test_raw_files_that_are_damaged_are_named(tmp_path):
    pytest.importorskip("rawpy")
    (tmp_path / "a.dng").write_bytes(b"II*\0" + bytes(100))
    for read in (read_header, decode_image, verify_image, read_tags):
        with pytest.raises(CaptureError, match=r"a\.dng: LibRaw cannot read the raw file"):
            read(tmp_path / "a.dng")


def test_other_kinds_beside_a_picture_of_the_same_name_are_not_taken(tmp_path):
    for name in ("a.JPG", "a.DNG", "b.DNG", "c.heic"):
        (tmp_path / name).touch()
    assert "a.DNG" not in find_images(tmp_path)


@pytest.mark.parametrize(("name", "package"), [("a.dng", "rawpy"), ("a.heic", "pillow-heif")])
def test_without_a_decoder_the_message_says_what_installs_it(tmp_path, monkeypatch, name, package):
    def absent(module: str) -> None:
        raise ModuleNotFoundError(f"No module named '{module}'")

    optional_decoders._register_heif.cache_clear()
    monkeypatch.setattr(optional_decoders.importlib, "import_module", absent)
    (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    for read in (read_header, decode_image):
        with pytest.raises(CaptureError, match=rf"needs {package} .*: pip install 'vdgs\[photos\]'"):
            read(tmp_path / name)
    optional_decoders._register_heif.cache_clear()


def write_tiff(file, channels: np.ndarray, **more) -> None:
    """A TIFF of channels [h, w, n] as GDAL writes it."""
    import rasterio

    height, width, count = channels.shape
    more["transform"] = rasterio.Affine.scale(2)
    shape = {"driver": "GTiff", "width": width, "height": height, "count": count, "dtype": channels.dtype.name}
    with rasterio.open(file, "w", **(shape | more)) as picture:
        for k in range(count):
            picture.write(channels[..., k], k + 1)


@pytest.mark.parametrize("factor", [1, 257])
@pytest.mark.parametrize(("alpha", "is_mask"), [("no", False), ("unspecified", False), ("yes", True)])
def test_the_fourth_channel_of_a_tiff_is_transparency_where_its_tags_say_so(tmp_path, factor, alpha, is_mask):
    """Near infrared, as cameras of four bands write it, hides nothing."""
    fourth = np.full((120, WIDE * len(COLORS), 1), 255)
    fourth[:, : WIDE * 2] = 0
    channels = (np.concatenate([patches(), fourth], axis=2) * factor).astype(np.uint8 if factor == 1 else np.uint16)
    write_tiff(tmp_path / "a.tif", channels, photometric="RGB", alpha=alpha)
    pixels, opaque = decode_image(tmp_path / "a.tif")
    assert read_tags(tmp_path / "a.tif").has_alpha_channel == verify_image(tmp_path / "a.tif").has_alpha_channel
    assert (opaque is not None) == read_tags(tmp_path / "a.tif").has_alpha_channel == is_mask
    assert ("the first 3 of 4 channels" in read_tags(tmp_path / "a.tif").kind) != is_mask
    assert np.allclose(middles(pixels)[2:], COLORS[2:], atol=1)
    if opaque is not None:
        assert np.array_equal(opaque, fourth[..., 0] > 0)


def test_a_tiff_of_gray_keeps_its_transparency(tmp_path):
    gray, fourth = Image.fromarray(patches()[..., 0]), patches()[..., 1]
    gray.putalpha(Image.fromarray(fourth))
    gray.save(tmp_path / "a.tif")
    assert np.array_equal(decode_image(tmp_path / "a.tif")[1], fourth >= 128)


def test_channels_of_16_bits_one_behind_the_other_are_refused(tmp_path):
    """Decoders mix them up."""
    write_tiff(tmp_path / "a.tif", patches().astype(np.uint16) * 257, photometric="RGB", interleave="BAND")
    with pytest.raises(CaptureError, match="3 channels of 16 bits, one behind the other: save red"):
        read_header(tmp_path / "a.tif")


def test_values_of_12_bits_are_scaled_by_the_white_that_their_tag_says(tmp_path):
    """4095 is the white of 12 bits; other values are the largest of a picture: by those scales differ."""
    values = ((patches()[..., 0].astype(np.uint32) * 4095 + 127) // 255).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "a.tif", tiffinfo={281: 4095})
    assert np.abs(middles(decode_image(tmp_path / "a.tif")[0])[:, 0] - COLORS[:, 0]).max() <= 1
    Image.fromarray(values * 4).save(tmp_path / "b.tif", tiffinfo={281: int(values.max()) * 4 - 3})
    assert np.abs(middles(decode_image(tmp_path / "b.tif")[0])[:, 0] - COLORS[:, 0] / 4).max() <= 1
