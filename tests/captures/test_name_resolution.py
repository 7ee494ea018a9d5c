"""Which names mean the same photograph: in tables of positions, lists, masks, and on cards of other systems."""

from __future__ import annotations

import unicodedata
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.captures import tiny_scene, write_colmap
from support.flights import write_photograph
from vdgs.captures.georeference import match_gps
from vdgs.captures.loading import load_capture
from vdgs.captures.name_resolution import ImageNameIndex, NameLookup, match_key, to_colmap_name
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images

#: Two photographs of one name, as cards have them.
CARD = ["100MEDIA/DJI_0001.JPG", "100MEDIA/DJI_0002.JPG", "101MEDIA/DJI_0001.JPG"]
NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)


def apart(name: str) -> str:
    """As macOS writes it: letters and their accents apart."""
    return unicodedata.normalize("NFD", name)


def matched(tmp_path: Path, names: list[str], *rows: str) -> dict[str, float]:
    """The numbers that a table gives photographs, of rows `name` and `number`: its latitudes are ten metres apart."""
    file, parted = tmp_path / "gps.csv", [row.rpartition(",") for row in rows]
    lines = [f"{name},{40 + 1e-4 * int(number):.4f},20,5\n" for name, _, number in parted]
    file.write_text("name,lat,lon,alt\n" + "".join(lines), encoding="utf-8")
    found = match_gps(names, file)
    latitudes = found.geodetic[:, 0]
    return {names[index]: round((place - 40) * 1e4) for index, place in zip(found.images, latitudes, strict=True)}


def card(folder: Path, *names: str) -> Path:
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_photograph(folder / name, np.roll(NOISE, k, axis=0), k, None)
    return folder


def test_no_name_in_a_capture_is_a_comment_of_colmaps_lists(tmp_path):
    assert [to_colmap_name(name) for name in ("#1.jpg", "a#1.jpg", "# 2.jpg")] == ["_1.jpg", "a#1.jpg", "__2.jpg"]
    found = collect_images([card(tmp_path, "#1.JPG", "b#2.JPG", "c.JPG")])
    assert [photo.name for photo in found.images] == ["_1.JPG", "b#2.JPG", "c.JPG"]


# ------------------------------------------------------------------------------------ tables of positions


@pytest.mark.parametrize("top", ["", "DCIM/", "/Volumes/SD/DCIM/", ".\\"])
def test_photographs_of_one_name_keep_their_own_positions(tmp_path, top):
    rows = [f"{top}{name.lower()},{k}" for k, name in enumerate(CARD)]
    assert matched(tmp_path, CARD, *rows) == {name: k for k, name in enumerate(CARD)}
    assert matched(tmp_path, [f"flight/{name}" for name in CARD], *[f"{name},{k}" for k, name in enumerate(CARD)]) == {
        f"flight/{name}": k for k, name in enumerate(CARD)
    }


def test_a_name_that_may_be_of_two_photographs_is_refused_with_what_to_write(tmp_path):
    said = (
        r"gps\.csv: line 3: 'DJI_0001\.JPG' may be 100MEDIA/DJI_0001\.JPG or 101MEDIA/DJI_0001\.JPG: write the folder"
    )
    with pytest.raises(CaptureError, match=said):
        matched(tmp_path, CARD, "DJI_0002.JPG,1", "DJI_0001.JPG,2")
    with pytest.raises(CaptureError, match=r"may be x\.jpg or x\.png: write it as it stands here"):
        matched(tmp_path, ["x.jpg", "x.png"], "x,1")


@pytest.mark.parametrize("rows", [("x 1.jpg,1", "X\t1.jpg,2"), ("100MEDIA/x_1.jpg,1", "101MEDIA/x_1.jpg,2")])
def test_rows_that_place_one_photograph_differently_are_refused(tmp_path, rows):
    with pytest.raises(CaptureError, match=r"gps\.csv: lines 2 and 3 .* give x_1\.jpg different positions"):
        matched(tmp_path, ["x_1.jpg", "y.jpg"], *rows)
    assert matched(tmp_path, ["x_1.jpg", "y.jpg"], rows[0], rows[0]) == {"x_1.jpg": 1}


