"""Visitors of a viewer without a browser: they speak its protocol. And a real browser, where there is one."""

from __future__ import annotations

import base64
import contextlib
import json
import math
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import viser
import zstandard
from scipy.spatial.transform import Rotation
from websockets.sync.client import ClientConnection, connect

from support.captures import tiny_scene, write_colmap
from support.commands import PATIENCE_SECONDS, vdgs
from vdgs.evaluation.metrics import to_8bit
from vdgs.geometry.camera import Camera
from vdgs.model.renderer import render
from vdgs.runs.visibility_store import with_fade
from vdgs.viewer.server import ViewerServer
from vdgs.visibility.visibility_counts import FADE_BELOW

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
#: A busy machine may need long; nothing waits so long where all is well.
PATIENCE = PATIENCE_SECONDS
#: Viser's threads end after its sockets.
quiet = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning", "ignore::ResourceWarning")


def trained(folder: Path) -> Path:
    """A run of a textured plane whose coarse stage is done."""
    write_colmap(folder / "capture", tiny_scene())
    done = vdgs(
        "train-coarse", folder / "capture", "--output", folder / "run", "--preset", "laptop", "--iterations", "60",
        "--save-every", "20", "--up", "z",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "run"


def expected(viewer: ViewerServer, camera: Camera) -> np.ndarray:
    run = viewer.scene.run
    cameras = [view.camera for view in run.capture.train_views]
    shown = with_fade(run.model, cameras, FADE_BELOW)
    return to_8bit(render(shown, camera).image.numpy())


class Guest:
    """A visitor that sends cameras and receives messages."""

    def __init__(self, address: str, headers: dict[str, str] | None = None) -> None:
        self.socket: ClientConnection = connect(
            address.replace("http", "ws", 1), subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            additional_headers=headers, max_size=None, compression=None,
        )  # fmt: skip
        self.kept: list[dict[str, Any]] = []

    def send(self, kind: str, **fields: Any) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def stand(self, camera: Camera) -> None:
        """Tell where this visitor stands."""
        rotation = camera.camera_from_world[:3, :3].T
        self.send(
            "ViewerCameraMessage", wxyz=np.roll(Rotation.from_matrix(rotation).as_quat(), 1).tolist(),
            position=camera.position.tolist(), fov=2 * math.atan(0.5 * camera.height / camera.fy), near=0.01, far=1e4,
            image_height=camera.height, image_width=camera.width,
            look_at=(camera.position + camera.forward).tolist(), up_direction=[0.0, 0.0, 1.0],
        )  # fmt: skip

    def click(self, x: float, y: float) -> None:
        """Click at a share of width and height."""
        self.send(
            "ScenePointerMessage", event_type="click", ray_origin=[0.0, 0.0, 0.0], ray_direction=[0.0, 0.0, 1.0],
            screen_pos=[[float(x), float(y)]], modifier=None,
        )  # fmt: skip

    def messages(self, patience: float = PATIENCE) -> Iterator[dict[str, Any]]:
        """What comes, until nothing has for so long. All is `kept`, without pictures."""
        while True:
            try:
                raw = self.socket.recv(timeout=patience)
            except TimeoutError:
                return
            assert isinstance(raw, bytes)
            packed = int.from_bytes(raw[8:16], "little")
            content = msgspec.msgpack.decode(
                zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed], int.from_bytes(raw[:8], "little"))
            )
            for message in content["messages"]:
                if message["type"] != "BackgroundImageMessage":
                    self.kept.append(message)
                yield message

    def pictures(self, patience: float = PATIENCE) -> Iterator[np.ndarray]:
        """The pictures that come, RGB."""
        for message in self.messages(patience):
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                data = np.frombuffer(message["rgb_data"], np.uint8)
                yield cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]

    def full_picture(self, camera: Camera) -> np.ndarray:
        """The next picture of the size of a camera."""
        for picture in self.pictures():
            if picture.shape[:2] == (camera.height, camera.width):
                return picture
        raise AssertionError("no full picture came")

    def assert_sees(self, expected: np.ndarray) -> None:
        """Look until a picture comes that is the expected one but for what JPEG loses."""
        for picture in self.pictures():
            if picture.shape == expected.shape and np.abs(picture.astype(int) - expected).mean() < 3:
                return
        raise AssertionError("the expected picture did not come")

    def control(self, label: str) -> str:
        """What tells a control of the panel, by its label."""
        found = [m["uuid"] for m in self.kept if m["type"].startswith("Gui") and _label(m) == label]
        assert found, f"the panel has no {label}"
        return str(found[-1])

    def choose(self, label: str, value: Any) -> None:
        """Change a control of the panel."""
        self.send("GuiUpdateMessage", uuid=self.control(label), updates={"value": value})

    def text(self) -> str:
        """All words that the panel has shown."""
        parts = []
        for message in self.kept:
            parts.append(str(message.get("props", {}).get("_markdown", "")))
            parts.append(str(message.get("updates", {}).get("_markdown", "")))
        return "\n".join(part for part in parts if part)

    def close(self) -> None:
        self.socket.close()

    def vanish(self) -> None:
        """Go without a word, as a machine that is switched off."""
        self.socket.socket.close()


