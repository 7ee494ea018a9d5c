"""The server of `vdgs view`: who may come in, what they get, what happens when they vanish."""

from __future__ import annotations

import gc
import io
import json
import math
import os
import shutil
import socket
import sys
import warnings
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("viser", reason="viser is not installed (pip install 'vdgs[viewer]')")

import viser

from support.commands import PATIENCE_SECONDS, begun, vdgs, wait_until
from support.next_commands import parse
from support.small_pipeline import vdgs as here
from support.viewer import Guest, expected, quiet, trained
from vdgs.config.commands import ViewRequest
from vdgs.errors import RunError, VdgsError
from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import look_at_pose
from vdgs.rendering.path_io import load_path
from vdgs.runs.open_run import open_run
from vdgs.runs.run_folder import RunFolder
from vdgs.system.stop_signals import STOP_SIGNALS
from vdgs.viewer import navigation, server
from vdgs.viewer.client_session import ClientSession
from vdgs.viewer.layers import Painter
from vdgs.viewer.live_run import open_run_or_checkpoint, run_file_times, run_status_markdown
from vdgs.viewer.measurement import MeasuredPoint
from vdgs.viewer.path_panel import PathPanel
from vdgs.viewer.point_panel import PointPanel
from vdgs.viewer.render_scheduler import MAX_CACHED_IMAGES, RenderSession
from vdgs.viewer.server import ViewerServer, find_free_port, serve

