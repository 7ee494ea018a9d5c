"""The folder for a web server, in a real browser: it shows what we draw, coarse parts first and fine ones near by."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from support.commands import wait_until
from support.gaussians import overhead, picture, psnr, random_gaussians
from support.viewer import needs_browser, open_page, served
from vdgs.captures.first_view import FOV_DEG
from vdgs.export.formats.export_scene import ExportScene, InitialView
from vdgs.export.formats.streamed_page import write_streamed_page
from vdgs.geometry.camera import Camera

pytestmark = [pytest.mark.browser, needs_browser, pytest.mark.xdist_group("viewer")]
SIZE = 256


def upright(position: np.ndarray, focal: float) -> Camera:
    """Looks at the origin, z up."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return replace(overhead(size=SIZE), camera_from_world=matrix, fx=focal, fy=focal)


def test_the_page_shows_what_we_draw_and_loads_what_is_near(tmp_path):
    gaussians = random_gaussians(600, 0)
    focal = SIZE / 2 / np.tan(np.radians(FOV_DEG) / 2)
    camera = upright(np.array([2.0, -5.0, 6.0]), focal)
    view = InitialView(
        tuple(camera.position), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "town",
        count_visibility=lambda places: 1 + (places[:, 0] > 0).int() + (places[:, 0] > 0.8).int(),
    )  # fmt: skip
    write_streamed_page(tmp_path / "scene.json", replace(ExportScene.of(gaussians), page=view), node_size=100)
    expected, nodes = picture(gaussians, camera), len(list(tmp_path.glob("nodes-1/*.bin")))
    assert nodes > 5

    def state(page) -> str:
        return page.evaluate("document.body.dataset.state")

    def shown(page) -> np.ndarray:
        wait_until(lambda: state(page) in ("complete", "failed"))
        assert state(page) == "complete", page.evaluate("document.body.innerText")
        return page.screenshot() / 255

    with served(tmp_path) as address, open_page(address, SIZE, SIZE) as page:
        near = shown(page)
        assert page.evaluate("document.title") == "town"
        assert "parts" in page.evaluate("document.getElementById('caption').textContent")
        page.evaluate("document.getElementById('caption').remove()")
        trust = "document.getElementById('trust')"
        page.evaluate(f"{trust}.click()")
        wait_until(lambda: np.abs(page.screenshot() / 255 - near)[40:].max() > 0.3)
        assert "training cameras" in page.evaluate("document.body.innerText")
        more_red = (page.screenshot()[40:].astype(int) - (255 * near[40:]).astype(int))[..., 0].mean(axis=0)
        assert more_red[: SIZE // 3].mean() > more_red[-SIZE // 4 :].mean() + 5  # the west is seen by one camera
        page.evaluate(f"{trust}.click()")
        page.evaluate(f"{trust}.parentElement.remove()")
        wait_until(lambda: psnr(page.screenshot() / 255, expected) > 30)
        cv2.imwrite(str(tmp_path / "shown.png"), page.screenshot()[..., ::-1])
        assert psnr(page.screenshot() / 255, expected) > 30
        for other in (near[::-1], near[:, ::-1]):
            assert psnr(other, expected) < 25
        page.evaluate(
            "document.getElementById('canvas').dispatchEvent(new WheelEvent('wheel', {deltaY: -900, cancelable: true}))"
        )
        wait_until(lambda: psnr(page.screenshot() / 255, expected) < 25)  # one stands nearer
        assert state(page) in ("loading", "complete")
    # From so far that a pixel holds the whole, the root is enough.
    scene = json.loads((tmp_path / "scene.json").read_text())
    scene["view"]["position"] = [0.0, -3000.0, 3000.0]
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    with served(tmp_path) as address, open_page(address, SIZE, SIZE) as page:
        shown(page)
        assert f"1 of {nodes} parts" in page.evaluate("document.getElementById('caption').textContent")
    # What is missing is said.
    (tmp_path / scene["root"]["content"]["uri"]).unlink()
    with served(tmp_path) as address, open_page(address, SIZE, SIZE) as page:
        wait_until(lambda: state(page) == "failed")
        assert "are missing (404): copy it whole" in page.evaluate("document.body.innerText")


def test_a_server_that_is_away_for_a_while_is_asked_again_and_a_lost_graphics_card_is_said(tmp_path):
    camera = upright(np.array([2.0, -5.0, 6.0]), SIZE / 2 / np.tan(np.radians(FOV_DEG) / 2))
    view = InitialView(tuple(3000 * camera.position), (0.0, 0.0, 0.0), title="town")
    scene = replace(ExportScene.of(random_gaussians(600, 0)), page=view)
    write_streamed_page(tmp_path / "scene.json", scene, node_size=100)
    move = "canvas.dispatchEvent(new WheelEvent('wheel', {deltaY: -9000, cancelable: true}))"
    beside = "for (let i = 0; i < 100; i++) canvas.dispatchEvent(new KeyboardEvent('keydown', {{key: 'Arrow{}'}}))"

    def told(page) -> tuple[str, str]:
        state, caption = page.evaluate("[document.body.dataset.state, caption.textContent]")
        return state, caption

    with served(tmp_path) as address, open_page(address, SIZE, SIZE) as page:
        wait_until(lambda: told(page)[0] == "complete")
        # As a proxy answers while its server is away; and then as no server does.
        page.evaluate(
            "window.plain = fetch; window.asked = 0;"
            "window.fetch = async () => {"
            "  if (asked++ % 2) throw new TypeError();"
            "  return new Response('', {status: 502}); }"
        )
        page.evaluate(move)
        wait_until(lambda: "no connection; trying again" in told(page)[1])
        assert told(page)[0] == "loading"
        before = page.evaluate("asked")
        wait_until(lambda: page.evaluate("asked") > before)  # by itself
        # Beside the scene nothing is wanted: nothing is amiss.
        page.evaluate(beside.format("Up"))
        wait_until(lambda: told(page)[0] == "complete")
        assert "connection" not in told(page)[1]
        page.evaluate(beside.format("Down"))
        wait_until(lambda: "no connection; trying again" in told(page)[1])
        page.evaluate("window.fetch = plain")
        wait_until(lambda: told(page)[0] == "complete")
        assert "parts" in told(page)[1]
        # Only what passes is asked again: stores of objects say 403 of files that are not there.
        passing, lasting = [408, 425, 429, 500, 503], [400, 401, 403, 410]
        page.evaluate(
            "window.answers = [];"
            f"for (const status of {passing + lasting}) {{"
            "  window.fetch = async () => new Response('', {status});"
            "  get('a.bin', 'json').then(found => answers.push([status, found === null ? '' : 'found']),"
            "                            error => answers.push([status, error.message])); }"
        )
        wait_until(lambda: len(page.evaluate("answers")) == len(passing + lasting))
        answers = dict(page.evaluate("answers"))
        assert sorted(status for status, text in answers.items() if not text) == passing
        assert answers[403] == "a.bin: 403. Copy the folder whole, or let the server show it."
        page.evaluate("canvas.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()")
        wait_until(lambda: told(page)[0] == "failed")
        page.evaluate(move)
        page.screenshot()
        page.screenshot()
        assert told(page) == ("failed", "The graphics card was lost. Load the page again.")


def test_what_stands_alone_far_outside_keeps_nobody_from_coming_near(tmp_path):
    gaussians = random_gaussians(300, 0)
    gaussians.means[0] = torch.tensor([200_000.0, 0.0, 0.0])
    camera = upright(np.array([2.0, -5.0, 6.0]), SIZE / 2 / np.tan(np.radians(FOV_DEG) / 2))
    view = InitialView(tuple(camera.position), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    write_streamed_page(tmp_path / "scene.json", replace(ExportScene.of(gaussians), page=view), node_size=100)
    expected = picture(gaussians, camera)
    with served(tmp_path) as address, open_page(address, SIZE, SIZE) as page:
        wait_until(lambda: page.evaluate("document.body.dataset.state") == "complete")
        page.evaluate("document.getElementById('caption').remove()")
        wait_until(lambda: psnr(page.screenshot() / 255, expected) > 30)


def test_a_view_is_drawn_as_finely_as_there_is_room_whatever_was_looked_at_before(tmp_path):
    """Parts of a view take the place of those of earlier ones, not of each other."""
    gaussians = random_gaussians(3000, 0)
    spread = 1000 * torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - 500
    gaussians = replace(gaussians, means=spread * torch.tensor([1.0, 1.0, 0.01]))
    view = InitialView((-250.0, -251.0, 300.0), (-250.0, -250.0, 0.0))
    write_streamed_page(tmp_path / "scene.json", replace(ExportScene.of(gaussians), page=view), node_size=20)

    def parts(page) -> int:
        """How many are drawn of the 64 that there is room for, once all are loaded."""
        wait_until(lambda: page.evaluate("document.body.dataset.state") == "complete")
        found = re.search(r"(\d+) of", page.evaluate("document.getElementById('caption').textContent"))
        return int(found[1]) if found else 0

    def pan(page, key: str) -> int:
        """Look at the next quarter of the scene, or beyond it."""
        page.evaluate(
            "document.body.dataset.state = ''; for (let i = 0; i < 10; i++) document.getElementById('canvas')"
            f".dispatchEvent(new KeyboardEvent('keydown', {{key: 'Arrow{key}'}}))"
        )
        return parts(page)

    with served(tmp_path) as address, open_page(address, SIZE, SIZE) as page:
        first = parts(page)
        around = [pan(page, key) for key in ("Right", "Up", "Left", "Down")]
        assert min(first, *around) > 20
        assert around[-1] == first
        assert [pan(page, key) for key in ("Down", "Up")] == [0, first]


def test_a_page_that_was_opened_as_a_file_says_how_to_serve_it(tmp_path):
    write_streamed_page(tmp_path / "scene.json", ExportScene.of(random_gaussians(20, 0)))
    with open_page((tmp_path / "index.html").as_uri(), SIZE, SIZE) as page:
        wait_until(lambda: page.evaluate("document.body.dataset.state") == "failed")
        assert "http.server" in page.evaluate("document.body.innerText")
