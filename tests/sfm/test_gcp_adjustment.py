"""Surveyed points hold a model where they were surveyed, and measure it where they are held out."""

from __future__ import annotations

import io
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("embreex")
pytest.importorskip("pyproj")

from support.flights import ALTITUDE_M, HEIGHT, ORIGIN, WIDTH, Flight, sightings
from support.gcp_files import NAMES, PLACES, SURVEY_OFF, write_list
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import gcp_table, is_finished, read_reconstruction, report_rows
from vdgs.captures.validation import validate_capture
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.sfm import capture_writer, focal_decision
from vdgs.sfm import reconstruct as reconstructing
from vdgs.sfm.feature_extraction import CameraGroup
from vdgs.sfm.gcp_adjustment import Level, fit_surveyed, fit_to_gcps, gcp_accuracy, no_better_than_left
from vdgs.sfm.reconstruct import reconstruct
from vdgs.system.lazy_pycolmap import pycolmap

pytestmark = [pytest.mark.xdist_group("sfm"), pytest.mark.slow]


def console() -> Console:
    return Console(file=io.StringIO(), width=500)


@pytest.fixture(scope="module")
def flight(nine) -> Flight:
    return nine


@pytest.fixture(scope="module")
def points(flight) -> list[dict[int, np.ndarray]]:
    return sightings(flight.cameras, PLACES)


@pytest.fixture
def made(nine_begun) -> Path:
    """Placed by GPS; its features, matches and model are kept."""
    return nine_begun["made"]


def test_points_that_fit_to_a_part_of_a_pixel_are_no_outliers():
    """One on a roof, off by a few centimetres, where the others agree to a millimetre and a pixel shows 11 cm."""
    rng = np.random.default_rng(2)
    surveyed = np.column_stack([rng.uniform(-40, 40, (8, 2)), rng.normal(0, 0.2, 8)])
    surveyed[3, 2] = 12.6
    seen = surveyed + rng.normal(0, 0.001, surveyed.shape)
    seen[3, 2] += 0.04
    assert not fit_to_gcps(seen / 5, surveyed)[1][3]
    found, trusted = fit_to_gcps(seen / 5, surveyed, 0.11 / 5)
    assert trusted.all()
    assert found.scale == pytest.approx(5, rel=1e-3)
    seen[3, 2] += 1
    assert fit_to_gcps(seen / 5, surveyed, 0.11 / 5)[1].tolist() == [k != 3 for k in range(8)]


@pytest.mark.parametrize(("count", "wrong"), [(5, 0), (6, 0), (7, 1), (9, 0)])
def test_the_stated_accuracy_of_few_points_holds(count, wrong):
    rng = np.random.default_rng(count)
    surveys, beyond = 100, np.zeros(4)
    for _ in range(surveys):
        surveyed = rng.uniform(-100, 100, (count, 3)) * [1, 1, 0.05]
        seen = surveyed + rng.normal(size=(count, 3)) * [0.03, 0.03, 0.06]
        seen[:wrong] += [2.0, -1.0, 1.0]
        found, trusted = fit_to_gcps(seen, surveyed)
        stated = gcp_accuracy(found.apply(seen[trusted]), surveyed[trusted], int(trusted.sum()))
        middle = surveyed[trusted].mean(axis=0)
        off = np.abs(found.apply(middle[None])[0] - middle)
        beyond += [100 * abs(found.scale - 1) > stated.scale_percent, np.hypot(*off[:2]) > stated.place_m[0],
                   off[2] > stated.place_m[1],
                   np.degrees(np.arccos(found.rotation[2, 2])) > stated.level_deg]  # fmt: skip
    assert (beyond <= np.array([0.1, 0.1, 0.1, 0.2]) * surveys).all(), beyond  # level: about the worse axis alone


