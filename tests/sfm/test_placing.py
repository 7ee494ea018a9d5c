"""A finished capture is placed anew by other positions, known distances or none; contradictions leave it as it is."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from rich.console import Console

pytest.importorskip("embreex")

from support.flights import ORIGIN, Flight, copy_folder, sightings, unestimated, write_photograph
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import is_capture
from vdgs.captures.reconstruction import MAPPED, is_finished, read_reconstruction, report_rows
from vdgs.captures.validation import validate_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.method import MethodConfig
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, RunError, VdgsError
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.pipeline import dry_run
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.sfm import feature_extraction, feature_matching, gps_priors, incremental_mapper, scale_bars, workspace
from vdgs.sfm import reconstruct as reconstruction
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.reconstruct import reconstruct
from vdgs.system.atomic_files import write_json

pytestmark = [pytest.mark.xdist_group("sfm"), pytest.mark.slow]


def console() -> Console:
    return Console(file=io.StringIO(), width=500)


@pytest.fixture
def capture(nine_begun, tmp_path, monkeypatch) -> Path:
    """A copy, placed by GPS, whose features, matches and poses must not be made again."""
    copy_folder(nine_begun["done"], tmp_path / "capture")
    for room, name in (
        (feature_extraction, "extract_features"),
        (feature_matching, "match_pairs"),
        (incremental_mapper, "run_mapper"),
    ):
        monkeypatch.setattr(room, name, lambda *_: pytest.fail("was done already"))
    return tmp_path / "capture"


def again(flight: Flight, capture: Path, gps: Path | None = None, **options):
    said = console()
    request = SfmRequest(
        image_folders=(flight.folder,), output=capture, gps=gps, threads=1, options=SfmOptions(**options)
    )
    return reconstruct(request, said), said.file.getvalue()


def table(file: Path, flight: Flight, change=lambda enu: enu, columns=(0, 1, 2)) -> Path:
    enu = change(np.array([camera.position for camera in flight.cameras]))
    geodetic = geodetic_from_enu(enu, ORIGIN)[:, columns]
    rows = [f"{name},{a:.9f},{b:.9f},{c:.3f}" for name, (a, b, c) in zip(flight.names, geodetic, strict=True)]
    file.write_text("\n".join(["name,lat,lon,alt", *rows]))
    return file


def files(folder: Path) -> dict[str, bytes]:
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in found if path.suffix != ".JPG"}


def test_a_table_given_afterwards_moves_the_finished_capture(nine, capture, tmp_path, monkeypatch):
    shift = np.array([30.0, -20, 15])
    before = read_reconstruction(capture)
    facts, said = again(nine, capture, table(tmp_path / "gps.csv", nine, lambda enu: enu + shift))
    assert "placed anew" in said
    assert max(facts.residual_rms_m) < 0.3
    assert (facts.registered, facts.pairs, facts.found) == (before.registered, before.pairs, before.found)
    scene = load_capture(capture)
    assert validate_capture(scene).problems == ()
    assert "scale ±" in scene.ground.description  # what maps and reports say of their place
    origin = np.array(facts.origin) - before.origin
    assert origin[2] == pytest.approx(15, abs=1)
    for label in ("Accuracy", "Positions are good to"):
        assert label in dict(report_rows(facts))
    written = json.loads((capture / "reconstruction.json").read_text())["accuracy"]
    assert written["scale_percent"] > 0
    monkeypatch.setattr(workspace, "_VERSION", " by vdgs 99.0")  # after an upgrade
    assert "nothing to do" in again(nine, capture, tmp_path / "gps.csv")[1]
    moved, said = again(nine, capture, table(tmp_path / "gps.csv", nine, lambda enu: enu - shift))
    assert "placed anew" in said
    assert moved.origin[2] - before.origin[2] == pytest.approx(-15, abs=1)


@pytest.mark.parametrize("altitudes", [True, False])
def test_positions_of_half_of_the_photographs_place_all(nine, capture, tmp_path, altitudes, monkeypatch):
    rows = table(tmp_path / "gps.csv", nine).read_text().splitlines()[:1:-2]
    if not altitudes:
        monkeypatch.setattr(gps_priors, "_or_nan", lambda value: np.nan)
        monkeypatch.setattr(gps_priors, "with_take_off_heights", lambda places, kinds, photos: (places, kinds, []))
    lines = rows if altitudes else [row.rpartition(",")[0] for row in rows]
    (tmp_path / "gps.csv").write_text("\n".join(["name,lat,lon,alt" if altitudes else "name,lat,lon", *lines]))
    facts, said = again(nine, capture, tmp_path / "gps.csv")
    assert f"positions of {len(rows)} photographs" in facts.georeferenced
    assert facts.registered == 9
    assert facts.height_m == pytest.approx(45, abs=2)
    assert facts.accuracy.scale_percent < 10
    assert len(facts.residual_rms_m) == (3 if altitudes else 2)
    georef = json.loads((capture / "georef.json").read_text())
    assert (georef["origin_alt_m"] == 0) != altitudes
    assert ("heights above the sea are not known" in said) != altitudes
    scene = load_capture(capture)
    assert scene.ground.metric
    assert validate_capture(scene).problems == ()


def test_altitudes_that_drift_afterwards_tilt_nothing(nine, capture, tmp_path):
    drift = np.outer(np.linspace(0, 30, 9), [0, 0, 1])
    facts, said = again(nine, capture, table(tmp_path / "gps.csv", nine, lambda enu: enu + drift))
    assert facts.tilt_deg < 5
    assert facts.accuracy.altitude == "drifts" or "barometer" in facts.georeferenced
    assert "drift" in said
    assert facts.height_m == pytest.approx(45, abs=4)


def test_mirrored_tables_are_refused_and_leave_the_capture_as_it_was(nine, capture, tmp_path):
    before = files(capture)
    mirrored = table(tmp_path / "north.csv", nine, lambda enu: enu * [1, -1, 1])
    exchanged = table(tmp_path / "exchanged.csv", nine, columns=(1, 0, 2))
    for file in (mirrored, exchanged):
        with pytest.raises(CaptureError, match=r"latitude and longitude (are )?exchanged"):
            again(nine, capture, file)
    assert files(capture) == before
    assert "used all the same" in again(nine, capture, mirrored, georeference="anyway")[1]


def test_what_was_trained_is_deleted_only_once_the_new_place_is_not_refused(nine, capture, tmp_path):
    run = RunFolder(tmp_path / "run")
    write_json(run.capture_file, {})  # as training leaves it
    mirrored = table(tmp_path / "north.csv", nine, lambda enu: enu * [1, -1, 1])
    request = SfmRequest(image_folders=(nine.folder,), output=capture, gps=mirrored, threads=1, overwrite=True)
    before = files(capture)
    with pytest.raises(CaptureError, match="mirrored"):
        reconstruct(request, console(), run, "vdgs run --gps north.csv")
    assert run.is_trained
    assert files(capture) == before
    right = table(tmp_path / "gps.csv", nine, lambda enu: enu + 1)
    reconstruct(replace(request, gps=right), console(), run, "vdgs run --gps gps.csv")
    assert not run.is_trained


def test_what_was_trained_stays_until_another_capture_takes_its_place(nine, capture, tmp_path, monkeypatch):
    shutil.copytree(capture, tmp_path / "run" / "capture", symlinks=True)
    run, same = RunFolder(tmp_path / "run"), SfmRequest(image_folders=(nine.folder,), output=capture, threads=1)
    same = replace(same, output=run.own_capture)
    anew = replace(same, options=SfmOptions(max_output_size=200))
    write_json(run.capture_file, {})  # as training leaves it

    def refuse(*_):
        raise CaptureError("no scene can be made of these")

    monkeypatch.setattr(reconstruction, "_features", refuse)
    monkeypatch.setattr(reconstruction, "estimate_sfm", unestimated)
    for request in (replace(anew, overwrite=True), anew):  # the same command goes on, whose --overwrite is not kept
        with pytest.raises(CaptureError, match="no scene"):
            reconstruct(request, console(), run)
    assert run.is_trained
    assert load_capture(run.own_capture).views
    assert not is_finished(run.own_capture)
    with pytest.raises(RunError, match="Add --overwrite"):
        reconstruct(replace(anew, options=SfmOptions(max_output_size=300)), console(), run)
    reconstruct(same, console(), run)  # it is there as it was
    assert run.is_trained
    assert is_finished(run.own_capture)
    with pytest.raises(RunError, match="Add --overwrite"):
        reconstruct(anew, console(), run)


def test_a_look_says_what_is_left_and_refuses_what_the_work_refuses(nine, capture, tmp_path, monkeypatch):
    gps = table(tmp_path / "gps.csv", nine, lambda enu: enu + 1)
    shutil.copytree(capture, tmp_path / "run" / "capture", symlinks=True)
    run, card = RunFolder(tmp_path / "run"), tmp_path / "card"
    shutil.copytree(nine.folder, card)
    same = RunRequest(capture=nine.folder, output=run.path, threads=1)
    other = replace(same, options=CaptureOptions(gps=gps))
    anew = replace(same, sfm=SfmOptions(max_output_size=200))
    run.create_or_check(RunSettings.create(run.own_capture, CaptureOptions(), MethodConfig()))
    write_json(run.capture_file, {})  # as training leaves it
    before, found = files(run.path), []
    monkeypatch.setattr(dry_run, "estimate_sfm", lambda plan: found.append("all") or unestimated(plan))
    monkeypatch.setattr(dry_run, "choose_for_photographs", lambda *_: SimpleNamespace(estimate=1))
    monkeypatch.setattr(dry_run, "_estimate_from_capture", lambda *_, is_anew: found.append(is_anew))
    monkeypatch.setattr(dry_run, "_print_estimate", lambda *_: None)
    for request, left, told in (
        (same, False, "nothing to do"),
        (replace(other, overwrite=True), True, "is placed anew, in seconds; its photographs and poses stay; what was"),
        (replace(anew, overwrite=True), "all", "with other settings (--sfm.*); it is made anew; what was trained"),
    ):
        said = console()
        dry_run.estimate_run(request, said)
        assert found.pop() == left
        assert told in said.file.getvalue()
    for request in (other, anew):
        with pytest.raises(RunError, match="was made with other positions or other settings"):
            dry_run.estimate_run(request, console())
    (card / nine.names[0]).unlink()
    with pytest.raises(VdgsError, match=rf"1 removed \({nine.names[0]}\)"):
        dry_run.estimate_run(replace(same, capture=card), console())
    assert (files(run.path), found) == (before, [])


@pytest.fixture(scope="module")
def marks(nine) -> list[dict[int, np.ndarray]]:
    return sightings(nine.cameras, np.array([[-8.0, -8], [9, -7], [8, 9]]))


def bars(file: Path, flight: Flight, marks, factor: float = 1.0) -> Path:
    lines = ["# measured with a tape"]
    for name, seen in zip("ABC", marks, strict=True):
        lines += [f"{name} {seen[k][0]:.2f} {seen[k][1]:.2f} {flight.names[k]}" for k in seen if k >= 0]
    for i, j in ((0, 1), (1, 2)):
        lines.append(f"{'ABC'[i]} {'ABC'[j]} {factor * np.linalg.norm(marks[i][-1] - marks[j][-1]):.3f}")
    file.write_text("\n".join(lines))
    return file


def test_a_known_distance_gives_meters_without_positions(nine, capture, marks, tmp_path):
    off, said = again(nine, capture, georeference="off")
    assert off.origin is None
    assert "--scale-bar" in said
    assert not load_capture(capture).ground.metric
    facts, _ = again(nine, capture, georeference="off", scale_bar=bars(tmp_path / "bars.txt", nine, marks))
    scene = load_capture(capture)
    assert scene.ground.metric
    assert scene.ground.origin_geo is None
    assert facts.height_m == pytest.approx(45, abs=1.5)
    assert facts.accuracy.scale_percent < 5
    assert facts.accuracy.place_m is None
    assert "a known distance (bars.txt)" in facts.georeferenced


def test_a_known_distance_and_positions_agree_or_are_refused(nine, capture, marks, tmp_path):
    facts, _ = again(nine, capture, scale_bar=bars(tmp_path / "bars.txt", nine, marks))
    assert "scale by a known distance" in facts.georeferenced
    assert facts.origin is not None
    with pytest.raises(CaptureError, match=r"3\.[12]\d* times as large.*in feet.*--georeference off"):
        again(nine, capture, scale_bar=bars(tmp_path / "feet.txt", nine, marks, 1 / 0.3048))


def test_some_of_many_points_tell_how_far_what_photographs_show_is(nine, capture, marks, tmp_path, monkeypatch):
    """The limits of a known distance come of it; thousands of photographs times millions of points would last."""
    model, collection = pycolmap.Reconstruction(capture / MAPPED), collect_images((nine.folder,))
    distances = scale_bars.read_scale_bars(bars(tmp_path / "bars.txt", nine, marks), collection)
    all_points = scale_bars.known_scale(model, distances)
    monkeypatch.setattr(scale_bars, "MAX_POINTS", model.num_points3D())
    assert scale_bars.known_scale(model, distances) == all_points
    monkeypatch.setattr(scale_bars, "MAX_POINTS", 50)
    measured, norm = [], np.linalg.norm
    monkeypatch.setattr(np.linalg, "norm", lambda array, **how: measured.append(len(array)) or norm(array, **how))
    assert scale_bars.known_scale(model, distances) == pytest.approx(all_points, rel=0.02)
    assert max(measured) <= 50 < model.num_points3D()


def test_what_a_pixel_changes_with_a_place_follows_lens_and_pose(capture):
    model = pycolmap.Reconstruction(capture / MAPPED)
    image = next(image for image in model.images.values() if image.has_pose)
    place = model.points3D[image.points2D[image.get_observation_point2D_idxs()[0]].point3D_id].xyz
    step = np.array([0.003, -0.002, 0.001])
    moved = image.project_point(place + step) - image.project_point(place - step)
    assert scale_bars._jacobian(model, image, place) @ step * 2 == pytest.approx(moved, rel=1e-3)


BAD_BARS = {
    "nothing": ("", "names no distance"),
    "one photograph": ("A 10 10 DJI_0001.JPG\nB 20 20 DJI_0001.JPG\nA B 3", "A is marked in fewer than two"),
    "no mark": ("A B 3", "A is marked in fewer than two photographs"),
    "no number": ("A B three", "line 1: 'A B three' is not"),
    "no distance": ("A B -3", "line 1: 'A B -3' is not"),
    "unknown": ("A 10 10 DJI_0999.JPG\nA B 3", "line 1: there is no photograph"),
}


@pytest.mark.parametrize(("text", "said"), BAD_BARS.values(), ids=BAD_BARS)
def test_bad_lists_of_distances_are_refused_with_the_line(nine, capture, tmp_path, text, said):
    (tmp_path / "bars.txt").write_text(text)
    with pytest.raises(CaptureError, match=said):
        again(nine, capture, scale_bar=tmp_path / "bars.txt")


def test_two_photographs_that_were_joined_are_no_capture(nine, tmp_path):
    (tmp_path / "card").mkdir()
    for name in nine.names[:2]:
        shutil.copy(nine.folder / name, tmp_path / "card")
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3), np.uint8)
    write_photograph(tmp_path / "card" / "other.jpg", noise, 5, None)
    with pytest.raises(CaptureError, match="only 2 photographs could be joined; a scene needs 3"):
        reconstruct(SfmRequest(image_folders=(tmp_path / "card",), output=tmp_path / "out", threads=1), console())
    assert not (tmp_path / "out" / "sparse").exists()
    assert not is_capture(tmp_path / "out")
