"""Multispectral sets: which pictures are of one band, and which of a set are used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.flights import write_photograph
from vdgs.errors import CaptureError
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.xmp import read_xmp

COUNT = 6


def noise(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (120, 160, 3), np.uint8)


def flight(folder: Path) -> list[str]:
    names = [f"DJI_{k + 1:04d}.JPG" for k in range(COUNT)]
    for k, name in enumerate(names):
        write_photograph(folder / name, noise(k), k, np.array((10.0 * (k % 3), 12.0 * (k // 3), 40.0)))
    return names


def bands(folder: Path, names: list[str], xmp: str = "", size: tuple[int, int] = (160, 120)) -> None:
    for k, name in enumerate(names):
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "Bands"
        exif.get_ifd(0x8769)[0x920A] = 5.4
        gray = np.kron(noise(k)[..., 0], np.ones((2, 2)))[: size[1], : size[0]].astype(np.uint16) * 257
        more = {0x02BC: (xmp % k).encode(), 0x010F: "Maker", 0x0110: "Bands"} if xmp else {}
        Image.fromarray(gray).save(folder / name, exif=exif, tiffinfo=more)


@pytest.mark.parametrize(
    "tails", [("_MS_G.TIF", "_MS_R.TIF", "_MS_RE.TIF", "_MS_NIR.TIF"), ("_GRE.TIF", "_RED.TIF", "_REG.TIF", "_NIR.TIF")]
)
def test_of_a_multispectral_set_the_color_photographs_are_used(tmp_path, tails):
    names = flight(tmp_path)
    bands(tmp_path, [f"DJI_{k + 1:04d}{tail}" for k in range(COUNT) for tail in tails])
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert len(found.excluded) == COUNT * len(tails)
    assert any(
        "Green (6), NIR (6), Red (6), Red edge (6); the 6 color photographs beside them are used" in note
        for note in found.notes
    )


def test_of_a_multispectral_set_without_color_one_band_is_used(tmp_path):
    bands(tmp_path, [f"IMG_{k:04d}_{band}.tif" for k in range(COUNT) for band in range(1, 6)])
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == [f"IMG_{k:04d}_2.tif" for k in range(COUNT)]
    assert any("Green is used, in gray" in note for note in found.notes)
    for file in tmp_path.glob("*_[!4].tif"):
        file.unlink()
    assert len(collect_images([tmp_path]).images) == COUNT  # what is given alone is meant


def test_bands_are_known_by_their_tags(tmp_path):
    """DJI's P4 Multispectral numbers its pictures; color cameras list three bands."""
    flight(tmp_path)
    packet = "<Camera:BandName><rdf:Seq><rdf:li>Blue %d</rdf:li></rdf:Seq></Camera:BandName>"
    bands(tmp_path, [f"DJI_{k:04d}.TIF" for k in (12, 13)], packet)
    excluded = {each.name: each.reason for each in collect_images([tmp_path]).excluded}
    assert excluded["DJI_0012.TIF"].startswith("is of the band Blue 0;")
    three = packet % 0 + packet.replace("</rdf:li>", "</rdf:li><rdf:li>Red</rdf:li>") % 0
    assert "Camera:BandName" not in read_xmp(three.partition("</Camera:BandName>")[2].encode())


def test_bands_that_were_saved_as_color_are_known_by_their_tags_and_their_gray(tmp_path):
    names = flight(tmp_path)
    for k in range(COUNT):
        for band in ("Green", "NIR"):
            gray = Image.fromarray(noise(k)[..., 0]).convert("RGB")
            gray.save(tmp_path / f"IMG_{k:04d}_{band}.jpg", xmp=f'<x Camera:BandName="{band}"/>'.encode())
    with Image.open(tmp_path / names[0]) as first:  # a color photograph that names a band is none of a band
        first.save(tmp_path / names[0], exif=first.info["exif"], xmp=b'<x Camera:BandName="Green"/>', quality=95)
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert any("Green (6), NIR (6); the 6 color photographs" in note for note in found.notes)