@pytest.mark.parametrize(("count", "heights"), [(3, 0), (3, 1), (3, 2), (4, 2), (4, 4)])
def test_known_heights_that_level_nothing_make_the_stated_accuracy_no_better(count, heights):
    """Of 95 % stated, 92 to 98 hold, for north and for scale."""
    rng, within, trials = np.random.default_rng(count + heights), np.zeros(2), 600
    level = Level(up=np.array([0, 0, 1.0]), deviation_deg=1.0, gps=None, gps_up_m=None)
    for _ in range(trials):
        places = np.column_stack([rng.uniform(-100, 100, (count, 2)), rng.uniform(0, 5, count)])
        targets = places + rng.normal(0, 0.03, places.shape)
        targets[heights:, 2] = np.nan
        fit = fit_surveyed(places, targets, level)
        north = np.degrees(np.arctan2(fit.similarity.rotation[1, 0], fit.similarity.rotation[0, 0]))
        scale = 100 * (fit.similarity.scale - 1)
        within += np.abs([north, scale]) <= [fit.accuracy.north_deg, fit.accuracy.scale_percent]
    assert (within >= 0.92 * trials).all()
    assert (within <= 0.98 * trials).all()


def test_one_wrong_height_lifts_no_model_that_heights_do_not_level():
    """Known heights along a line leave level to what else tells it; the median of three holds."""
    places = np.array([[0.0, 0, 1], [30, 0, 2], [60, 0, 3], [10, 50, 4], [50, 40, 0]])
    expected = places + np.array([0, 0, 12.0])
    targets = expected.copy()
    targets[1, 2] += 5
    targets[3:, 2] = np.nan
    fit = fit_surveyed(places, targets, Level(up=np.array([0, 0, 1.0]), deviation_deg=1.0, gps=None, gps_up_m=None))
    assert fit.is_level
    assert fit.aims == pytest.approx(expected)


def surveyed(made: Path, flight: Flight, tmp_path: Path, file: Path | None, *held_out: str):
    output = tmp_path / "capture"
    if not output.exists():
        shutil.copytree(made, output, symlinks=True)
    options = SfmOptions(gcp=file, check_points=held_out)
    said = console()
    facts = reconstruct(
        SfmRequest(image_folders=(flight.folder,), output=output, threads=1, options=options, keep_intermediate=True),
        said,
    )
    return facts, load_capture(output), said.file.getvalue()


def test_a_place_is_no_better_known_than_by_what_a_model_leaves_of_its_points():
    """Nine points of the model itself agree to the last bit; bent by their marks it leaves millimetres."""
    places = np.random.default_rng(0).uniform(-20, 20, (9, 3))
    stated = gcp_accuracy(places, places, 9)
    assert stated.place_m == (0.0, 0.0)
    left = np.tile([[0.003, 0.004, 0.011], [-0.003, -0.004, np.nan]], (5, 1))[:9]
    across, up = no_better_than_left(stated, left).place_m
    assert across == pytest.approx(2.306 * 0.005 / 3, rel=1e-3)  # Student's t of eight
    assert up == pytest.approx(2.776 * 0.011 / np.sqrt(5), rel=1e-3)  # of the five that have heights
    worse = replace(stated, place_m=(0.5, 0.6))
    assert no_better_than_left(worse, left) == worse
    assert no_better_than_left(replace(stated, place_m=None), left).place_m is None


def test_control_points_hold_a_model_where_they_were_surveyed(made, flight, points, tmp_path):
    """GPS is beside the survey by metres, and does not matter; points that were held out come out right."""
    file = write_list(tmp_path / "gcp_list.txt", flight, points)
    facts, capture, said = surveyed(made, flight, tmp_path, file, "well", "fence")
    assert "placed anew" in said
    assert [each.role for each in facts.survey] == ["control"] * 4 + ["check"] * 2 + ["control"]
    assert max(facts.gcp_rmse_m("check")) < 0.12  # a pixel shows 0.13 m
    assert max(facts.gcp_rmse_m("control")) < 0.12
    assert np.mean([each.residual_m for each in facts.photographs if each.residual_m], axis=0) == pytest.approx(
        SURVEY_OFF, abs=0.3
    )
    shift = enu_from_geodetic(np.array([capture.ground.origin_geo]), ORIGIN)[0]
    for view, truth in zip(capture.views, flight.cameras, strict=True):
        assert np.linalg.norm(view.camera.position + shift - truth.position - SURVEY_OFF) < 0.6
    assert "heights as in gcp_list.txt" in facts.altitude_reference
    rows = dict(report_rows(facts))
    assert rows["Control points"].startswith("5, place the model: RMSE 0.")
    assert rows["Check points"].startswith("2, held out: RMSE 0.")
    assert [row[0] for row in gcp_table(facts)] == list(NAMES)
    assert read_reconstruction(tmp_path / "capture") == facts


