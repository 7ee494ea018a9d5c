"""Shards that executors start, without the seconds of importing: forked from one process that has imported the package.

An executor starts `python -m vdgs.distributed.run_shard`; that process (`started`) asks the server for a fork, forwards
its signals to it and ends as it does. The fork does the shard and ends with `started`. What it knows as its parent is
the parent of `started`, so that it notices when its driver is gone. The first shard of a server is none of these: it
runs in the process that the executor started.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

#: Environment variable that holds the address of the server.
VARIABLE = "VDGS_TEST_SHARDS"
MODULE = "vdgs.distributed.run_shard"
#: More than the arguments and the environment of a process take.
MOST_BYTES = 1 << 17


@contextmanager
def shard_server() -> Iterator[dict[str, str]]:
    """The variables with which executors are to start shards that are forked."""
    from support.commands import PROCESSES

    paths = (Path(__file__).parent / "startup", Path(__file__).parents[1], os.environ.get("PYTHONPATH", ""))
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(f"{folder}/server")
        listener.listen()
        server = PROCESSES.Process(target=_serve, args=(listener,))
        server.start()
        try:
            yield {VARIABLE: f"{folder}/server", "PYTHONPATH": os.pathsep.join(map(str, filter(None, paths)))}
        finally:
            server.kill()
            server.join()


def started(process: int) -> int:
    """The process that an executor started for a forked shard; any other process is itself."""
    name, _, number = Path(f"/proc/{process}/comm").read_text().partition(" ")
    return int(number) if name == "shard" else process


def parent_of(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def fork_shard_where_asked() -> None:
    """If this process was started to do a shard and the server forks one for it, end as that does. Called before all
    else."""
    if VARIABLE not in os.environ or MODULE not in sys.orig_argv:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.connect(os.environ[VARIABLE])
        order = {
            "arguments": sys.orig_argv[sys.orig_argv.index(MODULE) + 1 :],
            "folder": os.getcwd(),
            "environment": dict(os.environ),
        }
        socket.send_fds(
            server,
            [json.dumps(order | {"started": os.getpid()}, ensure_ascii=False).encode(errors="surrogateescape")],
            [1, 2],
        )
        shard = int(server.recv(MOST_BYTES))
        if not shard:
            return

        def forward(number: int, _frame: object) -> None:
            with suppress(ProcessLookupError):
                os.kill(shard, number)

        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
            signal.signal(number, forward)
        code = int(server.recv(MOST_BYTES))
    if code < 0:
        if code != -signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _serve(listener: socket.socket) -> None:
    """Fork shards and tell how they end, until the tests end, however these do. No threads: it forks."""
    import multiprocessing
    from multiprocessing.connection import wait

    tests: Any = multiprocessing.parent_process()
    running = dict[int, tuple[Any, socket.socket]]()
    if tests.sentinel in wait([listener, tests.sentinel]):
        return
    _decline_first(listener)
    while tests.sentinel not in (found := wait([listener, tests.sentinel, *running])):
        for ready in found:
            if isinstance(ready, int):
                shard, asking = running.pop(ready)
                shard.join()
                with asking, suppress(OSError):  # who asked may have been killed
                    asking.send(str(shard.exitcode).encode())
                continue
            asking, _ = listener.accept()
            shard = multiprocessing.get_context("fork").Process(target=_become, args=(asking,))
            shard.start()
            running[shard.sentinel] = shard, asking
    os._exit(0)  # its shards end with it


def _decline_first(listener: socket.socket) -> None:
    """Let the first shard run in the process that was started for it."""
    with listener.accept()[0] as asking:
        asking.recv(MOST_BYTES)
        asking.send(b"0")


def _become(asking: socket.socket) -> None:
    """Do the shard that is asked for, in a session of its own."""
    import ctypes
    import gc

    from support.pausing import pause_where_asked
    from vdgs.distributed import run_shard

    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # it ends with the server
    message, outputs, _, _ = socket.recv_fds(asking, MOST_BYTES, 2)
    order = json.loads(message.decode(errors="surrogateescape"))
    os.setsid()
    for descriptor, output in zip((1, 2), outputs, strict=True):
        os.dup2(output, descriptor)
        os.close(output)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    os.chdir(order["folder"])
    os.environ.clear()
    os.environ.update(order["environment"])
    Path("/proc/self/comm").write_text(f"shard {order['started']}")
    os.getppid = lambda: parent_of(order["started"])
    threading.Thread(target=_end_with, args=(asking,), daemon=True).start()
    asking.send(str(os.getpid()).encode())
    gc.enable()
    pause_where_asked()
    sys.exit(run_shard.main(order["arguments"]))


def _end_with(asking: socket.socket) -> None:
    """End when the process that asked has."""
    with suppress(OSError):
        asking.recv(1)
    os.kill(os.getpid(), signal.SIGKILL)