def test_rows_of_other_photographs_take_no_part(tmp_path):
    """A table of a whole card, a capture of some of it."""
    rows = [f"{name},{k}" for k, name in enumerate(CARD)]
    assert matched(tmp_path, CARD[1:], *rows) == {CARD[1]: 1, CARD[2]: 2}  # not the position of its namesake
    assert matched(tmp_path, CARD[:2], *rows, "DJI_0001.JPG,9") == {CARD[0]: 0, CARD[1]: 1}
    assert matched(tmp_path, ["x.jpg"], "x.dng,1", "x.tif,2", "x.jpg,3") == {"x.jpg": 3}


def test_other_folders_and_extensions_still_match(tmp_path):
    assert matched(tmp_path, CARD[:2], "raw/DJI_0001.DNG,1", "raw/dji_0002,2") == {CARD[0]: 1, CARD[1]: 2}
    with pytest.raises(CaptureError, match=r"'raw/DJI_0001\.DNG' may be 100MEDIA"):
        matched(tmp_path, CARD, "raw/DJI_0001.DNG,1")


def test_blanks_and_accents_are_alike_in_tables_and_photographs(tmp_path):
    folder = card(tmp_path / "card", "höhe  0.jpg", "x 1.jpg", apart("é/x 1.jpg"))
    names = [photo.name for photo in collect_images([folder]).images]
    assert names == ["höhe__0.jpg", "x_1.jpg", "é/x_1.jpg"]
    table = tmp_path / "gps.csv"
    rows = ["Höhe  0.jpg,1", "x 1.jpg,1.001", "É/x 1.jpg,1.002"]
    for way in (lambda text: text, apart):
        table.write_text(way("name,lat,lon,alt\n" + "".join(f"{row},20,5\n" for row in rows)), encoding="utf-8")
        found = read_gps_priors(collect_images([folder]).images, table, (1, 2))
        assert found.image_indices.tolist() == [0, 1, 2]
        assert np.diff(found.enu[:, 1]) == pytest.approx([110, 110], rel=0.02)


@given(st.lists(st.text("ab é\u0301.", min_size=1, max_size=4), min_size=1, max_size=3))
def test_every_name_finds_itself_however_its_letters_are_written(parts):
    name = "/".join(parts)
    lookup = NameLookup([(name, 1), ("other.jpg", 2)])
    for written in (name, apart(name), to_colmap_name(name), to_colmap_name(name).upper()):
        assert 1 in lookup.find(written)[1]
    assert match_key(apart(name)) == match_key(name)


# ------------------------------------------------------------------------------------------- cards, captures


@pytest.mark.parametrize("names", [("x 0.jpg", "x_0.jpg"), ("é.jpg", apart("é.jpg"))], ids=["blanks", "accents"])
def test_names_that_become_one_are_refused(tmp_path, names):
    folder = card(tmp_path / "card", *names, "y.jpg", "z.jpg")
    if len(list(folder.iterdir())) < 4:
        pytest.skip("this file system holds one of the two only")
    with pytest.raises(CaptureError, match=r"would be called .* Rename one of the two"):
        collect_images([folder])


def test_folders_that_become_one_are_numbered(tmp_path):
    card(tmp_path, *(f"{folder}/x.jpg" for folder in ("a b", "a_b")), "a_b/y.jpg")
    seen = collect_images([tmp_path / "a b", tmp_path / "a_b"])
    assert {photo.name.split("/")[0] for photo in seen.images} == {"a_b_1", "a_b_2"}


def test_images_and_masks_are_found_however_their_letters_are_written(tmp_path):
    scene = tiny_scene(columns=3, rows=2)
    scene = replace(scene, cameras={f"é_{name}": camera for name, camera in scene.cameras.items()})
    write_colmap(tmp_path, scene)
    (tmp_path / "masks").mkdir()
    for name in scene.cameras:
        (tmp_path / "images" / name).rename(tmp_path / "images" / apart(name))
        cv2.imwrite(str(tmp_path / "masks" / apart(name)), np.full((48, 64), 255, np.uint8))
    first = min(scene.cameras)
    (tmp_path / "test.txt").write_text(apart(first) + "\n", encoding="utf-8")
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert all(view.mask_path is not None and view.image_path.is_file() for view in capture.views)
    assert [view.name for view in capture.test_views] == [first]
    assert capture.warnings == ()


def test_the_same_letters_come_before_the_same_stem():
    names = ImageNameIndex({apart("é.jpg"): Path(), "é.png": Path()})
    assert names.find("é.jpg") == apart("é.jpg")
    assert names.find("é.tif") is None
