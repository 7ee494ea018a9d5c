"""Points that do not lie in front of a camera that is said to show them."""

from __future__ import annotations

import numpy as np
import pytest

pycolmap = pytest.importorskip("pycolmap")

from vdgs.sfm.reprojection import LARGEST_PX, drop_unseen_observations, mean_reprojection_error  # noqa: E402

SEEN = np.array([[x, y, 10.0] for x in (-2, 0, 2) for y in (-1, 0, 1)])


def model_of(points: np.ndarray):
    """Three cameras that look along z, all of which are said to show all points, half a pixel off."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=400, height=300, params=[300, 300, 200, 150], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for number, across in enumerate((-1.0, 0.0, 1.0), 1):
        away = points - [across, 0, 0]
        pixels = 300 * away[:, :2] / np.where(away[:, 2:] > 0, away[:, 2:], 1.0) + [200.5, 150]
        pose = pycolmap.Rigid3d(np.c_[np.eye(3), [-across, 0, 0]])
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=f"{number}.jpg", keypoints=pixels, camera_id=1, image_id=number), pose
        )
    for k, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(number, k) for number in (1, 2, 3)])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


@pytest.mark.parametrize("wrong", [[0.0, 0, -3], [1.0, 0, 0], [1.0, 0, -1e-12]])
def test_a_point_behind_or_at_a_camera_is_no_part_of_the_model(wrong):
    model = model_of(np.r_[SEEN, [wrong]])
    assert drop_unseen_observations(model) == 3
    assert model.num_points3D() == len(SEEN)
    assert max(point.error for point in model.points3D.values()) == pytest.approx(0.5)
    assert mean_reprojection_error(model) == pytest.approx(model.compute_mean_reprojection_error())


def test_a_point_stays_by_the_cameras_that_do_see_it():
    model = model_of(np.r_[SEEN, [[0.0, 0.5, 5]]])
    behind = pycolmap.Rigid3d(np.c_[np.diag([-1.0, 1, -1]), [0, 0, 0]])
    model.images[3].frame.rig_from_world = behind
    drop_unseen_observations(model)
    assert model.num_points3D() == len(SEEN) + 1
    assert {point.track.length() for point in model.points3D.values()} == {2}
    assert drop_unseen_observations(model) == 0


def test_no_single_point_makes_the_mean_error():
    model = model_of(np.r_[SEEN, [[0.0, 0, -3]]])
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() > 1e100
    assert mean_reprojection_error(model) == pytest.approx((len(SEEN) * 0.5 + LARGEST_PX) / (len(SEEN) + 1))
    assert mean_reprojection_error(pycolmap.Reconstruction()) == 0
    assert mean_reprojection_error(model_of(SEEN)) == 0  # not computed yet


def test_points_without_observations_stay():
    model = model_of(SEEN)
    model.add_point3D(np.zeros(3), pycolmap.Track(), np.zeros(3, np.uint8))
    assert drop_unseen_observations(model) == 0
    assert model.num_points3D() == len(SEEN) + 1
    assert mean_reprojection_error(model) == pytest.approx(0.5)
