"""Pages that show a scene offline: what is in them, what they may load, and what a real browser draws from them."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="viser is not installed (pip install 'vdgs[viewer]')")

from cli_support import wait_until
from formats_support import overhead, picture, psnr, random_gaussians
from vdgs.cameras import Camera
from vdgs.errors import VdgsError
from vdgs.export.formats import registry
from vdgs.export.formats.scene import Facts, Page, Scene
from vdgs.films.paths import look_at
from vdgs.kernels.spherical_harmonics import dc_of_colours
from vdgs.model.gaussians import Gaussians, draw_gaussians
from vdgs.model.similarity import covariances
from viewer_support import browser, open_page

pytestmark = pytest.mark.xdist_group("viewer")
PLACED = Facts(origin=(690_000.0, 5_334_000.25, 512.0), crs="EPSG:32632", geodetic=(48.13, 11.57, 512.0))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 300.0])
def test_a_page_holds_the_scene_in_any_unit(tmp_path, scale):
    gaussians = random_gaussians(2000, 0)
    gaussians = replace(
        gaussians, means=scale * gaussians.means, log_scales=gaussians.log_scales + float(np.log(scale))
    )
    assert registry.write(tmp_path / "a.html", Scene.of(gaussians, PLACED)) == (
        "colours do not change with the viewing direction",
    )
    read = registry.read(tmp_path / "a.html")
    assert torch.allclose(read.means, gaussians.means, rtol=1e-6, atol=1e-6 * scale)
    spread = covariances(gaussians)
    assert torch.allclose(covariances(read), spread, rtol=2e-3, atol=1e-5 * scale**2)
    camera = overhead(8.0)
    if scale == 1.0:
        assert psnr(picture(read, camera), picture(gaussians, camera)) > 38


def test_what_is_far_larger_than_all_else_is_held_as_large_as_it_can_be(tmp_path):
    gaussians = random_gaussians(1000, 0)
    gaussians.log_scales[0] = 15.0
    registry.write(tmp_path / "a.html", Scene.of(gaussians))
    read = registry.read(tmp_path / "a.html")
    assert bool(torch.isfinite(read.log_scales).all())
    assert float(read.log_scales[0].max()) > float(read.log_scales[1:].max())


def test_what_is_too_large_is_thinned_until_it_fits(tmp_path):
    gaussians = random_gaussians(40_000, 1, reach=20.0)
    page = Page((0.0, -20.0, 20.0), (0.0, 0.0, 0.0), most_bytes=1_300_000)
    _, thinned = registry.write(tmp_path / "a.html", replace(Scene.of(gaussians), page=page))
    assert (tmp_path / "a.html").stat().st_size <= 1_300_000
    kept = len(registry.read(tmp_path / "a.html"))
    assert 40_000 // 8 < kept < 40_000
    assert (tmp_path / "a.html").stat().st_size > 0.8 * 1_300_000  # there is little room left
    assert f"{kept:,}" in thinned
    assert "--html-mb" in thinned
    with pytest.raises(VdgsError, match="--html-mb"):
        registry.write(tmp_path / "b.html", replace(Scene.of(gaussians), page=replace(page, most_bytes=500_000)))
    assert not (tmp_path / "b.html").exists()


def test_a_page_asks_nobody_for_anything(tmp_path):
    """What it may load is in it; whatever a place is called, it is no part of the page."""
    page = Page((0.0, -9.0, 9.0), (0.0, 0.0, 0.0), title='<script>"a" & b</script>')
    registry.write(tmp_path / "a.html", replace(Scene.of(random_gaussians(1000, 0), PLACED), page=page))
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
        registry.read(tmp_path / "a.html")
    with pytest.raises(VdgsError, match="cannot be read"):
        registry.read(tmp_path / "b.html")


def test_without_viser_it_is_said_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(VdgsError, match=r"vdgs\[viewer\]"):
        registry.check(tmp_path / "a.html", Scene(chunks=(), count=5, degree=0))


def test_writing_other_formats_does_not_wait_for_viser():
    code = "import sys, vdgs.export.exporting; sys.exit('viser' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# ------------------------------------------------------------------------------------- a real browser


def two_floors() -> Gaussians:
    """A chequered floor, and a red roof above its north-east quarter that comes first in the file: what does not sort
    draws the floor over it. A white post in the west stands upright."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(-4, 4, 0.25) + 0.125, np.arange(-4, 4, 0.25) + 0.125))
    floor = np.stack([x, y, 0 * x], 1)
    chequered = (np.floor(x / 2) + np.floor(y / 2)) % 2
    paint = np.where(chequered[:, None] > 0, [0.1, 0.2, 0.9], [0.1, 0.7, 0.2])
    above = floor[(x > 0) & (y > 0)] + [0, 0, 1.5]
    post = np.stack([np.full(12, -2.0), np.full(12, -1.0), np.linspace(0, 2, 12)], 1)
    means = np.concatenate([above, floor, post]).astype(np.float32)
    colours = np.concatenate([np.full(above.shape, [0.9, 0.1, 0.1]), paint, np.full(post.shape, 0.95)])
    count = len(means)
    return Gaussians(
        means=torch.from_numpy(means), log_scales=torch.tensor([0.13, 0.13, 0.02]).log().repeat(count, 1),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), logits=torch.full((count,), 5.0),
        dc=dc_of_colours(torch.from_numpy(colours.astype(np.float32))), rest=torch.zeros(count, 0, 3),
    )  # fmt: skip


@pytest.mark.skipif(browser() is None, reason="no Chromium on this machine (apt-get install chromium)")
def test_a_browser_without_network_draws_what_we_draw(tmp_path):
    gaussians, background = two_floors(), (0.8, 0.75, 0.5)
    page = Page((-1.0, -8.0, 6.0), (0.0, 0.0, 0.0), background, "two floors")
    registry.write(tmp_path / "scene.html", replace(Scene.of(gaussians), page=page))
    pose = look_at(np.array(page.position), np.array(page.target))
    focal = 0.5 * 480 / np.tan(np.radians(25))
    camera = Camera(camera_from_world=pose, fx=focal, fy=focal, cx=320.0, cy=240.0, width=640, height=480)
    with torch.no_grad():
        expected = draw_gaussians(gaussians, camera, torch.tensor(background), 0)[0].image.clamp(0, 1).numpy()
    part = slice(60, 440), slice(320, 580)  # beside what the client says of software rendering
    with open_page((tmp_path / "scene.html").as_uri(), 640, 480, offline=True) as shown:

        def likeness() -> float:
            return psnr(shown.screenshot()[part] / 255.0, expected[part])

        wait_until(lambda: likeness() > 26)
        assert shown.evaluate("document.title") == "two floors"
        assert shown.evaluate("performance.getEntriesByType('resource').filter(e => /^http/.test(e.name)).length") == 0