@pytest.mark.parametrize("then", ["the old command", "the new command"])
def test_photographs_of_another_lens_are_written_all_or_none(made, flight, points, tmp_path, monkeypatch, then):
    """Control points tell another lens; stopped among the photographs, the capture is not finished."""
    file = write_list(tmp_path / "gcp_list.txt", flight, points)
    surveyed(made, flight, tmp_path, None)
    monkeypatch.setattr(reconstructing, "LENS_PX", 0.0)
    before, write, output = written(tmp_path / "capture"), capture_writer.write_images, tmp_path / "capture"

    def stopped(folder, work, names, *rest):
        write(folder, work, {number: members[:4] for number, members in names.items()}, *rest)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(capture_writer, "write_images", stopped)
        with pytest.raises(KeyboardInterrupt):
            surveyed(made, flight, tmp_path, file)
    assert not is_finished(output)
    assert not (output / "sparse").exists()
    assert len(written(output)) < len(before)
    _, capture, said = surveyed(made, flight, tmp_path, file if then == "the new command" else None)
    assert "placed anew" in said
    assert validate_capture(capture).problems == ()
    assert (written(output) == before) is (then == "the old command")
    assert "nothing to do" in surveyed(made, flight, tmp_path, file if then == "the new command" else None)[2]
    assert (output / "work" / "database.db").is_file()  # asked to keep


def written(capture: Path) -> dict[str, bytes]:
    return {str(file.relative_to(capture)): file.read_bytes() for file in capture.glob("images*/*")}


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", (3000.0, 2000, 1500, -0.05)),
        ("OPENCV", (3000.0, 3010, 2000, 1500, -0.05, 0.01, 0.001, -0.001)),
        ("OPENCV_FISHEYE", (1500.0, 1500, 2000, 1500, 0.01, -0.002, 0.001, 0.0005)),
    ],
)
def test_every_term_of_a_lens_moves_photographs(model, params):
    lens = Intrinsics(model, params, 4000, 3000)
    assert capture_writer.lens_shift_px({1: lens}, {1: lens}) == 0
    assert capture_writer.lens_shift_px({}, {1: lens}) == np.inf
    for k in range(len(params)):
        other = replace(lens, params=(*params[:k], params[k] + (0.01 if params[k] < 1 else 5), *params[k + 1 :]))
        assert capture_writer.lens_shift_px({1: lens}, {1: other}) > reconstructing.LENS_PX
        slight = replace(lens, params=(*params[:k], params[k] * (1 + 1e-8), *params[k + 1 :]))
        assert capture_writer.lens_shift_px({1: lens}, {1: slight}) < reconstructing.LENS_PX


def test_a_national_datum_counts_in_the_place_of_control_points(made, flight, points, tmp_path):
    """Chile's PSAD56 leads to WGS 84 by a shift that is good to 17 m."""
    stated = {}
    for system in ("EPSG:32719", "EPSG:24879"):
        (tmp_path / system).mkdir()
        listed = write_list(tmp_path / system / "gcp_list.txt", flight, points, system)
        facts, _, said = surveyed(made, flight, tmp_path / system, listed)
        stated[system] = facts.accuracy.place_m[0]
        assert ("converted from PSAD56 to WGS 84, good to 17 m" in said) is (system == "EPSG:24879")
    assert stated["EPSG:24879"] == pytest.approx(np.hypot(stated["EPSG:32719"], 17), abs=0.1)
    assert stated["EPSG:32719"] < 1


