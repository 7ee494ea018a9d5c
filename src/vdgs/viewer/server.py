"""`vdgs view`: the server. One port, the page and pictures of the scene, nothing else of the machine."""

from __future__ import annotations

import contextlib
import gc
import http
import io
import math
import secrets
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from rich.console import Console

from vdgs.captures.camera_height import FOV_DEG, camera_height
from vdgs.config.commands import ViewRequest
from vdgs.errors import Interrupted, VdgsError
from vdgs.kernels.idle_memory import return_unused
from vdgs.runs.open_run import TrainedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.system.memory.process_memory import share_arenas
from vdgs.system.stop_signals import stop_if_asked, stop_requests
from vdgs.viewer import navigation
from vdgs.viewer.access_control import ALL, Door, is_loopback
from vdgs.viewer.client_session import Visitor
from vdgs.viewer.live_run import newest, open_or_last_saved, standing_lines
from vdgs.viewer.render_scheduler import Studio
from vdgs.viewer.viewer_scene import Scene

#: Where the search for a free port begins, and how many are tried.
FIRST_PORT, TRIED_PORTS = 8080, 50
#: So many bytes may wait in the system for a visitor's network before newer pictures take the place of older ones here.
WAITING_BYTES = 64 << 10
#: How often a run that trains is looked at, seconds.
LOOK_AGAIN = 2.0


def view_run(asked: ViewRequest, console: Console, opened: Callable[[str], None] | None = None) -> None:
    """Serve a run until Ctrl-C. `opened` is called with the address once it can be opened.

    Raises VdgsError for a run without a model, an address that cannot be used, and where viser is not installed.
    """
    _require_viser()
    share_arenas()
    # Visitors may vanish while a picture is on its way to them.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    free_port(asked.host, asked.port)  # said before the run is opened
    run = open_or_last_saved(asked.run, asked.model, asked.device)
    if run.caution:
        console.print(f"[yellow]warning[/] {run.caution}", highlight=False)
    # Ctrl-C is how it ends, not how it fails, from the moment that the address is printed. Asked for anew: what reads
    # captures has set a handler of its own.
    ending = contextlib.suppress(KeyboardInterrupt, Interrupted)
    with ending, stop_requests(interrupts=True), serve(run, asked.host, asked.port, console) as viewer:
        for line in invitation(run.line, viewer.door):
            console.print(line, highlight=False, soft_wrap=True)
        if opened is not None:
            opened(viewer.door.address())
        _until_asked(viewer, asked, console)


def invitation(scene: str, door: Door) -> list[str]:
    """What to say once a scene can be opened: where, and by whom."""
    lines = [f"{scene}: {door.address()}"]
    if not door.token:
        return [*lines, "Only this machine can open it (--host lets others in). Ctrl-C ends it."]
    elsewhere = door.address_elsewhere()
    if elsewhere is not None:
        lines.append(f"from other machines: {elsewhere}")
        lines.append("Where they do not know that name, write this machine's IP address in its place.")
    elif door.host in ALL:
        lines.append("From other machines, write this machine's IP address in place of localhost.")
    return [*lines, "Whoever has this address can see the scene. Ctrl-C ends it."]


@dataclass(eq=False, kw_only=True)
class Viewer:
    """A server that runs."""

    server: Any
    door: Door
    scene: Scene
    studio: Studio
    visitors: dict[int, Visitor]
    progress: str = ""

    def show(self, run: TrainedRun) -> None:
        """Let every visitor see a newer model."""
        self.studio.errand(lambda: self.scene.show(run)).result()
        for visitor in list(self.visitors.values()):
            visitor.model_changed()

    def tell(self, progress: str) -> None:
        """How far training is, to every visitor who does not know it yet."""
        if progress != self.progress:
            self.progress = progress
            for visitor in list(self.visitors.values()):
                visitor.tell(progress)


@contextlib.contextmanager
def serve(run: TrainedRun, host: str, port: int | None, console: Console) -> Iterator[Viewer]:
    """A viewer of an opened run on a port (None: the first that is free), while the context lasts."""
    scene, studio = Scene(run), Studio()
    door, server = _listening(host, port)
    viewer = Viewer(server=server, door=door, scene=scene, studio=studio, visitors={})
    _place_newcomers(server, run)

    def comes(client: Any) -> None:
        generation = scene.generation
        visitor = Visitor(client, scene, studio, console)
        viewer.visitors[client.client_id] = visitor
        visitor.tell(viewer.progress)
        if scene.generation != generation:  # a newer model came while the panel was made
            visitor.model_changed()
        if client.client_id not in server.get_clients():  # gone while the panel was made
            goes(client)

    def goes(client: Any) -> None:
        visitor = viewer.visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.leave()

    # What is there by now stays. Left out of all later searches for garbage, it lets them be quick and frequent:
    # visitors who left are held by circles of viser's until one finds them.
    gc.collect()
    gc.freeze()
    return_unused()  # what opening the run took beside what it left
    worker = threading.Thread(target=studio.run, name="studio", daemon=True)
    worker.start()
    server.on_client_connect(comes)
    server.on_client_disconnect(goes)
    try:
        yield viewer
    finally:
        studio.close()
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it stopped
            server.stop()
        worker.join(timeout=5.0)
        scene.close()
        gc.unfreeze()


