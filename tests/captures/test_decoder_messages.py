"""What image libraries print by themselves about files of strangers does not reach people; all else does."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from support.commands import PATIENCE_SECONDS
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.image_files import decode_image, read_header, verify_image
from vdgs.captures.jpeg import lacks_only_end
from vdgs.captures.pillow_limits import pillow_without_limits
from vdgs.captures.undistortion import ImageFile, undistort
from vdgs.errors import CaptureError
from vdgs.system.native_messages import without_decoder_messages


def strange_files(folder: Path) -> None:
    """Files of which libjpeg, libpng, libtiff, OpenCV or Pillow say something on standard error."""
    pixels = Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8))
    pixels.save(folder / "whole.jpg")
    jpeg = (folder / "whole.jpg").read_bytes()
    (folder / "extra.jpg").write_bytes(jpeg[:-2] + bytes(300) + jpeg[-2:])
    (folder / "half.jpg").write_bytes(jpeg[: len(jpeg) // 2] + b"\xff\xd9")
    exif = Image.Exif()
    exif[0x010F] = "maker " * 9
    pixels.save(folder / "exif.jpg", exif=exif)
    tagged = (folder / "exif.jpg").read_bytes()
    (folder / "exif.jpg").write_bytes(tagged.replace(struct.pack(">I", 55), struct.pack(">I", 60_000), 1))
    pixels.save(folder / "whole.png")
    png = (folder / "whole.png").read_bytes()
    profile = b"iCCP" + b"bad\0\0" + zlib.compress(bytes(9))
    chunk = struct.pack(">I", len(profile) - 4) + profile + struct.pack(">I", zlib.crc32(profile))
    (folder / "profile.png").write_bytes(png[:33] + chunk + png[33:])
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags.tagtype[65000] = 2
    tags[65000] = "unknown"
    pixels.save(folder / "tag.tif", tiffinfo=tags)
    tiff = (folder / "tag.tif").read_bytes()
    (folder / "half.tif").write_bytes(tiff[: len(tiff) // 2])


def test_libraries_say_nothing_of_strange_files(tmp_path: Path) -> None:
    strange_files(tmp_path)
    code = (
        "import sys\nfrom pathlib import Path\nfrom vdgs.captures.image_files import decode_image, has_camera\n"
        "from vdgs.errors import CaptureError\n"
        "for file in sorted(Path(sys.argv[1]).iterdir()):\n"
        "    has_camera(file)\n"
        "    try:\n        decode_image(file)\n    except CaptureError as error:\n        print(error)\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OPENCV_LOG_LEVEL"}
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=PATIENCE_SECONDS,
        env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "half.tif: " in done.stdout


def test_other_lines_pass_whoever_writes_them(capfd: pytest.CaptureFixture[str]) -> None:
    with without_decoder_messages():
        os.write(2, b"libpng warning: iCCP: too short\n")
        os.write(2, b"Segmentation fault\nCorrupt JPEG data: 3 extraneous bytes\n")
        with without_decoder_messages():
            os.write(2, b"inside\n")
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "Segmentation fault\ninside\nafter\n"


def test_an_error_leaves_standard_error_as_it_was(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "no.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40))
    with pytest.raises(CaptureError, match=r"no\.png"):
        decode_image(tmp_path / "no.png")
    os.write(2, b"still here\n")
    assert capfd.readouterr().err.endswith("still here\n")


def test_limits_of_pillow_return_once_the_last_thread_has_left():
    """Photographs are opened in several threads, which leave in any order."""
    before = Image.MAX_IMAGE_PIXELS, list(warnings.filters)
    one, other = pillow_without_limits(), pillow_without_limits()
    with one:
        other.__enter__()
    assert Image.MAX_IMAGE_PIXELS is None
    other.__exit__(None, None, None)
    assert (Image.MAX_IMAGE_PIXELS, list(warnings.filters)) == before


@pytest.mark.parametrize("kind", ["jpg", "jpg without its end", "png", "tif", "unknown to OpenCV"])
@pytest.mark.filterwarnings("error")
def test_pictures_beyond_the_limits_of_pillow_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str):
    """Aerial cameras have 150 megapixels; Pillow warns from 89 on and refuses twice as many."""
    file = tmp_path / f"a.{kind[:3] if kind != 'unknown to OpenCV' else 'png'}"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)).save(file)
    if kind == "jpg without its end":
        file.write_bytes(file.read_bytes()[:-2])
    if kind == "unknown to OpenCV":
        monkeypatch.setattr("cv2.imdecode", lambda *_: None)
    for limit in (1000, 2000):  # refused, and warned of
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
        assert read_header(file).width == 64
        assert lacks_only_end(file) == kind.startswith("jpg")
    assert verify_image(file).has_content
    assert decode_image(file)[0].shape == (48, 64, 3)
    lens = Intrinsics("SIMPLE_RADIAL", (60.0, 32.0, 24.0, -0.05), 64, 48)
    (straight,) = undistort(tmp_path / "straight", [ImageFile(file.name, file, None, lens)])
    assert straight.path.is_file()
