"""Spark's RAD: every Gaussian a leaf of one tree, every number back from its column."""

import json
import struct
import zlib

import numpy as np
import torch

from support.gaussians import random_gaussians, turned
from vdgs.export.formats import registry
from vdgs.export.formats.axes import Y_UP
from vdgs.export.formats.export_scene import ExportScene, base_colors
from vdgs.export.formats.rad import build_tree


def test_every_gaussian_is_a_leaf_of_one_tree():
    some = random_gaussians(700, 1)
    tree = build_tree(some)
    parents = np.flatnonzero(tree.counts)
    assert (tree.counts[parents] > 1).all()
    assert (tree.starts[parents] > parents).all()
    children = np.concatenate([np.arange(tree.starts[i], tree.starts[i] + tree.counts[i]) for i in parents])
    assert np.sort(children).tolist() == list(range(1, len(tree.counts)))
    leaves = tree.gaussians.select(torch.from_numpy(tree.counts == 0))
    near = torch.cdist(some.means, leaves.means).argmin(1)
    assert len(near.unique()) == len(leaves.means) == 700
    torch.testing.assert_close(leaves.shN[near], some.shN)
    for i in parents[:20]:
        own = tree.gaussians.means[tree.starts[i] : tree.starts[i] + tree.counts[i]]
        assert (tree.gaussians.means[i] >= own.amin(0) - 1e-4).all()
        assert (tree.gaussians.means[i] <= own.amax(0) + 1e-4).all()
    assert len(build_tree(some.select(torch.arange(1))).counts) == 1


def test_columns_hold_the_numbers_of_the_tree(tmp_path):
    some = random_gaussians(400, 2)
    registry.write_scene(tmp_path / "a.rad", ExportScene.of(some))
    data, wanted = (tmp_path / "a.rad").read_bytes(), build_tree(turned(some, Y_UP.turn))
    assert data[:4] == b"RAD0"
    length = struct.unpack_from("<I", data, 4)[0]
    header = json.loads(data[8 : 8 + length])
    at = 8 + -(-length // 8) * 8
    assert header["count"] == len(wanted.counts)
    assert header["chunks"] == [{"offset": 0, "bytes": len(data) - at}]
    assert data[at : at + 4] == b"RADC"
    length = struct.unpack_from("<I", data, at + 4)[0]
    chunk = json.loads(data[at + 8 : at + 8 + length])
    start = at + 8 + -(-length // 8) * 8 + 8
    assert struct.unpack_from("<Q", data, start - 8)[0] == len(data) - start == chunk["payloadBytes"]
    columns = {}
    for each in chunk["properties"]:
        assert each["offset"] % 8 == 0
        packed = data[start + each["offset"] : start + each["offset"] + each["bytes"]]
        columns[each["property"]] = zlib.decompress(packed, -15)
    n = chunk["count"]
    places = np.frombuffer(columns["center"], np.uint8).reshape(4, 3, n).transpose(2, 1, 0)
    np.testing.assert_allclose(
        np.ascontiguousarray(places).view("<f4")[..., 0], wanted.gaussians.means.numpy(), atol=1e-6
    )
    colors = np.frombuffer(columns["rgb"], "<f2").reshape(3, n).T
    np.testing.assert_allclose(colors, base_colors(wanted.gaussians), atol=2e-3)
    np.testing.assert_array_equal(np.frombuffer(columns["child_count"], "<u2"), wanted.counts)
    assert set(columns) >= {"sh1", "sh2"}
    assert "sh3" not in columns
    assert json.loads((tmp_path / "a.rad.json").read_text())["axes"].startswith("x, z, -y of the ground")
