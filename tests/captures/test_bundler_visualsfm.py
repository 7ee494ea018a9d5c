"""Models of Bundler and VisualSFM: a known flight in each, read back to its numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support import project_writers as writers
from support.known_flight import (
    BentLens,
    KnownFlight,
    MeasuredLens,
    known_flight,
)
from support.project_reading import OPTIONS, check_numbers, check_tie_points, read
from vdgs.captures.capture_root import capture_root
from vdgs.captures.format_dispatch import read_source
from vdgs.captures.formats.aligned_sizes import Fit, fit_of
from vdgs.captures.formats.bundler import read_bundle
from vdgs.errors import CaptureError


@pytest.fixture
def flight() -> KnownFlight:
    return known_flight()


def test_bundler_in_its_own_layout_is_read_by_folder_and_by_file(tmp_path: Path, flight: KnownFlight) -> None:
    """The list and the photographs in the root, the model in bundle/."""
    file = writers.write_bundler(tmp_path / "bundle", flight)
    flight.write_photographs(tmp_path)
    (tmp_path / "list.txt").write_text("\n".join(flight.names))
    (tmp_path / "bundle" / "list.txt").unlink()
    assert capture_root(file) == tmp_path
    assert len(read_source(file, OPTIONS).views) == len(read_source(tmp_path, OPTIONS).views) == len(flight.names)
    header, counts, *_ = file.read_text().splitlines()
    nothing = ["0 0 0"] * 5 * int(counts.split()[0])
    file.write_text("\n".join([header, f"{counts.split()[0]} 0", *nothing]))
    with pytest.raises(CaptureError, match="no camera of it has a pose"):
        read_source(file, OPTIONS)


def test_bundler_is_read_to_its_numbers(tmp_path: Path) -> None:
    flight = known_flight(BentLens(center=(400.0, 300.0), k=(-0.11, 0.034, 0.0, 0.0), p=(0.0, 0.0)))
    writers.write_bundler(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    source = read(tmp_path, "bundler")
    check_numbers(source, flight, placed=False)
    assert (source.colors == flight.colors).all()
    assert sum(view.observations is not None for view in source.views) == len(flight.names)


@pytest.mark.parametrize("radial", [0.12, -0.08, 0.0])
@pytest.mark.parametrize("matrix", [False, True])
def test_visualsfm_is_read_to_its_numbers(tmp_path: Path, radial: float, matrix: bool) -> None:
    flight = known_flight(MeasuredLens(radial=radial))
    flight.write_photographs(tmp_path / "images")
    writers.write_visualsfm(tmp_path, flight, matrix=matrix)
    check_tie_points(read(tmp_path, "visualsfm"), flight)


def test_a_calibration_that_visualsfm_held_is_read_to_its_numbers(tmp_path: Path) -> None:
    flight = known_flight(MeasuredLens(radial=0.0))
    flight.write_photographs(tmp_path / "images")
    file = writers.write_visualsfm(tmp_path, flight)
    file.write_text(file.read_text().replace("NVM_V3 \n", "NVM_V3 FixedK 700 401 710 302 0\n", 1))
    lens = read(tmp_path, "visualsfm").views[0].intrinsics
    assert (lens.focal, lens.principal_point) == ((700.0, 710.0), (401.0, 302.0))


def test_a_lens_of_visualsfm_that_folds_over_is_named(tmp_path: Path) -> None:
    flight = known_flight(MeasuredLens(radial=0.0))
    flight.write_photographs(tmp_path / "images")
    file = writers.write_visualsfm(tmp_path, flight)
    file.write_text(file.read_text().replace(" 0.0 0.0\n", " -2.5 0.0\n", 1))
    [said] = [each for each in read(tmp_path, "visualsfm").warnings if "cannot be used" in each]
    assert "folds over" in said
    assert flight.names[0] in said


@pytest.mark.parametrize("program", ["bundler", "visualsfm"])
def test_shrunk_photographs_are_told_by_the_pixels_of_a_file_without_sizes(tmp_path: Path, program: str) -> None:
    """The focal length is that of the photographs that were aligned; photographs of half the size would be misread."""
    flight = known_flight(MeasuredLens(radial=0.0, k=(0.0, 0.0, 0.0, 0.0)))
    getattr(writers, f"write_{program}")(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    assert len(read(tmp_path, program).views) == len(flight.names)
    for path in (tmp_path / "images").rglob("*.*"):
        Image.new("RGB", (400, 300)).save(path)
    with pytest.raises(CaptureError, match=r"photograph is 400x300: it is of another size\. Give the photographs that"):
        read(tmp_path, program)


def test_photographs_of_another_size_keep_the_lens_that_visualsfm_held(tmp_path: Path) -> None:
    """Its principal point counts from the corner, and is the middle of the photographs that were aligned."""
    flight = known_flight(MeasuredLens(radial=0.0, k=(0.0, 0.0, 0.0, 0.0)))
    file = writers.write_visualsfm(tmp_path, flight)
    file.write_text(file.read_text().replace("NVM_V3 \n", "NVM_V3 FixedK 700 400 700 300 0\n", 1))
    flight.write_photographs(tmp_path / "images")
    for width in (400, 600, 2400, 3200):
        for path in (tmp_path / "images").rglob("*.*"):
            Image.new("RGB", (width, width * 3 // 4)).save(path)
        lens = read(tmp_path, "visualsfm").views[0].intrinsics
        assert (lens.focal, lens.width, lens.height) == ((700.0, 700.0), 800, 600)


def _ending(share: float, count: int = 3000) -> np.ndarray:
    """Points all over photographs of 800x600, `share` as wide, in pixels from the middle."""
    return np.random.default_rng(4).uniform(-share, share, (count, 2)) * (400, 300)


def _round(count: int) -> np.ndarray:
    points = _ending(1.0, count)
    return points[np.hypot(*points.T) < 200]


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        (_ending(1.0), Fit.FITS),
        (_ending(1.0, 50), Fit.FITS),
        (_ending(1 / 1.25), Fit.SHORT),
        (_ending(0.5), Fit.SHORT),
        (_ending(0.95), Fit.UNCLEAR),
        (_ending(1 / 0.96), Fit.BESIDE),
        (_ending(1.0) + np.array([10.0, 7.5]), Fit.UNCLEAR),  # of a lens whose principal point is off the middle
        (_ending(2.0, 50), Fit.BESIDE),
        (_ending(0.5, 200), Fit.UNCLEAR),
        (_ending(0.5, 50), Fit.FITS),  # too few to tell
        (_ending(1.0) * (0.6, 0.8), Fit.UNCLEAR),  # a thing of another shape
        (_round(9000), Fit.UNCLEAR),
        (np.random.default_rng(4).normal(0, 60, (20000, 2)), Fit.UNCLEAR),
        (_ending(0.984) * (1.0, 0.995), Fit.FITS),  # no points are looked for within a few pixels of the rims
        (np.append(_ending(1.0), [[900.0, 0.0]], axis=0), Fit.FITS),
        (np.zeros((0, 2)), Fit.FITS),
    ],
)
def test_points_tell_the_size_of_the_photographs_that_were_aligned(points: np.ndarray, expected: Fit) -> None:
    assert fit_of(points, (800, 600))[0] is expected


def test_those_photographs_count_that_the_points_of_bundler_fit(tmp_path: Path, flight: KnownFlight) -> None:
    """Named by --images or in the capture; the others are not those that were aligned."""
    writers.write_bundler(tmp_path, flight)
    for folder, (width, height) in (("images", (1600, 1200)), ("small", (800, 600)), ("tiny", (200, 150))):
        flight.write_photographs(tmp_path / folder)
        for path in (tmp_path / folder).rglob("*.*"):
            Image.new("RGB", (width, height)).save(path)
    views = read_source(tmp_path, replace(OPTIONS, images="small")).views
    assert {(view.intrinsics.width, view.intrinsics.focal[0]) for view in views} == {(800, flight.lens.focal)}
    for folder in ("tiny", "images"):
        with pytest.raises(CaptureError, match="it is of another size"):
            read_source(tmp_path, replace(OPTIONS, images=folder))
    for path in (tmp_path / "images").rglob("*.*"):
        Image.new("RGB", (800, 600)).save(path)
    views = read_source(tmp_path, replace(OPTIONS, images="tiny")).views
    assert {view.intrinsics.width for view in views} == {800}


def test_points_without_a_place_are_left_out(tmp_path: Path, flight: KnownFlight) -> None:
    """NaN, also as Windows writes it."""
    bundle, nvm = writers.write_bundler(tmp_path / "a", flight), writers.write_visualsfm(tmp_path / "b", flight)
    lines = bundle.read_text().splitlines()
    lines[2 + 5 * len(flight.names)] = "nan -nan(ind) -1.#IND"
    bundle.write_text("\n".join(lines))
    model = read_bundle(bundle)
    assert len(model.points) == len(flight.points) - 1
    assert model.seen_point.max() == len(flight.points) - 2
    assert "1 of its" in model.warnings[0]
    lines = nvm.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if line == str(len(flight.points))) + 1
    lines[first] = "nan nan nan " + " ".join(lines[first].split()[3:])
    nvm.write_text("\n".join(lines))
    flight.write_photographs(tmp_path / "b" / "images")
    source = read(tmp_path / "b", "visualsfm")
    assert len(source.points) == len(flight.points) - 1
    assert any("not finite" in note for note in source.warnings)


def test_photographs_that_bundler_did_not_place_are_named(tmp_path: Path, flight: KnownFlight) -> None:
    file = writers.write_bundler(tmp_path, flight)
    lines = file.read_text().splitlines()
    lines[2:7] = ["0 0 0", "0 0 0", "0 0 0", "0 0 0", "0 0 0"]
    file.write_text("\n".join(lines))
    flight.write_photographs(tmp_path / "images")
    source = read(tmp_path, "bundler")
    assert len(source.views) == len(flight.names) - 1
    assert any("not aligned" in note and flight.names[0] in note for note in source.warnings)


def test_list_of_bundler_must_name_every_camera(tmp_path: Path, flight: KnownFlight) -> None:
    writers.write_bundler(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    (tmp_path / "list.txt").write_text("only.jpg\n")
    with pytest.raises(CaptureError, match=r"list\.txt names 1"):
        read(tmp_path, "bundler")
    (tmp_path / "list.txt").unlink()
    with pytest.raises(CaptureError, match=r"no list\.txt"):
        read(tmp_path, "bundler")
    (tmp_path / "export.imagelist").write_text("".join(f"C:\\card\\{name}\n" for name in flight.names))
    assert len(read(tmp_path, "bundler").views) == len(flight.names)


def test_names_in_the_list_of_bundler_may_hold_blanks(tmp_path: Path, flight: KnownFlight) -> None:
    """Bundler itself writes a guess of the focal length behind each."""
    flight = replace(flight, names=[f"flight 1/DJI {k}.jpg" for k in range(len(flight.names))])
    writers.write_bundler(tmp_path, flight)
    flight.write_photographs(tmp_path / "images")
    assert [view.name for view in read(tmp_path, "bundler").views] == sorted(flight.names)
    plain = replace(flight, names=[name.replace(" ", "_") for name in flight.names])
    plain.write_photographs(tmp_path / "images")
    (tmp_path / "list.txt").write_text("".join(f"images/{name} 0 700.5\n" for name in plain.names))
    assert [view.name for view in read(tmp_path, "bundler").views] == sorted(plain.names)
