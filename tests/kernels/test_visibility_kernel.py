"""Counting views: the native kernel finds what brute force in float64 finds, to the last point."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.cuda_on_host import HostDriver, build_on_host, needs_a_compiler, needs_nvrtc
from support.instruction_sets import every_instruction_set, on_threads, using
from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels.cpu import visibility as native
from vdgs.kernels.cuda import visibility as on_card
from vdgs.kernels.cuda.launch import CudaProgram
from vdgs.kernels.torch_ref import visibility as reference


def rotation(generator: np.random.Generator) -> np.ndarray:
    basis, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    return basis * np.sign(np.linalg.det(basis))


def make_camera(generator: np.random.Generator, spread: float, model: str = "pinhole") -> Camera:
    """A camera anywhere in the scene, looking anywhere."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(generator)
    matrix[:3, 3] = -matrix[:3, :3] @ generator.uniform(-spread, spread, 3)
    width, height = (int(v) for v in generator.integers(1, 2000, 2))
    focal = generator.uniform(0.3, 2.0) * width / (1 if model == "pinhole" else spread)
    return Camera(
        camera_from_world=matrix, fx=focal, fy=focal * 1.1, cx=width * 0.45, cy=height * 0.55, width=width,
        height=height, model=model,
    )  # fmt: skip


def flight(count: int, height_m: float = 100.0, extent_m: float = 1000.0, seed: int = 0) -> list[Camera]:
    """Nadir views over a square."""
    generator = np.random.default_rng(seed)
    cameras = []
    for _ in range(count):
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])
        matrix[:3, 3] = -matrix[:3, :3] @ [*generator.uniform(0, extent_m, 2), height_m]
        cameras.append(Camera(camera_from_world=matrix, fx=900.0, fy=900.0, cx=600.0, cy=400.0, width=1200, height=800))
    return cameras


def brute_force(points: torch.Tensor, cameras: list[Camera]) -> torch.Tensor:
    seen = [camera.in_frustum(points.double().numpy()) for camera in cameras]
    return torch.from_numpy(np.sum(seen, axis=0, dtype=np.int32))


@settings(max_examples=40)
@given(st.integers(1, 3000), st.integers(1, 12), st.sampled_from([1.0, 50.0, 1e4]), st.integers(0, 10**6))
def test_native_equals_brute_force(n, count, spread, seed):
    generator = np.random.default_rng(seed)
    cameras = [make_camera(generator, spread, ("pinhole", "orthographic")[i % 2]) for i in range(count)]
    points = torch.from_numpy(generator.uniform(-spread, spread, (n, 3)))
    for dtype in (torch.float32, torch.float64):
        cloud = points.to(dtype)
        assert torch.equal(native.count_visibility(cloud, cameras), brute_force(cloud, cameras))


@every_instruction_set
def test_every_instruction_set_and_any_number_of_threads_agree(instructions):
    generator = np.random.default_rng(2)
    cameras = flight(60)
    points = torch.from_numpy(generator.uniform([0, 0, 0], [1000, 1000, 60], (30_011, 3))).float()
    expected = brute_force(points, cameras)
    assert 0 < int(expected.max()) < 60
    with using(instructions):
        for threads in (1, 2, 3):
            with on_threads(threads):
                assert torch.equal(native.count_visibility(points, cameras), expected)