@pytest.mark.parametrize(
    ("size", "band", "used"), [((128, 100), "LWIR", 2), ((320, 240), "Panchro", 6), ((160, 120), "band 6", 2)]
)
def test_the_sixth_band_is_known_by_its_size(tmp_path, size, band, used):
    """Altum's is thermal and smaller, RedEdge-P's panchromatic and larger, the tenfold RedEdge's another blue."""
    bands(tmp_path, [f"IMG_{k:04d}_{number}.tif" for k in range(COUNT) for number in range(1, 7)])
    if size != (160, 120):
        bands(tmp_path, [f"IMG_{k:04d}_6.tif" for k in range(COUNT)], size=size)
    found = collect_images([tmp_path])
    assert {photo.name for photo in found.images} == {f"IMG_{k:04d}_{used}.tif" for k in range(COUNT)}
    assert any(f"{band} (6)" in note for note in found.notes)


@pytest.mark.parametrize("tags", [True, False])
def test_color_and_a_band_are_not_used_together(tmp_path, tags):
    """The photographs in color are used, whether or not tags say their camera, unless those of the band are more."""
    colors = [f"IMG_{k:04d}_RGB.JPG" for k in range(COUNT)]
    for k, name in enumerate(colors):
        exif = Image.Exif()
        if tags:
            exif[0x010F], exif[0x0110] = "Parrot", "Sequoia"
        Image.fromarray(noise(k)).save(tmp_path / name, exif=exif, quality=95)
    bands(tmp_path, [f"IMG_{k:04d}_{band}.TIF" for k in range(COUNT) for band in ("GRE", "NIR")])
    assert [photo.name for photo in collect_images([tmp_path]).images] == colors
    (tmp_path / colors.pop()).unlink()
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == (
        colors if tags else [f"IMG_{k:04d}_GRE.TIF" for k in range(COUNT)]
    )
    if not tags:
        reasons = {each.name: each.reason for each in found.excluded}
        assert "none of the band Green" in reasons[colors[0]]


@pytest.mark.parametrize(
    ("band", "color"),
    [
        ("IMG_{:04d}_NIR.TIF", "IMG_{:04d}_RGB.JPG"),
        ("a{:04d}_REG.TIF", "b{:04d}.JPG"),
        ("IMG_{:04d}_1.tif", "IMG_{:04d}.jpg"),
        ("p{:04d}_RED.TIF", "p{:04d}_RGB.JPG"),
        ("IMG_{:04d}_1.tif", "frame{:04d}.jpg"),
        ("shed{:04d}_RED.TIF", "frame{:04d}.jpg"),
    ],
)
def test_one_band_beside_color_is_known_by_a_clear_word_or_the_photographs_of_its_shots(tmp_path, band, color):
    colors, grays = [[name.format(k) for k in range(COUNT)] for name in (color, band)]
    for k, name in enumerate(colors):
        Image.fromarray(noise(k)).save(tmp_path / name, quality=95)
    for k, name in enumerate(grays):
        Image.fromarray(noise(20 + k)[..., 0]).save(tmp_path / name)
    found = {photo.name for photo in collect_images([tmp_path]).images}
    assert found == {*colors} | ({*grays} if color.startswith("frame") else set())


@pytest.mark.parametrize(
    ("sure", "number", "size", "color"),
    [
        (True, COUNT, (160, 120), False),  # maps of an index
        (True, 2 * COUNT, (160, 120), False),
        (True, 3 * COUNT, (160, 120), True),  # frames of a film
        (False, COUNT, (160, 120), True),
        (False, COUNT, (100, 100), False),  # previews
    ],
)
def test_pictures_without_tags_that_may_be_made_of_a_set_are_not_used_instead(tmp_path, sure, number, size, color):
    names = [f"x{k:02d}.png" for k in range(number)]
    for k, name in enumerate(names):
        Image.fromarray(noise(k)[: size[1], : size[0]]).save(tmp_path / name)
    packet = "<Camera:BandName><rdf:Seq><rdf:li>{}</rdf:li></rdf:Seq></Camera:BandName><!-- %d -->"
    grays = [f"IMG_{k:04d}_{band}.tif" for band in (2, 4) for k in range(COUNT)]
    bands(tmp_path, grays)
    if sure:
        bands(tmp_path, grays[:COUNT], packet.format("Green"))
        bands(tmp_path, grays[COUNT:], packet.format("NIR"))
    used = {photo.name for photo in collect_images([tmp_path]).images}
    assert used == ({*names} if color else {f"IMG_{k:04d}_2.tif" for k in range(COUNT)})


