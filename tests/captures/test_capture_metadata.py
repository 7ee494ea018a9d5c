"""What a run remembers of its capture: what changes results is noticed, and what does not is not."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.captures import tiny_scene, write_colmap
from vdgs.captures.capture_metadata import capture_fingerprint, capture_metadata, check_same_capture, off_path_crc
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


def test_whatever_figures_of_off_path_views_depend_on_makes_others(tmp_path):
    """The photograph and the truth in as many bytes as before, the pose, a mask, truth that was not there."""
    write_colmap(tmp_path, tiny_scene(width=64, height=48))
    views = tiny_scene(columns=1, rows=2, width=32, height=24)
    views = replace(views, cameras={f"street/{name}": camera for name, camera in views.cameras.items()})
    folder = tmp_path / "off_path"
    write_colmap(folder, views, images=".")
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    first, others = capture.off_path_views[0], capture.off_path_views[1:]
    photograph, truth = first.image_path, folder / "truth" / "views" / f"{Path(first.name).stem}.npz"
    mask = write_mask(tmp_path, 30)

    def write_other_bytes(file: Path) -> None:
        content = file.read_bytes()
        file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        os.utime(file, ns=(0, len(found)))  # another time, however coarse the clock of the disk

    found = [off_path_crc(capture)]
    assert off_path_crc(load_capture(tmp_path, CaptureOptions(up="z"))) == found[0]
    write_other_bytes(photograph)
    found.append(off_path_crc(capture))
    pose = first.camera.camera_from_world.copy()
    pose[0, 3] += 0.1
    moved = replace(first, camera=replace(first.camera, camera_from_world=pose))
    found += [
        off_path_crc(replace(capture, off_path_views=(each, *others)))
        for each in (moved, replace(first, mask_path=mask))
    ]
    truth.parent.mkdir(parents=True)
    found.append(off_path_crc(capture))
    truth.write_bytes(b"depth")
    found.append(off_path_crc(capture))
    write_other_bytes(truth)
    found.append(off_path_crc(capture))
    assert len(set(found)) == len(found) == 7


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