def test_the_order_of_the_points_is_without_effect():
    generator = np.random.default_rng(3)
    points = torch.from_numpy(generator.uniform(0, 1000, (9_000, 3)))
    order = torch.from_numpy(generator.permutation(9_000))
    cameras = flight(20)
    assert torch.equal(native.count_visibility(points[order], cameras), native.count_visibility(points, cameras)[order])


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
@pytest.mark.parametrize("offset_px", [0.0, 1e-9, -1e-9, 1e-7, -1e-7, 1e-3, -1e-3])
def test_points_at_the_border_of_the_image_are_decided_in_float64(model, offset_px):
    generator = np.random.default_rng(4)
    camera = make_camera(generator, 10.0, model)
    depth = generator.uniform(0.5, 50, 400)
    u, v = generator.uniform(0, camera.width, 400), generator.uniform(0, camera.height, 400)
    u[:100], u[100:200] = offset_px, camera.width + offset_px
    v[200:300], v[300:] = offset_px, camera.height + offset_px
    scale = depth if model == "pinhole" else 1.0
    local = np.stack([(u - camera.cx) / camera.fx * scale, (v - camera.cy) / camera.fy * scale, depth], axis=1)
    points = (local - camera.camera_from_world[:3, 3]) @ camera.camera_from_world[:3, :3]
    cloud = torch.from_numpy(points)
    # Two float64 formulas may differ in the last bits of a pixel coordinate, and nowhere else.
    pixels, _ = camera.project(points)
    size = np.array([camera.width, camera.height])
    clear = torch.from_numpy(np.minimum(np.abs(pixels), np.abs(pixels - size)).min(axis=1) > 1e-10)
    assert torch.equal(native.count_visibility(cloud, [camera])[clear], brute_force(cloud, [camera])[clear])


def test_points_about_the_camera_and_on_the_near_plane():
    camera = Camera(camera_from_world=np.eye(4), fx=100.0, fy=100.0, cx=50.0, cy=50.0, width=100, height=100)
    points = torch.tensor(
        [[0, 0, 0], [0, 0, NEAR_PLANE], [0, 0, NEAR_PLANE * 1.01], [0, 0, -1], [0, 0, 1.0]], dtype=torch.float64
    )
    for implementation in (reference, native):
        assert implementation.mark_visible(points, camera).tolist() == [False, False, True, False, True]


@pytest.mark.parametrize("implementation", [reference, native])
class TestMeaning:
    def test_counts_are_sums_of_marks(self, implementation):
        generator = np.random.default_rng(6)
        points = torch.from_numpy(generator.uniform(0, 1000, (2_000, 3))).float()
        cameras = flight(9)
        count = implementation.count_visibility(points, cameras)
        assert count.dtype == torch.int32
        assert torch.equal(count, sum(implementation.mark_visible(points, camera).int() for camera in cameras))
        assert implementation.mark_visible(points, cameras[0]).dtype == torch.bool

    @pytest.mark.parametrize("repeats", [3, 30])
    def test_points_that_are_not_finite_are_in_no_view(self, implementation, repeats):
        points = torch.tensor([[0.0, 0, 5], [0, 0, torch.nan], [0, torch.inf, 5], [0, 0, torch.inf], [1, 1, 5]])
        camera = Camera(camera_from_world=np.eye(4), fx=10.0, fy=10.0, cx=50.0, cy=50.0, width=100, height=100)
        assert implementation.count_visibility(points, [camera] * repeats).tolist() == [repeats, 0, 0, 0, repeats]

    def test_nothing_to_count(self, implementation):
        assert implementation.count_visibility(torch.zeros(0, 3), flight(2)).shape == (0,)
        assert implementation.count_visibility(torch.ones(4, 3), []).tolist() == [0] * 4

    def test_strided_points_are_read_as_they_are(self, implementation):
        generator = np.random.default_rng(7)
        points = torch.from_numpy(generator.uniform(0, 1000, (3, 500))).t()
        cameras = flight(30)
        assert torch.equal(
            implementation.count_visibility(points, cameras),
            implementation.count_visibility(points.contiguous(), cameras),
        )

    def test_unsuitable_points_are_refused(self, implementation):
        with pytest.raises(TypeError):
            implementation.count_visibility(torch.zeros(4, 3).long(), flight(1))
        with pytest.raises((ValueError, TypeError)):
            implementation.count_visibility(torch.zeros(4, 2), flight(1))


