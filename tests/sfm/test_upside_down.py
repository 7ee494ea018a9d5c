"""What tells up and down of a model: attitudes and views that contradict each other, positions that are mirrored, and
worlds that would be upside down."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vdgs.captures.position_adjustment import Up
from vdgs.captures.turned_views import are_turned_over
from vdgs.config.sfm_options import SfmOptions
from vdgs.errors import CaptureError
from vdgs.sfm import georegistration
from vdgs.sfm.georeferencing import _refuse_no_scene, _refuse_upside_down
from vdgs.sfm.georegistration import Georegistration
from vdgs.sfm.gps_priors import GpsPriors, read_gps_priors
from vdgs.sfm.image_metadata import attitude_from_gimbal
from vdgs.sfm.up_direction import model_points, up_of

pytestmark = pytest.mark.slow


def up_of_an_arc(recorded_pitch_deg: float) -> tuple[Up, list[str]]:
    """18 photographs on an arc of 85 degrees about a building, 20 degrees down, and the gimbal's angles."""
    rng = np.random.default_rng(0)
    turn = Rotation.random(random_state=3).as_matrix()
    images, photographs = {}, []
    for k in range(18):
        angle = np.radians(5 * k)
        place, yaw = np.array([40 * np.cos(angle), 40 * np.sin(angle), 20.0]), 270 - 5 * k
        pose = attitude_from_gimbal(yaw, -20.0, 0.0).camera_from_enu @ turn.T
        recorded = attitude_from_gimbal(yaw, recorded_pitch_deg + rng.normal(0, 0.1), 0.0)
        images[k] = SimpleNamespace(
            name=str(k), has_pose=True, projection_center=lambda place=place: turn @ place,
            cam_from_world=lambda pose=pose: SimpleNamespace(rotation=SimpleNamespace(matrix=lambda: pose)),
        )  # fmt: skip
        photographs.append(SimpleNamespace(name=str(k), attitude=recorded, face=""))
    wall = rng.uniform(-1, 1, (400, 3)) * [8, 8, 5] + [0, 0, 5]
    points = {k: SimpleNamespace(xyz=turn @ place) for k, place in enumerate(wall)}
    up, notes = up_of(SimpleNamespace(images=images, points3D=points), photographs)
    return replace(up, direction=up.direction @ turn), notes


def test_a_vague_guess_of_up_by_views_leaves_recorded_attitudes_that_agree():
    up, notes = up_of_an_arc(-20.0)
    assert notes == []
    assert up.how == "the recorded attitudes"
    assert np.degrees(np.arccos(up.direction[2])) < 1


def test_attitudes_that_plainly_contradict_the_views_are_not_used():
    up, notes = up_of_an_arc(160.0)  # looks up and back
    assert "contradict" in notes[0]
    assert up.how == "the views"


def placed_image(number: int, place: np.ndarray, pose: np.ndarray) -> SimpleNamespace:
    """A photograph of a model: its place [3] and camera_from_world [3, 3]."""
    return SimpleNamespace(
        name=str(number), has_pose=True, points2D=(), projection_center=lambda: place,
        cam_from_world=lambda: SimpleNamespace(rotation=SimpleNamespace(matrix=lambda: pose)),
    )  # fmt: skip


