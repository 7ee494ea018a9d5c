"""Positions of different accuracy: each counts by what its receiver states, as far as the residuals agree."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.captures import tiny_scene
from vdgs.captures.formats.source_capture import Intrinsics, SourceCapture, SourceView
from vdgs.captures.ground_estimation import find_ground_frame
from vdgs.captures.position_adjustment import PositionFit, Problem, Up
from vdgs.captures.position_fit import fit_positions
from vdgs.captures.position_weights import agreed, are_told, relative_deviations, weighing_note, with_unstated
from vdgs.config.capture_options import CaptureOptions
from vdgs.geometry.geodesy import geodetic_from_enu

pytestmark = pytest.mark.slow

AXES = np.array([1.0, 1.0, 2.0])
COUNT = 48


def fitted(off_m: np.ndarray, said_m: np.ndarray, seed: int, weighed: bool = True) -> tuple[PositionFit, np.ndarray]:
    """The fit of strips whose positions are off by normal errors [n] (one standard deviation) where receivers say
    `said_m` [n] (NaN for nothing), and by how much the places are off [3]."""
    rng, count = np.random.default_rng(seed), len(off_m)
    long = 8 if count >= 16 else 2
    strip, k = np.divmod(np.arange(count), long)
    along = 25.0 * np.where(strip % 2, long - 1 - k, k)
    places = np.stack([along, 30.0 * strip, 75 + rng.normal(0, 2, count)], axis=1)
    turn = Rotation.random(random_state=seed).as_matrix()
    askew = Rotation.from_rotvec([*rng.normal(0, np.radians(1.5), 2), 0]).as_matrix()
    said = np.isfinite(said_m)
    deviations = with_unstated(np.where(said, said_m, 1.0)[:, None] * AXES, said)
    recorded = places + off_m[:, None] * AXES * rng.normal(size=(count, 3))
    fit = fit_positions(
        Problem(
            centers=places @ turn / 13 + [1.0, -2, 3], targets=recorded,
            times=np.linspace(0, 1, count), up=Up(turn.T @ askew @ [0.0, 0, 1], 2.0, "the views"),
            stated=deviations if are_told(deviations, said) else None,
            relative=relative_deviations(deviations) if weighed else None,
        )
    )  # fmt: skip
    return fit, np.sqrt(((fit.placed - places) ** 2).mean(axis=0))


def bad(share: float, seed: int) -> np.ndarray:
    return np.random.default_rng(100 + seed).permutation(COUNT) < share * COUNT


@pytest.mark.parametrize(
    ("share", "good_m", "bad_m", "says"),
    [(0.4, 0.015, 3.0, True), (0.7, 0.02, 3.0, True), (0.4, 0.02, 2.0, False)],
)
def test_photographs_with_a_fix_place_the_scene_beside_others_without(share, good_m, bad_m, says):
    within = []
    for seed in range(4):
        worse = bad(share, seed)
        off = np.where(worse, bad_m, good_m)
        fit, error = fitted(off, np.where(worse, bad_m if says else np.nan, good_m), seed)
        assert (error < [0.03, 0.03, 0.06]).all()
        assert fit.gps_std[0] < 3 * good_m
        assert fit.place_error_m[0] < 0.3
        assert fit.inliers[~worse].mean() > 0.9
        assert f"{(~worse & fit.inliers).sum()} of them" in weighing_note(fit.deviations, fit.inliers)
        within += [abs(fit.similarity.scale / 13 - 1) <= fit.scale_error, error[0] <= fit.place_error_m[0]]
    assert np.mean(within) >= 0.85


@pytest.mark.parametrize("share", [0.9, 0.6])
def test_accuracies_that_the_residuals_contradict_do_no_harm(share):
    """Some say centimetres and are metres off like all others."""
    for seed in range(3):
        fit, error = fitted(np.full(COUNT, 2.0), np.where(bad(share, seed), 2.0, 0.02), seed)
        plain, as_before = fitted(np.full(COUNT, 2.0), np.full(COUNT, 2.0), seed, weighed=False)
        assert np.linalg.norm(error) < 1.5 * np.linalg.norm(as_before) + 0.3
        assert fit.gps_std[0] == pytest.approx(plain.gps_std[0], rel=0.4)
        assert fit.place_error_m[0] > 0.5 * plain.place_error_m[0]


def test_accuracies_that_say_the_opposite_make_positions_no_worse_than_they_are():
    worse = bad(0.5, 0)
    fit, error = fitted(np.where(worse, 0.02, 2.0), np.where(worse, 2.0, 0.02), 0)
    assert fit.gps_std[0] < 2.5
    assert (error < [1.5, 1.5, 3.0]).all()


def test_a_wrong_fix_is_an_outlier_by_its_own_accuracy():
    worse = bad(0.4, 0)
    off = np.where(worse, 2.0, 0.02)
    wrong = np.flatnonzero(~worse)[:3]
    off[wrong] = 30.0
    fit, error = fitted(off, np.where(worse, 2.0, 0.02), 0)
    assert not fit.inliers[wrong].any()
    assert (error < 0.06).all()


@pytest.mark.parametrize("said_m", [0.02, 2.0])
def test_positions_that_state_about_the_same_count_alike(said_m):
    said = np.random.default_rng(0).uniform(said_m, 1.9 * said_m, COUNT)
    assert relative_deviations(said[:, None] * AXES) is None
    one, _ = fitted(np.full(COUNT, said_m), said, 0)
    other, _ = fitted(np.full(COUNT, said_m), said, 0, weighed=False)
    assert np.array_equal(one.placed, other.placed)
    assert weighing_note(one.deviations, one.inliers) == ""


@pytest.mark.parametrize(("count", "good"), [(5, 2), (5, 3), (3, 2)])
@pytest.mark.parametrize("off_m", [0.02, 1.5])
def test_few_positions_count_alike_whatever_they_say(count, good, off_m):
    """A fit can follow each of few: none shows whether what it says is true."""
    within = []
    for seed in range(12):
        best = np.random.default_rng(seed).permutation(count) < good
        fit, error = fitted(np.where(best, off_m, 3.0), np.where(best, 0.02, 3.0), seed)
        assert (fit.deviations == fit.gps_std).all()
        assert weighing_note(fit.deviations, fit.inliers) == ""
        within += [error[0] <= fit.place_error_m[0], error[2] <= fit.place_error_m[1]]
        within += [abs(fit.similarity.scale / 13 - 1) <= fit.scale_error]
    assert np.mean(within) >= 0.9


@pytest.mark.parametrize("off_m", [0.02, 0.5, 2.0])
def test_more_positions_of_the_same_accuracy_tell_the_same(off_m):
    """Thousands, of which some tell most, as those that they repeat."""
    rng, worse = np.random.default_rng(0), bad(0.5, 0)[:-1, None]
    relative = relative_deviations(np.where(worse, 2.0, 0.02) * AXES)
    assert relative is not None
    residuals = np.where(worse, 2.0, off_m) * AXES * rng.normal(size=relative.shape)
    few, many = (
        agreed(*(np.tile(each, (times, 1)) for each in (relative, residuals, np.zeros_like(relative))))
        for times in (1, 60)
    )
    assert many == pytest.approx(np.tile(few, (60, 1)), rel=1e-6)


def test_accuracies_in_a_table_count_for_a_capture_with_poses(tmp_path):
    scene, rng = tiny_scene(), np.random.default_rng(0)
    views, rows = [], ["name,lat,lon,alt,hacc,vacc"]
    for k, (name, camera) in enumerate(scene.cameras.items()):
        pose, good = camera.camera_from_world, 0.02 if k % 2 else 3.0
        lens = Intrinsics("PINHOLE", (50.0, 50.0, 32.0, 24.0), 64, 48)
        views.append(SourceView(name=name, camera_from_world=pose, intrinsics=lens))
        place = camera.position + rng.normal(0, good, 3)
        lat, lon, alt = geodetic_from_enu(place[None], (46.8, -92.0, 160.0))[0]
        rows.append(f"{name},{lat:.10f},{lon:.10f},{alt:.4f},{good},{2 * good}")
    (tmp_path / "gps.csv").write_text("\n".join(rows))
    source = SourceCapture(
        source="colmap", images="images", views=tuple(views), points=scene.points, colors=scene.colors
    )
    frame, warnings = find_ground_frame(source, tmp_path, CaptureOptions(gps=tmp_path / "gps.csv"))
    assert "positions count by the accuracy that each states" in "".join(warnings)
    assert frame.scale == pytest.approx(1.0, abs=0.01)
