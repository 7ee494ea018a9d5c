"""Nothing is written among photographs, masks and sparse models, under whichever name that folder goes."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from experiments.bench.bench import BenchSettings, run_bench
from experiments.bench.plan import PlanOptions
from support.captures import tiny_scene, write_colmap
from support.dataset_layouts import write_mega_nerf
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import check_not_among_inputs, check_output
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import OrthoRequest
from vdgs.config.presets import PRESETS
from vdgs.errors import VdgsError
from vdgs.rendering.ortho.render_ortho import render_ortho
from vdgs.report.capture_report import inspect_capture
from vdgs.runs.create_or_resume import create_or_resume_run
from vdgs.runs.run_context import RunContext
from vdgs.synth import SynthOptions, generate


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A capture with masks whose photographs lie in `images_4`."""
    write_colmap(tmp_path / "capture", tiny_scene())
    (tmp_path / "capture" / "images").rename(tmp_path / "capture" / "images_4")
    (tmp_path / "capture" / "masks").mkdir()
    return tmp_path / "capture"


def contents(folder: Path) -> dict[Path, bytes | None]:
    return {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


INSIDE = ("images_4", "images_4/run", "images_4/film.mp4", "masks", "masks/new/run", "sparse/0", "out/../images_4/x")


@pytest.mark.parametrize("inside", INSIDE)
def test_inputs_of_any_capture_are_known_without_reading_it(root: Path, inside: str) -> None:
    with pytest.raises(VdgsError, match="is for inputs of the capture"):
        check_output(root / inside)


@pytest.mark.parametrize("beside", ["", "run", "renders/images", "images_by_me", "undistorted/images", "film.mp4"])
def test_other_places_in_a_capture_are_free(root: Path, beside: str) -> None:
    before, capture = contents(root), load_capture(root)
    check_output(root / beside)  # raises nothing
    check_not_among_inputs(root / beside, capture)
    assert contents(root) == before  # nor makes what it was asked about


@pytest.mark.parametrize("inside", ["blocks/x.ply", "coarse", "evaluation_off_path/new/x.mp4", "lod"])
def test_folders_of_stages_are_for_the_stages(tmp_path: Path, inside: str) -> None:
    (tmp_path / "config.yaml").write_text("vdgs:\n")
    with pytest.raises(VdgsError, match="which a stage of the run"):
        check_output(tmp_path / inside)
    check_output(tmp_path / "export" / "blocks" / inside)  # raises nothing


def test_relative_names_and_links_lead_to_the_same_folder(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (root.parent / "link").symlink_to(root / "images_4")
    (root.parent / "film.mp4").symlink_to(root / "images_4" / "frame_000.png")
    monkeypatch.chdir(root / "sparse")
    for name in ("../images_4", "../../link/run", "../../film.mp4", "../../link/../images_4"):
        with pytest.raises(VdgsError, match="images_4"):
            check_output(Path(name))


def test_photographs_elsewhere_and_under_other_names_are_known(root: Path, tmp_path: Path) -> None:
    store = tmp_path / "card" / "DCIM"
    shutil.move(root / "images_4", store)
    (root / "photos").symlink_to(store)
    capture = load_capture(root, CaptureOptions(images="photos"))
    for output in (store, store / "run", root / "photos" / "run"):
        with pytest.raises(VdgsError, match="is for inputs"):
            check_not_among_inputs(output, capture)
    check_not_among_inputs(tmp_path / "card" / "run", capture)


def test_what_single_photographs_are_links_to_is_known(root: Path, tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    photograph = root / "images_4" / "frame_003.png"
    shutil.move(photograph, tmp_path / "store")
    photograph.symlink_to(tmp_path / "store" / photograph.name)
    with pytest.raises(VdgsError, match="store"):
        check_not_among_inputs(tmp_path / "store", load_capture(root))


def test_photographs_in_the_root_leave_folders_beside_them_free(tmp_path: Path) -> None:
    write_colmap(tmp_path / "flat", tiny_scene())
    for photograph in (tmp_path / "flat" / "images").iterdir():
        shutil.move(photograph, tmp_path / "flat")
    capture = load_capture(tmp_path / "flat", CaptureOptions(images="."))
    check_not_among_inputs(tmp_path / "flat" / "run", capture)
    with pytest.raises(VdgsError, match="is for inputs"):
        check_not_among_inputs(tmp_path / "flat", capture)


def test_the_layout_of_mega_nerf_is_known(tmp_path: Path) -> None:
    write_mega_nerf(tmp_path / "mill", tiny_scene())
    for inside in ("train/rgbs", "val/rgbs/run", "train/metadata"):
        with pytest.raises(VdgsError, match="is for inputs"):
            check_output(tmp_path / "mill" / inside)


def begin(root: Path, output: Path) -> None:
    create_or_resume_run(root, output, CaptureOptions(), PRESETS["laptop"])


def inspect(root: Path, output: Path) -> None:
    inspect_capture(load_capture(root), output)


def synth(_: Path, output: Path) -> None:
    generate(output, SynthOptions(size="toy"))


def bench(_: Path, output: Path) -> None:
    run_bench(BenchSettings("toy", output, PlanOptions()), Console(quiet=True))


def map_scene(root: Path, output: Path) -> None:
    pytest.importorskip("rasterio")
    asked = OrthoRequest(run=root.parent / "run", output=output)
    render_ortho(RunContext.from_path(asked.run), asked, Console(quiet=True))


@pytest.mark.parametrize("verb", [begin, inspect, synth, bench, map_scene])
@pytest.mark.parametrize("inside", ["images_4", "images_4/new"])
def test_no_verb_writes_among_inputs(root: Path, verb, inside: str) -> None:
    before = contents(root)
    with pytest.raises(VdgsError, match="Nothing was written"):
        verb(root, root / inside)
    assert contents(root) == before


def test_photographs_are_not_undistorted_onto_themselves(tmp_path: Path) -> None:
    write_colmap(tmp_path / "bent", tiny_scene(), model="SIMPLE_RADIAL", extra=(0.1,))
    before = contents(tmp_path)
    options = CaptureOptions(undistort=True, undistorted_folder=tmp_path / "bent" / "images")
    with pytest.raises(VdgsError, match="is for inputs"):
        load_capture(tmp_path / "bent", options)
    assert contents(tmp_path) == before


def test_a_folder_that_cannot_be_read_is_no_capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(13, os.strerror(13), str(path))

    monkeypatch.setattr("vdgs.captures.output_guard.find_models", refuse)
    check_output(tmp_path / "images" / "run")
    assert not list(tmp_path.iterdir())


def photographs(folder: Path, count: int, maker: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if maker:
        exif[0x010F] = maker
    for k in range(count):
        Image.new("RGB", (16, 16), (k, 0, 0)).save(folder / f"P{k:04d}.jpg", exif=exif)
    return folder


def is_refused(output: Path) -> bool:
    try:
        check_output(output)
    except VdgsError:
        return True
    return False


def test_folders_of_photographs_are_known_without_a_capture(tmp_path: Path) -> None:
    many = photographs(tmp_path / "flight", 5)
    one = photographs(tmp_path / "one", 1, "DJI")
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "A.DNG").touch()
    for inside in (many, many / "run", many / "film.mp4", many / "new" / "run", one, one / "film.mp4", raw):
        assert is_refused(inside), inside
    assert not is_refused(tmp_path / "run")  # beside folders of photographs
    assert not is_refused(one / "run")  # a folder with a picture in it, such as a home


def test_a_file_that_nobody_takes_for_a_photograph_may_lie_among_some(tmp_path: Path) -> None:
    shots = photographs(tmp_path / "screenshots", 3)
    one = photographs(tmp_path / "one", 1, "DJI")
    for name in ("scene.html", "scene.PLY", "x.compressed.ply", "x.spz", "x.sog", "x.glb", "x.laz", "new/x.splat"):
        assert not is_refused(shots / name), name
        assert not is_refused(one / name), name
    for name in ("sky.png", "film.mp4", "map.tif", "tiles/tileset.json", "lod-meta.json", "run"):
        assert is_refused(shots / name), name
    (shots / "folder.html").mkdir()
    assert is_refused(shots / "folder.html")
    photographs(tmp_path / "DCIM" / "100MEDIA", 3)
    assert is_refused(tmp_path / "DCIM" / "100MEDIA" / "scene.html")


def test_pictures_that_only_lie_there_keep_no_file_away(tmp_path: Path) -> None:
    """Figures, or pictures of a screen among other work: no series that is most of what lies there."""
    figures = tmp_path / "figures"
    figures.mkdir()
    for name in ("plan", "report", "town-north", "town-south", "overview", "IMG_20240102"):
        shutil.copy(photographs(tmp_path / "some", 1) / "P0000.jpg", figures / f"{name}.jpg")
    work = photographs(tmp_path / "work", 5)
    for name in "abcdefg":
        (work / f"{name}.txt").touch()
    for folder in (figures, work):
        for name in ("film.mp4", "sky.png", "map.tif"):
            assert not is_refused(folder / name), name
        assert is_refused(folder)  # many files would be mixed with them
    frames = photographs(tmp_path / "frames", 5)  # of a film, without what a camera says
    (frames / "notes.txt").touch()
    assert is_refused(frames / "film.mp4")


@pytest.mark.parametrize("beside", [(".txt", ".json"), (".JPG.xmp", ".MP4", ".SRT"), ("_mask.png", ".xmp")])
def test_what_belongs_to_pictures_makes_their_folder_none_of_other_work(tmp_path: Path, beside: Sequence[str]) -> None:
    """Labels and records of each picture, and the films of the same card."""
    frames = photographs(tmp_path / "frames", 5)
    for picture in list(frames.iterdir()):
        for ending in beside:
            picture.with_name(picture.stem + ending).touch()
    (frames / "notes.txt").touch()
    for name in ("film.mp4", "run", "runs/first"):
        assert is_refused(frames / name), name


@pytest.mark.parametrize("poses", ["transforms.json", "poses_bounds.npy"])
def test_points_beside_the_photographs_in_a_root_would_be_those_of_the_capture(tmp_path: Path, poses: str) -> None:
    root = photographs(tmp_path / "set", 3)
    (root / poses).touch()
    for name in ("scene.ply", "points3D.PLY", "x.las", "x.laz"):
        with pytest.raises(VdgsError, match=rf"taken for the capture's points.*{tmp_path / name}$"):
            check_output(root / name)
    for free in ("scene.html", "x.spz", "export/scene.ply"):
        assert not is_refused(root / free), free


def test_a_few_pictures_are_no_photographs(tmp_path: Path) -> None:
    figures = photographs(tmp_path / "figures", 2)
    assert not is_refused(figures)
    home = photographs(tmp_path / "home", 4)
    for name in "abcdefgh":
        (home / name).mkdir()
    assert is_refused(home)
    assert not is_refused(home / "a" / "run")


def test_all_that_a_camera_took_is_one_tree(tmp_path: Path) -> None:
    photographs(tmp_path / "DCIM" / "100MEDIA", 1)
    for inside in ("DCIM", "DCIM/run", "DCIM/100MEDIA/x", "DCIM/101MEDIA"):
        with pytest.raises(VdgsError, match=re.escape(f"{tmp_path}/") + "(DCIM-results|run|x|101MEDIA)$"):
            check_output(tmp_path / inside)
    assert not is_refused(tmp_path / "other" / "DCIM")  # not there yet


def test_results_of_ours_are_no_photographs(tmp_path: Path) -> None:
    renders = photographs(tmp_path / "views", 9)
    (renders / "render.json").write_text("{}")
    run = photographs(tmp_path / "run", 9)
    (run / "config.yaml").write_text("vdgs:\n  version: 0\n")
    straight = photographs(tmp_path / "straight", 9)
    for picture in list(straight.iterdir()):
        picture.with_name(picture.name + ".json").write_text('{"made_from": {}}')
        shutil.copy(picture, picture.with_name(picture.name + ".mask.png"))
    for output in (renders, run / "maps", run / "film.mp4", straight):
        assert not is_refused(output), output


def test_a_capture_with_photographs_in_its_root_takes_folders_but_no_files(tmp_path: Path) -> None:
    write_colmap(tmp_path / "flat", tiny_scene())
    for photograph in (tmp_path / "flat" / "images").iterdir():
        shutil.move(photograph, tmp_path / "flat")
    assert not is_refused(tmp_path / "flat" / "run" / "maps")
    assert is_refused(tmp_path / "flat" / "film.mp4")