def survey_looking_down(pitch_deg: float) -> tuple[SimpleNamespace, list[SimpleNamespace], GpsPriors]:
    """A survey of 25 photographs, nearly straight down, with this pitch of the gimbal recorded."""
    rng = np.random.default_rng(0)
    turn, images, photographs = Rotation.random(random_state=3).as_matrix(), {}, []
    places = np.array([[20.0 * (k % 5), 20.0 * (k // 5), 60 + rng.normal(0, 1)] for k in range(25)])
    for k, place in enumerate(places):
        pose = attitude_from_gimbal(90.0 * (k % 2), -85.0, 0.0).camera_from_enu @ turn.T
        images[k] = placed_image(k, turn @ place, pose)
        recorded = attitude_from_gimbal(90.0 * (k % 2), pitch_deg, 0.0)
        photographs.append(
            SimpleNamespace(name=str(k), attitude=recorded, face="", datetime="", subsecond=None, gps_std=None,
                            relative_altitude=None)
        )  # fmt: skip
    points = {k: SimpleNamespace(xyz=turn @ each) for k, each in enumerate(rng.uniform(0, 80, (400, 3)) * [1, 1, 0.05])}
    positions = GpsPriors(
        enu=places - [40.0, 40, 60], gps_std=np.full((25, 3), 1.0), image_indices=np.arange(25),
        origin=(-33.5, -70.6, 500.0), altitude_reference="", source="EXIF", notes=(),
    )  # fmt: skip
    return SimpleNamespace(images=images, points3D=points), photographs, positions


def test_attitudes_that_look_up_are_named_where_positions_look_mirrored_by_them():
    """A pitch of +90 degrees straight down, as some firmware writes it; and positions that are mirrored indeed."""
    model, photographs, positions = survey_looking_down(85.0)
    with pytest.raises(CaptureError, match=r"mirrored: .* Or are the recorded attitudes wrong.* say --georeference"):
        georegistration.georegister(model, photographs, positions)
    model, photographs, positions = survey_looking_down(-85.0)
    flipped = replace(positions, enu=positions.enu * [-1, 1, 1])
    with pytest.raises(CaptureError, match="mirrored") as said:
        georegistration.georegister(model, photographs, flipped)
    assert "attitudes" not in str(said.value)


def flight_along_a_line(pitch_deg: float) -> tuple[SimpleNamespace, list[SimpleNamespace], GpsPriors]:
    """18 photographs along one line to the east, by hand, of one heading and without attitudes."""
    rng = np.random.default_rng(0)
    turn, k = Rotation.random(random_state=3).as_matrix(), np.arange(18)
    places = np.stack([6.0 * k - 51, 3 * np.sin(k), 70 + rng.normal(0, 0.3, 18)], axis=1)
    pose = attitude_from_gimbal(90.0, pitch_deg, 0.0).camera_from_enu @ turn.T
    images = {number: placed_image(number, turn @ place, pose) for number, place in enumerate(places)}
    photographs = [
        SimpleNamespace(name=str(each), attitude=None, face="", datetime="", subsecond=None, gps_std=None,
                        relative_altitude=70.0)
        for each in k
    ]  # fmt: skip
    ahead = 70 / np.tan(np.radians(-pitch_deg))
    ground = rng.uniform([-90, -40, -1], [90, 40, 1], (400, 3)) + np.array([ahead, 0, 0])
    positions = GpsPriors(
        enu=places * [1, 1, 0], gps_std=np.full((18, 3), 1.0), image_indices=k, origin=(47.3, 8.5, 500.0),
        altitude_reference="", source="EXIF", notes=(),
    )  # fmt: skip
    points = {number: SimpleNamespace(xyz=turn @ place) for number, place in enumerate(ground)}
    return SimpleNamespace(images=images, points3D=points), photographs, positions


@pytest.mark.parametrize("pitch_deg", [-90.0, -80.0])
def test_exchanged_positions_along_a_line_are_refused_though_up_is_in_doubt(pitch_deg):
    """Level at a wall or straight down is one for photographs of one heading: neither looks straight up."""
    model, photographs, positions = flight_along_a_line(pitch_deg)
    assert not up_of(model, photographs)[0].sure
    placed = georegistration.georegister(model, photographs, positions)
    assert isinstance(placed, Georegistration)
    assert abs(placed.similarity.scale - 1) < 0.05
    exchanged = replace(positions, enu=positions.enu[:, [1, 0, 2]])
    with pytest.raises(CaptureError, match=r"fit the photographs only once .* Are latitude and longitude exchanged"):
        georegistration.georegister(model, photographs, exchanged)
    anyway = georegistration.georegister(model, photographs, exchanged, anyway=True)
    assert any("used all the same" in note for note in anyway.notes)


def test_a_world_larger_than_any_is_refused_whatever_made_it_so():
    model, _, _ = flight_along_a_line(-90.0)
    placed = SimpleNamespace(method="positions of 18 photographs")
    prepared = SimpleNamespace(gps_priors=SimpleNamespace(source="poses.csv"))
    places = np.array([image.projection_center() for image in model.images.values()])
    _refuse_no_scene(model, float(places[:, 2].mean()) - 12_000, placed, prepared)
    with pytest.raises(CaptureError, match=r"18 photographs \(poses.csv\), the cameras would be 77 km over the ground"):
        _refuse_no_scene(model, float(places[:, 2].mean()) - 77_300, placed, prepared)


def test_positions_of_photographs_that_are_of_no_flight_are_not_used():
    """Local metres that a program wrote into EXIF as degrees."""
    photographs = [
        SimpleNamespace(
            name=f"{k}.jpg", lat_lon=(7.0 * (k % 5) - 14, 7.0 * (k // 5) - 14), altitude=35.0, altitude_type="",
            relative_altitude=None,
        )
        for k in range(25)
    ]  # fmt: skip
    priors = read_gps_priors(photographs, None, (3.0, 6.0))
    assert not priors.usable
    assert any("cannot be of one flight: they lie" in note for note in priors.notes)


@pytest.mark.parametrize(
    ("pitch_deg", "roll_deg", "turned_over"),
    [
        pytest.param(-90.0, 0.0, False, id="a survey"),
        pytest.param(0.0, 0.0, False, id="a facade"),
        pytest.param(45.0, 0.0, False, id="a look up at a facade"),
        pytest.param(-10.0, 180.0, False, id="a camera that hangs upside down"),
        pytest.param(90.0, 0.0, True, id="a survey upside down"),
        pytest.param(45.0, 180.0, True, id="an oblique film upside down"),
    ],
)
def test_views_of_a_world_upside_down_are_told_from_looks_up(pitch_deg, roll_deg, turned_over):
    rotations = np.array([attitude_from_gimbal(yaw, pitch_deg, roll_deg).camera_from_enu for yaw in (0, 5, 90, 180)])
    assert are_turned_over(rotations) == turned_over


@pytest.mark.parametrize("over", [True, False])
def test_a_world_placed_upside_down_is_refused_though_up_is_in_doubt(over):
    """Whatever placed it, by nothing that a mirror image explains; but from under a ceiling photographs look about."""
    model, photographs, _ = flight_along_a_line(-90.0)
    turn = Rotation.random(random_state=3).as_matrix()
    turn = (np.diag([1.0, -1, -1]) if over else np.eye(3)) @ turn.T
    model.images = {
        number: placed_image(number, turn @ image.projection_center(),
                             image.cam_from_world().rotation.matrix() @ turn.T)
        for number, image in model.images.items()
    }  # fmt: skip
    model.points3D = {number: SimpleNamespace(xyz=turn @ point.xyz) for number, point in model.points3D.items()}
    prepared = SimpleNamespace(
        request=SimpleNamespace(options=SfmOptions()), image_list=SimpleNamespace(images=photographs)
    )
    ground = float(np.median(model_points(model)[:, 2]))
    placed = SimpleNamespace(method="GPS")
    if not over:
        return _refuse_upside_down(model, ground, placed, prepared)
    with pytest.raises(CaptureError, match="m under the ground and look up"):
        _refuse_upside_down(model, ground, placed, prepared)
    prepared.request.options = SfmOptions(georeference="anyway")
    return _refuse_upside_down(model, ground, placed, prepared)
