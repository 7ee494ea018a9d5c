"""XMP wherever cameras and programs put it in files of photographs."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from vdgs.captures.image_tags import read_tags
from vdgs.captures.xmp_packets import MAX_XMP_BYTES
from vdgs.sfm.xmp import read_xmp

NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
STANDARD, EXTENSION = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
GUID = b"0123456789ABCDEF0123456789ABCDEF"
DRONE = b'<rdf:Description drone-dji:RelativeAltitude="+39.80" drone-dji:GimbalPitchDegree="-90.0"/>'
RATING = b'<rdf:Description xmp:Rating="3" drone-dji:GimbalPitchDegree="-45.0"/>'
NAMES_IT = b'<rdf:Description xmpNote:HasExtendedXMP="' + GUID + b'"/>'


def part(packet: bytes, start: int, end: int, guid: bytes = GUID) -> bytes:
    return EXTENSION + guid + struct.pack(">II", len(packet), start) + packet[start:end]


def jpeg(file: Path, *segments: bytes) -> Path:
    Image.fromarray(NOISE).save(file, "JPEG")
    content = file.read_bytes()
    inserted = b"".join(b"\xff\xe1" + struct.pack(">H", len(each) + 2) + each for each in segments)
    file.write_bytes(content[:2] + inserted + content[2:])
    return file


def altitude(file: Path) -> str | None:
    return read_xmp(read_tags(file).xmp_packet).get("drone-dji:RelativeAltitude")


@pytest.mark.parametrize(
    "segments",
    [
        pytest.param([STANDARD + DRONE], id="one"),
        pytest.param([STANDARD + RATING, STANDARD + DRONE], id="the second"),
        pytest.param([STANDARD + RATING + b" " * 60_000] * 4 + [STANDARD + DRONE], id="behind long ones"),
        pytest.param([STANDARD + DRONE.decode().encode("utf-16")], id="UTF-16"),
        pytest.param([STANDARD + DRONE.decode().encode("utf-16-be")], id="UTF-16 without its mark"),
        pytest.param([STANDARD + DRONE.decode().encode("utf-32")], id="UTF-32"),
        pytest.param([STANDARD + NAMES_IT, part(DRONE, 30, 999), part(DRONE, 0, 30)], id="extended, in parts"),
    ],
)
def test_every_packet_of_a_jpeg_is_read(tmp_path, segments):
    assert altitude(jpeg(tmp_path / "a.jpg", *segments)) == "+39.80"


def test_the_first_packet_comes_first_and_parts_that_nothing_names_are_left_over(tmp_path):
    file = jpeg(tmp_path / "a.jpg", STANDARD + RATING, STANDARD + DRONE)
    assert read_xmp(read_tags(file).xmp_packet)["drone-dji:GimbalPitchDegree"] == "-45.0"
    assert altitude(jpeg(tmp_path / "b.jpg", STANDARD + RATING, part(DRONE, 0, 999))) is None


def test_no_file_makes_xmp_large(tmp_path):
    filled = b" " * 65_000
    segments = [STANDARD + NAMES_IT + filled] * 12 + [part(filled, 0, len(filled))] * 12
    assert len(read_tags(jpeg(tmp_path / "a.jpg", *segments)).xmp_packet) <= MAX_XMP_BYTES


def magick(name: str, content: bytes) -> tuple[str, str]:
    digits = content.hex()
    lines = "\n".join(digits[k : k + 72] for k in range(0, len(digits), 72))
    return f"Raw profile type {name}", f"\n{name}\n{len(content):8d}\n{lines}\n"


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("name", "content"), [("xmp", DRONE), ("APP1", STANDARD + DRONE), ("APP1", STANDARD[:-1] + b"nonsense")]
)
def test_the_text_of_a_png_has_profiles_of_imagemagick(tmp_path, name, content, packed):
    text = PngInfo()
    text.add_text(*magick(name, content), zip=packed)
    Image.fromarray(NOISE).save(tmp_path / "a.png", pnginfo=text)
    assert altitude(tmp_path / "a.png") == ("+39.80" if DRONE in content else None)


def test_exif_in_the_text_of_a_png_is_read(tmp_path):
    exif, text = Image.Exif(), PngInfo()
    exif[0x010F], exif.get_ifd(0x8769)[0x920A], exif.get_ifd(0x8825)[1] = "Maker", 8.5, "S"
    text.add_text(*magick("APP1", exif.tobytes()))
    Image.fromarray(NOISE).save(tmp_path / "a.png", pnginfo=text)
    found = read_tags(tmp_path / "a.png")
    assert (found.tags[0x010F], float(found.details[0x920A]), found.gps[1]) == ("Maker", 8.5, "S")


@pytest.mark.parametrize(
    "written", ["", "\nAPP1\n 12\nzz", "\nAPP1\n 12\n123", "APP1", "\nAPP1\n-5\n00", "\nAPP1\n 9\n457869660000414243"]
)
def test_damaged_profiles_say_nothing(tmp_path, written):
    text = PngInfo()
    text.add_text("Raw profile type APP1", written)
    Image.fromarray(NOISE).save(tmp_path / "a.png", pnginfo=text)
    found = read_tags(tmp_path / "a.png")
    assert (found.tags, found.xmp_packet) == ({}, b"")
