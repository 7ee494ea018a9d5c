"""What a run remembers of its capture: what changes results is noticed, and what does not is not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from support.captures import tiny_scene, write_colmap
from vdgs.captures.capture_metadata import capture_fingerprint, capture_metadata, check_same_capture
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import RunError


def write_mask(capture: Path, kept_rows: int) -> Path:
    mask = np.full((48, 64), 255, np.uint8)
    mask[kept_rows:] = np.random.default_rng(kept_rows).integers(0, 2, mask[kept_rows:].shape) * 255
    file = capture / "masks" / "frame_005.png"
    file.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(file), mask)
    return file


def test_masks_that_are_added_edited_or_removed_make_another_capture(tmp_path):
    def read():
        return load_capture(tmp_path, CaptureOptions())

    write_colmap(tmp_path, tiny_scene(width=64, height=48))
    plain = capture_metadata(read())
    mask = write_mask(tmp_path, 30)
    masked = capture_metadata(read())
    check_same_capture(tmp_path / "capture.json", masked, read())
    with pytest.raises(RunError, match=r"changed: masks\. Restore the capture"):
        check_same_capture(tmp_path / "capture.json", plain, read())
    write_mask(tmp_path, 10)
    with pytest.raises(RunError, match=r"changed: masks\."):
        check_same_capture(tmp_path / "capture.json", masked, read())
    mask.unlink()
    mask.parent.rmdir()
    with pytest.raises(RunError, match=r"changed: masks\."):
        check_same_capture(tmp_path / "capture.json", masked, read())
    check_same_capture(tmp_path / "capture.json", plain, read())
    assert "masks" not in capture_fingerprint(read())


@pytest.mark.parametrize(("scale", "kind"), [(1, ".png"), (30, ".bmp")])  # a few KB; some MB, without a checksum
def test_a_pixel_of_a_mask_that_is_edited_to_the_same_size_makes_another_capture(tmp_path, scale, kind):
    def read():
        return load_capture(tmp_path, CaptureOptions())

    write_colmap(tmp_path, tiny_scene(width=64, height=48))
    file, mask = tmp_path / "masks" / "frame_005.png", np.full((48 * scale, 64 * scale), 255, np.uint8)
    file.parent.mkdir()
    write = lambda: file.write_bytes(cv2.imencode(kind, mask, (cv2.IMWRITE_PNG_COMPRESSION, 0))[1])  # noqa: E731
    write()
    before, size = capture_metadata(read()), file.stat().st_size
    mask[20 * scale + 7, 10 * scale] = 0
    write()
    assert file.stat().st_size == size
    with pytest.raises(RunError, match=r"changed: masks\. Restore"):
        check_same_capture(tmp_path / "capture.json", before, read())