pytestmark = [pytest.mark.xdist_group("viewer"), pytest.mark.slow]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of a textured plane whose coarse stage is done."""
    return trained(tmp_path_factory.mktemp("view"))


@pytest.fixture(scope="module")
def viewer(run):
    with serve(open_run(run), "127.0.0.1", None, Console(file=sys.stderr)) as opened:
        yield opened


@pytest.fixture
def guest(viewer):
    guest = Guest(viewer.access.local_url())
    yield guest
    guest.close()


def above(x: float = 0.0, y: float = 0.0, width: int = 320, height: int = 240) -> Camera:
    focal = 0.5 * height / math.tan(math.radians(25))
    pose = look_at_pose(np.array([x, y - 2.0, 9.0]), np.array([x, y, 0.0]))
    return Camera(camera_from_world=pose, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)


@quiet
def test_a_visitor_sees_the_true_model(viewer, guest):
    for camera in (above(), above(1.0, 0.5), above(0.0, 0.0, 480, 300)):
        guest.stand(camera)
        guest.assert_sees(expected(viewer, camera))


@quiet
def test_every_layer_can_be_chosen(guest):
    camera = above()
    guest.stand(camera)
    seen = [guest.full_picture(camera)]
    for name in ("Depth", "V: cameras that see it", "Alpha: how opaque", "Blocks", "Error against nearest photograph"):
        guest.choose("Layer", name)
        while True:
            picture = guest.full_picture(camera)
            if np.abs(picture.astype(int) - seen[-1]).mean() > 1:
                break
        assert all(np.abs(picture.astype(int) - other).mean() > 1 for other in seen)
        seen.append(picture)


@quiet
def test_a_click_tells_the_place(viewer, guest):
    camera = above(width=640, height=480)
    guest.stand(camera)
    guest.full_picture(camera)
    place = np.array([0.8, -0.6, 0.0])
    x, y = camera.project(place[None])[0][0]
    guest.click(x / 640, y / 480)
    for _ in guest.messages():
        if "ground frame" in guest.text():
            break
    words = next(line for line in guest.text().splitlines() if "ground frame" in line)
    found = [float(part.split()[1]) for part in words.split(",")[:2]]
    assert found == pytest.approx(place[:2], abs=0.15)  # of a scene of 60 iterations
    assert "training cameras have it in their picture" in guest.text()


@quiet
def test_a_double_click_turns_about_the_place(viewer, guest):
    camera = above(width=640, height=480)
    guest.stand(camera)
    guest.full_picture(camera)
    (visitor,) = viewer.sessions.values()
    visitor.point_panel.clock = lambda: 0.0  # all at the same time
    x, y = camera.project(np.array([[0.8, -0.6, 0.0]]))[0][0]
    guest.click(x / 640, y / 480)
    guest.click(x / 640 + 0.1, y / 480)  # elsewhere
    wait_until(lambda: visitor.point_panel._point is not None)
    assert visitor.camera.position == pytest.approx(camera.position)
    guest.click(x / 640, y / 480)
    guest.click(x / 640, y / 480)
    wait_until(lambda: np.linalg.norm(visitor.pose.look_at[:2] - [0.8, -0.6]) < 0.15)
    assert visitor.camera.position == pytest.approx(camera.position, abs=1e-6)

    def in_the_middle() -> bool:
        seen, _ = visitor.camera.project(visitor.pose.look_at[None])
        return bool(np.abs(seen[0] - (320.0, 240.0)).max() < 0.5)

    wait_until(in_the_middle)  # the browser says where it looks once it has been led there


@quiet
def test_a_path_is_set_and_saved(viewer, guest, tmp_path):
    frames = [above(), above(1.0, 0.0)]
    for count, camera in enumerate(frames, start=1):
        guest.stand(camera)
        guest.full_picture(camera)
        guest.choose("Key frame", "Add")
        visitor = list(viewer.sessions.values())[-1]
        wait_until(lambda visitor=visitor, count=count: len(visitor.path_panel.keyframes) == count)
    guest.choose("Path", "Save")
    parts = b""
    for message in guest.messages():
        if message["type"] == "FileTransferPart":
            parts += bytes(message["content"])
            break
    file = tmp_path / "path.json"
    file.write_bytes(parts)
    read = load_path(file, above())
    assert np.allclose(read.cameras[0].camera_from_world, frames[0].camera_from_world, atol=1e-9)
    assert np.allclose(read.cameras[-1].camera_from_world, frames[1].camera_from_world, atol=1e-9)


def browser_cookie(address: str) -> dict[str, str]:
    """The header by which a browser that has opened the page is known from then on."""
    _, _, cookie = ask(address)
    assert "HttpOnly" in cookie
    return {"Cookie": cookie.split(";")[0]}


def newest(viewer: ViewerServer) -> ClientSession:
    """Who came last, once there is a visitor."""
    wait_until(lambda: viewer.sessions)
    return viewer.sessions[max(viewer.sessions)]


def leaves_work(viewer: ViewerServer, guest: Guest) -> None:
    """A key frame, two clicked places and a known distance."""
    guest.stand(above(1.0, 0.5))
    visitor = newest(viewer)
    wait_until(lambda: visitor.camera is not None)
    visitor.path_panel.add()
    visitor.path_panel._seconds.value = 7.5
    measures = visitor.point_panel.measure_panel
    for x in (0.0, 1.0):
        measures.add(MeasuredPoint(np.array([x, 0.0, 0.0]), rays=(("a", 0.0, 0.0), ("b", 0.0, 0.0))))
    measures._meters.value = 5.0
    measures.save()


@quiet
def test_what_a_visitor_made_outlives_a_lost_connection(viewer, monkeypatch):
    """And nobody else gets it, whoever comes first."""
    wait_until(lambda: not viewer.sessions)
    address = viewer.access.local_url()
    mine, theirs = browser_cookie(address), browser_cookie(address)
    assert mine != theirs
    guest = Guest(address, mine)
    leaves_work(viewer, guest)
    guest.vanish()
    wait_until(lambda: not viewer.sessions)
    welcome, welcomed = viewer.visits.welcome, list[ClientSession]()

    def seen_to_welcome(session: ClientSession) -> None:
        welcome(session)
        welcomed.append(session)

    monkeypatch.setattr(viewer.visits, "welcome", seen_to_welcome)
    for headers in (theirs, None, mine):
        guest = Guest(address, headers)
        guest.stand(above())
        wait_until(lambda: welcomed)
        visitor = welcomed.pop()
        measures = visitor.point_panel.measure_panel
        if headers is mine:
            wait_until(lambda visitor=visitor: np.allclose(visitor.pose.position, above(1.0, 0.5).position))
            assert len(visitor.path_panel.keyframes) == 1
            assert visitor.path_panel._seconds.value == 7.5
            assert measures.ruler.distance() == 1.0
            assert [each.meters for each in measures.known] == [5.0]
            assert "**5 m**" in measures._command.content
        else:
            assert not visitor.path_panel.keyframes
            assert not measures.known
            assert np.allclose(visitor.pose.position, above().position)
        guest.close()
        wait_until(lambda: not viewer.sessions)


@quiet
def test_a_browser_that_is_back_before_its_loss_is_noticed_gets_its_work_too(viewer):
    wait_until(lambda: not viewer.sessions)
    mine = browser_cookie(viewer.access.local_url())
    lost = Guest(viewer.access.local_url(), mine)
    leaves_work(viewer, lost)
    back = Guest(viewer.access.local_url(), mine)
    back.stand(above())
    wait_until(lambda: len(viewer.sessions) == 2)
    visitor = newest(viewer)
    assert not visitor.path_panel.keyframes
    lost.close()
    wait_until(lambda: visitor.path_panel.keyframes)
    assert np.allclose(visitor.pose.position, above().position)  # stays where it has moved meanwhile
    back.close()


@quiet
def test_measures_are_drawn_where_they_are(viewer, guest):
    """Browsers keep the position of a name: a line never has the name of what had a position."""
    guest.stand(above())
    measures = newest(viewer).point_panel.measure_panel
    for x, kind in ((1.0, "SetPositionMessage"), (2.0, "LineSegmentsMessage")):
        measures.add(MeasuredPoint(np.array([x, 0.0, 0.0])))
        next(message for message in guest.messages() if message["type"] == kind)
    placed = {each["name"] for each in guest.kept if each["type"] == "SetPositionMessage"}
    lines = {each["name"] for each in guest.kept if each["type"] == "LineSegmentsMessage"}
    assert placed
    assert lines
    assert not lines & placed


@pytest.mark.parametrize(
    ("width", "height", "farther"),
    [(1920, 1000, 1.0), (1400, 800, 1.0), (1100, 750, 1.18), (2200, 1500, 1.18), (800, 600, 1.55), (400, 800, 2.0),
     (480, 320, 1.0)],
)  # fmt: skip
def test_the_first_view_lies_beside_the_panel(viewer, width: int, height: int, farther: float) -> None:
    capture = viewer.scene.capture
    wide, pose = navigation.overview_pose(capture), navigation.overview_pose(capture, (width, height))
    assert pose.distance == pytest.approx(farther * wide.distance, rel=0.01)
    focal = 0.5 * height / math.tan(math.radians(25))
    camera = Camera(
        camera_from_world=look_at_pose(pose.position, pose.look_at), fx=focal, fy=focal, cx=width / 2, cy=height / 2,
        width=width, height=height,
    )  # fmt: skip
    across = camera.camera_from_world @ np.append(wide.look_at, 1.0)
    middle, half = width / 2 + focal * across[0] / across[2], 0.6 * height / farther
    is_phone = width <= 576  # its panel is below
    panel = 0 if is_phone else 335 * (2 if width > 2000 else 1)
    assert 0 <= middle <= width / 2 + 1e-6
    if not is_phone:
        assert middle + half <= width - panel + 2
        assert middle - half >= -2


def test_a_canvas_without_pixels_is_no_other_canvas(viewer):
    """Of a window that is hidden or laid out: the first view stays, and is fitted once there is a canvas."""
    session = ClientSession.__new__(ClientSession)
    stands = navigation.fitted_pose(viewer.scene.first_view, (1920, 1000))
    camera = SimpleNamespace(image_width=0, image_height=0, position=stands.position, look_at=stands.look_at)
    session.scene, session.client = viewer.scene, SimpleNamespace(camera=camera)
    session._is_at_first_view, session._fitted, session._camera = True, (1920, 1000), object()
    session._on_camera_moved = lambda: None
    moves = list[navigation.CameraPose]()
    session.move_to = moves.append
    session._on_browser_moved()
    assert moves == []
    camera.image_width, camera.image_height = 400, 800
    session._on_browser_moved()
    (moved,) = moves
    assert moved.distance == pytest.approx(2 * stands.distance, rel=0.01)


@quiet
def test_a_narrow_window_shows_all_at_first(viewer):
    wait_until(lambda: not viewer.sessions)
    capture = viewer.scene.capture
    for width, height in ((480, 320), (240, 480), (1100, 750)):
        begin = navigation.overview_pose(capture)
        focal = 0.5 * height / math.tan(math.radians(25))
        camera = Camera(
            camera_from_world=look_at_pose(begin.position, begin.look_at), fx=focal, fy=focal, cx=width / 2,
            cy=height / 2, width=width, height=height,
        )  # fmt: skip
        guest = Guest(viewer.access.local_url())
        guest.stand(camera)
        visitor = newest(viewer)
        meant = navigation.overview_pose(capture, (width, height))
        wait_until(lambda visitor=visitor, meant=meant: np.allclose(visitor.pose.position, meant.position))
        guest.close()
        wait_until(lambda: not viewer.sessions)


@quiet
def test_visitors_that_vanish_are_forgotten(viewer):
    wait_until(lambda: not viewer.sessions)
    guests = [Guest(viewer.access.local_url()) for _ in range(4)]
    for number, guest in enumerate(guests):
        guest.stand(above(0.1 * number))
    wait_until(lambda: len(viewer.sessions) == 4)
    for guest in guests[:3]:
        guest.stand(above(0.5))
        guest.vanish()
    camera = above(0.3, 0.2)
    guests[3].stand(camera)
    guests[3].assert_sees(expected(viewer, camera))
    guests[3].close()
    wait_until(lambda: not viewer.sessions)
    assert not viewer.scheduler._sessions


def test_what_is_sent_to_one_who_left_is_no_warning(run):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with serve(open_run(run), "127.0.0.1", None, Console(file=io.StringIO())) as viewer:
            guest = Guest(viewer.access.local_url())
            guest.stand(above())
            wait_until(lambda: viewer.sessions)
            (visitor,) = viewer.sessions.values()
            guest.vanish()
            wait_until(lambda: not viewer.sessions)
            visitor.set_progress("a picture that came too late")
    assert not [each.message for each in said if "closed connection" in str(each.message)]


@quiet
def test_many_visits_leave_nothing_behind(viewer):
    """Counted in objects: what a process weighs depends on its allocator, and on what else was at work."""
    kinds = (ClientSession, Painter, RenderSession, PointPanel, PathPanel, viser.ClientHandle)

    def there() -> dict[type, int]:
        gc.collect()
        return {kind: sum(issubclass(type(each), kind) for each in gc.get_objects()) for kind in kinds}

    wait_until(lambda: not viewer.sessions)
    for number in range(6):
        guest = Guest(viewer.access.local_url())
        guest.stand(above(0.1 * number))
        guest.full_picture(above(0.1 * number))
        guest.choose("Layer", "Depth")
        (guest.vanish if number % 2 else guest.close)()
    wait_until(lambda: not viewer.sessions)
    wait_until(lambda: not any(there().values()))
    assert len(viewer.scheduler._full_images) <= MAX_CACHED_IMAGES


@quiet
def test_a_photograph_lies_over_the_model_until_one_leaves(viewer, guest):
    guest.stand(above())
    guest.full_picture(above())
    wait_until(lambda: len(viewer.sessions) == 1)
    (visitor,) = viewer.sessions.values()
    taken = viewer.scene.capture.views[0].camera
    visitor.view_image(0)
    assert visitor.display.image_index == 0
    guest.stand(above(0.2))  # was on its way when the browser was told to go
    wait_until(lambda: visitor.camera.position[0] == pytest.approx(0.2))
    assert visitor.display.image_index == 0
    guest.stand(taken)
    wait_until(lambda: np.allclose(visitor.camera.position, taken.position))
    guest.assert_sees(visitor.painter.paint(visitor.display, visitor.camera, visitor.camera))
    guest.stand(above(0.3))
    wait_until(lambda: visitor.display.image_index is None)


# ------------------------------------------------------------------------------------- the door


def ask(address: str, path: str = "/", **headers: str) -> tuple[int, bytes, str]:
    try:
        with urlopen(Request(address.split("?")[0].rstrip("/") + path, headers=headers)) as answer:
            return answer.status, answer.read(), answer.headers.get("Set-Cookie", "")
    except HTTPError as error:
        with error:
            return error.code, error.read(), ""


@quiet
def test_nothing_of_the_machine_is_reached(viewer):
    address = viewer.access.local_url()
    assert ask(address)[0] == 200
    outside = "/../../../../etc/passwd", "/%2e%2e/%2e%2e/pyproject.toml", "/..%5c..%5cx", "//etc/passwd", "/assets/"
    for path in outside:
        status, body, _ = ask(address, path)
        assert status == 404, path
        assert b"root:" not in body
    assert ask(address, Host="evil.example")[0] == 403
    assert ask(address, Origin="http://evil.example")[0] == 403
    with pytest.raises(Exception, match="403"):
        Guest(address, {"Origin": "http://evil.example"})
    assert viewer.server.request_share_url() is None  # no tunnel to elsewhere


@quiet
def test_a_health_check_leaves_no_traceback(viewer, caplog):
    with socket.create_connection(("127.0.0.1", viewer.access.port), timeout=PATIENCE_SECONDS) as connection:
        connection.sendall(b"HEAD / HTTP/1.1\r\n\r\n")
        while connection.recv(4096):
            pass
    assert not [record for record in caplog.records if record.name.startswith("websockets")]


def test_others_need_the_token(run):
    said = io.StringIO()
    with serve(open_run(run), "0.0.0.0", None, Console(file=said)) as viewer:
        address, token = viewer.access.local_url(), viewer.access.token
        assert token is not None
        assert len(token) >= 32
        assert ask(address)[0] == 403
        assert ask(address, "/?token=" + token[:-1])[0] == 403
        with pytest.raises(Exception, match="403"):
            Guest(address.split("?")[0])
        status, _, cookie = ask(address, "/?token=" + token, Host="somewhere.example")
        assert status == 200
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        assert ask(address, Cookie=cookie.split(";")[0])[0] == 200
        guest = Guest(address.split("?")[0], {"Cookie": cookie.split(";")[0]})
        guest.stand(above())
        assert guest.full_picture(above()).shape == (240, 320, 3)
        guest.close()
        # Why is printed, once for each reason, and never the token.
        assert said.getvalue().count("The token is missing or wrong") == 1
        assert ask(address, Cookie=cookie.split(";")[0], Origin="http://lab.example:80")[0] == 403
        assert ask(address, Cookie=cookie.split(";")[0], Origin="http://lab.example:80")[0] == 403
        assert said.getvalue().count("proxy_set_header Host $http_host") == 1
        assert "Origin http://lab.example:80" in said.getvalue()
        assert token[:-1] not in said.getvalue()


@quiet
def test_a_proxy_that_keeps_its_own_name_is_named(run):
    """nginx without more settings: the page has loaded, its socket is refused for ever."""
    said = io.StringIO()
    with serve(open_run(run), "127.0.0.1", None, Console(file=said)) as viewer:
        address = viewer.access.local_url()
        for _ in range(3):
            with pytest.raises(Exception, match="403"):
                Guest(address, {"Origin": "http://127.0.0.1:8302"})
        assert said.getvalue().count("warning") == 1
        assert "proxy_set_header Host $http_host" in said.getvalue()
        for host in ("lab.example", "evil.example"):
            assert ask(address, Host=host)[0] == 403
        assert said.getvalue().count("warning") == 2
        assert "--host" in said.getvalue()
        assert "docs/viewer.md" in said.getvalue()


@quiet
def test_a_canvas_that_is_too_large_is_drawn_smaller(viewer, monkeypatch):
    monkeypatch.setattr(navigation, "MAX_CANVAS_PIXELS", 320 * 240)
    guest = Guest(viewer.access.local_url())
    guest.stand(above(width=200_000, height=150_000))
    guest.assert_sees(expected(viewer, above()))
    guest.close()


def test_ports_and_hosts_that_cannot_be_used_are_said_before_any_work(run):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(VdgsError, match=f"--port {port}: cannot be used"):
            find_free_port("127.0.0.1", port)
        done = vdgs("view", run, "--port", port)
        assert done.returncode == 1
        assert f"--port {port}" in done.stderr
    with pytest.raises(VdgsError, match="no address of this machine"):
        find_free_port("no.such.host.invalid", None)
    for port in (None, 8140):
        with pytest.raises(VdgsError, match=r"--host 192\.0\.2\.7: is no address of this machine\."):  # of RFC 5737
            find_free_port("192.0.2.7", port)
    with pytest.raises(VdgsError, match="--port 70000"):
        parse(["view", str(run), "--port", "70000"])


@pytest.mark.parametrize("how", STOP_SIGNALS)
def test_it_ends_when_asked_to(run, how):
    with begun("view", run) as process:
        wait_until(lambda: "http://127.0.0.1:" in process.printed() or not process.runs())
        process.send_signal(how)
        done = process.finished()
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("coarse model ("), done.stdout
    assert "Traceback" not in done.stderr


def test_a_folder_without_a_run_is_said(tmp_path):
    done = vdgs("view", tmp_path)
    assert done.returncode == 1
    assert str(tmp_path) in done.stderr


# ------------------------------------------------------------------------------------- a run that trains


@quiet
def test_a_run_that_trains_is_shown_as_it_was_saved_last(run, viewer, guest, tmp_path):
    unfinished = tmp_path / "run"
    shutil.copytree(run, unfinished)
    finished = open_run(unfinished)
    assert open_run_or_checkpoint(unfinished).name == "coarse"
    before = run_file_times(RunFolder(unfinished))
    (unfinished / "coarse/model.safetensors").unlink()
    status = json.loads((unfinished / "coarse/status.json").read_text())
    (unfinished / "coarse/status.json").write_text(json.dumps({**status, "state": "stopped"}))
    assert run_file_times(RunFolder(unfinished)) != before
    last = open_run_or_checkpoint(unfinished)
    assert last.name == "training"
    assert "60 iterations" in last.warning
    assert np.array_equal(last.model.anchors.features, finished.model.anchors.features)
    assert last.model.photograph_pixel == pytest.approx(finished.model.photograph_pixel, rel=0.2)
    assert "**coarse** stopped" in run_status_markdown(RunFolder(unfinished))
    with pytest.raises(RunError):
        open_run_or_checkpoint(unfinished, "merged")
    for file in (unfinished / "coarse/checkpoints").iterdir():
        file.unlink()
    with pytest.raises(RunError, match="no model and no checkpoint yet"):
        open_run_or_checkpoint(unfinished)
    # Whoever looks sees the newer model, and how far training is.
    camera = above()
    guest.stand(camera)
    guest.full_picture(camera)
    viewer.set_progress(run_status_markdown(RunFolder(run)))
    shown = viewer.scene.run
    viewer.replace_run(last)
    guest.assert_sees(expected(viewer, camera))
    viewer.replace_run(shown)
    for _ in guest.messages():  # words and pictures take turns
        if "**coarse** done" in guest.text():
            break
    assert "**coarse** done" in guest.text()


def test_what_is_saved_while_a_run_is_opened_is_shown_too(run, tmp_path, monkeypatch):
    """A merge is the last file to come: none after it would bring it."""
    shutil.copytree(run, tmp_path / "run")
    opened, viewer = open_run(tmp_path / "run"), MagicMock()

    def open_slowly(*_):
        os.utime(tmp_path / "run/coarse/model.safetensors", (1e9, 1e9))
        return opened

    monkeypatch.setattr(server, "open_run_or_checkpoint", open_slowly)
    monkeypatch.setattr(server, "serve", lambda *_: nullcontext(viewer))
    monkeypatch.setattr(server, "REFRESH_SECONDS", 0.0)
    viewer.scene.run = opened
    viewer.replace_run.side_effect = KeyboardInterrupt
    viewer.set_progress.side_effect = [None, None, KeyboardInterrupt]
    server.view_run(ViewRequest(run=tmp_path / "run"), Console(quiet=True))
    viewer.replace_run.assert_called_once_with(opened)


def test_blocks_that_train_are_shown_with_what_they_have(run, tmp_path):
    cut = tmp_path / "run"
    shutil.copytree(run, cut)
    for command in (("visibility", cut), ("partition", cut, "--blocks", "2")):
        here(*command)
    assert open_run_or_checkpoint(cut).name == "coarse"
    here("train-blocks", cut, "--block", "1", "--block.iterations", "20", "--save-every", "10")
    folder = cut / "blocks/01"
    status = json.loads((folder / "status.json").read_text())
    for unfinished in (False, True):
        if unfinished:
            (folder / "model.safetensors").unlink()
            (folder / "status.json").write_text(json.dumps({**status, "state": "stopped"}))
        shown = open_run_or_checkpoint(cut)
        assert shown.name == "training"
        assert "1 of 2 blocks" in shown.warning
        assert shown.missing_blocks == (0,)
        assert len(shown.model.anchors) > 0
        assert "**block 1**" in run_status_markdown(RunFolder(cut))
