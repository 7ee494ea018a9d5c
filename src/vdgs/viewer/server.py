"""`vdgs view`: the server. One port, the page and pictures of the scene, nothing else of the machine."""

from __future__ import annotations

import contextlib
import errno
import gc
import http
import io
import logging
import math
import secrets
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.markup import escape

from vdgs.captures.first_view import FOV_DEG
from vdgs.config.commands import ViewRequest
from vdgs.errors import Interrupted, VdgsError
from vdgs.kernels.idle_memory import trim_heap
from vdgs.runs.lod_status import is_of_present_version
from vdgs.runs.open_run import OpenedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.system.console import print_warning
from vdgs.system.memory.process_memory import limit_malloc_arenas
from vdgs.system.quoting import shell_word
from vdgs.system.stop_signals import catch_stop_signals, check_stop_requested
from vdgs.viewer.access_control import ALL_INTERFACES, AccessControl, is_loopback
from vdgs.viewer.client_session import ClientSession
from vdgs.viewer.live_run import open_run_or_checkpoint, run_file_times, run_status_markdown
from vdgs.viewer.render_scheduler import RenderScheduler
from vdgs.viewer.viewer_scene import ViewerScene
from vdgs.viewer.visitor_work import Visits

#: Where the search for a free port begins, and how many are tried.
FIRST_PORT, MAX_PORT_TRIES = 8080, 50
#: So many bytes may wait in the system for a session's network before newer pictures take the place of older ones here.
MAX_UNSENT_BYTES = 64 << 10
#: How often a run that trains is looked at, seconds.
REFRESH_SECONDS = 2.0
#: The browser (`AccessControl.browser_of`) of the request that is answered; whatever its connection does inherits it.
_browser: ContextVar[str | None] = ContextVar("browser", default=None)


def view_run(request: ViewRequest, console: Console) -> None:
    """Serve a run until Ctrl-C.

    Raises VdgsError for a run without a model, an address that cannot be used, and where viser is not installed.
    """
    _require_viser()
    limit_malloc_arenas()
    find_free_port(request.host, request.port)  # said before the run is opened
    seen = run_file_times(RunFolder(request.run))  # before: what is written meanwhile is newer
    run = open_run_or_checkpoint(request.run, request.model, request.device)
    print_warning(console, run.warning)
    if not is_of_present_version(run.folder):
        console.print(
            f"[yellow]warning[/] the level-of-detail tree is of another version of vdgs, so that all of the model is "
            f"drawn. Make it again: vdgs lod {shell_word(run.folder.path)}",
            highlight=False,
        )
    # Ctrl-C is how it ends, not how it fails, from the moment that the address is printed. Asked for anew: what reads
    # captures has set a handler of its own.
    ending = contextlib.suppress(KeyboardInterrupt, Interrupted)
    with ending, catch_stop_signals(interrupts=True), serve(run, request.host, request.port, console) as viewer:
        for line in startup_message(run.summary, viewer.access):
            console.print(line, highlight=False, soft_wrap=True)
        _serve_until_stopped(viewer, request, seen, console)


def startup_message(scene: str, access: AccessControl) -> list[str]:
    """What to say once a scene can be opened: where, and by whom."""
    lines = [f"{scene}: {access.local_url()}"]
    if not access.token:
        return [*lines, "Only this machine can open it (--host lets others in). Ctrl-C ends it."]
    elsewhere = access.network_url()
    if elsewhere is not None:
        lines.append(f"from other machines: {elsewhere}")
        lines.append("Where they do not know that name, write this machine's IP address in its place.")
    elif access.host in ALL_INTERFACES:
        lines.append("From other machines, write this machine's IP address in place of localhost.")
    return [*lines, "Whoever has this address can see the scene. Ctrl-C ends it."]


