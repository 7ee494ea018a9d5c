"""A PLY of ours in a published viewer for the web, in a real browser, beside the picture that we draw of it.

The viewer is `@mkkellogg/gaussian-splats-3d` (MIT) with `three`, from npm: fetched by whoever wants this test, into a
folder that VDGS_NODE names (.ci/run does). Nothing is downloaded here.
"""

from __future__ import annotations

import json
import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.commands import wait_until
from support.gaussians import overhead, picture, psnr, random_gaussians
from support.viewer import needs_browser, open_page
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportScene

pytestmark = [pytest.mark.browser, needs_browser]

MODULES = Path(os.environ.get("VDGS_NODE") or "none") / "node_modules"
NEEDED = ("@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js", "three/build/three.module.js")
SIZE = 256

PAGE = """<!doctype html><style>html, body {{ margin: 0; background: black; overflow: hidden }}</style>
<script type="importmap">{{"imports": {{"three": "./node_modules/three/build/three.module.js"}}}}</script>
<script type="module">
import * as THREE from "three";
import * as Splats from "./node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js";
const view = {view};
const camera = new THREE.PerspectiveCamera(view.fov, 1, 0.1, 1000);
camera.position.fromArray(view.position);
camera.up.fromArray(view.up);
camera.lookAt(new THREE.Vector3().fromArray(view.target));
const renderer = new THREE.WebGLRenderer({{ antialias: false, preserveDrawingBuffer: true }});
renderer.setPixelRatio(1);
renderer.setSize({size}, {size});
renderer.setClearColor(0x000000, 1);
document.body.appendChild(renderer.domElement);
const viewer = new Splats.Viewer({{
  renderer, camera, useBuiltInControls: false, sharedMemoryForWorkers: false, gpuAcceleratedSort: false,
  ignoreDevicePixelRatio: true, sphericalHarmonicsDegree: 2, sceneRevealMode: Splats.SceneRevealMode.Instant,
}});
viewer.addSplatScene("scene.ply", {{ showLoadingUI: false, progressiveLoad: false, splatAlphaRemovalThreshold: 0 }})
  .then(() => {{ viewer.start(); document.title = "loaded"; }}, error => {{ document.title = "failed: " + error; }});
</script>"""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder's files."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.mark.skipif(
    not all((MODULES / file).is_file() for file in NEEDED),
    reason="VDGS_NODE names no folder with a viewer: npm install --prefix FOLDER @mkkellogg/gaussian-splats-3d three",
)
def test_a_published_viewer_shows_what_we_draw(tmp_path):
    gaussians, camera = random_gaussians(300, 2), overhead(size=SIZE)
    registry.write_scene(tmp_path / "scene.ply", ExportScene.of(gaussians))
    (tmp_path / "node_modules").symlink_to(MODULES.resolve())
    view = {
        "position": camera.position.tolist(), "target": (camera.position + camera.forward).tolist(),
        "up": (-camera.camera_from_world[1, :3]).tolist(), "fov": math.degrees(2 * math.atan(SIZE / 2 / camera.fy)),
    }  # fmt: skip
    (tmp_path / "index.html").write_text(PAGE.format(view=json.dumps(view), size=SIZE))
    expected = picture(gaussians, camera)
    with served(tmp_path) as address, open_page(address, SIZE, SIZE) as page:
        wait_until(lambda: page.evaluate("document.title").startswith(("loaded", "failed")))
        assert page.evaluate("document.title") == "loaded"
        shown = [np.zeros((SIZE, SIZE, 3), np.uint8)]

        def alike() -> bool:
            shown[0] = page.screenshot()
            return psnr(shown[0] / 255, expected) > 33

        try:
            wait_until(alike)
        finally:
            cv2.imwrite(str(tmp_path / "shown.png"), shown[0][..., ::-1])
            cv2.imwrite(str(tmp_path / "expected.png"), np.rint(255 * expected).astype(np.uint8)[..., ::-1])
    assert psnr(shown[0] / 255, expected) > 33
    # So the comparison can fail: it sees that one picture is turned over.
    assert psnr(shown[0][::-1] / 255, expected) < 25
