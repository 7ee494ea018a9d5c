"""Files as other programs write them: filters, flags, older layouts, other elements, numbers that are none."""

from __future__ import annotations

import gzip
import re
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from support.gaussians import random_gaussians
from vdgs.errors import VdgsError
from vdgs.export.formats import registry, spz
from vdgs.export.formats.axes import Y_DOWN
from vdgs.export.formats.export_scene import ExportScene
from vdgs.export.formats.gaussian_ply import property_names
from vdgs.model.gaussian_transform import gaussian_covariances
from vdgs.model.gaussians import Gaussians

pytestmark = pytest.mark.slow


def plain_ply(path: Path, some: Gaussians, text: bool = False, before: bytes = b"", **more: np.ndarray) -> Gaussians:
    """Write a PLY as another program does: more properties, another element before the vertices (its header)."""
    registry.write_scene(path, ExportScene.of(some))
    head, _, body = path.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(len(some), -1)
    rows = np.concatenate([rows, *(column[:, None].astype("<f4") for column in more.values())], 1)
    head += b"".join(b"property float %s\n" % name.encode() for name in more)
    head = head.replace(b"element vertex", before + b"element vertex")
    if text:
        lines = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows)
        path.write_bytes(head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + lines.encode() + b"\n")
    else:
        path.write_bytes(head + b"end_header\n" + rows.astype("<f4").tobytes())
    return some


def replace_bytes(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))


# How they are to be drawn


def test_the_filter_of_mip_splatting_makes_gaussians_larger_and_fainter(tmp_path):
    """By the covariance of a round Gaussian, with the same integral of opacity over space."""
    some, sizes = random_gaussians(50, 1), np.linspace(0, 0.5, 50)
    plain_ply(tmp_path / "a.ply", some, filter_3D=sizes)
    with pytest.warns(UserWarning, match="anti-aliased"):
        read = registry.read_gaussians(tmp_path / "a.ply")
    round_part = torch.from_numpy(sizes**2).float()[:, None, None] * torch.eye(3)
    torch.testing.assert_close(
        gaussian_covariances(read), gaussian_covariances(some) + round_part, rtol=1e-4, atol=1e-5
    )
    mass, wanted = (each.opacity_logits.sigmoid() * each.log_scales.sum(1).exp() for each in (read, some))
    torch.testing.assert_close(mass, wanted, rtol=1e-4, atol=0)


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz"])
def test_what_is_to_be_drawn_anti_aliased_says_so(tmp_path, name: str):
    some = random_gaussians(20, 1)
    registry.write_scene(tmp_path / name, replace(ExportScene.of(some), antialiased=True))
    with pytest.warns(UserWarning, match=re.escape(name) + r".*anti-aliased"):
        registry.read_gaussians(tmp_path / name)
    registry.write_scene(tmp_path / name, ExportScene.of(some))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        registry.read_gaussians(tmp_path / name)


@pytest.mark.parametrize("said", ["SplatRenderMode: mip", "antialiased 1"])
def test_the_words_of_brush_and_postshot_are_understood(tmp_path, said: str):
    plain_ply(tmp_path / "a.ply", random_gaussians(5, 0), before=b"comment %s\n" % said.encode())
    with pytest.warns(UserWarning, match="anti-aliased"):
        registry.read_gaussians(tmp_path / "a.ply")


# SPZ


def test_extensions_after_the_gaussians_of_an_spz_are_skipped_where_its_flag_says_so(tmp_path):
    some, path = random_gaussians(20, 1), tmp_path / "a.spz"
    registry.write_scene(path, ExportScene.of(some))
    wanted, data = registry.read_gaussians(path), bytearray(gzip.decompress(path.read_bytes()))
    record = struct.pack("<II", 0xADBE0002, 12) + bytes(12)
    path.write_bytes(gzip.compress(bytes(data) + record))
    with pytest.raises(VdgsError, match="longer"):
        registry.read_gaussians(path)
    data[14] |= spz.HAS_EXTENSIONS
    path.write_bytes(gzip.compress(bytes(data) + record))
    assert torch.equal(registry.read_gaussians(path).means, wanted.means)


# Compressed PLYs


def test_an_older_compressed_ply_has_colors_between_0_and_1(tmp_path):
    """As PlayCanvas wrote them first: twelve numbers a chunk."""
    some = random_gaussians(300, 1)
    registry.write_scene(tmp_path / "new.compressed.ply", ExportScene.of(some))
    new = registry.read_gaussians(tmp_path / "new.compressed.ply")
    head, mark, body = (tmp_path / "new.compressed.ply").read_bytes().partition(b"end_header\n")
    chunks = np.frombuffer(body, "<f4", 2 * 18).reshape(2, 18)
    head = re.sub(rb"property float (min|max)_[rgb]\n", b"", head)
    (tmp_path / "old.ply").write_bytes(head + mark + chunks[:, :12].tobytes() + body[2 * 72 :])
    old = registry.read_gaussians(tmp_path / "old.ply")
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "shN"):
        assert torch.equal(old.tensors()[name], new.tensors()[name]), name
    shown = old.sh0 * 0.28209479177387814 + 0.5
    assert -1e-6 < float(shown.min()) < 0.01
    assert 0.99 < float(shown.max()) < 1 + 1e-6