@dataclass(eq=False, kw_only=True)
class ViewerServer:
    """A server that runs."""

    server: Any
    access: AccessControl
    scene: ViewerScene
    scheduler: RenderScheduler
    sessions: dict[int, ClientSession]
    progress: str = ""
    visits: Visits = field(default_factory=Visits)

    def replace_run(self, run: OpenedRun) -> None:
        """Show a newer model to every client."""
        self.scheduler.submit(lambda: self.scene.replace_run(run)).result()
        for session in list(self.sessions.values()):
            session.on_model_changed()

    def set_progress(self, progress: str) -> None:
        """How far training is, to every session who does not know it yet."""
        if progress != self.progress:
            self.progress = progress
            for session in list(self.sessions.values()):
                session.set_progress(progress)


@contextlib.contextmanager
def serve(run: OpenedRun, host: str, port: int | None, console: Console) -> Iterator[ViewerServer]:
    """A viewer of an opened run on a port (None: the first that is free), while the context lasts."""
    scene, scheduler = ViewerScene(run), RenderScheduler()
    scene.tree(scene.names[0])  # a damaged one is refused here
    access, server = _start_listening(host, port, console)
    viewer = ViewerServer(server=server, access=access, scene=scene, scheduler=scheduler, sessions={})
    _set_initial_camera(server, scene)

    async def identify(client: Any) -> None:  # in the connection's own context, before `on_connect`
        viewer.visits.begin(client.client_id, _browser.get())

    def on_connect(client: Any) -> None:
        generation = scene.generation
        session = ClientSession(client, scene, scheduler, console)
        viewer.sessions[client.client_id] = session
        session.set_progress(viewer.progress)
        viewer.visits.welcome(session)
        if scene.generation != generation:  # a newer model came while the panel was made
            session.on_model_changed()
        if client.client_id not in server.get_clients():  # gone while the panel was made
            on_disconnect(client)

    def on_disconnect(client: Any) -> None:
        session = viewer.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
        viewer.visits.end(client.client_id)

    # What is there by now stays. Left out of all later searches for garbage, it lets them be quick and frequent:
    # visitors who left are held by circles of viser's until one finds them.
    gc.collect()
    gc.freeze()
    trim_heap()  # what opening the run took beside what it left
    # Visitors may vanish while a picture, or what is known of a place, is on its way to them.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    worker = threading.Thread(target=scheduler.run, name="render scheduler", daemon=True)
    worker.start()
    server.on_client_connect(identify)
    server.on_client_connect(on_connect)
    server.on_client_disconnect(on_disconnect)
    try:
        yield viewer
    finally:
        scheduler.close()
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it stopped
            server.stop()
        worker.join(timeout=5.0)
        scene.close()
        gc.unfreeze()


def _set_initial_camera(server: Any, scene: ViewerScene) -> None:
    """Where viser lets every new connection stand, in a wide window. A session moves on from there: in a narrower
    window, and where its browser stood before (`Visits.welcome`)."""
    stand, height = scene.first_view, scene.camera_height
    start = server.initial_camera
    start.up, start.fov = (0.0, 0.0, 1.0), math.radians(FOV_DEG)
    start.position, start.look_at = tuple(stand.position), tuple(stand.look_at)
    start.near, start.far = 1e-3 * height, 1000 * height


def _serve_until_stopped(
    viewer: ViewerServer, request: ViewRequest, seen: tuple[tuple[str, int], ...], console: Console
) -> None:
    """Serve, and follow a run that is not finished and had the files `seen` (`run_file_times`) when it was opened."""
    folder = RunFolder(request.run)
    follows = viewer.scene.run.name != "merged" and request.model == "best"
    looked = 0.0
    while True:
        check_stop_requested()
        time.sleep(0.2)
        if not follows or time.monotonic() - looked < REFRESH_SECONDS:
            continue
        looked = time.monotonic()
        viewer.set_progress(run_status_markdown(folder))
        if (now := run_file_times(folder)) == seen:
            continue
        try:
            viewer.replace_run(open_run_or_checkpoint(request.run, request.model, request.device))
            seen, follows = now, viewer.scene.run.name != "merged"
        except VdgsError as error:  # it is just being written, or training began anew
            console.print(f"[yellow]waiting[/] {error}", highlight=False)
            seen = now


