"""Photographs to a capture, all the way: ray cast photographs whose true cameras are known."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

pytest.importorskip("embreex")
import pycolmap

from support.flights import FOCAL, HEIGHT, ORIGIN, WIDTH, Flight, write_photograph
from vdgs.captures.image_cache import load_image
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import read_reconstruction, report_rows
from vdgs.captures.validation import validate_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.presets import PRESETS
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, RunError, VdgsError
from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.geometry.similarity import Similarity
from vdgs.pipeline.dry_run import estimate_run
from vdgs.pipeline.run_pipeline import reconstruct_if_needed
from vdgs.report.write_report import write_report
from vdgs.runs.create_or_resume import create_or_resume_run
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm import feature_extraction, feature_matching, georegistration, incremental_mapper, sfm_estimate
from vdgs.sfm.georegistration import AlignmentFailure, Georegistration, georegister, transform_model
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.reconstruct import reconstruct
from vdgs.sfm.reconstruction_plan import plan_reconstruction
from vdgs.sfm.run_request import make_sfm_request
from vdgs.sfm.workspace import call_cancellable
from vdgs.system.atomic_files import write_json
from vdgs.system.stop_signals import catch_stop_signals

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("sfm")]


def console() -> Console:
    return Console(file=io.StringIO(), width=500)


@pytest.fixture
def flight(nine) -> Flight:
    return nine


@pytest.fixture
def made(nine_begun) -> Path:
    return nine_begun["made"]


def files(folder: Path) -> dict[str, tuple[int, int]]:
    found = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.stat().st_size) for path in sorted(found)}


def size(file: Path) -> tuple[int, int]:
    with Image.open(file) as image:
        return image.size


def test_all_photographs_are_placed_where_they_were_taken(made, flight):
    capture = load_capture(made)
    assert [view.name for view in capture.views] == flight.names
    assert capture.ground.metric
    origin = capture.ground.origin_geo
    shift = enu_from_geodetic(np.array([origin]), ORIGIN)[0]
    for view, truth in zip(capture.views, flight.cameras, strict=True):
        assert np.linalg.norm(view.camera.position + shift - truth.position) < 0.4  # metres, 45 of them up
        assert view.camera.forward @ truth.forward > np.cos(np.radians(1.5))
        assert view.camera.fx == pytest.approx(FOCAL, rel=0.02)
    assert validate_capture(capture).problems == ()
    assert validate_capture(capture).reprojection_px < 1


def test_photographs_come_in_exact_sizes_and_stay_as_they_were(made, flight):
    for name in flight.names:
        whole, half, quarter = (size(made / f"images{suffix}" / name) for suffix in ("", "_2", "_4"))
        assert whole == tuple(2 * side for side in half) == tuple(4 * side for side in quarter)
    small = load_capture(made, CaptureOptions(images="images_4")).views[0].camera
    assert small.fx == pytest.approx(load_capture(made).views[0].camera.fx / 4)


def test_facts_name_what_came_out_and_what_was_left_out(made):
    facts = read_reconstruction(made)
    assert facts is not None
    assert (facts.found, facts.registered, facts.components) == (11, 9, (9,))
    why = {photo.name: photo.excluded_reason for photo in facts.photographs if photo.excluded_reason}
    assert "cut off" in why["cut.jpg"]
    assert "features" in why["gray.jpg"]
    assert max(facts.residual_rms_m) < 0.3
    assert facts.focal_fixed
    assert facts.cameras[0].focal_after_px == pytest.approx(FOCAL)
    assert any("9 of 11" in value for _, value in report_rows(facts))
    with Image.open(made / "reconstruction.png") as picture:
        assert len(picture.convert("L").getcolors()) > 20  # points, positions and words


def test_the_same_command_does_nothing_and_an_option_only_what_depends_on_it(made, flight, monkeypatch, tmp_path):
    output = tmp_path / "capture"
    shutil.copytree(made, output, symlinks=True)
    before = files(output)
    reconstruct(SfmRequest(image_folders=(flight.folder,), output=output, threads=1, keep_intermediate=True), console())
    assert files(output) == before
    for room, name in (
        (feature_extraction, "extract_features"),
        (feature_matching, "match_pairs"),
        (incremental_mapper, "run_mapper"),
    ):
        monkeypatch.setattr(room, name, lambda *_: pytest.fail("was done already"))
    asked = SfmRequest(
        image_folders=(flight.folder,), output=output, threads=1, options=SfmOptions(max_output_size=200)
    )
    reconstruct(asked, console())
    assert max(load_capture(output).views[0].camera.full_size) <= 200
    assert validate_capture(load_capture(output)).reprojection_px < 1
    assert not (output / "work").exists()


@pytest.mark.usefixtures("unestimated", "few_features")
def test_photographs_that_came_later_are_refused_or_make_the_capture_anew(flight, tmp_path):
    output, card, (*names, late) = tmp_path / "capture", tmp_path / "card", flight.names[:5]
    card.mkdir()
    for name in names:
        shutil.copy(flight.folder / name, card)
    run = RunFolder(tmp_path / "run")
    first = SfmRequest(image_folders=(card,), output=output, threads=1, options=SfmOptions(num_neighbors=3))
    assert reconstruct(first, console(), run).registered == 4
    write_json(run.capture_file, {})  # as training leaves it
    before = files(output)
    with pytest.raises(RunError, match="other positions or other settings"):
        reconstruct(replace(first, options=SfmOptions(max_output_size=200)), console(), run)
    shutil.copy(flight.folder / late, card)
    with pytest.raises(VdgsError, match=rf"1 added \({late}\).*--overwrite"):
        reconstruct(first, console(), run)
    assert files(output) == before
    assert reconstruct(replace(first, overwrite=True), console(), run).registered == 5
    assert not run.is_trained


@pytest.mark.usefixtures("unestimated")
def test_without_positions_the_scale_is_arbitrary_and_said_so(flight, tmp_path):
    """One photograph lies on its side, and its mask with it. Three were taken with the camera turned: portrait for
    EXIF, and for everybody after it."""
    card = tmp_path / "card"
    (card / "masks").mkdir(parents=True)
    keep = np.ones((HEIGHT, WIDTH), bool)
    keep[:40] = False
    Image.fromarray(np.rot90(keep)).save(card / "masks" / f"{flight.names[2]}.png")
    for k, name in enumerate(flight.names[:6]):
        with Image.open(flight.folder / name) as image:
            pixels = np.array(image)
        turned = k == 2  # a photograph that lies on its side, as EXIF says
        write_photograph(card / name, np.rot90(pixels).copy() if turned else pixels, k, None, 6 if k > 1 else 1)
    before = files(card)
    said = console()
    facts = reconstruct(SfmRequest(image_folders=(card,), output=tmp_path / "capture", threads=1), said)
    assert (facts.registered, facts.origin, facts.residual_rms_m) == (6, None, None)
    assert "scale of the scene is arbitrary" in said.file.getvalue()
    assert not (tmp_path / "capture/georef.json").exists()
    capture = load_capture(tmp_path / "capture")
    assert not capture.ground.metric
    masks = [load_image(view).mask for view in capture.views]
    assert [mask is not None for mask in masks] == [k == 2 for k in range(6)]
    assert not masks[2][:35].any()
    assert masks[2][45:].all()
    sizes = [size(tmp_path / "capture/images" / name) for name in flight.names[:6]]
    assert sizes == [view.camera.full_size for view in capture.views]
    assert [height > width for width, height in sizes] == [k > 2 for k in range(6)]  # all stand upright
    assert len(set(sizes[:3])) == len(set(sizes[3:])) == 1
    assert files(card) == before


@pytest.mark.usefixtures("unestimated")
def test_photographs_that_do_not_overlap_are_no_scene(tmp_path):
    rng = np.random.default_rng(0)
    for k in range(3):
        pixels = np.kron(rng.integers(0, 255, (30, 40, 3)), np.ones((8, 8, 1))).astype(np.uint8)
        (tmp_path / "card").mkdir(exist_ok=True)
        write_photograph(tmp_path / "card" / f"p{k}.jpg", pixels, k, np.array([50.0 * k, 0, 40]))
    with pytest.raises(CaptureError, match="no two photographs could be joined"):
        reconstruct(SfmRequest(image_folders=(tmp_path / "card",), output=tmp_path / "capture", threads=1), console())


def test_other_things_are_not_written_over_and_a_full_disk_is_told_before(flight, tmp_path, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/thesis.txt").write_text("three years")
    with pytest.raises(VdgsError, match="holds other things"):
        reconstruct(SfmRequest(image_folders=(flight.folder,), output=tmp_path / "full"), console())
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(VdgsError, match="MB are free"):
        reconstruct(SfmRequest(image_folders=(flight.folder,), output=tmp_path / "new"), console())
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("attitudes", [True, False])
def test_one_line_of_photographs_is_placed_by_attitudes_or_views(made, flight, attitudes):
    """Positions along a line leave a turn about it open."""
    model = pycolmap.Reconstruction(made / "work" / "models" / "0")
    transform_model(model, Similarity(0.3, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([5.0, 6, 7])))
    line = collect_images([flight.folder]).images[:3]
    for image in list(model.images.values()):
        if image.name not in {photo.name for photo in line}:
            model.deregister_frame(image.frame_id)
    line = [photo if attitudes else replace(photo, attitude=None) for photo in line]
    placed = georegister(model, line, read_gps_priors(line, None, (1.0, 2.0)))
    assert isinstance(placed, Georegistration)
    assert "along one line" in placed.method
    assert np.abs(placed.residuals).max() < 0.7
    transform_model(model, placed.similarity)
    for image in (image for image in model.images.values() if image.has_pose):
        assert image.viewing_direction()[2] < -np.cos(np.radians(8))


@pytest.mark.parametrize("line", [True, False])
@pytest.mark.parametrize(("smaller", "believed"), [(1, True), (12, False)])
def test_positions_that_are_wrong_by_as_much_as_the_flight_is_wide_tell_no_scale(made, flight, smaller, believed, line):
    """Metres wrong, as a phone is: of the nine photographs 9 m apart, and of as many around an object."""
    photographs = [photo for photo in collect_images([flight.folder]).images if photo.name in flight.names]
    model = pycolmap.Reconstruction(made / "sparse" / "0")
    positions = read_gps_priors(photographs, None, (3.0, 3.0) if line else (0.1, 0.1))
    drift = np.random.default_rng(4).normal(0, 0.9, positions.enu.shape)
    placed = georegister(model, photographs, replace(positions, enu=positions.enu / smaller + drift))
    assert isinstance(placed, Georegistration) == believed
    if isinstance(placed, AlignmentFailure):
        assert "disagree" in placed.reason
        assert "over a flight of" in placed.reason
        assert "--gcp" in placed.remedy
        assert "--georeference anyway" in placed.remedy
    else:
        assert placed.similarity.scale == pytest.approx(1, abs=0.15)
        assert abs(placed.similarity.scale - 1) < placed.accuracy.scale_percent / 100


def test_positions_that_disagree_leave_the_scale_arbitrary_and_say_why(made, flight, tmp_path, monkeypatch):
    output, said = tmp_path / "capture", console()
    shutil.copytree(made, output, symlinks=True)
    found = AlignmentFailure("the positions disagree by 2 m", "give better ones")
    monkeypatch.setattr(georegistration, "georegister", lambda *_, **__: found)
    facts = reconstruct(
        SfmRequest(image_folders=(flight.folder,), output=output, threads=1, options=SfmOptions(max_output_size=200)),
        said,
    )
    assert (facts.origin, facts.residual_rms_m) == (None, None)
    assert "disagree by 2 m" in facts.georeferenced
    assert (
        "not georeferenced (the positions disagree by 2 m): the scale of the scene is arbitrary" in said.file.getvalue()
    )
    assert "To mend it, give better ones" in said.file.getvalue()
    assert not (output / "georef.json").exists()
    assert not load_capture(output).ground.metric


def test_facts_are_plain_json(made):
    written = json.loads((made / "reconstruction.json").read_text())
    assert written["registered"] == 9
    georef = json.loads((made / "georef.json").read_text())
    assert georef["gps_residual_rms_m_xyz"] == pytest.approx(written["residual_rms_m"])


def asked(flight: Flight, output: Path) -> RunRequest:
    return RunRequest(
        capture=flight.folder, output=output, preset="laptop", threads=1, training=PRESETS["laptop"].training
    )


def test_a_run_of_photographs_makes_them_a_capture_first_and_reports_how(made, flight, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(made, run / "capture", symlinks=True)  # as the stage leaves it
    request = reconstruct_if_needed(replace(asked(flight, run), sfm=SfmOptions()), console())
    assert request.capture == run / "capture"
    assert reconstruct_if_needed(request, console()) == request  # a capture is taken as it is
    context = create_or_resume_run(request.capture, request.output, request.options, request.method(), overwrite=False)
    folder, capture = context.run, context.capture
    assert capture.ground.metric
    page = write_report(folder).read_text()
    assert "From photographs to cameras" in page
    assert "cut.jpg" in page


def test_a_dry_run_of_photographs_looks_and_writes_nothing(flight, tmp_path, monkeypatch):
    request, said = replace(asked(flight, tmp_path / "run"), device="cpu"), console()
    estimate = estimate_run(request, said)
    assert {"photographs", "coarse", "blocks", "measuring"} <= {
        name for name, cost in estimate.times.items() if cost.seconds > 0
    }
    assert "the whole job: about" in said.file.getvalue()
    assert "10 of 10" in said.file.getvalue()
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(sfm_estimate.feature_matching, "count_inliers", lambda workspace: [])  # three far apart
    assert sfm_estimate.estimate_sfm(plan_reconstruction(make_sfm_request(request))).points > 100


def test_a_run_among_other_files_is_refused_before_the_work(flight, tmp_path):
    (tmp_path / "thesis.txt").write_text("three years")
    with pytest.raises(RunError, match="holds other files"):
        reconstruct_if_needed(asked(flight, tmp_path), console())


def test_an_interrupted_call_is_waited_for():
    """What still runs while Python ends would abort the process."""
    ended = []

    def long(cancellation_token):
        os.kill(os.getpid(), signal.SIGINT)
        while not cancellation_token.is_cancelled:
            Event().wait(0.001)
        ended.append(True)

    with pytest.raises(KeyboardInterrupt), catch_stop_signals(interrupts=True):
        call_cancellable(long)
    assert ended