def test_control_points_without_heights_count_in_the_plane(made, flight, points, tmp_path):
    """Of some points; of all, whose model then lies as high as GPS says, upright by the attitudes."""
    file = write_list(tmp_path / "gcp_list.txt", flight, points)
    text = file.read_text()
    rows = [line.split() for line in text.splitlines()[3:]]
    for flat in (NAMES[4:], NAMES):
        words = [[*row[:2], "nan" if row[6] in flat else row[2], *row[3:]] for row in rows]
        file.write_text("\n".join(["EPSG:32719", *(" ".join(each) for each in words)]))
        facts, capture, said = surveyed(made, flight, tmp_path, file, "well")
        off = {each.name: each.residual_m for each in facts.survey}
        assert [len(off[name]) for name in NAMES] == [2 if name in flat else 3 for name in NAMES]
        assert np.abs([value[:2] for value in off.values()]).max() < 0.3
        assert "points without a height (" in said
        assert dict(report_rows(facts))["Check points"].endswith("m north")
        shift = enu_from_geodetic(np.array([capture.ground.origin_geo]), ORIGIN)[0]
        heights = [view.camera.position[2] + shift[2] for view in capture.views]
        up = np.median(np.subtract(heights, [camera.position[2] for camera in flight.cameras]))
        if flat == NAMES:
            assert up == pytest.approx(0, abs=3)  # GPS, straight down from one height
            assert "heights are by GPS" in said
            assert len(facts.accuracy.place_m) == 2
        else:
            assert up == pytest.approx(SURVEY_OFF[2], abs=0.5)
            assert "too few control points" not in said


def test_check_points_measure_a_model_that_gps_placed(made, flight, points, tmp_path):
    file = write_list(tmp_path / "gcp_list.txt", flight, points)
    facts, capture, _ = surveyed(made, flight, tmp_path, file, "all")
    assert facts.gcp_rmse_m("control") is None
    across, up = np.array(facts.gcp_rmse_m("check")[:2]), facts.gcp_rmse_m("check")[2]
    assert across == pytest.approx(np.abs(SURVEY_OFF[:2]), abs=0.3)
    assert up == pytest.approx(SURVEY_OFF[2], abs=2.5)  # straight down from one height, nothing else tells the depth
    assert max(facts.residual_rms_m) < 0.3  # it lies where GPS says
    known = load_capture(made)
    for view, before in zip(capture.views, known.views, strict=True):
        assert np.allclose(view.camera.camera_from_world, before.camera.camera_from_world, atol=1e-6)


def test_a_point_that_does_not_fit_and_marks_that_are_wrong_are_named(made, flight, points, tmp_path):
    moved = [dict(seen) for seen in points]
    moved[2][-1] = moved[2][-1] + [0, 6.0, 0]
    first = next(k for k in moved[0] if k >= 0)
    moved[0][first] = np.clip(moved[0][first] + [60, 0], 0, [WIDTH, HEIGHT])
    facts, _, said = surveyed(made, flight, tmp_path, write_list(tmp_path / "gcp_list.txt", flight, moved))
    assert "the control point gate does not fit the others" in said
    assert "the surveyed point north_west is marked" in said
    assert max(facts.gcp_rmse_m("control")) < 0.4
    off = {each.name: each.residual_m for each in facts.survey}["gate"]
    assert off == pytest.approx((0, -6, 0), abs=0.6)
    assert pytest.approx(facts.height_m, abs=4) == ALTITUDE_M


