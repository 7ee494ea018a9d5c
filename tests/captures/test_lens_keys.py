"""Lenses of transforms.json under the keys of other programs: read as nerfstudio's, or refused by name."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from support.dataset_layouts import write_transforms
from vdgs.captures.formats.json_poses import parse_intrinsics
from vdgs.captures.formats.opensfm import _intrinsics as opensfm_lens
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.loading import load_capture
from vdgs.errors import CaptureError

HEAD = {"fl_x": 50.0, "fl_y": 51.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
MATRIX = [[50.0, 0, 32.0], [0, 51.0, 24.0], [0, 0, 1]]
RADTAN, RADTAN_K3 = [-0.2, 0.05, 0.001, -0.002], [-0.2, 0.05, 0.001, -0.002, 0.03]
OPENCV = ("OPENCV", (-0.2, 0.05, 0.001, -0.002))
FULL = ("FULL_OPENCV", (-0.2, 0.05, 0.001, -0.002, 0.03, 0.0, 0.0, 0.0))
ONE = ("OPENCV", (-0.2, 0.0, 0.0, 0.0))
FISHEYE = ("OPENCV_FISHEYE", (-0.2, 0.05, 0.001, -0.002))
PINHOLE: tuple[str, tuple[float, ...]] = ("PINHOLE", ())


def lens_of(common: dict, frame: dict | None = None) -> Intrinsics:
    return parse_intrinsics(frame or {}, common, Path("a.png"), Path("transforms.json"))


@pytest.mark.parametrize(
    ("says", "model"),
    [
        ({"distortion_model": "plumb_bob", "D": RADTAN_K3}, FULL),
        ({"distortion_model": "plumb_bob", "D": [*RADTAN, 0]}, OPENCV),
        ({"camera_model": "OPENCV", "distortion": RADTAN_K3}, FULL),
        ({"distortion_coefficients": RADTAN}, OPENCV),
        ({"distortion_coefficients": {"rows": 1, "cols": 5, "data": RADTAN_K3}}, FULL),
        ({"dist_coeffs": [RADTAN_K3]}, FULL),
        ({"distCoeffs": [*RADTAN_K3, 0.1, 0.2, 0.3]}, ("FULL_OPENCV", (*RADTAN_K3, 0.1, 0.2, 0.3))),
        ({"D": [*RADTAN_K3, 0.1, 0.2, 0.3, 0, 0, 0, 0]}, ("FULL_OPENCV", (*RADTAN_K3, 0.1, 0.2, 0.3))),
        ({"dist": RADTAN}, OPENCV),
        ({"distortion": {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}}, OPENCV),
        ({"distortion": {"model": "radtan", "coeffs": 4, "k1": -0.2}}, ("OPENCV", (-0.2, 0, 0, 0))),
        ({"radial_distortion": [-0.2, 0.05], "tangential_distortion": [0.001, -0.002]}, OPENCV),
        ({"lens": {"K1": -0.2, "K2": 0.05, "p1": 0.001, "p2": -0.002}}, OPENCV),
        ({"camera_model": "PINHOLE", "distortion_model": "equidistant", "distortion_coefficients": RADTAN}, FISHEYE),
        ({"is_fisheye": True, "distortion": RADTAN}, FISHEYE),
        ({"camera_model": "OPENCV_FISHEYE", "D": [[each] for each in RADTAN]}, FISHEYE),
        ({"distortion": RADTAN, "k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}, OPENCV),
        ({"distortion_model": "plumb_bob", "D": [0, 0, 0, 0, 0]}, PINHOLE),
        ({"distortion_model": "inverse_brown_conrady", "distortion": [0, 0, 0, 0, 0]}, PINHOLE),
        ({"distortion_model": "none", "distortion": "none", "distortion_params": None, "xi": 0}, PINHOLE),
        ({"distortion_map": "", "undistorted": True, "is_distorted": False, "radius": 2.5}, PINHOLE),
        ({"distortion_score": 0.3, "distortion_applied": 1, "fisheye_fov": 190.0}, PINHOLE),
        ({"camera": {"camera_model": "iPhone 14 Pro"}}, PINHOLE),
        ({"camera_model": "SIMPLE_RADIAL", "k": -0.2}, ONE),
        ({"camera_model": "SIMPLE_RADIAL", "k": 0.0}, PINHOLE),
        ({"camera_model": "RADIAL", "k1": 0, "k2": 0}, PINHOLE),
        ({"camera_model": "OPENCV"}, PINHOLE),  # as converters write it of phones
        ({"k": RADTAN}, OPENCV),
        ({"k": [-0.2]}, ONE),
        ({"k": 3}, PINHOLE),
        ({"k": 16}, PINHOLE),
        ({"K": [50.0, 51.0, 32.0, 24.0]}, PINHOLE),
        ({"K": [[50.0, 0, 32.0], [0, 51.0, 24.0], [0, 0, 1]], "k": -0.2}, ONE),
        ({"dist": [-0.2]}, ONE),
        ({"coeffs": RADTAN, "kappa": 92.5}, OPENCV),
        ({"k_1": -0.2, "k2 ": 0.05, "lens_p1": 0.001, "P-2": -0.002}, OPENCV),
        ({"lens": {"model": "SIMPLE_RADIAL", "k": -0.2}}, ONE),
        ({"camera_model": "OPENCV", "params": [50.0, 51.0, 32.0, 24.0, *RADTAN]}, OPENCV),
        ({"camera_model": "OPENCV_FISHEYE", "colmap_params": [50.0, 51.0, 32.0, 24.0, *RADTAN]}, FISHEYE),
        ({"intrinsics": [50.0, 51.0, 32.0, 24.0, *RADTAN]}, OPENCV),
        ({"params": [1, 2, 3], "coefficients": list(range(27))}, PINHOLE),
        ({"lens_model": "Hasselblad L2D-20c", "lens": "24 mm", "dist": [1.0, 2.0], "camera": {"fov": 84}}, PINHOLE),
    ],
)
def test_distortion_of_other_programs_is_read(says, model):
    expected = Intrinsics(model[0], (50.0, 51.0, 32.0, 24.0, *model[1]), 64, 48)
    assert lens_of(HEAD | says) == expected
    assert lens_of(HEAD, says) == expected  # of each frame


@pytest.mark.parametrize(
    "says",
    [
        {"camera_model": "SIMPLE_RADIAL", "params": [50.0, 32.0, 24.0, -0.2]},
        {"lens": {"model": "SIMPLE_RADIAL", "params": [50.0, 32.0, 24.0, -0.2]}},
        {"camera_model": "RADIAL", "intrinsics": [50.0, 32.0, 24.0, -0.2, 0.0]},
        {"params": [50.0, 50.0, 32.0, 24.0, -0.2, 0.0, 0.0, 0.0]},
    ],
)
def test_parameters_in_the_order_of_colmap_are_a_whole_lens(says):
    expected = Intrinsics("OPENCV", (50.0, 50.0, 32.0, 24.0, *ONE[1]), 64, 48)
    size = {"w": 64, "h": 48}
    assert lens_of(size | says) == lens_of(size, says) == expected
    assert lens_of(HEAD | says).params == (50.0, 51.0, *expected.params[2:])  # known keys count more


@pytest.mark.parametrize(
    ("says", "message"),
    [
        ({"camera_model": "OPENCV", "xi": 0.2}, "under 'xi' cannot be read"),
        ({"alpha": 0.6, "beta": 1.1}, "alpha, beta are not supported"),
        ({"distortion": [0.1, 0.2, 0.3]}, "'distortion' cannot be read: 3 numbers, and OpenCV's are k1, k2, p1, p2"),
        ({"distortion": [*RADTAN, 0, 0.1]}, "6 numbers"),
        ({"D": [*RADTAN_K3, 0.1, 0.2, 0.3, 0.4, 0, 0, 0]}, "12 numbers"),
        ({"is_fisheye": True, "D": RADTAN_K3}, "5 numbers, and OpenCV's are k1, k2, k3, k4"),
        ({"distortion": -0.2}, "'distortion' cannot be read"),
        ({"distortion_model": "omni", "D": RADTAN}, "distortion_model 'omni' is not supported"),
        ({"distortion_model": "modified_brown_conrady", "D": RADTAN}, "'modified_brown_conrady' is not supported"),
        ({"camera_model": "OPENCV", "distortion_model": "equidistant"}, "contradicts the camera model OPENCV"),
        ({"camera_model": "OPENCV_FISHEYE", "distortion_model": "plumb_bob"}, "contradicts the camera model"),
        ({"distortion": RADTAN, "k1": 0.1}, "'distortion' contradicts k1 0.1"),
        ({"distortion": RADTAN, "D": RADTAN_K3}, "'D' contradicts k3 0.0"),
        ({"lens_distortion_grid": {"x": [[0.1, 0.2]]}}, "'lens_distortion_grid' cannot be read"),
        ({"thin_prism_coeffs": [0.1, 0, 0, 0]}, "'thin_prism_coeffs' cannot be read"),
        ({"radial_coeffs": [0.1, 0.1, 0.1, 0.1, 0.1, 0.1]}, "'radial_coeffs' cannot be read"),
        ({"distortion": {"k1": 0.1, "k6": 0.1}}, "k6 is not supported"),
        ({"fisheye": True}, "'fisheye' cannot be read"),
        ({"camera_model": "SIMPLE_RADIAL"}, "SIMPLE_RADIAL bends, and no key is known"),
        ({"lens": {"model": "RADIAL_FISHEYE"}}, "RADIAL_FISHEYE bends, and no key is known"),
        ({"k": 800.5}, "'k' may be coefficients, or focal lengths"),
        ({"K": [0.8, 0.8, 0.5, 0.5]}, "'K' may be coefficients, or focal lengths"),
        ({"k": [0.1, 0.2, 0.3]}, "'k' cannot be read: 3 numbers"),
        ({"camera_model": "SIMPLE_RADIAL", "params": [50.0, 32.0, 24.0, 0.1, 0.2]}, "5 parameters .* has 4"),
        ({"colmap_params": [50.0, 32.0, 24.0, 0.1]}, "4 parameters of a lens, and no camera_model"),
        ({"params": [50.0, 32.0, 24.0, 0.1]}, "4 parameters of a lens, and no camera_model"),
        ({"intrinsics": [50.0, 51.0, 32.0, 24.0, 0.1, 0.2]}, "'intrinsics' (may hold lens distortion|is neither)"),
        ({"k_5": 0.1}, "k5 is not supported"),
        ({"p3": 0.1}, "p3 is not supported"),
        ({"wide_k1": 0.1}, "'wide_k1' cannot be read"),
        ({"intrinsics": {"model": "Inverse Brown Conrady", "coeffs": RADTAN}}, "Brown Conrady' is not supported"),
    ],
)
def test_distortion_that_cannot_be_read_is_refused_by_name(says, message):
    for common, frame in ((HEAD | says, {}), (HEAD, says)):
        with pytest.raises(CaptureError, match=message):
            lens_of(common, frame)


@pytest.mark.parametrize(
    "says",
    [
        {"K": MATRIX, "w": 64, "h": 48},
        {"intrinsics": [50.0, 51.0, 32.0, 24.0], "w": 64, "h": 48},
        {"camera_matrix": {"rows": 3, "cols": 3, "data": [each for row in MATRIX for each in row]}, "w": 64, "h": 48},
        {"camera_info": {"width": 64, "height": 48, "K": [50.0, 0, 32, 0, 51.0, 24, 0, 0, 1], "D": [0] * 5}},
        {"intrinsic_matrix": [50.0, 0, 0, 0, 51.0, 0, 32, 24, 1], "w": 64, "h": 48},  # column by column
        {"intrinsics": [[*row, 0] for row in MATRIX] + [[0, 0, 0, 1]], "w": 64, "h": 48},
        {"camera": {"fx": 50.0, "fy": 51.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}},
        {"fx": 50.0, "fy": 51.0, "cx": 32.0, "cy": 24.0, "image_width": 64, "image_height": 48},
        {
            "x_fov": math.degrees(2 * math.atan(32 / 50)),
            "y_fov": math.degrees(2 * math.atan(24 / 51)),
            "w": 64,
            "h": 48,
        },
        HEAD | {"K": [[99.0, 0, 70.0], [0, 99.0, 60.0], [0, 0, 1]]},  # nerfstudio's keys count more
        HEAD | {"fx": 0.8, "camera_matrix": [[0, -1.0, 0, 3], [1, 0, 0, 4], [0, 0, 1, 5]]},  # and a pose is no lens
    ],
)
def test_focal_lengths_of_other_programs_are_read(says):
    for common, frame in ((says, {}), ({"w": 64, "h": 48}, says)):
        lens = lens_of(common, frame)
        assert lens.model == "PINHOLE"
        assert (lens.width, lens.height) == (64, 48)
        assert lens.params == pytest.approx((50.0, 51.0, 32.0, 24.0))


def test_a_list_of_a_frame_counts_more_than_the_distortion_of_all():
    common = HEAD | {"k1": 0.3, "k2": 0.2, "p1": 0.1, "k4": 0.1}
    assert lens_of(common, {"D": RADTAN}) == lens_of(HEAD, {"D": RADTAN})
    assert not lens_of(common, {"D": [0, 0, 0, 0, 0]}).is_distorted
    assert lens_of(HEAD | {"D": [*RADTAN_K3, 0.1, 0.2, 0.3]}, {"distortion": RADTAN}).model == "OPENCV"
    assert lens_of(common | {"D": [0, 0, 0, 0]}).is_distorted


def test_a_matrix_of_a_frame_counts_more_than_the_focal_length_of_all():
    assert lens_of(HEAD, {"K": [[70.0, 0, 32], [0, 70.0, 24], [0, 0, 1]]}).focal == (70.0, 70.0)
    with pytest.raises(CaptureError, match=r"'K' of a frame .* at 320\.0, 240\.0, and w and h are 64x48"):
        lens_of(HEAD, {"K": [[700.0, 0, 320], [0, 700.0, 240], [0, 0, 1]]})
    with pytest.raises(CaptureError, match=r"'K' is neither fx, fy, cx, cy nor .* \(a skew is not"):
        lens_of({"w": 64, "h": 48, "K": [[50.0, 2.0, 32], [0, 51.0, 24], [0, 0, 1]]})


def test_what_may_be_of_a_lens_and_is_not_read_is_named(tmp_path, scene):
    content = write_transforms(tmp_path, scene, cameras=[{"fx": 3.0}], calibration_file="a.json", fov=60.0)
    for number, frame in enumerate(content["frames"]):
        frame |= {"fov": 60.0 + number, "focal_length": 8.8}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    (said,) = [each for each in load_capture(tmp_path).warnings if "not read" in each]
    assert said.startswith("transforms.json: 'cameras', 'fov': not read")


@pytest.mark.parametrize(("kind", "term"), [("perspective", "k3"), ("fisheye_opencv", "p1"), ("brown", "s1")])
def test_terms_that_a_projection_of_opensfm_has_not_are_named(kind, term):
    camera = {"projection_type": kind, "width": 64, "height": 48, "focal": 0.8, "k1": -0.1}
    assert isinstance(opensfm_lens(camera | {term: 0.0}, "one", Path("a.json")), Intrinsics)
    said = opensfm_lens(camera | {term: 0.1}, "one", Path("a.json"))
    assert said == f"the lens parameter {term} of the camera 'one', of a projection '{kind}', is not supported"


@pytest.mark.parametrize(
    "says",
    [
        {"distortion_model": "undistorted", "dist": 3.5},  # the distance to something
        {"K": [[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]]},  # of the photograph before it was shrunk
        {"K": [[0.8, 0, 0.5], [0, 1.1, 0.5], [0, 0, 1]]},
        {"fx": 500.0, "width": 640, "height": 480},
    ],
)
def test_other_keys_beside_the_focal_length_of_all_leave_it_as_it_is(says):
    without = {key: value for key, value in HEAD.items() if key not in ("cx", "cy")}
    assert lens_of(without | says) == lens_of(without)
    assert lens_of(HEAD | says) == lens_of(HEAD)


def test_the_size_of_the_known_focal_length_is_read():
    named = {"fl_x": 50.0, "fl_y": 51.0, "fx": 50.0, "width": 64, "height": 48}
    assert lens_of(named) == lens_of(HEAD)


def test_whole_numbers_in_the_lens_of_a_frame_are_read():
    lens = lens_of(HEAD, {"intrinsics": {"fx": 70, "fy": 70, "cx": 32, "cy": 24}})
    assert lens.params == (70.0, 70.0, 32.0, 24.0)


def test_the_same_distortion_with_fewer_digits_is_no_contradiction():
    written = dict(zip(("k1", "k2", "p1", "p2"), (-0.200001, 0.0500001, 0.001, -0.002), strict=True))
    assert lens_of(HEAD | written | {"distortion": RADTAN}) == lens_of(HEAD | written)
    named = {"k1": -0.2, "distortion_model": "SIMPLE_RADIAL"}
    assert lens_of(HEAD | named).params[4:] == (-0.2, 0.0, 0.0, 0.0)
