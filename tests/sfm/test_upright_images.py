"""Photographs brought upright and decoded before the search, on all threads."""

from __future__ import annotations

import io
from pathlib import Path
from threading import Barrier
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from support.flights import write_photograph
from vdgs.errors import CaptureError
from vdgs.sfm import feature_extraction
from vdgs.sfm.feature_extraction import images_without_features, prepare_images, write_upright_images
from vdgs.sfm.image_list import ExcludedImage, collect_images
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.workspace import Workspace


def card(folder: Path) -> tuple[ImageMetadata, ...]:
    """Four photographs that lie on their sides, four PNG files of which two are cut off, and one as it is."""
    folder.mkdir()
    for k in range(9):
        pixels = np.random.default_rng(k).integers(0, 255, (120, 160, 3), np.uint8)
        if k in (4, 5, 6, 7):
            Image.fromarray(pixels).save(folder / f"{k}.png")
        else:
            write_photograph(folder / f"{k}.jpg", pixels, k, None, 6 if k < 4 else 1)
    photographs = collect_images([folder]).images
    for k in (5, 6):
        file = folder / f"{k}.png"
        file.write_bytes(file.read_bytes()[:20000])
    return photographs


def test_copies_are_made_on_all_threads_and_are_the_same_on_any_number(tmp_path, monkeypatch):
    photographs, made, lost = card(tmp_path / "card"), [], []
    for threads in (1, 3):
        work = Workspace(tmp_path / str(threads))
        lost.append(write_upright_images(work, photographs, threads))
        made.append({file.name: file.read_bytes() for file in work.images.iterdir()})
    assert made[0] == made[1]
    assert lost[0] == lost[1]
    assert [each.name for each in lost[0]] == ["5.png", "6.png"]
    together, write = Barrier(2, timeout=60), feature_extraction._write_upright

    def met(photo, target):
        together.wait()  # none goes on alone
        write(photo, target)

    monkeypatch.setattr(feature_extraction, "_write_upright", met)
    write_upright_images(Workspace(tmp_path / "again"), photographs, 2)


@pytest.mark.parametrize("decoded", [True, False])
def test_what_lasts_is_shown_once(tmp_path, decoded):
    """Links are made in no time, and copies that are there are not made again."""
    photographs = [photo for photo in card(tmp_path / "card") if photo.name == "8.jpg" or decoded]
    for again in (False, True):
        console = Console(file=io.StringIO())
        sound = [photo for photo in photographs if photo.name not in ("5.png", "6.png")]
        assert prepare_images(Workspace(tmp_path / "work"), sound, 1, console) == []
        assert ("features, decoded, photographs: 7" in console.file.getvalue()) is (decoded and not again)


def test_of_photographs_that_cannot_be_decoded_the_decoder_says_why(tmp_path):
    names = [f"{k}.jpg" for k in range(4)]
    seen = [SimpleNamespace(name=name, may_be_masked=False) for name in names]
    failed, counts = [ExcludedImage("0.jpg", "is black, as it is. Scale it.")], dict.fromkeys(names[1:], 900)
    assert images_without_features(seen, counts, failed) == failed
    with pytest.raises(CaptureError, match=r"needs 3\. The first: 0\.jpg is black, as it is\. Scale it\.$"):
        images_without_features(seen[:3], counts, failed)
