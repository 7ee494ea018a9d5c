"""Files of ours in the programs that people open them with, in a real browser, beside the picture that we draw.

The programs come from npm: fetched by whoever wants these tests, into a folder that VDGS_NODE names (.ci/run does).
Nothing is downloaded here. Each is given a file that was written for it (`vdgs export --for`), and asked to stand where
our camera stands, in coordinates in which the scene is upright.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.commands import wait_until
from support.gaussians import overhead, picture, psnr, random_gaussians
from support.viewer import needs_browser, open_page, served
from vdgs.export.formats import registry
from vdgs.export.formats.axes import Y_UP, Axes
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene
from vdgs.export.programs import PROGRAMS
from vdgs.geometry.camera import Camera
from vdgs.geometry.geodesy import enu_axes

pytestmark = [pytest.mark.browser, needs_browser, pytest.mark.xdist_group("viewer")]

MODULES = Path(os.environ.get("VDGS_NODE") or "none") / "node_modules"
SIZE = 128
STYLE = """<!doctype html><style>html, body { margin: 0; background: black; overflow: hidden }</style><script>
window.addEventListener("error", event => { document.title = "failed: " + event.message; });
window.addEventListener("unhandledrejection", event => { document.title = "failed: " + event.reason; });
</script>"""
#: What a viewer for three.js needs before it is told of a scene.
THREE = """
import * as THREE from "three";
const camera = new THREE.PerspectiveCamera(view.fov, 1, 0.1, 1000);
camera.position.fromArray(view.position);
camera.up.fromArray(view.up);
camera.lookAt(new THREE.Vector3().fromArray(view.target));
camera.updateMatrixWorld();  // GaussianSplats3D sorts by it before three.js first draws
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(1);
renderer.setSize(view.size, view.size);
renderer.setClearColor(0x000000, 1);
document.body.appendChild(renderer.domElement);
"""
SPLATS_3D = (
    THREE
    + """
import * as Splats from "./node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js";
const viewer = new Splats.Viewer({
  renderer, camera, useBuiltInControls: false, sharedMemoryForWorkers: false, gpuAcceleratedSort: false,
  ignoreDevicePixelRatio: true, sphericalHarmonicsDegree: 2, sceneRevealMode: Splats.SceneRevealMode.Instant,
});
viewer.addSplatScene(view.file, { showLoadingUI: false, progressiveLoad: false, splatAlphaRemovalThreshold: 0 })
  .then(() => { viewer.start(); document.title = "loaded"; }, error => { document.title = "failed: " + error; });
"""
)
SPARK = (
    THREE
    + """