def _require_viser() -> None:
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise VdgsError("vdgs view needs viser. Install it: pip install 'vdgs[viewer]'") from error


def find_free_port(host: str, port: int | None) -> int:
    """The port that was asked for, else the first free one. Raises VdgsError where there is none, or no such host."""
    tried = range(FIRST_PORT, FIRST_PORT + MAX_PORT_TRIES) if port is None else [port]
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
            if error.errno == errno.EADDRNOTAVAIL:
                raise VdgsError(f"--host {host}: is no address of this machine.") from error
            why = error
    if port is None:
        raise VdgsError(f"--host {host}: none of the ports {tried[0]} to {tried[-1]} can be used ({why}). Give --port.")
    raise VdgsError(f"--port {port}: cannot be used on {host} ({why}). Give another one.")


def _start_listening(host: str, port: int | None, console: Console) -> tuple[AccessControl, Any]:
    """A server that listens, and its access. A port that another program takes between the look and the start is passed
    over, unless it was asked for: VdgsError then."""
    token = None if is_loopback(host) else secrets.token_urlsafe(24)
    for _ in range(MAX_PORT_TRIES):
        access = AccessControl(host, token, find_free_port(host, port))
        server = _start(access, console)
        if server is not None:
            return access, server
        if port is not None:
            break
    raise VdgsError(f"--port {access.port}: was taken meanwhile. Give the command again.")


def _start(access: AccessControl, console: Console) -> Any:
    """A viser server behind a access; None if its port was taken meanwhile."""
    import viser
    import websockets.asyncio.server as sockets

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """No session may open a tunnel to elsewhere."""
            return None

    guarded = False
    # Health checks and port scans, which send HEAD or nothing, are no reason for tracebacks.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    unguarded = sockets.serve

    def serve_guarded(*args: Any, process_request: Any, **options: Any) -> Any:
        nonlocal guarded
        guarded = True
        return unguarded(*args, process_request=_guard_requests(access, process_request, console), **options)

    # viser has no hook before its own answers. What it calls to listen is ours while it starts.
    sockets.serve = serve_guarded  # type: ignore[misc, assignment]
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a table of addresses without the token
            server = Server(host=access.host, port=access.port, verbose=False)
    finally:
        sockets.serve = unguarded  # type: ignore[misc]
    if not guarded or server.get_port() != access.port:
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it stopped
            server.stop()
        return None
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    server.gui.set_panel_label("vdgs")
    return server


def _limit_send_buffer(connection: Any) -> None:
    """Let nothing pile up in the system's buffers (Linux, macOS): over a slow network, pictures there grow old."""
    if hasattr(socket, "TCP_NOTSENT_LOWAT"):
        with contextlib.suppress(OSError, AttributeError):
            wire = connection.transport.get_extra_info("socket")
            wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MAX_UNSENT_BYTES)


def _guard_requests(
    access: AccessControl, handler: Callable[[Any, Any], Any], console: Console
) -> Callable[[Any, Any], Any]:  # fmt: skip
    """What answers a request: a refusal, or what viser answers. Each reason of a refusal is printed once."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    told = set[str]()

    def answer(connection: Any, request: Any) -> Any:
        refusal = access.deny_reason(request.path, request.headers)
        if refusal is not None:
            if refusal not in told:
                told.add(refusal)
                said = escape(str(access.report(request.path, request.headers)))
                console.print(f"[yellow]warning[/] {said}", highlight=False, soft_wrap=True)
            body = (refusal + "\n").encode()
            headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
            return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, body)
        _limit_send_buffer(connection)
        browser = access.browser_of(request.headers)
        _browser.set(browser)
        response = handler(connection, request)
        if response is not None:
            response.headers["Referrer-Policy"] = "no-referrer"
            response.headers["X-Frame-Options"] = "DENY"
            if access.has_token(request.path):
                response.headers["Set-Cookie"] = access.set_cookie_header()
            if browser is None:
                response.headers["Set-Cookie"] = access.set_browser_header()
        return response

    return answer
