"""Angles whose names leave several readings open, of flights whose true rotations are known."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.flights import write_photograph
from support.flown_models import flown_model
from vdgs.config.sfm_options import SfmOptions
from vdgs.sfm import georeferencing
from vdgs.sfm.attitude_readings import confirmed_by_model, reading_that_holds
from vdgs.sfm.cross_checks import cross_checked
from vdgs.sfm.georeferencing import Georeferenced, georeference
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.image_metadata import (
    BODY,
    BODY_NEGATED,
    GIMBAL,
    Attitude,
    ImageMetadata,
    attitude_from_aircraft,
    attitude_from_gimbal,
    read_image_metadata,
)
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.system.lazy_pycolmap import pycolmap

pytestmark = pytest.mark.slow

PIX4D = "Camera:Yaw", "Camera:Pitch", "Camera:Roll"
SENSEFLY = "sensefly:Heading", "sensefly:PitchAngle", "sensefly:RollAngle"
DJI = "drone-dji:GimbalYawDegree", "drone-dji:GimbalPitchDegree", "drone-dji:GimbalRollDegree"
NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)


def stacked(attitudes: list[Attitude]) -> np.ndarray:
    return np.array([each.camera_from_enu for each in attitudes])


def flown(count: int, roll_deg: float, rng: np.random.Generator) -> np.ndarray:
    """Yaw, pitch and roll [n, 3] of a wing in degrees: strips there and back, rolls of this deviation."""
    return np.column_stack([
        np.where(np.arange(count) % 10 < 5, 30.0, 210.0) + rng.normal(0, 4, count),
        rng.normal(8, 3, count),
        rng.normal(0, roll_deg, count),
    ])  # fmt: skip


def judged(true: np.ndarray, angles: np.ndarray, noise_deg: float, rng: np.random.Generator) -> str:
    """The reading that is taken of angles [n, 3] of cameras with these true rotations, in a world of its own; at first
    as those of a body."""
    world = Rotation.random(random_state=rng).as_matrix()
    noise = Rotation.from_rotvec(rng.normal(0, np.radians(noise_deg), (len(true), 3))).as_matrix()
    recorded = {
        BODY: stacked([attitude_from_aircraft(*each) for each in angles]),
        BODY_NEGATED: stacked([attitude_from_aircraft(*each) for each in angles * [1, 1, -1]]),
        GIMBAL: stacked([attitude_from_gimbal(*each) for each in angles]),
    }
    return reading_that_holds(noise @ true @ world, recorded, BODY)[0]


@pytest.mark.parametrize("noise_deg", [0.0, 1.0])
@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_the_wrong_sign_of_the_roll_is_found_and_the_right_one_stays(noise_deg, wrong):
    """Though a share of the photographs has angles of other moments."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        angles = flown(40, 8.0, rng)
        true = stacked([attitude_from_aircraft(*each) for each in angles])
        angles[: int(40 * wrong)] = rng.uniform([0, -20, -20], [360, 20, 20], (int(40 * wrong), 3))
        assert judged(true, angles, noise_deg, rng) == BODY
        assert judged(true, angles * [1, 1, -1], noise_deg, rng) == BODY_NEGATED


def test_the_sign_is_found_of_a_flight_that_the_wind_rolls_to_one_side():
    """By a turn of the world most attitudes fit by either sign."""
    rng = np.random.default_rng(6)
    angles = np.column_stack([rng.normal(90, 2, 40), rng.normal(5, 1, 40), np.where(np.arange(40) % 4, 10.0, -10.0)])
    true = stacked([attitude_from_aircraft(*each) for each in angles])
    assert judged(true, angles, 0.5, rng) == BODY
    assert judged(true, angles * [1, 1, -1], 0.5, rng) == BODY_NEGATED


def test_the_angles_of_a_gimbal_are_found_by_cameras_that_turn():
    rng = np.random.default_rng(1)
    angles = np.column_stack([rng.uniform(0, 360, 30), rng.uniform(-30, 0, 30), rng.normal(0, 1, 30)])
    assert judged(stacked([attitude_from_gimbal(*each) for each in angles]), angles, 1.0, rng) == GIMBAL


@pytest.mark.parametrize("noise_deg", [0.0, 3.0])
@pytest.mark.parametrize("count", [10, 40])
def test_rolls_near_0_and_noise_change_nothing(noise_deg, count):
    rng = np.random.default_rng(2)
    for _ in range(25):
        angles = flown(count, 0.7, rng)
        true = stacked([attitude_from_aircraft(*each) for each in angles * [1, 1, rng.choice([-1, 1])]])
        assert judged(true, angles + rng.normal(0, noise_deg, angles.shape), noise_deg, rng) == BODY