import { SparkRenderer, SplatMesh } from "./node_modules/@sparkjsdev/spark/dist/spark.module.js";
const scene = new THREE.Scene();
scene.add(new SparkRenderer({ renderer }));
const mesh = new SplatMesh({ url: view.file });
scene.add(mesh);
mesh.initialized.then(() => { document.title = "loaded"; }, error => { document.title = "failed: " + error; });
renderer.setAnimationLoop(() => renderer.render(scene, camera));
"""
)
#: SuperSplat's engine. A file of Gaussians is turned by half a turn about z, as SuperSplat does when it opens one.
PLAYCANVAS = """
import * as pc from "./node_modules/playcanvas/build/playcanvas.mjs";
const canvas = document.createElement("canvas");
canvas.width = canvas.height = view.size;
document.body.appendChild(canvas);
const device = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
const options = new pc.AppOptions();
options.graphicsDevice = device;
options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler, pc.BinaryHandler, pc.JsonHandler];
const app = new pc.AppBase(canvas);
app.init(options);
app.setCanvasResolution(pc.RESOLUTION_FIXED, view.size, view.size);
app.start();
const camera = new pc.Entity();
camera.addComponent("camera", {
  clearColor: new pc.Color(0, 0, 0), fov: view.fov, nearClip: 0.1, farClip: 1000, toneMapping: pc.TONEMAP_LINEAR,
});
camera.setPosition(...view.position);
camera.lookAt(new pc.Vec3(...view.target), new pc.Vec3(...view.up));
app.root.addChild(camera);
const asset = new pc.Asset("scene", "gsplat", { url: view.file, filename: view.file });
app.assets.add(asset);
asset.on("error", error => { document.title = "failed: " + error; });
asset.ready(() => {
  const entity = new pc.Entity();
  entity.addComponent("gsplat", { asset });
  entity.setLocalEulerAngles(0, 0, 180);
  app.root.addChild(entity);
  document.title = "loaded";
});
app.assets.load(asset);
"""
CESIUM = """
const v = new Cesium.Viewer("scene", {
  baseLayer: false, baseLayerPicker: false, geocoder: false, homeButton: false, sceneModePicker: false,
  navigationHelpButton: false, animation: false, timeline: false, fullscreenButton: false, infoBox: false,
  selectionIndicator: false, skyBox: false, skyAtmosphere: false,
  contextOptions: { webgl: { preserveDrawingBuffer: true } },
});
v.scene.renderError.addEventListener((_, error) => { document.title = "failed: " + error; });
v.scene.globe.show = false;
v.scene.backgroundColor = Cesium.Color.BLACK;
for (const light of [v.scene.sun, v.scene.moon]) if (light) light.show = false;
v.scene.postProcessStages.fxaa.enabled = false;
v.scene.highDynamicRange = false;
try {
  const tiles = await Cesium.Cesium3DTileset.fromUrl(view.file, { maximumScreenSpaceError: 1 });
  v.scene.primitives.add(tiles);
  tiles.tileFailed.addEventListener(event => { document.title = "failed: " + event.message; });
  const frame = tiles.root.transform, three = each => new Cesium.Cartesian3(...each);
  const place = each => Cesium.Matrix4.multiplyByPoint(frame, three(each), new Cesium.Cartesian3());
  const direction = each => Cesium.Cartesian3.normalize(
    Cesium.Matrix4.multiplyByPointAsVector(frame, three(each), new Cesium.Cartesian3()), new Cesium.Cartesian3());
  v.camera.frustum.fov = view.fov * Math.PI / 180;
  v.camera.frustum.near = 0.1;
  v.camera.setView({
    destination: place(view.position),
    orientation: { direction: direction(view.target.map((x, i) => x - view.position[i])), up: direction(view.up) },
  });
  document.title = "loaded";
} catch (error) { document.title = "failed: " + error; }
"""
CESIUM_HEAD = """<style>.cesium-viewer-bottom, .cesium-viewer-toolbar { display: none !important }
#scene, .cesium-viewer, .cesium-widget, .cesium-widget canvas { width: 128px; height: 128px }</style>
<script>window.CESIUM_BASE_URL = "/node_modules/cesium/Build/Cesium/"</script>
<script src="/node_modules/cesium/Build/Cesium/Cesium.js"></script><div id="scene"></div>"""
#: By a program of `--for`: its package and file on npm, and what shows a scene in it.
VIEWERS = {
    "gaussiansplats3d": (
        "@mkkellogg/gaussian-splats-3d three",
        "@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js",
        SPLATS_3D,
    ),
    "spark": ("@sparkjsdev/spark three", "@sparkjsdev/spark/dist/spark.module.js", SPARK),
    "playcanvas": ("playcanvas", "playcanvas/build/playcanvas.mjs", PLAYCANVAS),
    "cesium": ("cesium", "cesium/Build/Cesium/Cesium.js", CESIUM),
}
#: How near each picture comes to ours, at least, dB.
FILES = [
    ("gaussiansplats3d", "z-up.ply", 36), ("gaussiansplats3d", "scene.ply", 36),
    ("gaussiansplats3d", "scene.splat", 36),
    ("spark", "scene.ply", 30), ("spark", "scene.spz", 30), ("spark", "scene.compressed.ply", 27),
    ("spark", "scene.sog", 27), ("spark", "scene.rad", 27), ("spark", "scene.splat", 30),
    ("playcanvas", "scene.ply", 30), ("playcanvas", "scene.compressed.ply", 27), ("playcanvas", "scene.sog", 27),
    ("playcanvas", "lod-meta.json", 27),
    ("cesium", "tileset.json", 30),
]  # fmt: skip


def page_of(program: str, file: str, camera: Camera, axes: Axes | None) -> str:
    """A page that shows a file from where the camera stands, in coordinates turned like the upright scene."""
    turn = np.eye(3) if axes is None else axes.turn
    view = {
        "position": (turn @ camera.position).tolist(), "target": (turn @ (camera.position + camera.forward)).tolist(),
        "up": (turn @ -camera.camera_from_world[1, :3]).tolist(), "size": SIZE, "file": file,
        "fov": math.degrees(2 * math.atan(SIZE / 2 / camera.fy)),
    }  # fmt: skip
    three = {
        "three": "./node_modules/three/build/three.module.js",
        "three/addons/": "./node_modules/three/examples/jsm/",
    }
    names = f'<script type="importmap">{json.dumps({"imports": three})}</script>'
    head = CESIUM_HEAD if program == "cesium" else names
    script = f"const view = {json.dumps(view)};\n{VIEWERS[program][2]}"
    # Imports stand before all else.
    lines = script.splitlines()
    lines.sort(key=lambda line: not line.startswith("import "))
    return f'{STYLE}{head}<script type="module">\n' + "\n".join(lines) + "\n</script>"


@pytest.mark.parametrize(("program", "name", "near"), FILES, ids=lambda value: str(value))
def test_a_published_program_shows_what_we_draw(tmp_path, program: str, name: str, near: float):
    packages, needed, _ = VIEWERS[program]
    if not (MODULES / needed).is_file():
        pytest.skip(f"VDGS_NODE names no folder with it: npm install --prefix FOLDER {packages}")
    gaussians, camera = random_gaussians(300, 0 if name.endswith(".splat") else 2), overhead(size=SIZE)
    ending = registry.format_from_path(Path(name)).suffix
    facts = ExportMetadata(geodetic=(48.13, 11.57, 512.0)) if ending == "tileset.json" else ExportMetadata()
    scene = ExportScene.of(gaussians, facts)
    file = tmp_path / name
    as_it_is = name == "z-up.ply"
    registry.write_scene(file, replace(scene, axes=None if as_it_is else PROGRAMS[program].axes[ending]))
    (tmp_path / "node_modules").symlink_to(MODULES.resolve())
    # Tiles stand in local coordinates, z up; all others show the scene with y up.
    upright = None if as_it_is or program == "cesium" else Y_UP
    (tmp_path / "index.html").write_text(page_of(program, name, camera, upright))
    expected = picture(gaussians, camera)
    with served(tmp_path) as address, open_page(address, SIZE, SIZE) as page:
        wait_until(lambda: page.evaluate("document.title").startswith(("loaded", "failed")))
        assert page.evaluate("document.title") == "loaded"
        shown = [np.zeros((SIZE, SIZE, 3), np.uint8)]

        def alike() -> bool:
            shown[0] = page.screenshot()
            assert not page.evaluate("document.title").startswith("failed"), page.evaluate("document.title")
            return psnr(shown[0] / 255, expected) > near

        try:
            wait_until(alike)
        finally:
            cv2.imwrite(str(tmp_path / "shown.png"), shown[0][..., ::-1])
            cv2.imwrite(str(tmp_path / "expected.png"), np.rint(255 * expected).astype(np.uint8)[..., ::-1])
    # So the comparison can fail: it sees that one picture is turned over, or mirrored.
    for other in (shown[0][::-1], shown[0][:, ::-1]):
        assert psnr(other / 255, expected) < 25


def test_tiles_stand_on_the_globe_as_the_page_for_them_says(tmp_path):
    """The root of a tileset takes east, north and up to Earth-centered axes."""
    registry.write_scene(
        tmp_path / "tileset.json",
        ExportScene.of(random_gaussians(50, 0), ExportMetadata(geodetic=(48.13, 11.57, 512.0))),
    )
    transform = json.loads((tmp_path / "tileset.json").read_text())["root"]["transform"]
    np.testing.assert_allclose(np.array(transform).reshape(4, 4).T[:3, :3], enu_axes(48.13, 11.57).T)
