"""Models placed by positions and, bent by them, kept where other things say more: up along a line, a known distance."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from support.flown_models import flown_model, sightings
from vdgs.captures.position_adjustment import Up
from vdgs.captures.reconstruction import AccuracyFacts
from vdgs.config.sfm_options import SfmOptions
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.geometry.similarity import Similarity
from vdgs.sfm import georeferencing, georegistration
from vdgs.sfm.bending import _tears, bend_to_positions, tell_level
from vdgs.sfm.gcp_list import GcpList, GcpObservation, GroundControlPoint
from vdgs.sfm.georeferencing import Georeferenced, georeference
from vdgs.sfm.georegistration import Georegistration
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.scale_bars import ScaleBars, known_scale
from vdgs.system.lazy_pycolmap import pycolmap

pytestmark = pytest.mark.slow


def priors(enu: np.ndarray, std: float, are_stated: bool) -> GpsPriors:
    count = len(enu)
    return GpsPriors(
        image_indices=np.arange(count), enu=enu, gps_std=np.full((count, 3), std),
        are_stated=np.full(count, are_stated), origin=(50.0, 8.0, 0.0), altitude_reference="", source="EXIF",
        notes=(), flights=np.zeros(count, int),
    )  # fmt: skip


def tilt_deg(model: pycolmap.Reconstruction, photographs: list[SimpleNamespace]) -> float:
    """Of the world against the true attitudes of its cameras."""
    turns = [
        model.find_image_with_name(photo.name).cam_from_world().rotation.matrix().T @ photo.true_rotation
        for photo in photographs
    ]
    left, _, right = np.linalg.svd(np.mean(turns, axis=0))
    return float(np.degrees(np.arccos(np.clip((left @ right)[2, 2], -1, 1))))


def georeferenced(
    model: pycolmap.Reconstruction,
    photographs: list[SimpleNamespace],
    positions: GpsPriors,
    bars: ScaleBars | None,
    gcps: GcpList | None = None,
) -> Georeferenced:
    prepared = ReconstructionPlan(
        request=SimpleNamespace(options=SfmOptions(), gps=None),
        image_list=ImageList((), tuple(photographs), (), 0), gps_priors=positions,
        preflight=SimpleNamespace(height_m=None), threads=1, pairs=0, gcps=gcps, scale_bars=bars,
    )  # fmt: skip
    return georeference(model, prepared, (True, "one height"))


@pytest.fixture
def bent(monkeypatch) -> list[bool]:
    """Whether models were bent."""
    found: list[bool] = []

    def watched(model, *given):
        changed = bend_to_positions(model, *given)
        found.append(changed is not model)
        return changed

    monkeypatch.setattr(georeferencing, "bend_to_positions", watched)
    return found


@pytest.mark.parametrize("seed", range(2))
def test_positions_along_one_line_bend_a_model_but_turn_it_not_about_the_line(seed, bent):
    """Positions of RTK along a line that is straight to 2 cm say nothing of a turn about it."""
    rng = np.random.default_rng(seed)
    places = np.array([[20.0 * k, 0, 80] for k in range(12)]) + rng.normal(0, 0.02, (12, 3))
    model, photographs = flown_model(places, rng)
    found = georeferenced(model, photographs, priors(places + rng.normal(0, 0.02, places.shape), 0.02, True), None)
    assert bent == [True]
    assert tilt_deg(found.model, photographs) < min(2.5, found.placed.accuracy.level_deg)


@pytest.mark.parametrize("deviations", [(0.02, 0.03), (0.03, 0.02)])
@pytest.mark.parametrize(
    ("strips", "apart_m", "tells"), [(6, 30.0, True), (2, 10.0, True), (2, 0.3, False), (1, 0.0, False)]
)
def test_whether_positions_tell_level_is_no_matter_of_noise(deviations, strips, apart_m, tells):
    """Strips metres apart do by RTK, whichever of across and up it measures better, whatever deviations are found
    of it; strips within decimetres, which say no more than views do (2.5 degrees), do not."""
    places = np.array([[20.0 * k, apart_m * strip, 80] for strip in range(strips) for k in range(10)])
    (across, high), none = deviations, np.zeros(0)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        east, north, up = rng.uniform(0.8, 1.2, 3) * (across, across, high)
        accuracy = AccuracyFacts(
            place_m=None,
            scale_percent=None,
            scale_m=None,
            north_deg=None,
            level_deg=None,
            positions_m=(east, north, up),
        )
        placed = Georegistration(
            similarity=Similarity(1.0, np.eye(3), np.zeros(3)), method="", position_rows=none, residuals=none,
            targets=places + rng.normal(0, (across, across, high), places.shape), inliers=np.ones(len(places), bool),
            accuracy=accuracy,
        )  # fmt: skip
        assert tell_level(placed, Up(np.array([0.0, 0, 1]), 2.5, "the views")) is tells


def test_a_known_distance_stays_as_long_as_it_is_where_positions_bend_the_model(bent):
    """Positions over 60 by 40 m make it longer by 1.5 %; a distance that is good to 0.2 % says better."""
    rng = np.random.default_rng(1)
    places = np.array([[15.0 * (k % 5), 20.0 * (k // 5), 80] for k in range(15)]) + rng.normal(0, 0.5, (15, 3))
    model, photographs = flown_model(places, rng)
    ends = np.array([[0.0, 0, 3], [60, 40, 3]])
    marks = [[GcpObservation(name, tuple(pixel)) for name, pixel in sightings(model, end)] for end in ends]
    points = tuple(
        GroundControlPoint(name, (0.0, 0, 0), tuple(seen), True) for name, seen in zip("AB", marks, strict=True)
    )
    bars = ScaleBars(points, (("A", "B", float(np.linalg.norm(ends[1] - ends[0]))),), "bars.txt")
    georegistration.transform_model(model, Similarity(0.1, np.eye(3), np.zeros(3)))
    recorded = places * [1.015, 1.015, 1] + rng.normal(0, 0.4, places.shape)
    found = georeferenced(model, photographs, priors(recorded, 0.6, False), bars)
    assert bent == [True]
    assert found.placed.accuracy.scale_percent < 0.6
    assert known_scale(found.model, bars)[0] == pytest.approx(1, abs=found.placed.accuracy.scale_percent / 100)


def test_a_bowl_is_flattened_by_positions(bent):
    rng = np.random.default_rng(0)
    places = np.array([[20.0 * (k % 5) - 40, 20.0 * (k // 5) - 40, 80] for k in range(25)])
    model, photographs = flown_model(places, rng, bowl=5e-4)
    found = georeferenced(model, photographs, priors(places + rng.normal(0, 0.02, places.shape), 0.02, True), None)
    centers = np.array([found.model.find_image_with_name(each.name).projection_center() for each in photographs])
    off = centers - places
    assert bent == [True]
    assert np.sqrt(((off - [0, 0, off[:, 2].mean()]) ** 2).sum(axis=1).mean()) < 0.05  # 0 is the ground's height


@pytest.mark.parametrize(("moved_m", "is_torn"), [(4.0, False), (20.0, True)])
def test_a_model_is_torn_once_cameras_move_by_a_part_of_their_height(moved_m, is_torn):
    """Though all of it moves alike, so that photographs fit as well as before."""
    places = np.array([[20.0 * (k % 3), 20.0 * (k // 3), 80] for k in range(6)])
    model, _ = flown_model(places, np.random.default_rng(0))
    moved = pycolmap.Reconstruction(model)
    georegistration.transform_model(moved, Similarity(1.0, np.eye(3), np.array([0.6, 0, 0.8]) * moved_m))
    assert _tears(model, moved) == (pytest.approx(moved_m) if is_torn else None)


def test_a_line_is_one_though_a_position_lies_beside_it():
    """Altitudes that drift along one line are said, whatever a single position is wrong by; as is the edge."""
    rng = np.random.default_rng(5)
    places = np.array([[20.0 * k, 0, 80] for k in range(16)]) + rng.normal(0, 0.5, (16, 3))
    model, photographs = flown_model(places, rng)
    recorded = places + rng.normal(0, 1.0, places.shape)
    recorded[:, 2] += np.linspace(-8, 8, 16)
    beside = recorded + np.outer(np.arange(16) == 6, [0, 300.0, 0])
    plain, stray = (
        georegistration.georegister(model, photographs, priors(each, 3, False)) for each in (recorded, beside)
    )
    assert stray.inliers.sum() == 15
    assert "along one line" in plain.method
    assert "along one line" in stray.method
    assert stray.accuracy.place_m[1] == pytest.approx(plain.accuracy.place_m[1], rel=0.2)
    assert stray.accuracy.scale_m / stray.accuracy.scale_percent == pytest.approx(
        plain.accuracy.scale_m / plain.accuracy.scale_percent, rel=0.05
    )


def test_check_points_are_measured_in_the_plane_where_no_altitude_is_known():
    rng = np.random.default_rng(0)
    places = np.array([[20.0 * (k % 4), 20.0 * (k // 4), 80] for k in range(12)]) + rng.normal(0, 0.5, (12, 3))
    model, photographs = flown_model(places, rng)
    marks = tuple(GcpObservation(name, tuple(pixel)) for name, pixel in sightings(model, np.array([30.0, 20, 3])))
    geodetic = geodetic_from_enu(np.array([[30.0, 20, 323]]), (50.0, 8.0, 0.0))[0]
    control = GcpList((GroundControlPoint("a", tuple(geodetic), marks, True),), "EPSG:4326", "gcp.txt", ())
    for has_altitudes, axes in ((True, 3), (False, 2)):
        recorded = places + rng.normal(0, 0.5, places.shape) + [0, 0, 320]
        recorded[:, 2] *= has_altitudes
        positions = replace(priors(recorded, 1.0, False), has_altitudes=has_altitudes)
        found = georeferenced(pycolmap.Reconstruction(model), photographs, positions, None, control)
        (report,) = found.survey
        assert np.abs(report.residual_m).max() < 2
        assert len(report.residual_m) == axes