@pytest.mark.parametrize("size", [(160, 120), (100, 100)])
def test_one_picture_of_a_band_does_not_win_over_photographs_without_tags(tmp_path, size):
    names = [f"x{k:02d}.jpg" for k in range(COUNT)]
    for k, name in enumerate(names):
        Image.fromarray(noise(k)[: size[1], : size[0]]).save(tmp_path / name, quality=95)
    bands(tmp_path, ["DJI_0001_MS_NIR.TIF"])
    assert [photo.name for photo in collect_images([tmp_path]).images] == names


@pytest.mark.parametrize(
    "names",
    [["IMG_0001_2.jpg"], ["shed_red.jpg"], ["IMG_0001_2.jpg", "IMG_0002_2.jpg"], ["IMG_0001_1.jpg", "a_NIR.jpg"]],
)
def test_a_few_gray_pictures_with_the_name_of_a_band_are_no_set(tmp_path, names):
    """Beside photographs without tags."""
    for k in range(COUNT):
        Image.fromarray(noise(k)).save(tmp_path / f"frame{k}.jpg", quality=95)
    for k, name in enumerate(names):
        Image.fromarray(noise(20 + k)[..., 0]).save(tmp_path / name, quality=95)
    found = collect_images([tmp_path])
    assert len(found.images) == COUNT + len(names)
    assert not any("single bands" in note for note in found.notes)


def test_of_a_tiff_of_five_channels_it_is_said_what_it_is(tmp_path):
    import rasterio

    for k in range(COUNT):
        shape = {
            "driver": "GTiff",
            "width": 160,
            "height": 120,
            "count": 5,
            "dtype": "uint16",
            "transform": rasterio.Affine.scale(2),
        }
        with rasterio.open(tmp_path / f"{k}.tif", "w", **shape) as file:
            for band in range(5):
                file.write(noise(k)[..., band % 3].astype(np.uint16) * 257, band + 1)
    with pytest.raises(CaptureError, match=r"0\.tif: is a TIFF of 5 channels of 16 bits: save red, green and blue"):
        collect_images([tmp_path])


def test_that_no_value_is_bright_is_said_before_the_work(tmp_path):
    for k in range(COUNT):
        Image.fromarray(noise(k)[..., 0].astype(np.uint16) * 16).save(tmp_path / f"{k}.tif")
    with pytest.raises(CaptureError, match=r"0\.tif: has 16 bits a pixel, of which it uses no value above .*Scale"):
        collect_images([tmp_path])
    flight(tmp_path)
    assert any("no value above" in note and "3 of 3 looked at" in note for note in collect_images([tmp_path]).notes)


def test_why_a_folder_shows_no_photographs_is_said(tmp_path):
    (tmp_path / "zipped").mkdir()
    (tmp_path / "zipped" / "photos.tar.gz").write_bytes(b"x")
    with pytest.raises(CaptureError, match=r"1 other file\. Unpack photos\.tar\.gz"):
        collect_images([tmp_path / "zipped"])
    with pytest.raises(CaptureError, match=r"photos\.tar\.gz: is an archive\. Unpack it"):
        collect_images([tmp_path / "zipped" / "photos.tar.gz"])
    (tmp_path / "named").mkdir()
    for k, name in enumerate(("ortho_1.jpg", "ortho_2.jpg", "DEM_3.jpg")):
        Image.fromarray(noise(k)).save(tmp_path / "named" / name)
    with pytest.raises(CaptureError, match=r"3 images that are left out by their names: DEM_3\.jpg is a map.*Rename"):
        collect_images([tmp_path / "named"])