def test_a_ply_is_read_by_its_header_whatever_its_name(tmp_path):
    some = random_gaussians(300, 1)
    registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(some))
    registry.write_scene(tmp_path / "b.ply", ExportScene.of(some))
    wanted = registry.read_gaussians(tmp_path / "a.compressed.ply")
    (tmp_path / "a.compressed.ply").rename(tmp_path / "c.ply")
    (tmp_path / "b.ply").rename(tmp_path / "d.compressed.ply")
    assert torch.equal(registry.read_gaussians(tmp_path / "c.ply").means, wanted.means)
    assert torch.equal(registry.read_gaussians(tmp_path / "d.compressed.ply").means, some.means)


def test_colors_that_do_not_change_stay_as_bright_as_they_are(tmp_path):
    """Zero is between two bytes, 1/64 above and below it: as many are of the one as of the other."""
    some = random_gaussians(512, 3)
    registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(replace(some, shN=torch.zeros_like(some.shN))))
    read = Y_DOWN.of_ground(registry.read_gaussians(tmp_path / "a.compressed.ply")).shN
    torch.testing.assert_close(read.abs(), torch.full_like(read, 1 / 64), atol=1e-6, rtol=0)
    assert float(read.mean(0).abs().max()) < 1e-6
    assert float(read.reshape(len(read), -1).mean(1).abs().max()) < 1 / 64 / 45 + 1e-6


def test_changing_colors_of_no_degree_are_refused(tmp_path):
    registry.write_scene(tmp_path / "a.compressed.ply", ExportScene.of(random_gaussians(5, 1)))
    replace_bytes(tmp_path / "a.compressed.ply", b"property uchar f_rest_8\n", b"")
    with pytest.raises(VdgsError, match="'sh' has 8 properties, not \\(9, 24, 45\\) bytes"):
        registry.read_gaussians(tmp_path / "a.compressed.ply")


# Headers and rows


@pytest.mark.parametrize("text", [False, True])
def test_elements_before_the_vertices_are_skipped(tmp_path, text: bool):
    some = random_gaussians(20, 1)
    plain_ply(tmp_path / "a.ply", some, text, b"element camera 2\nproperty float x\nproperty uchar y\n")
    replace_bytes(tmp_path / "a.ply", b"end_header\n", b"end_header\n" + (b"1 2\n3 4\n" if text else bytes(10)))
    assert torch.equal(registry.read_gaussians(tmp_path / "a.ply").means, some.means)


def test_empty_lines_of_a_text_file_are_nothing(tmp_path):
    some = plain_ply(tmp_path / "a.ply", random_gaussians(20, 1), text=True)
    replace_bytes(tmp_path / "a.ply", b"end_header\n", b"end_header\n\n")
    assert torch.equal(registry.read_gaussians(tmp_path / "a.ply").means, some.means)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("property float nx", "property float x", "names 'x' twice in the element 'vertex'. Write it with one"),
        ("element vertex 5", "element vertex -3", "'element vertex -3' says no number"),
        ("element vertex", "element points", "has no element 'vertex'"),
        ("float f_rest_3", "float f_rest_99", "none of the name f_rest_3. Number them without gaps"),
        ("property float nx", "property list uchar int nx", "has lists in the element 'vertex'. Write it without"),
        ("element vertex", "element face 1\nproperty list uchar int i\nelement vertex", "lists in the element 'face'"),
        ("binary_little_endian", "binary", "is of format 'binary'"),
    ],
)
def test_what_is_wrong_with_a_header_is_said(tmp_path, old: str, new: str, said: str):
    path = tmp_path / "a.ply"
    plain_ply(path, random_gaussians(5, 1))
    replace_bytes(path, old.encode(), new.encode())
    with pytest.raises(VdgsError, match=re.escape(str(path)) + ".*" + re.escape(said)):
        registry.read_gaussians(path)


def test_gaussians_that_nobody_can_draw_are_left_out_and_counted(tmp_path):
    """Infinite opacities mean 0 and 1, and stay: any file that is read can be written."""
    some = random_gaussians(10, 1)
    some.opacity_logits[2:4] = torch.tensor([torch.inf, -torch.inf])
    damaged = {"x": (5, np.nan), "scale_1": (6, np.inf), "f_rest_3": (7, np.nan)}
    plain = replace(some, opacity_logits=some.opacity_logits.clamp(-9, 9))
    plain_ply(tmp_path / "a.ply", plain)
    head, mark, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(10, -1).copy()
    names = property_names(1)
    rows[:, names.index("opacity")] = some.opacity_logits
    for name, (row, value) in damaged.items():
        rows[row, names.index(name)] = value
    rows[8, -4:] = 0
    (tmp_path / "a.ply").write_bytes(head + mark + rows.tobytes())
    with pytest.warns(UserWarning, match=r"a\.ply: 4 Gaussians have numbers that are not finite"):
        read = registry.read_gaussians(tmp_path / "a.ply")
    kept = [0, 1, 2, 3, 4, 9]
    assert torch.equal(read.means, some.means[kept])
    torch.testing.assert_close(read.opacity_logits.sigmoid(), some.opacity_logits[kept].sigmoid(), atol=1e-6, rtol=0)
    registry.write_scene(tmp_path / "b.ply", ExportScene.of(read))