@pytest.mark.parametrize("hangs_deg", [5.0, 15.0])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_camera_that_hangs_askew_is_no_other_reading(axis, hangs_deg):
    rng = np.random.default_rng(3)
    askew = Rotation.from_euler(axis, hangs_deg, degrees=True).as_matrix()
    for _ in range(10):
        angles = flown(40, 5.0, rng)
        assert judged(askew @ stacked([attitude_from_aircraft(*each) for each in angles]), angles, 0.5, rng) == BODY


# ------------------------------------------------------------------------------------------------------ flights


def of_a_line(
    folder: Path, names: tuple[str, str, str], sign: int, count: int = 24
) -> tuple[pycolmap.Reconstruction, list[ImageMetadata], np.ndarray]:
    """A wing's flight along one line, rolls of 10 degrees with the wind from the left mostly, of which photographs
    have the angles under these names, rolls times `sign`; its model in the true world; and its places [n, 3]."""
    rng = np.random.default_rng(4)
    rolls = np.where(np.arange(count) % 3 < 2, 10.0, -10.0)[rng.permutation(count)] + rng.normal(0, 1, count)
    angles = np.column_stack([rng.normal(90, 3, count), rng.normal(0, 2, count), rolls])
    places = np.column_stack([20.0 * np.arange(count), rng.normal(0, 0.3, count), rng.normal(80, 1, count)])
    model, _ = flown_model(places, rng, attitudes=[attitude_from_aircraft(*each) for each in angles])
    photographs = []
    for k, (yaw, pitch, roll) in enumerate(angles, 1):
        recorded = (yaw, pitch - (90 if names == DJI else 0), sign * roll)
        xmp = " ".join(f'{name}="{angle:.3f}"' for name, angle in zip(names, recorded, strict=True))
        file = folder / f"{k:03}.jpg"
        write_photograph(file, NOISE, k, places[k - 1], xmp=xmp, model="S.O.D.A.")
        photographs.append(read_image_metadata(file, file.name))
    return model, cross_checked(photographs), places


def georeferenced(
    model: pycolmap.Reconstruction, photographs: list[ImageMetadata], places: np.ndarray
) -> tuple[Georeferenced, float]:
    """Where positions good to a metre place the flight, and how far from level in degrees."""
    count = len(places)
    positions = GpsPriors(
        image_indices=np.arange(count), enu=places + np.random.default_rng(5).normal(0, 1, (count, 3)),
        gps_std=np.full((count, 3), 2.0), origin=(50.0, 8.0, 0.0), altitude_reference="", source="EXIF", notes=(),
    )  # fmt: skip
    plan = ReconstructionPlan(
        request=SimpleNamespace(options=SfmOptions(), gps=None), image_list=ImageList((), tuple(photographs), (), 0),
        gps_priors=positions, preflight=SimpleNamespace(height_m=None), threads=1, pairs=0,
    )  # fmt: skip
    found = georeference(pycolmap.Reconstruction(model), plan, (True, "one height"))
    before, after = (
        stacked([Attitude(each.find_image_with_name(photo.name).cam_from_world().rotation.matrix())
                 for photo in photographs])
        for each in (model, found.model)
    )  # fmt: skip
    up = np.mean(after.transpose(0, 2, 1) @ before, axis=0)[:, 2]
    return found, float(np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1))))


@pytest.mark.parametrize("names", [PIX4D, SENSEFLY])
def test_a_flight_with_the_roll_negated_lies_level(tmp_path, monkeypatch, names):
    """Along one line, where only attitudes say what level is: the model tells how they are meant."""
    model, photographs, places = of_a_line(tmp_path, names, -1)
    found, off = georeferenced(model, photographs, places)
    assert off < 1
    assert [note.partition(":")[0] for note in found.notes] == [
        f"the recorded angles of {photographs[0].camera} are read as those of such a body with the roll negated"
    ]
    assert "from those of a body that looks down when level by" in found.notes[0]
    assert all(photo.attitude is photo.attitudes[BODY_NEGATED] for photo in found.photographs)
    monkeypatch.setattr(georeferencing, "confirmed_by_model", lambda _, photographs: (photographs, ()))
    assert georeferenced(model, photographs, places)[1] > 4


@pytest.mark.parametrize(("names", "sign"), [(PIX4D, 1), (SENSEFLY, 1), (DJI, 1), (DJI, -1)])
def test_angles_that_are_right_or_have_one_reading_stay(tmp_path, names, sign):
    model, photographs, _ = of_a_line(tmp_path, names, sign)
    same, notes = confirmed_by_model(model, photographs)
    assert notes == ()
    assert all(one is other for one, other in zip(same, photographs, strict=True))


def test_few_photographs_tell_no_reading(tmp_path):
    model, photographs, _ = of_a_line(tmp_path, PIX4D, -1, count=9)
    assert confirmed_by_model(model, photographs)[1] == ()