@needs_nvrtc
@needs_a_compiler
@pytest.mark.usefixtures("not_for_a_card")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_card_s_kernels_equal_brute_force(dtype, compiled_code):
    """Run on the processor by a stand-in driver."""
    program = CudaProgram(name=on_card.PROGRAM.name, driver=HostDriver(build_on_host(compiled_code)))
    cloud, cameras = cloud_and_cameras(dtype)
    expected = brute_force(cloud.nan_to_num(posinf=0.0), cameras)
    expected[[3, 4]] = 0
    assert torch.equal(on_card.count_visibility(cloud, cameras, program=program), expected)
    marks = [on_card.mark_visible(cloud, camera, program=program) for camera in cameras]
    assert torch.equal(torch.stack(marks).sum(0, dtype=torch.int32), expected)
    assert on_card.count_visibility(cloud[:0], cameras, program=program).shape == (0,)
    assert not on_card.count_visibility(cloud, [], program=program).any()


@pytest.mark.gpu
def test_a_card_counts_what_the_reference_counts():
    cloud, cameras = cloud_and_cameras(torch.float32)
    assert torch.equal(
        on_card.count_visibility(cloud.cuda(), cameras).cpu(), reference.count_visibility(cloud, cameras)
    )


def cloud_and_cameras(dtype: torch.dtype) -> tuple[torch.Tensor, list[Camera]]:
    """Points of which two are not finite, and cameras of both kinds."""
    generator = np.random.default_rng(5)
    cameras = [make_camera(generator, 50.0, ("pinhole", "orthographic")[i % 2]) for i in range(9)]
    cloud = torch.from_numpy(generator.uniform(-50.0, 50.0, (700, 3))).to(dtype)
    cloud[3, 1], cloud[4, 2] = torch.nan, torch.inf
    return cloud, cameras


@every_instruction_set
@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
@pytest.mark.parametrize(("n", "least"), [(0, 1), (1, 1), (700, 1), (3000, 2), (3000, 5)])
def test_native_fades_as_the_reference_does(n: int, least: int, model: str, instructions: str) -> None:
    """Also near cameras and behind them, beside places that lie very far away, and for what is no place."""
    generator = np.random.default_rng(n + least)
    cameras = [make_camera(generator, 20.0, model) for _ in range(40)]
    points = torch.from_numpy(generator.uniform(-40, 40, (n, 3)))
    points[100:200] = torch.from_numpy(cameras[0].position) + points[100:200] / 400
    points[n // 2 :: 100] = np.nan
    points[-1:] = torch.inf
    points[600:700:10] *= torch.logspace(2, 30, 10, dtype=torch.float64)[: len(points[600:700:10]), None]
    with using(instructions):
        for those in (points.float(), points):
            wanted = reference.fade_factors(those.double(), cameras, least, 0.3)
            factors = native.fade_factors(those, cameras, least, 0.3)
            with on_threads(1):
                assert torch.equal(native.fade_factors(those, cameras, least, 0.3), factors)
            torch.testing.assert_close(factors, wanted, atol=5e-5, rtol=0)
            assert (factors[reference.count_visibility(those, cameras) >= least] == 1).all()
            assert (factors[~those.isfinite().all(1)] == 0).all()
            assert n < 3000 or ((factors > 0.02) & (factors < 0.98)).sum() > 100
        assert (native.fade_factors(points, cameras[: least - 1], least, 0.3) == 0).all()
        assert (native.fade_factors(points, cameras, 0, 0.3) == 1).all()


def test_one_place_far_away_fades_none_of_its_neighbors() -> None:
    cameras = flight(30)
    points = torch.from_numpy(np.random.default_rng(0).uniform(0, 1000, (500, 3)) * [1, 1, 0.05])
    seen = reference.count_visibility(points, cameras) >= 2
    for far in (1e5, 1e8, 1e12, 1e300):
        points[250] = far
        factors = native.fade_factors(points, cameras, 2, 0.15)
        assert (factors[seen & (torch.arange(500) != 250)] == 1).all()
        torch.testing.assert_close(factors, reference.fade_factors(points, cameras, 2, 0.15), atol=5e-5, rtol=0)
