"""Positions in files beside photographs whose own tags were stripped."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vdgs.captures.image_files import find_images
from vdgs.sfm import image_list
from vdgs.sfm.image_metadata import read_image_metadata
from vdgs.sfm.sidecars import list_folder, with_sidecars

NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)


@pytest.mark.parametrize(
    ("photo", "beside"),
    [
        ("IMG_1.jpg", "IMG_1.jpg.supplemental-metadata.json"),
        ("IMG_1(2).jpg", "IMG_1.jpg.supplemental-metadata(2).json"),
        ("PXL_20240612_101112131-edited.jpg", "PXL_20240612_101112131.jpg.supplemental-metada.json"),
        ("DJI_1.jpg", "DJI_1.jpg.json"),
        ("IMG_1-modifié.jpg", "IMG_1.jpg.json"),
        ("IMG_1-edited(1).jpg", "IMG_1.jpg.supplemental-metadata(1).json"),
        ("IMG_1.jpg", "IMG_1.HEIC.json"),
        ("IMG_1.jpg", "IMG_1.heic.supplemental-metadata.json"),
        ("IMG_1.jpg", "IMG_1.xmp"),
        ("IMG_1.jpg", "IMG_1.jpg.xmp"),
    ],
)
def test_positions_of_files_beside_stripped_photographs_are_used(tmp_path, photo, beside):
    Image.fromarray(NOISE).save(tmp_path / photo)
    geo = {"latitude": 30.5, "longitude": -104.25, "altitude": 486.5}
    content = {"geoData": {**geo, "latitude": 31.0}, "geoDataExif": geo, "photoTakenTime": {"timestamp": "1258375918"}}
    xmp = '<rdf:Description exif:GPSLatitude="30,30.0N" exif:GPSLongitude="104,15.0W" exif:GPSAltitude="4865/10"/>'
    (tmp_path / beside).write_text(xmp if beside.endswith("xmp") else json.dumps(content))
    found = with_sidecars(read_image_metadata(tmp_path / photo, photo))
    assert (found.lat_lon, found.altitude) == (pytest.approx((30.5, -104.25)), 486.5)
    assert found.datetime == ("" if beside.endswith("xmp") else "2009:11:16 12:51:58")
    assert beside in found.doubts[0]
    (tmp_path / beside).write_text("[[" if beside.endswith("json") else "<")
    assert with_sidecars(read_image_metadata(tmp_path / photo, photo)).lat_lon is None


def test_the_json_of_another_file_that_is_there_is_not_taken(tmp_path):
    Image.fromarray(NOISE).save(tmp_path / "x.jpg")
    for name, latitude in (("x.PNG.json", 10.0), ("x.tif.json", 20.0), ("x.HEIC.json", 30.0)):
        (tmp_path / name).write_text(json.dumps({"geoData": {"latitude": latitude, "longitude": 5.0}}))
    (tmp_path / "x.PNG").touch()
    photo = read_image_metadata(tmp_path / "x.jpg", "x.jpg")
    assert with_sidecars(photo).lat_lon == (30.0, 5.0)  # what phones take is the likeliest
    for gone, place in (("x.HEIC.json", (20.0, 5.0)), ("x.tif.json", None)):
        (tmp_path / gone).unlink()
        assert with_sidecars(photo).lat_lon == place


@pytest.mark.parametrize("ending", ["HEIC", "heif", "avif", "DNG"])
def test_the_json_of_a_file_that_a_jpeg_beside_it_replaces_is_taken(tmp_path, ending):
    Image.fromarray(NOISE).save(tmp_path / "x.jpg")
    (tmp_path / f"x.{ending}").touch()
    place = {"geoData": {"latitude": 30.0, "longitude": 5.0}}
    (tmp_path / f"x.{ending}.supplemental-metadata.json").write_text(json.dumps(place))
    assert list(find_images(tmp_path)) == ["x.jpg"]
    assert with_sidecars(read_image_metadata(tmp_path / "x.jpg", "x.jpg")).lat_lon == (30.0, 5.0)


def test_a_folder_is_not_listed_for_each_photograph(tmp_path, monkeypatch):
    """At most once in each of the threads that begin together."""
    for k in range(12):
        Image.fromarray(np.roll(NOISE, 10 * k, 1)).save(tmp_path / f"{k}.jpg")
    asked = list[Path]()

    def listed(folder: Path) -> Mapping[str, Path]:
        asked.append(folder)
        return list_folder(folder)

    monkeypatch.setattr(image_list, "list_folder", listed)
    assert len(image_list.collect_images([tmp_path]).images) == 12
    assert set(asked) == {tmp_path}
    assert len(asked) <= 4
