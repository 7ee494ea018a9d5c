"""Photographs of which a part is missing: their ends, or what lies in the middle."""

from __future__ import annotations

import io
import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from support.small_flights import flight, picture, pixels, said
from vdgs.captures.image_files import decode_image, verify_image
from vdgs.captures.jpeg import lacks_only_end
from vdgs.errors import CaptureError
from vdgs.sfm.feature_extraction import write_upright_images
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.image_metadata import UnusableImage, read_image_metadata
from vdgs.sfm.workspace import Workspace


def jpeg(kind: str) -> bytes:
    shown = Image.fromarray(pixels(3, 320, 240))
    more = {
        "plain": {"format": "JPEG"}, "progressive": {"format": "JPEG", "progressive": True},
        "restarts": {"format": "JPEG", "restart_marker_rows": 1}, "gray": {"format": "JPEG"},
        "several": {"format": "MPO", "save_all": True, "append_images": [shown.resize((160, 120))]},
        "with a preview": {"format": "JPEG"},
    }[kind]  # fmt: skip
    if kind == "gray":
        shown = shown.convert("L")
    file = io.BytesIO()
    shown.save(file, quality=90, **more)
    content = file.getvalue()
    if kind == "with a preview":  # whose own end is in the tags
        small = io.BytesIO()
        shown.resize((80, 60)).save(small, "JPEG")
        tag = b"Preview\0" + small.getvalue()
        content = content[:2] + b"\xff\xe5" + struct.pack(">H", len(tag) + 2) + tag + content[2:]
    return content


KINDS = ["plain", "progressive", "restarts", "gray", "several", "with a preview"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_what_is_cut_off_is_named_in_every_kind_of_jpeg(tmp_path, kind, share):
    content, file = jpeg(kind), tmp_path / "a.jpg"
    first = content.index(b"\xff\xd9\xff\xd8") if kind == "several" else len(content)
    file.write_bytes(content[: int(share * first)])
    with pytest.raises(UnusableImage, match=r"cut off|damaged"):
        read_image_metadata(file, file.name)
    with pytest.raises(CaptureError):
        verify_image(file)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "several"])
@pytest.mark.parametrize("missing", [1, 2])
def test_what_lacks_its_end_alone_is_used_with_a_note(tmp_path, kind, missing):
    content, file = jpeg(kind), tmp_path / "a.jpg"
    file.write_bytes(content[:-missing])
    assert lacks_only_end(file)
    assert not read_image_metadata(file, file.name).whole
    assert verify_image(file).has_content
    shown = decode_image(file)[0]
    file.write_bytes(content)
    assert np.array_equal(shown, decode_image(file)[0])
    assert read_image_metadata(file, file.name).whole
    file.write_bytes(content + b"\0" * 500)  # what makers put behind it
    assert read_image_metadata(file, file.name).whole


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "several"])
def test_zeros_that_a_rescued_file_is_filled_up_with_are_no_pixels(tmp_path, kind):
    content, file = jpeg(kind), tmp_path / "a.jpg"
    file.write_bytes(content[: int(0.7 * len(content))] + bytes(len(content)))
    with pytest.raises(UnusableImage, match="cut off"):
        read_image_metadata(file, file.name)


@pytest.mark.parametrize("orientation", [1, 6])
def test_photographs_without_an_end_go_on_whole(tmp_path, orientation):
    names = flight(tmp_path / "card", orientation=orientation)
    whole = cv2.imread(str(tmp_path / "card" / names[0]), cv2.IMREAD_UNCHANGED)
    for name in names:
        file = tmp_path / "card" / name
        file.write_bytes(file.read_bytes()[:-2])
    found = collect_images([tmp_path / "card"])
    assert any("lacks its end marker, but nothing of the picture; used" in each for each in said(found))
    work = Workspace(tmp_path / "work")
    assert write_upright_images(work, found.images, 1) == []
    with Image.open(work.images / names[0]) as image:
        image.load()
        assert image.size == ((160, 120) if orientation == 1 else (120, 160))
    if orientation == 1:
        assert np.array_equal(cv2.imread(str(work.images / names[0]), cv2.IMREAD_UNCHANGED), whole)


def test_a_png_that_is_damaged_is_left_out_before_its_features_are_searched(tmp_path, capfd):
    """COLMAP takes what it can read of one, and the end of the work would fail."""
    exif = Image.Exif()
    exif[0x0110] = "Drone"
    for k in range(5):
        picture(tmp_path / "card" / f"{k}.png", pixels(k), exif=exif)
    whole = (tmp_path / "card/1.png").read_bytes()
    (tmp_path / "card/1.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "card/2.png").write_bytes(whole[: len(whole) // 3] + bytes(8) + whole[len(whole) // 3 + 8 :])
    work = Workspace(tmp_path / "work")
    failed = write_upright_images(work, collect_images((tmp_path / "card",)).images, 2)
    assert [each.name for each in failed] == ["1.png", "2.png"]
    assert all(each.reason.startswith("cannot be decoded (") for each in failed)
    assert sorted(path.name for path in work.images.iterdir()) == ["0.png", "3.png", "4.png"]
    assert capfd.readouterr().err == ""
