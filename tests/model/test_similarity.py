"""Gaussians under similarities: pictures do not change when scene and camera move together."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from support.gaussians import overhead, picture, psnr, random_gaussians
from vdgs.geometry.camera import Camera
from vdgs.kernels.spherical_harmonics import eval_sh_colors
from vdgs.model.gaussian_transform import (
    gaussian_covariances,
    quaternion_from_matrix,
    rotate_sh,
    sh_band_rotation,
    transform_gaussians,
)


def moved(camera: Camera, scale: float, rotation: np.ndarray, translation: np.ndarray) -> Camera:
    """The camera where a similarity of space takes it."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.camera_from_world[:3, :3] @ rotation.T
    matrix[:3, 3] = -matrix[:3, :3] @ (scale * rotation @ camera.position + translation)
    return replace(camera, camera_from_world=matrix)


@given(seed=st.integers(0, 1000), degree=st.integers(0, 3), scale=st.floats(0.2, 5))
@settings(max_examples=15)
def test_a_moved_scene_looks_the_same_from_a_moved_camera(seed, degree, scale):
    rng = np.random.default_rng(seed)
    rotation, translation = Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 5, 3)
    scene, camera = random_gaussians(150, degree, seed), overhead(size=48)
    there = picture(
        transform_gaussians(scene, scale, rotation, translation), moved(camera, scale, rotation, translation)
    )
    assert psnr(there, picture(scene, camera)) > 60


def test_leaving_out_the_harmonics_would_be_seen():
    """So the law above can fail."""
    turn = Rotation.from_euler("xyz", [90, 20, 40], degrees=True).as_matrix()
    scene, camera = random_gaussians(150, 3), overhead(size=48)
    wrong = replace(transform_gaussians(scene, 1.0, turn, np.zeros(3)), shN=scene.shN)
    assert psnr(picture(wrong, moved(camera, 1.0, turn, np.zeros(3))), picture(scene, camera)) < 30


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_harmonics_show_the_old_colors_along_turned_directions(degree):
    turn = Rotation.from_rotvec([0.3, -2.0, 1.1]).as_matrix()
    scene = random_gaussians(20, degree)
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(3)), dim=-1)
    turned = directions @ torch.from_numpy(turn.T).float()
    after = eval_sh_colors(scene.sh0, rotate_sh(scene.shN, turn), turned, degree)
    torch.testing.assert_close(after, eval_sh_colors(scene.sh0, scene.shN, directions, degree), atol=1e-5, rtol=0)


@pytest.mark.parametrize("band", [1, 2, 3])
def test_band_rotations_are_a_group_of_orthogonal_matrices(band):
    one, other = (Rotation.random(random_state=seed).as_matrix() for seed in (1, 2))
    first, second = sh_band_rotation(band, one), sh_band_rotation(band, other)
    torch.testing.assert_close(first @ first.T, torch.eye(2 * band + 1).double())
    torch.testing.assert_close(sh_band_rotation(band, one @ other), first @ second)


@pytest.mark.parametrize("turn", [np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1]), np.diag([-1.0, 1, -1])])
def test_half_turns_have_quaternions_too(turn):
    scene = random_gaussians(10, 0)
    expected = torch.from_numpy(turn).float() @ gaussian_covariances(scene) @ torch.from_numpy(turn.T).float()
    torch.testing.assert_close(gaussian_covariances(transform_gaussians(scene, 1.0, turn, np.zeros(3))), expected)
    assert float(quaternion_from_matrix(turn).norm()) == pytest.approx(1)


def test_what_is_no_similarity_is_refused():
    scene = random_gaussians(2, 1)
    with pytest.raises(ValueError, match="no rotation"):
        transform_gaussians(scene, 1.0, np.diag([1.0, 1, -1]), np.zeros(3))
    with pytest.raises(ValueError, match="positive scale"):
        transform_gaussians(scene, 0.0, np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="belong to no degree"):
        rotate_sh(scene.shN[:, :2], np.eye(3))