def _place_newcomers(server: Any, run: TrainedRun) -> None:
    """Where a browser stands when it first opens the page; one that connects again stays where it is."""
    stand, height = navigation.whole_scene(run.capture), camera_height(run.capture)
    start = server.initial_camera
    start.up, start.fov = (0.0, 0.0, 1.0), math.radians(FOV_DEG)
    start.position, start.look_at = tuple(stand.position), tuple(stand.look_at)
    start.near, start.far = 1e-3 * height, 1000 * height


def _until_asked(viewer: Viewer, asked: ViewRequest, console: Console) -> None:
    """Serve, and follow a run that is not finished."""
    folder = RunFolder(asked.run)
    seen, follows = newest(folder), viewer.scene.run.name != "merged" and asked.model == "best"
    looked = 0.0
    while True:
        stop_if_asked()
        time.sleep(0.2)
        if not follows or time.monotonic() - looked < LOOK_AGAIN:
            continue
        looked = time.monotonic()
        viewer.tell(standing_lines(folder))
        if (now := newest(folder)) == seen:
            continue
        try:
            viewer.show(open_or_last_saved(asked.run, asked.model, asked.device))
            seen, follows = now, viewer.scene.run.name != "merged"
        except VdgsError as error:  # it is just being written, or training began anew
            console.print(f"[yellow]waiting[/] {error}", highlight=False)
            seen = now


def _require_viser() -> None:
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise VdgsError("vdgs view needs viser. Install it: pip install 'vdgs[viewer]'") from error


def free_port(host: str, port: int | None) -> int:
    """The port that was asked for, else the first free one. Raises VdgsError where there is none, or no such host."""
    tried = range(FIRST_PORT, FIRST_PORT + TRIED_PORTS) if port is None else [port]
    why: OSError | None = None
    for each in tried:
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, each, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind) as trial:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind(address)
            return each
        except (socket.gaierror, UnicodeError) as error:
            raise VdgsError(f"--host {host}: is no address of this machine ({error}).") from error
        except OSError as error:
            why = error
    if port is None:
        raise VdgsError(f"--host {host}: none of the ports {tried[0]} to {tried[-1]} can be used ({why}). Give --port.")
    raise VdgsError(f"--port {port}: cannot be used on {host} ({why}). Give another one.")


def _listening(host: str, port: int | None) -> tuple[Door, Any]:
    """A server that listens, and its door. A port that another program takes between the look and the start is passed
    over, unless it was asked for: VdgsError then."""
    token = None if is_loopback(host) else secrets.token_urlsafe(24)
    for _ in range(TRIED_PORTS):
        door = Door(host, token, free_port(host, port))
        server = _start(door)
        if server is not None:
            return door, server
        if port is not None:
            break
    raise VdgsError(f"--port {door.port}: was taken meanwhile. Give the command again.")


def _start(door: Door) -> Any:
    """A viser server behind a door; None if its port was taken meanwhile."""
    import viser
    import websockets.asyncio.server as sockets

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """No visitor may open a tunnel to elsewhere."""
            return None

    guarded = False
    unguarded = sockets.serve

    def serve_guarded(*args: Any, process_request: Any, **options: Any) -> Any:
        nonlocal guarded
        guarded = True
        return unguarded(*args, process_request=_at_the_door(door, process_request), **options)

    # viser has no hook before its own answers. What it calls to listen is ours while it starts.
    sockets.serve = serve_guarded  # type: ignore[misc, assignment]
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a table of addresses without the token
            server = Server(host=door.host, port=door.port, verbose=False)
    finally:
        sockets.serve = unguarded  # type: ignore[misc]
    if not guarded or server.get_port() != door.port:
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it stopped
            server.stop()
        return None
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    server.gui.set_panel_label("vdgs")
    return server


def _keep_short(connection: Any) -> None:
    """Let nothing pile up in the system's buffers (Linux, macOS): over a slow network, pictures there grow old."""
    if hasattr(socket, "TCP_NOTSENT_LOWAT"):
        with contextlib.suppress(OSError, AttributeError):
            wire = connection.transport.get_extra_info("socket")
            wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, WAITING_BYTES)


def _at_the_door(door: Door, inner: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """What answers a request: a refusal, or what viser answers."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    def answer(connection: Any, request: Any) -> Any:
        refusal = door.refusal(request.path, request.headers)
        if refusal is not None:
            body = (refusal + "\n").encode()
            headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
            return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, body)
        _keep_short(connection)
        response = inner(connection, request)
        if response is not None:
            response.headers["Referrer-Policy"] = "no-referrer"
            response.headers["X-Frame-Options"] = "DENY"
            if door.has_token(request.path):
                response.headers["Set-Cookie"] = door.set_cookie()
        return response

    return answer
