"""Where photographs of a model without images/ are taken from: not from results, nor from those of another lens."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.advice import advised_words
from support.captures import UP, tiny_scene, up, write_colmap, write_images
from vdgs.captures.format_dispatch import read_source
from vdgs.captures.formats.source_capture import Intrinsics, SourceView
from vdgs.captures.image_matching import fit_to_image
from vdgs.captures.loading import load_capture
from vdgs.captures.strays import is_undistorted_folder
from vdgs.errors import CaptureError

BENT = {"model": "SIMPLE_RADIAL", "extra": (-0.03,)}


@pytest.fixture(scope="module")
def scene():
    return tiny_scene()


@pytest.mark.parametrize(("images", "sparse"), [("DCIM", "sparse/0"), (".", "sparse/0"), (".", ".")])
def test_what_was_undistorted_here_is_no_second_place_of_photographs(tmp_path, scene, images, sparse):
    write_colmap(tmp_path, scene, images=images, sparse=sparse, **BENT)
    first, again = (load_capture(tmp_path, UP) for _ in range(2))
    assert (tmp_path / "undistorted").is_dir()
    assert (again.images, again.warnings, again.num_unused_images) == (first.images, first.warnings, 0)
    assert [view.image_path for view in again.views] == [view.image_path for view in first.views]


def test_what_was_undistorted_into_a_folder_of_any_name_is_no_second_place(tmp_path, scene):
    write_colmap(tmp_path, scene, images="DCIM", **BENT)
    options = up(undistorted_folder=tmp_path / "straight")
    assert [load_capture(tmp_path, options).images for _ in range(2)] == ["DCIM", "DCIM"]


def test_figures_of_inspect_are_no_second_place(tmp_path, scene):
    write_colmap(tmp_path, scene, images="DCIM")
    (tmp_path / "looks").mkdir()
    (tmp_path / "looks/report.json").write_text("{}")
    for name in ("visibility.png", "visibility_map.png"):
        shutil.copy(tmp_path / "DCIM/frame_000.png", tmp_path / "looks" / name)
    assert read_source(tmp_path, UP).images == "DCIM"


@pytest.mark.parametrize("name", ["dense/0", "dense", "photos"])
def test_photographs_of_a_capture_of_pinholes_are_none_of_a_bent_lens(tmp_path, scene, name):
    write_colmap(tmp_path, scene, images=None, **BENT)
    write_colmap(tmp_path / name, scene, sparse="sparse")
    with pytest.raises(CaptureError, match="undistorted photographs, which do not fit") as refused:
        read_source(tmp_path, UP)
    (capture,) = advised_words("vdgs run WORD --output RUN", str(refused.value))
    assert len(load_capture(Path(capture), UP).views) == 12
    write_images(tmp_path / "DCIM", scene)
    assert read_source(tmp_path, UP).images == "DCIM"


@pytest.mark.parametrize(
    "name", ["undistorted_images", "images_undistorted", "undistorted", "rectified", "undist", "mvs"]
)
def test_folders_called_undistorted_are_none_of_a_bent_lens(tmp_path, scene, name):
    write_colmap(tmp_path, scene, images=name, **BENT)
    with pytest.raises(CaptureError, match=f"--images {name} if it holds none of such"):
        read_source(tmp_path, UP)
    shutil.rmtree(tmp_path / "sparse")
    write_colmap(tmp_path, scene, images=None)
    assert read_source(tmp_path, UP).images == name
    assert not any(map(is_undistorted_folder, ("images", "photos", "DCIM", "flight1", "images_2")))


def test_photographs_of_a_capture_of_the_same_lens_are_used(tmp_path, scene):
    write_colmap(tmp_path, scene, images=None, **BENT)
    write_colmap(tmp_path / "nerfstudio", scene, **BENT)
    assert read_source(tmp_path, UP).images == "nerfstudio"


@pytest.mark.parametrize("size", [(3915, 2936), (4085, 3064)])
def test_photographs_all_but_as_large_as_a_bent_camera_are_refused(tmp_path, size):
    """As programs leave them that undistort."""
    with pytest.raises(CaptureError, match="which would be undistorted once more"):
        fitted(tmp_path, size, 0.005)
    assert (fitted(tmp_path, size, 0.0).width, fitted(tmp_path, size, 0.0).height) == size


@pytest.mark.parametrize("size", [(4000, 3000), (4000, 2999), (3840, 2880), (3800, 2850), (2000, 1500), (1333, 1000)])
def test_photographs_that_were_shrunk_on_purpose_are_used(tmp_path, size):
    assert fitted(tmp_path, size, 0.005).width == size[0]


def test_photographs_whose_shorter_side_is_round_are_used(tmp_path):
    assert fitted(tmp_path, (3868, 2900), 0.005).width == 3868
    with pytest.raises(CaptureError, match="which would be undistorted once more"):
        fitted(tmp_path, (3865, 2899), 0.005)


def test_photographs_all_but_as_large_as_a_bent_camera_by_a_round_number_are_remarked(tmp_path, scene):
    cameras = {name: camera.resized(66, 49) for name, camera in scene.cameras.items()}
    write_colmap(tmp_path, replace(scene, cameras=cameras), images=None, **BENT)
    write_images(tmp_path / "images", scene)
    assert any("12 of 12 photographs are all but as large" in each for each in load_capture(tmp_path, UP).warnings)


def fitted(folder: Path, size: tuple[int, int], bend: float) -> Intrinsics:
    """The intrinsics of a camera of 4000x3000 at the size of a photograph."""
    Image.new("1", size).save(folder / "a.png")
    lens = Intrinsics("SIMPLE_RADIAL", (2900.0, 2000.0, 1500.0, bend), 4000, 3000)
    return fit_to_image(SourceView(name="a.png", camera_from_world=np.eye(4), intrinsics=lens), folder / "a.png")
