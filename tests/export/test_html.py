"""Pages that show a scene offline: what is in them, what they may load."""

from __future__ import annotations

import base64
import re
import sys
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="viser is not installed (pip install 'vdgs[viewer]')")

from support.gaussians import overhead, picture, psnr, random_gaussians
from vdgs.errors import VdgsError
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene, InitialView
from vdgs.export.formats.gaussian_store import even_rows
from vdgs.export.formats.html import PAGE_LOSSES
from vdgs.model.gaussian_transform import gaussian_covariances

PLACED = ExportMetadata(origin=(690_000.0, 5_334_000.25, 512.0), crs="EPSG:32632", geodetic=(48.13, 11.57, 512.0))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 300.0])
def test_a_page_holds_the_scene_in_any_unit(tmp_path, scale):
    gaussians = random_gaussians(2000, 0)
    gaussians = replace(
        gaussians, means=scale * gaussians.means, log_scales=gaussians.log_scales + float(np.log(scale))
    )
    assert registry.write_scene(tmp_path / "a.html", ExportScene.of(gaussians, PLACED)) == PAGE_LOSSES
    read = registry.read_gaussians(tmp_path / "a.html")
    assert torch.allclose(read.means, gaussians.means, rtol=1e-6, atol=1e-6 * scale)
    spread = gaussian_covariances(gaussians)
    assert torch.allclose(gaussian_covariances(read), spread, rtol=2e-3, atol=1e-5 * scale**2)
    camera = overhead(8.0)
    if scale == 1.0:
        assert psnr(picture(read, camera), picture(gaussians, camera)) > 38


def test_a_sample_of_many_names_rows_that_are_there():
    for count in (1, 5, (1 << 24) + 1, 50_000_000):
        rows = even_rows(count, 1 << 15)
        assert (rows[0], rows[-1]) == (0, count - 1)
        assert len(np.unique(rows)) == len(rows) == min(count, 1 << 15)


def test_a_page_says_what_few_cameras_see(tmp_path):
    gaussians = random_gaussians(1001, 0)
    seen = torch.arange(1001) % 6
    page = InitialView((0.0, -20.0, 20.0), (0.0, 0.0, 0.0), count_visibility=lambda places: seen)
    registry.write_scene(tmp_path / "a.html", replace(ExportScene.of(gaussians), page=page))
    packed = re.search(r'atob\("([A-Za-z0-9+/=]*)"', (tmp_path / "a.html").read_text())
    codes = np.frombuffer(zlib.decompress(base64.b64decode(packed[1])), np.uint8)
    assert [codes[i >> 2] >> 2 * (i & 3) & 3 for i in range(1001)] == [max(0, min(int(v) - 1, 2)) for v in seen]
    registry.write_scene(tmp_path / "b.html", ExportScene.of(gaussians))
    assert "trust" not in (tmp_path / "b.html").read_text()


def test_what_is_far_larger_than_all_else_is_held_as_large_as_it_can_be(tmp_path):
    gaussians = random_gaussians(1000, 0)
    gaussians.log_scales[0] = 15.0
    registry.write_scene(tmp_path / "a.html", ExportScene.of(gaussians))
    read = registry.read_gaussians(tmp_path / "a.html")
    assert bool(torch.isfinite(read.log_scales).all())
    assert float(read.log_scales[0].max()) > float(read.log_scales[1:].max())


def test_what_is_too_large_is_thinned_until_it_fits(tmp_path):
    gaussians = random_gaussians(40_000, 1, reach=20.0)
    page = InitialView((0.0, -20.0, 20.0), (0.0, 0.0, 0.0), max_bytes=1_300_000)
    *_, thinned = registry.write_scene(tmp_path / "a.html", replace(ExportScene.of(gaussians), page=page))
    assert (tmp_path / "a.html").stat().st_size <= 1_300_000
    kept = len(registry.read_gaussians(tmp_path / "a.html"))
    assert 40_000 // 8 < kept < 40_000
    assert (tmp_path / "a.html").stat().st_size > 0.8 * 1_300_000  # there is little room left
    assert f"{kept:,}" in thinned
    assert "--html-max-mb" in thinned
    with pytest.raises(VdgsError, match="--html-max-mb"):
        registry.write_scene(
            tmp_path / "b.html", replace(ExportScene.of(gaussians), page=replace(page, max_bytes=500_000))
        )
    assert not (tmp_path / "b.html").exists()


def test_a_page_asks_nobody_for_anything(tmp_path):
    """What it may load is in it; whatever a place is called, it is no part of the page."""
    page = InitialView((0.0, -9.0, 9.0), (0.0, 0.0, 0.0), title='<script>"a" & b</script>')
    registry.write_scene(tmp_path / "a.html", replace(ExportScene.of(random_gaussians(1000, 0), PLACED), page=page))
    text = (tmp_path / "a.html").read_text()
    assert '<script>"a"' not in text
    assert "&lt;script&gt;&quot;a&quot; &amp; b&lt;/script&gt;" in text
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy is not None
    assert not re.search(r"https?:|\*|'self'", policy[1])
    assert text.index("Content-Security-Policy") < text.index("<script")
    assert "EPSG:32632" in text
    assert not re.search(r'(src|href)="(?!data:)', text)


def test_what_is_no_page_is_said(tmp_path):
    (tmp_path / "a.html").write_text("<html></html>")
    with pytest.raises(VdgsError, match="no page"):
        registry.read_gaussians(tmp_path / "a.html")
    with pytest.raises(VdgsError, match="cannot be read"):
        registry.read_gaussians(tmp_path / "b.html")


def test_without_viser_it_is_said_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(VdgsError, match=r"vdgs\[viewer\]"):
        registry.check_export(tmp_path / "a.html", ExportScene(chunks=(), count=5, degree=0))
