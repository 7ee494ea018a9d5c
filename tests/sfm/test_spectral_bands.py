"""Multispectral sets: which pictures are of one band, and which of a set are used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.flights import write_photograph
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


def bands(folder: Path, names: list[str], xmp: str = "") -> None:
    for k, name in enumerate(names):
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "Bands"
        exif.get_ifd(0x8769)[0x920A] = 5.4
        gray = noise(k)[..., 0].astype(np.uint16) * 257
        more = {0x02BC: (xmp % k).encode()} if xmp else {}
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
