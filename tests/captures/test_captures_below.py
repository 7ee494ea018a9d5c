"""Folders above captures: which of several is named, and with which photographs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from support.advice import advised_words
from support.captures import TinyScene, write_colmap, write_images
from support.dataset_layouts import halves, write_matrixcity, write_mega_nerf, write_transforms
from support.metashape_files import metashape_xml
from support.true_flight import true_flight
from vdgs.captures.format_dispatch import read_source
from vdgs.captures.loading import load_capture
from vdgs.captures.nested_captures import model_below
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word


def follow(said: str | None) -> tuple[Path, CaptureOptions]:
    """What the command in a message gives to vdgs."""
    capture, images = advised_words("vdgs run WORD(?: --images WORD)? --output RUN", said or "")
    return Path(capture), CaptureOptions(images=images, up="z")


def write_city_gaussian(
    root: Path, scene: TinyScene, sides: tuple[str, ...] = ("train/block_all", "test/block_all_test")
):
    """MatrixCity as CityGaussian has it: each side with its photographs in input/ and a model of these."""
    for side, part in zip(sides, halves(scene), strict=True):
        write_colmap(root / side, part, images="input")


@pytest.mark.parametrize("above", [".", "train", "test"])
def test_the_biggest_model_is_named_with_the_photographs_in_its_folder(tmp_path, scene, above):
    write_city_gaussian(tmp_path, scene)
    said = model_below(tmp_path / above)
    root, options = follow(said)
    assert root == tmp_path / ("test/block_all_test" if above == "test" else "train/block_all")
    assert ("(beside it: test/block_all_test; a run is of one)" in str(said)) == (above == ".")
    assert len(load_capture(root, options).views) == (3 if above == "test" else 9)


def test_a_model_is_never_given_the_photographs_of_another(tmp_path, scene):
    """Photographs of training and of test have the same names, each with poses of its own."""
    write_city_gaussian(tmp_path, scene)
    shutil.rmtree(tmp_path / "train/block_all/input")
    said = model_below(tmp_path)
    assert f"put them beside it as images: vdgs run {shell_word(tmp_path / 'train/block_all')} --output RUN" in str(
        said
    )


@pytest.mark.parametrize("sides", [("zz", "aa"), ("train/zz", "test/aa")])
def test_the_biggest_of_several_captures_is_named(tmp_path, scene, sides):
    for side, part in zip(sides, halves(scene), strict=True):
        write_colmap(tmp_path / side, part)
    said = model_below(tmp_path)
    assert follow(said)[0] == tmp_path / sides[0]
    assert f"(beside it: {sides[1]}; a run is of one)" in str(said)


def test_photographs_of_training_and_of_test_are_found_by_the_command(tmp_path, scene):
    """MatrixCity as published: they lie in folders beside that of the poses."""
    write_matrixcity(tmp_path / "aerial/pose/block_A", *halves(scene))
    capture = load_capture(*follow(model_below(tmp_path / "aerial")))
    assert (len(capture.train_views), len(capture.test_views)) == (9, 3)


def test_photographs_in_two_folders_beside_transforms_are_found_by_the_folder_above(tmp_path, scene):
    content = write_transforms(tmp_path / "nerf", scene)
    for k, frame in enumerate(content["frames"]):
        name = frame["file_path"].split("/")[1]
        frame["file_path"] = f"{'test' if k < 3 else 'train'}/{name}"
        place = tmp_path / "photographs" / frame["file_path"]
        place.parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "nerf/images" / name).rename(place)
    (tmp_path / "nerf/images").rmdir()
    (tmp_path / "nerf/transforms.json").write_text(json.dumps(content))
    root, options = follow(model_below(tmp_path))
    assert options.images == str(tmp_path / "photographs")
    assert len(load_capture(root, options).views) == 12


@pytest.mark.parametrize("other", ["project", "capture"])
def test_a_project_beside_another_is_named_with_its_own_photographs(tmp_path, scene, other):
    for name in ("north", "south"):
        write_images(tmp_path / name / "photos", scene)
    for name in ("north", "south") if other == "project" else ("north",):
        (tmp_path / name / "cameras.xml").write_text(metashape_xml(true_flight()), encoding="utf-8")
    if other == "capture":
        write_colmap(tmp_path / "south", scene)
    said = model_below(tmp_path)
    assert said is not None
    assert said.endswith("(beside it: south; a run is of one)")
    assert f"vdgs run {tmp_path / 'north/cameras.xml'} --output RUN" in said


def test_parts_of_a_divided_project_are_all_named(tmp_path, scene):
    shots = {"cameras": {}, "shots": {}, "points": {}}
    for k in range(3):
        part = tmp_path / f"submodels/submodel_000{k}"
        write_images(part / "images", scene)
        (part / "opensfm").mkdir()
        (part / "opensfm/reconstruction.json").write_text(json.dumps([shots]))
    with pytest.raises(CaptureError, match=r"submodel_0000/opensfm/reconstruction\.json is a project of") as refused:
        load_capture(tmp_path)
    assert follow(str(refused.value))[1].images is None  # its own photographs lie beside it
    others = "submodels/submodel_0001, submodels/submodel_0002"
    assert f"(beside it: {others}; a run is of one)" in str(refused.value)


def test_a_mega_nerf_set_without_photographs_names_the_script_that_makes_them(tmp_path, scene):
    write_mega_nerf(tmp_path / "set", scene)
    for side in ("train", "val"):
        shutil.rmtree(tmp_path / "set" / side / "rgbs")
    write_images(tmp_path / "photos", scene)
    with pytest.raises(CaptureError) as refused:
        read_source(tmp_path, CaptureOptions())
    words = advised_words(
        "copy_images.py --image_path WORD --dataset_path WORD; then: vdgs run WORD", str(refused.value)
    )
    assert words == [str(tmp_path / "photos"), *2 * [str(tmp_path / "set")]]
    with pytest.raises(CaptureError, match=r"copy_images\.py --image_path PHOTOGRAPHS"):
        read_source(tmp_path / "set", CaptureOptions())


def test_a_model_far_below_is_named(tmp_path, scene):
    """As workspaces of COLMAP and caches of Meshroom lie in the folder of a survey."""
    write_images(tmp_path / "photographs", scene)
    write_colmap(tmp_path / "processing/2024/colmap/town/dense", scene)
    assert f"{tmp_path / 'processing/2024/colmap/town/dense'} is a capture" in str(model_below(tmp_path))