@pytest.mark.parametrize(
    ("spread", "open_", "held"),
    [(focal_decision.MIN_HEIGHT_SPREAD, 0.001, True), (0.0, 0.001, False), (0.0, 0.1, True)],
)
def test_a_focal_length_that_altitudes_leave_open_is_fitted_where_the_model_shows_several_heights(
    made, monkeypatch, spread, open_, held
):
    """And where its views differ enough in direction to tell it."""
    model = pycolmap.Reconstruction(made / "mapped")
    before = [camera.params.copy() for camera in model.cameras.values()]
    monkeypatch.setattr(focal_decision, "MIN_HEIGHT_SPREAD", spread)  # any height is another one
    monkeypatch.setattr(focal_decision, "focal_deviation", lambda _: open_)
    found = focal_decision.release_focal([model], (True, focal_decision.OF_FLIGHTS), [], 1)
    assert found[0] is held
    after = [camera.params for camera in model.cameras.values()]
    assert np.array_equal(before, after) is held
    assert focal_decision.release_focal([model], (False, "asked for"), [], 1) == (False, "asked for")


@pytest.mark.parametrize("factor", [1.0, 0.6, 1.5])
def test_a_focal_length_that_one_tag_alone_says_is_given_up_where_photographs_contradict_it(made, factor):
    model = pycolmap.Reconstruction(made / "mapped")
    for camera in model.cameras.values():
        camera.focal_length *= factor
    held = pycolmap.BundleAdjustmentOptions()
    held.print_summary, held.refine_focal_length = False, False
    pycolmap.bundle_adjustment(model, held)  # what a mapper makes of it
    group = CameraGroup(
        camera="", width=0, height=0, focal_px=model.cameras[1].focal_length, has_focal_prior=True, source="",
        images=(), is_confirmed=False,
    )  # fmt: skip
    why, groups = (True, "one height"), [group]
    assert focal_decision.is_contradicted(model, why, groups, 1) is (factor != 1)
    assert model.cameras[1].focal_length == group.focal_px
    for not_asked in ((False, "fitted"), (True, focal_decision.ASKED)):
        assert not focal_decision.is_contradicted(model, not_asked, groups, 1)
    assert not focal_decision.is_contradicted(model, why, [replace(group, is_confirmed=True)], 1)


@pytest.mark.parametrize("flip", ["exchanged", "from the lower edge", "of half the size"])
def test_marks_that_are_read_wrongly_are_refused_and_the_capture_stays(made, flight, points, tmp_path, flip):
    def wrong(pixel: np.ndarray) -> np.ndarray:
        if flip == "of half the size":
            return pixel / 2
        return pixel[::-1] if flip == "exchanged" else np.array([pixel[0], HEIGHT - pixel[1]])

    marked = [{k: p if k < 0 else wrong(p) for k, p in seen.items()} for seen in points]
    marked = [{k: p for k, p in seen.items() if k < 0 or p[1] <= HEIGHT} for seen in marked]
    with pytest.raises(
        CaptureError, match=r"px and py change places|py counts from the lower edge|photographs of another size"
    ):
        surveyed(made, flight, tmp_path, write_list(tmp_path / "gcp_list.txt", flight, marked))
    assert load_capture(tmp_path / "capture").ground.metric


def test_control_points_in_feet_or_with_x_and_y_exchanged_are_refused(made, flight, points, tmp_path):
    text = write_list(tmp_path / "gcp_list.txt", flight, points).read_text().splitlines()
    rows = [line.split() for line in text[3:]]
    feet = [[*row[:2], f"{float(row[2]) / 0.3048:.3f}", *row[3:]] for row in rows]
    (tmp_path / "feet.txt").write_text("\n".join([text[0], *(" ".join(row) for row in feet)]))
    with pytest.raises(CaptureError, match="feet"):
        surveyed(made, flight, tmp_path, tmp_path / "feet.txt")
    mirrored = [{k: (p[[1, 0, 2]] if k < 0 else p) for k, p in seen.items()} for seen in points]
    with pytest.raises(CaptureError, match=r"x \(east\) and y \(north\) exchanged"):
        surveyed(made, flight, tmp_path, write_list(tmp_path / "gcp_list.txt", flight, mirrored))
