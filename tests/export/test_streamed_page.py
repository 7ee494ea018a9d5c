"""The folder for a web server: its tree holds the scene, and no page of others is overwritten."""

import json
import re

import numpy as np
import pytest
import torch

from support.gaussians import random_gaussians
from vdgs.errors import VdgsError
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportScene
from vdgs.export.formats.html import PAGE_LOSSES
from vdgs.export.formats.streamed_page import write_streamed_page


def test_the_leaves_hold_the_scene_and_nodes_above_fewer(tmp_path):
    some, path = random_gaussians(500, 0), tmp_path / "scene.json"
    assert write_streamed_page(path, ExportScene.of(some), node_size=100) == PAGE_LOSSES
    scene = json.loads(path.read_text())
    leaves, waiting, count = [], [scene["root"]], 0
    while waiting:
        entry = waiting.pop()
        rows = np.frombuffer((tmp_path / entry["content"]["uri"]).read_bytes(), np.float32).reshape(-1, 8)
        assert len(rows) <= 100
        waiting += entry.get("children", [])
        count += 1
        if "children" not in entry:
            assert entry["geometricError"] == 0
            leaves.append(rows[:, :3] / scene["factor"])
    means = torch.from_numpy(np.concatenate(leaves))
    near = torch.cdist(some.means, means).argmin(1)
    assert len(near.unique()) == len(means) == 500
    torch.testing.assert_close(means[near], some.means)
    files = registry.format_from_path(path).files(path)
    assert len(files) == 1 + count
    registry.write_scene(path, ExportScene.of(some))
    assert sorted(each.name for each in tmp_path.iterdir()) == ["index.html", "nodes-2", "scene.json"]


def test_a_browser_asks_whether_what_it_holds_is_still_right(tmp_path):
    """A server of files says only when they changed, so browsers would hold an old tree for long."""
    registry.write_scene(tmp_path / "scene.json", ExportScene.of(random_gaussians(20, 0)))
    page = (tmp_path / "index.html").read_text()
    assert 'FRESH = { cache: "no-cache" }' in page
    assert re.findall(r"fetch\(([^)]*)\)", page) == ["uri, FRESH"]


def test_a_page_of_others_stays(tmp_path):
    (tmp_path / "index.html").write_text("<title>mine</title>")
    with pytest.raises(VdgsError, match="is a page of something else"):
        registry.check_export(tmp_path / "scene.json", ExportScene.of(random_gaussians(20, 0)))
    assert (tmp_path / "index.html").read_text() == "<title>mine</title>"
