"""Panoramas of 360° and fisheyes: cut to perspective views, placed with their true places and headings."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from rich.console import Console

from support.flights import add_xmp
from support.panoramas import fisheye, walk
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.reconstruction import read_digests
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import VdgsError
from vdgs.geometry.similarity import fit_similarity
from vdgs.sfm.capture_writer import make_undistortion
from vdgs.sfm.cube_faces import FACES, cut_face
from vdgs.sfm.feature_extraction import group_by_camera
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.mask_files import read_keep_mask
from vdgs.sfm.reconstruct import reconstruct
from vdgs.sfm.reconstruction_plan import plan_reconstruction
from vdgs.sfm.step_keys import step_keys

WIDTH = 640


def globe(width: int = 720) -> np.ndarray:
    """A panorama whose red is the longitude and whose green is the latitude."""
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(width // 2) + 0.5) * 2 / width)
    return np.stack([255 * u, 255 * v, 0 * u], axis=-1).astype(np.uint8)


def test_faces_look_where_they_say():
    """The middle of each face shows the panorama in that direction; neighbors meet at their edges."""
    faces = {name: cut_face(globe(), name, 60).astype(float) for name in FACES}
    for name, (longitude, latitude) in {
        "front": (0.5, 0.5), "right": (0.75, 0.5), "left": (0.25, 0.5), "up": (None, 0.0), "down": (None, 1.0)
    }.items():  # fmt: skip
        middle = faces[name][29:31, 29:31].mean(axis=(0, 1)) / 255
        assert longitude is None or middle[0] == pytest.approx(longitude, abs=0.01)
        assert middle[1] == pytest.approx(latitude, abs=0.02)
    assert faces["front"][30, -1] == pytest.approx(faces["right"][30, 0], abs=4)
    assert faces["front"][-1, 30] == pytest.approx(faces["down"][0, 30], abs=4)
    assert faces["front"][0, 30] == pytest.approx(faces["up"][-1, 30], abs=4)
    for axes in FACES.values():
        assert np.array_equal(np.cross(axes[0], axes[1]), axes[2])


def test_the_mirror_image_of_a_panorama_has_mirrored_faces():
    """Exactly: no face is moved by part of a pixel."""
    panorama = np.random.default_rng(0).uniform(0, 255, (60, 120)).astype(np.float32)
    for name, other in {"front": "front", "back": "back", "left": "right", "up": "up"}.items():
        mirrored = cut_face(panorama[:, ::-1], other, 20)
        np.testing.assert_allclose(mirrored[:, ::-1], cut_face(panorama, name, 20), atol=0.5)
    flipped = cut_face(panorama[::-1], "down", 20)
    np.testing.assert_allclose(flipped[::-1], cut_face(panorama, "up", 20), atol=0.5)


def write(folder, number: int, xmp: bytes = b'<rdf:Description GPano:ProjectionType="equirectangular"/>') -> None:
    folder.mkdir(exist_ok=True)
    pixels = np.random.default_rng(number).integers(0, 255, (120, 240, 3), np.uint8)
    Image.fromarray(pixels).save(folder / f"P{number}.jpg")
    if xmp:
        add_xmp(folder / f"P{number}.jpg", xmp)


def test_panoramas_are_known_by_their_tags_or_asked_for(tmp_path):
    for k in range(3):
        write(tmp_path / "tagged", k)
        write(tmp_path / "plain", k, b"")
        write(tmp_path / "part", k, b'<r GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="480" '
              b'GPano:CroppedAreaImageWidthPixels="240"/>')  # fmt: skip
    for asked, known in (("tagged",), True), (("plain",), False), (("plain", "equirectangular"), True):
        found = collect_images([tmp_path / asked[0]], *asked[1:]).images
        assert [photo.is_panorama for photo in found] == [known] * 3
    with pytest.raises(VdgsError, match="is a part of a panorama"):
        collect_images([tmp_path / "part"])
    plan = plan_reconstruction(SfmRequest(image_folders=(tmp_path / "tagged",), output=tmp_path / "out"))
    assert len(plan.image_list.images) == 18
    assert plan.pairs == 3 * 36
    groups = group_by_camera(plan.image_list.images)
    assert all(group.has_focal_prior and group.is_confirmed for group in groups)  # exact: no adjustment doubts it
    request = SfmRequest(
        image_folders=(tmp_path / "tagged",), output=tmp_path / "out", options=SfmOptions(scale_bar=tmp_path / "bars")
    )
    with pytest.raises(VdgsError, match="not in panoramas"):
        plan_reconstruction(request)


def test_the_mask_of_a_panorama_masks_its_faces(tmp_path):
    for k in range(3):
        write(tmp_path / "images", k)
    mask = np.full((120, 240), 255, np.uint8)
    mask[60:] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "P0.png")
    plan = plan_reconstruction(SfmRequest(image_folders=(tmp_path / "images",), output=tmp_path / "out"))
    kept = {photo.face: read_keep_mask(photo) for photo in plan.image_list.images if photo.frame == "P0.jpg"}
    assert kept["up"].all()
    assert not kept["down"].any()
    half = kept["front"].shape[0] // 2
    assert kept["front"][: half - 1].all()
    assert not kept["front"][half + 1 :].any()


@pytest.mark.slow
@pytest.mark.xdist_group("sfm")  # over the town that its flights share
@pytest.mark.usefixtures("unestimated")
def test_a_walk_with_panoramas_is_placed(tmp_path):
    """Among each other to centimetres; level and north to degrees, which four places tell no better; views of one share
    a place; none is of the sky."""
    places = [np.array([x, y, 12.0 + z]) for x, y, z in [(-7, -3, 0), (0, -3, 1), (7, -3, 0), (3, 4, 1)]]
    headings = walk(tmp_path / "photos", places, WIDTH)
    output = tmp_path / "capture"
    options = SfmOptions(max_num_features=700)
    request = SfmRequest(image_folders=(tmp_path / "photos",), output=output, threads=1, options=options)
    report = reconstruct(request, Console(file=io.StringIO()))
    assert report.reprojection_px < 0.6
    images = pycolmap.Reconstruction(output / "sparse" / "0").images.values()
    assert not any(image.name.startswith("pano_up/") for image in images)
    centers, turns = dict[int, list[np.ndarray]](), []
    for image in images:
        face, number = image.name.partition("/")[0].removeprefix("pano_"), int(image.name[-8:-4]) - 1
        centers.setdefault(number, []).append(np.asarray(image.projection_center()))
        front_from_world = np.array(FACES[face]).T @ image.cam_from_world().rotation.matrix()
        angle = np.radians(headings[number])
        turns.append(front_from_world[2] @ [np.sin(angle), np.cos(angle), 0])
    assert sorted(centers) == [0, 1, 2, 3]
    assert len(turns) >= 14
    assert np.degrees(np.arccos(np.clip(turns, -1, 1))).max() < 3
    assert max(np.ptp(each, axis=0).max() for each in centers.values()) < 1e-6
    found = np.array([centers[k][0] for k in range(4)])
    similarity = fit_similarity(found, np.array(places))
    assert np.abs(similarity.apply(found) - places).max() < 0.1
    assert similarity.scale == pytest.approx(1, abs=0.02)


def test_the_name_of_the_lens_tells_a_fisheye(tmp_path):
    for k, lens in enumerate(("8mm F3.5 Fish-Eye", "Fisheye 10.5mm", "24mm F2.8")):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA434] = lens
        exif.get_ifd(0x8769)[0x920A] = 8.0
        Image.fromarray(globe(240)).save(tmp_path / f"{k}.jpg", exif=exif)
    models = [photo.camera_model for photo in collect_images([tmp_path]).images]
    assert models == ["OPENCV_FISHEYE", "OPENCV_FISHEYE", "SIMPLE_RADIAL"]
    assert {photo.camera_model for photo in collect_images([tmp_path], "opencv").images} == {"OPENCV"}
    output, keys = tmp_path.parent / "out", []
    for options in (SfmOptions(), SfmOptions(camera_model="opencv")):
        request = SfmRequest(image_folders=(tmp_path,), output=output, options=options)
        keys.append(step_keys(plan_reconstruction(request), read_digests(output)))
    assert keys[0]["features"] != keys[1]["features"]


def test_the_photograph_of_a_fisheye_becomes_a_perspective_view():
    """What is written of the picture of a known fisheye is what the pinhole camera that goes with it sees."""
    lens = Intrinsics("OPENCV_FISHEYE", (100.0, 100.0, 120.0, 120.0, 0.03, -0.01, 0.0, 0.0), 240, 240)
    bent = fisheye(globe(1440), 240, 100.0, lens.params[4:], 60.0)
    straight = make_undistortion(lens, 0)
    x, y = straight.grid[..., 0], straight.grid[..., 1]
    shown = cv2.remap(bent, x, y, cv2.INTER_CUBIC)[..., :2].astype(float)
    (fx, fy), (cx, cy) = straight.intrinsics.focal, straight.intrinsics.principal_point
    columns, rows = np.meshgrid(np.arange(shown.shape[1]) + 0.5, np.arange(shown.shape[0]) + 0.5)
    local = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=-1)
    cos, sin = 0.5, np.sqrt(0.75)
    right, ahead, up = local[..., 0], sin - cos * local[..., 1], -cos - sin * local[..., 1]
    longitude, latitude = np.arctan2(right, ahead), np.arctan2(up, np.hypot(right, ahead))
    expected = 255 * np.stack([longitude / (2 * np.pi) + 0.5, 0.5 - latitude / np.pi], axis=-1)
    inside = (np.hypot(right, ahead) > 0.3) & (np.abs(longitude) < 3)  # not at the nadir, nor at the seam
    assert inside.mean() > 0.8
    assert np.abs(shown - expected)[inside].max() < 3
