"""What a real browser draws from a page that shows a scene offline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="viser is not installed (pip install 'vdgs[viewer]')")

from support.commands import wait_until
from support.gaussians import psnr
from support.viewer import needs_browser, open_page
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportScene, InitialView
from vdgs.geometry.camera import Camera
from vdgs.kernels.spherical_harmonics import rgb_to_sh
from vdgs.model.gaussians import Gaussians, render_gaussians
from vdgs.rendering.camera_paths import look_at_pose

pytestmark = [pytest.mark.browser, needs_browser, pytest.mark.xdist_group("viewer")]


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
    colors = np.concatenate([np.full(above.shape, [0.9, 0.1, 0.1]), paint, np.full(post.shape, 0.95)])
    count = len(means)
    return Gaussians(
        means=torch.from_numpy(means), log_scales=torch.tensor([0.13, 0.13, 0.02]).log().repeat(count, 1),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), opacity_logits=torch.full((count,), 5.0),
        sh0=rgb_to_sh(torch.from_numpy(colors.astype(np.float32))), shN=torch.zeros(count, 0, 3),
    )  # fmt: skip


@pytest.mark.parametrize(("width", "height"), [(640, 480), (320, 640)])
def test_a_browser_without_network_draws_what_we_draw(tmp_path, width, height):
    """On a telephone from as much farther as its window is narrow."""
    gaussians, background = two_floors(), (0.8, 0.75, 0.5)
    page = InitialView(
        (-1.0, -8.0, 6.0), (0.0, 0.0, 0.0), background, "two floors",
        count_visibility=lambda places: 3 - (places[:, 0] > 2).int(),
    )  # fmt: skip
    registry.write_scene(tmp_path / "scene.html", replace(ExportScene.of(gaussians), page=page))
    target, farther = np.array(page.target), max(1.0, height / width)
    pose = look_at_pose(target + farther * (np.array(page.position) - target), target)
    focal = 0.5 * height / np.tan(np.radians(25))
    camera = Camera(camera_from_world=pose, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)
    with torch.no_grad():
        expected = render_gaussians(gaussians, camera, torch.tensor(background), 0)[0].image.clamp(0, 1).numpy()
    # Beside what the client says of software rendering, and below the box.
    part = slice(90, 430) if width > height else slice(200, 440), slice(width // 2, width - 60)
    with open_page((tmp_path / "scene.html").as_uri(), width, height, offline=True) as shown:

        def likeness() -> float:
            return psnr(shown.screenshot()[part] / 255.0, expected[part])

        wait_until(lambda: likeness() > 26)
        assert shown.evaluate("document.title") == "two floors"
        shown.evaluate("document.getElementById('trust').click()")
        marked = replace(gaussians, sh0=gaussians.sh0.clone())
        east, yellow = gaussians.means[:, 0] > 2, rgb_to_sh(torch.tensor([[1.0, 0.72, 0.0]]))
        marked.sh0[east] = 0.4 * marked.sh0[east] + 0.6 * yellow
        with torch.no_grad():
            expected = render_gaussians(marked, camera, torch.tensor(background), 0)[0].image.clamp(0, 1).numpy()
        wait_until(lambda: likeness() > 26)
        assert shown.evaluate("performance.getEntriesByType('resource').filter(e => /^http/.test(e.name)).length") == 0
