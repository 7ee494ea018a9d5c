"""`vdgs view` in a real browser."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("viser", reason="viser is not installed (pip install 'vdgs[viewer]')")


from support.commands import vdgs, wait_until
from support.viewer import Page, expected, needs_browser, open_page, quiet, trained
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.geometry.camera import Camera
from vdgs.runs.open_run import open_run
from vdgs.viewer import navigation
from vdgs.viewer.client_session import LAYER_LABELS, ClientSession
from vdgs.viewer.measurement import SCALE_BAR_FILE
from vdgs.viewer.server import ViewerServer, serve

pytestmark = [pytest.mark.browser, needs_browser, pytest.mark.xdist_group("viewer")]


#: Width and height of the browser's window, and pixels of the screen for one of it.
WINDOW, SCALE = (1000, 700), 0.25


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of a textured plane whose coarse stage is done."""
    return trained(tmp_path_factory.mktemp("view"))


@pytest.fixture(scope="module")
def viewer(run):
    with serve(open_run(run), "127.0.0.1", None, Console(file=sys.stderr)) as opened:
        yield opened


def in_window(visitor: ClientSession) -> Camera | None:
    """Where a visitor stands, with the pixels of the whole window: a browser that is short of time asks for fewer,
    and shows them as large. None until it has laid out its window."""
    camera = visitor.camera
    if camera is None or camera.width / camera.height != pytest.approx(WINDOW[0] / WINDOW[1], rel=0.01):
        return None
    return camera.resized(WINDOW[0] // 2, WINDOW[1] // 2)


def beside_the_panel(picture: np.ndarray) -> np.ndarray:
    """That part of a picture of the window, at an eighth of its size, where fewer pixels look the same."""
    small = cv2.resize(picture, (WINDOW[0] // 8, WINDOW[1] // 8), interpolation=cv2.INTER_AREA)
    return small[31:81, 5:75].astype(int)


@dataclass(frozen=True)
class Visit:
    """A page of the viewer, who looks at it, and the folder of what the page gives."""

    viewer: ViewerServer
    page: Page
    visitor: ClientSession
    downloads: Path

    def differs(self) -> float:
        """From what the model shows from there."""
        seen, meant = self.page.screenshot(), expected(self.viewer, in_window(self.visitor))
        return float(np.abs(beside_the_panel(seen) - beside_the_panel(meant)).mean())

    def look_at_all(self) -> None:
        pose = navigation.overview_pose(self.viewer.scene.capture)
        overview = (pose.look_at - pose.position) / pose.distance
        wait_until(lambda: self.page.press("All"))
        wait_until(lambda: self.visitor.camera.forward == pytest.approx(overview, abs=0.02))


@pytest.fixture(scope="module")
def visit(viewer, tmp_path_factory) -> Iterator[Visit]:
    """A page that shows the scene: until then it takes no clicks."""
    downloads = tmp_path_factory.mktemp("downloads")
    with open_page(viewer.access.local_url(), *WINDOW, downloads=downloads, scale=SCALE) as page:
        wait_until(lambda: viewer.sessions)
        (visitor,) = viewer.sessions.values()
        wait_until(lambda: in_window(visitor))
        opened = Visit(viewer, page, visitor, downloads)
        wait_until(lambda: opened.differs() < 6)
        yield opened


@quiet
def test_a_browser_shows_the_scene(visit):
    page, visitor = visit.page, visit.visitor
    camera = in_window(visitor)
    assert camera is not None
    page.click(340.0, 440.0)
    wait_until(lambda: "ground frame" in visitor.point_panel._label.content)
    place = visitor.point_panel._point
    assert place is not None
    where = camera.resized(*WINDOW).project(place.position[None])[0][0]
    assert where == pytest.approx((340.0, 440.0), abs=1.0)
    page.drag((340.0, 440.0), (430.0, 400.0))
    wait_until(lambda: not np.allclose(visitor.camera.position, camera.position))
    wait_until(lambda: visit.differs() < 8)  # the mark of the place is in it now


@quiet
def test_a_browser_shows_every_layer_and_goes_where_buttons_lead(visit):
    page, visitor = visit.page, visit.visitor

    def painted() -> np.ndarray:
        """What the visitor should see now."""
        camera = in_window(visitor)
        return beside_the_panel(visitor.submit(lambda: visitor.painter.paint(visitor.display, camera, camera)))

    def seen() -> np.ndarray:
        return beside_the_panel(page.screenshot())

    shown = {}
    for name in LAYER_LABELS:
        visitor._layer_choice.value = name
        wait_until(lambda name=name: visitor.display.layer == LAYER_LABELS[name])
        wait_until(lambda: np.abs(seen() - painted()).mean() < 6)
        shown[name] = seen()
    for one, other in combinations(shown, 2):
        assert np.abs(shown[one] - shown[other]).mean() > 3, (one, other)
    visitor._layer_choice.value = "Color"
    wait_until(lambda: page.press("From above"))
    wait_until(lambda: visitor.camera.forward == pytest.approx((0, 0, -1), abs=0.02))
    assert -visitor.camera.camera_from_world[1, 1] > 0.7
    wait_until(lambda: np.abs(seen() - painted()).mean() < 6)
    visit.look_at_all()
    assert -visitor.camera.camera_from_world[1, 2] > 0
    wait_until(lambda: np.abs(seen() - painted()).mean() < 6)


@quiet
def test_a_distance_measured_in_a_browser_gives_the_capture_its_metres(visit, run, tmp_path):
    page, viewer, visitor = visit.page, visit.viewer, visit.visitor
    visit.look_at_all()
    panel = visitor.point_panel.measure_panel
    panel._switch.value, panel._meters.value = True, 25.0
    for count, place in enumerate(((300.0, 380.0), (420.0, 460.0)), 1):
        page.click(*place)
        wait_until(lambda count=count: len(panel.ruler.clicked) == count)
    wait_until(lambda: "units** ±" in panel._measured.content)
    wait_until(lambda: page.press("Save known distance"))
    file = visit.downloads / SCALE_BAR_FILE
    wait_until(file.is_file)  # the browser has stored it: until then it has another name
    wait_until(lambda: f"--scale-bar {SCALE_BAR_FILE}" in panel._command.content)
    before = viewer.scene.capture.ground
    ground = load_capture(viewer.scene.capture.root, CaptureOptions(up="z", scale_bar=file)).ground
    ends = ground.to_ground(before.apply_inverse(panel.ruler.points()))
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(25.0, rel=1e-3)
    assert ground.metric
    assert not list(run.rglob(SCALE_BAR_FILE))  # nothing is written where the server is
    inspected = vdgs(
        "inspect", viewer.scene.capture.root, "--up", "z", "--scale-bar", file, "--output", tmp_path / "looks"
    )
    assert inspected.returncode == 0, inspected.stderr
    assert SCALE_BAR_FILE in inspected.stdout
    assert json.loads((tmp_path / "looks/report.json").read_text())["metric"] is True