def _label(message: dict[str, Any]) -> str:
    return str(message.get("props", {}).get("label", ""))


def browser() -> str | None:
    """A browser that can be driven, if this machine has one."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


class Page:
    """A page of a headless browser, by its DevTools protocol."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._number = socket, 0

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def evaluate(self, expression: str) -> Any:
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_until_loaded(self, address: str) -> None:
        """Between one page and the next there is none that could be drawn."""
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            with contextlib.suppress(AssertionError, TypeError):
                there, state = self.evaluate("[location.href, document.readyState]")
                if state == "complete" and there.split("?")[0] == address.split("?")[0]:
                    return
            time.sleep(0.05)
        raise AssertionError(f"the browser does not open {address}")

    def screenshot(self) -> np.ndarray:
        """What the page shows, RGB."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.ascontiguousarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])

    def click(self, x: float, y: float) -> None:
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, words: str) -> bool:
        """Press the button with these words; False while there is none."""
        found = f"[...document.querySelectorAll('button')].find(each => each.textContent === {json.dumps(words)})"
        return bool(self.evaluate(f"(() => {{const it = {found}; it?.click(); return it !== undefined;}})()"))

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 8) -> None:
        mouse = {"button": "left", "buttons": 1, "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], **mouse)
        for x, y in np.linspace(start, end, steps):
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=float(x), y=float(y), **mouse)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], **mouse)


class Browser:
    """The machine's browser, without a window, drawn in software."""

    def __init__(self) -> None:
        command = browser()
        assert command is not None
        #: Windows that no test uses.
        self._free = list[str]()
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [
                command, "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
                "--disable-dev-shm-usage", "--disable-gpu-rasterization", "--no-first-run", "--disable-extensions",
                "--remote-debugging-port=0", f"--user-data-dir={self._profile.name}", "about:blank",
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            self._address = _address_of(Path(self._profile.name) / "DevToolsActivePort", self._process)
        except BaseException:
            self.close()
            raise

    @contextlib.contextmanager
    def window(self) -> Iterator[Page]:
        """An empty page that knows nothing of what other pages kept. Windows serve again: each takes a second of
        processor time to open."""
        pages = self._address.partition("/devtools/")[0] + "/devtools/page/"
        target = self._free.pop() if self._free else self._open_window()
        with connect(pages + target, max_size=None) as own:
            page = Page(own)
            yield page
            page.call("Page.navigate", url="about:blank")
            page.call("Storage.clearDataForOrigin", origin="*", storageTypes="all")
            page.call("Network.clearBrowserCache")
        self._free.append(target)

    def _open_window(self) -> str:
        with connect(self._address, max_size=None) as socket:
            return str(Page(socket).call("Target.createTarget", url="about:blank", newWindow=True)["targetId"])

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._profile.cleanup()


#: Started by the first page, for all pages: its start takes longer than most pages. tests/browser/conftest.py ends it.
_browsers = list[Browser]()


def close_browser() -> None:
    while _browsers:
        _browsers.pop().close()


@contextlib.contextmanager
def open_page(
    address: str, width: int = 1000, height: int = 700, offline: bool = False, downloads: Path | None = None,
    scale: float = 1.0,
) -> Iterator[Page]:  # fmt: skip
    """A page of the machine's browser; `offline`: without any network; `downloads`: the folder where files are stored
    that the page gives; `scale`: pixels of the screen for one of the page, the fewer the quicker it is drawn."""
    if not _browsers:
        _browsers.append(Browser())
    with _browsers[0].window() as page:
        size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        page.call("Emulation.setDeviceMetricsOverride", **size)
        if downloads is not None:
            page.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(downloads))
        if offline:
            page.call("Network.enable")
            speed = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
            page.call("Network.emulateNetworkConditions", offline=True, **speed)
        page.call("Page.navigate", url=address)
        page.wait_until_loaded(address)
        yield page


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder's files."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    Quiet.extensions_map = {**Quiet.extensions_map, ".mjs": "text/javascript", ".wasm": "application/wasm"}
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _address_of(file: Path, process: subprocess.Popen[bytes]) -> str:
    """Where the browser listens, once it says so."""
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        assert process.poll() is None, "the browser does not start"
        with contextlib.suppress(OSError, ValueError):
            port, path = file.read_text().split()
            return f"ws://127.0.0.1:{port}{path}"
        time.sleep(0.05)
    raise AssertionError("the browser does not listen")


needs_browser = pytest.mark.skipif(browser() is None, reason="no Chromium on this machine (apt-get install chromium)")
