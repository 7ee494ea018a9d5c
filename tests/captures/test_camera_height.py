"""The length that settings refer to: the height of a flight, or the distance of cameras that fly at no height."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.captures import TinyScene, data_folder, look_down, moved, tiny_scene
from vdgs.captures.camera_height import camera_height, offset_rate_factor
from vdgs.captures.capture import Capture, View
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.training import TrainingProblem
from vdgs.training.training_loop import _volume_weight


def capture_of(scene: TinyScene) -> Capture:
    """The scene as a capture in which all views are for training."""
    views = tuple(
        View(name=name, camera=camera, image_path=Path(name), mask_path=None, split="train")
        for name, camera in scene.cameras.items()
    )
    frame = GroundFrame(scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description="as it is")
    return Capture(
        root=Path(), source="colmap", images="images", views=views, points=scene.points, point_colors=scene.colors,
        ground=frame,
    )  # fmt: skip


def about_a_tower(below: float) -> TinyScene:
    """Twelve cameras about a tower 40 high, 25 away from it, so far below the middle of its points."""
    generator = np.random.default_rng(3)
    angles = generator.uniform(0, 2 * np.pi, 500)
    tower = np.column_stack([3 * np.cos(angles), 3 * np.sin(angles), generator.uniform(0, 40, 500)])
    cameras = {}
    for index, angle in enumerate(np.linspace(0, 2 * np.pi, 12, endpoint=False)):
        place = np.array([25 * np.cos(angle), 25 * np.sin(angle), np.median(tower[:, 2]) - below])
        pose = look_down(place, 90.0, np.degrees(np.arctan2(-place[0], -place[1])))
        cameras[f"{index}.png"] = Camera(
            camera_from_world=pose, fx=60.0, fy=60.0, cx=32.0, cy=24.0, width=64, height=48
        )
    return TinyScene(cameras, tower, np.zeros((500, 3), np.uint8))


def plain_height(capture: Capture) -> float:
    centers = np.array([view.camera.position for view in capture.train_views])
    return float(np.median(centers[:, 2]) - np.median(capture.points[:, 2]))


def volume_weight(capture: Capture) -> float:
    nothing: object = None  # no photographs
    return _volume_weight(
        TrainingProblem(
            config=TrainConfig(), images=nothing, num_images=1, voxel_size=1.0, camera_height=camera_height(capture)
        )
    )  # type: ignore[arg-type]


@pytest.mark.parametrize("altitude", [10.0, 37.5, 120.0])
def test_of_a_flight_it_is_the_height_above_the_median_point_to_the_last_bit(altitude):
    capture = capture_of(tiny_scene(altitude=altitude))
    assert camera_height(capture) == plain_height(capture)


@pytest.mark.capture
@pytest.mark.parametrize("name", ["brighton", "copr", "seneca"])
def test_of_a_real_flight_too(name):
    capture = load_capture(data_folder(name, "images_4"), CaptureOptions(images="images_4"))
    assert camera_height(capture) == plain_height(capture)


@pytest.mark.parametrize("below", [0.0, 5.0, 15.0])
def test_cameras_that_look_up_give_volumes_the_weight_of_their_distance(below):
    capture = capture_of(about_a_tower(below))
    assert plain_height(capture) <= 0
    assert 20 < camera_height(capture) < 32
    from_above = TrainConfig().loss.volume_reg / (25 / 10) ** 3  # a flight 25 above the ground
    assert 0.4 * from_above < volume_weight(capture) < 2 * from_above


@settings(max_examples=20, deadline=None)
@given(
    scale=st.floats(0.01, 100), yaw=st.floats(0, 6.28), shift=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    tower=st.booleans(),
)  # fmt: skip
def test_moving_and_scaling_the_scene_changes_the_weight_as_it_changes_volumes(scale, yaw, shift, tower):
    scene = about_a_tower(3.0) if tower else tiny_scene()
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    before, after = capture_of(scene), capture_of(moved(scene, scale, rotation, np.array(shift)))
    assert camera_height(after) == pytest.approx(scale * camera_height(before), rel=1e-6)
    assert volume_weight(after) * scale**3 == pytest.approx(volume_weight(before), rel=1e-5)
    assert offset_rate_factor(after, TrainConfig()) == 1.0
    by_cameras = TrainConfig(lr_offsets_unit="cameras")
    factor = offset_rate_factor(before, by_cameras)
    assert factor == pytest.approx(1.1 * 25 if tower else factor, rel=0.01)
    assert offset_rate_factor(after, by_cameras) == pytest.approx(scale * factor, rel=1e-6)
    # In another ground frame the capture's own units stay what they are.
    rescaled = replace(after, ground=replace(after.ground, scale=scale))
    assert offset_rate_factor(rescaled, by_cameras) == pytest.approx(factor, rel=1e-6)


def test_all_in_one_place_is_no_division_by_zero():
    scene = tiny_scene(points=3)
    place = next(iter(scene.cameras.values())).position
    capture = capture_of(TinyScene(dict([next(iter(scene.cameras.items()))]), np.tile(place, (3, 1)), scene.colors))
    assert 0 < camera_height(capture) < 1e-6
