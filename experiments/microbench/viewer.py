"""How quick `vdgs view` is: to the first picture, while a camera moves, at rest, and with several visitors.

    python -m experiments.microbench.viewer RUN [--visitors 8] [--seconds 20] [--size 1280 800] [--load 300]

Visitors speak the browser's protocol on the loopback address; the server is another process. Prints one line
each. `--load` adds a long test in which half of the visitors vanish and come again.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from support.viewer import Guest
from vdgs.captures.first_view import FOV_DEG
from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import look_at_pose
from vdgs.runs.open_run import open_run
from vdgs.viewer.navigation import overview_pose

SERVER = "import sys\nfrom vdgs.cli.main import main\nmain(sys.argv[1:])"
#: How often a visitor's mouse moves, a second.
MOVES = 30.0


def orbit_camera(run: Path, width: int, height: int):
    """A camera on a circle about the scene, by its angle in radians."""
    overview = overview_pose(open_run(run).capture)
    away, focal = overview.position - overview.look_at, 0.5 * height / math.tan(math.radians(FOV_DEG / 2))

    def camera(angle: float) -> Camera:
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
        pose = look_at_pose(overview.look_at + turn @ away, overview.look_at)
        return Camera(
            camera_from_world=pose, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height
        )

    return camera


@dataclass
class Started:
    """A server that has shown a visitor a picture."""

    process: subprocess.Popen[str]
    address: str
    #: From the command to the first picture, and how much of that the server computed.
    seconds: float
    cpu_seconds: float


def start(run: Path, camera) -> Started:
    """Start the server and wait for a picture."""
    began = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-c", SERVER, "view", str(run)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    address = next(found[0] for line in process.stdout if (found := re.findall(r"http://\S+", line)))
    guest = Guest(address)
    guest.stand(camera(0.0))
    next(guest.pictures())
    taken, used = time.perf_counter() - began, psutil.Process(process.pid).cpu_times()
    guest.close()
    return Started(process, address, taken, used.user + used.system)


def visit_moving(address: str, camera, seconds: float, start: float = 0.0) -> dict[str, float]:
    """A visitor whose camera turns for so long and then rests: pictures a second, their size, gaps, age, time to full.

    The age of what a visitor sees is greatest just before the next picture comes: the time since the camera stood where
    the last picture was args for is at most the gap and the time that one picture takes.
    """
    guest, arrivals, sizes, stopped = Guest(address), list[float](), list[int](), threading.Event()
    ended = [math.inf]

    def move() -> None:
        began = time.perf_counter()
        while (now := time.perf_counter() - began) < seconds:
            guest.stand(camera(start + 0.3 * now))
            time.sleep(1 / MOVES)
        ended[0] = time.perf_counter()
        stopped.set()

    mover = threading.Thread(target=move)
    mover.start()
    full = camera(0.0)
    rest = math.nan
    for picture in guest.pictures():
        now = time.perf_counter()
        if stopped.is_set() and picture.shape[:2] == (full.height, full.width):
            rest = now - ended[0]
            break
        if not stopped.is_set():
            arrivals.append(now)
            sizes.append(picture.shape[1])
    mover.join()
    guest.close()
    gaps = np.diff(arrivals) if len(arrivals) > 1 else np.array([math.inf])
    return {
        "rate": len(arrivals) / seconds, "width": float(np.median(sizes)), "gap": float(np.quantile(gaps, 0.95)),
        "longest": float(gaps.max()), "rest": rest,
    }  # fmt: skip


def visit_repeatedly(address: str, camera, seconds: float, number: int) -> int:
    """One after another visits for a while, each looks about for some seconds and vanishes or leaves; how many."""
    until, visits = time.perf_counter() + seconds, 0
    while time.perf_counter() < until:
        guest = Guest(address)
        for step in range(int(MOVES * (1 + (number + visits) % 3))):
            guest.stand(camera(number + 0.01 * step))
            time.sleep(1 / MOVES)
        (guest.vanish if visits % 2 else guest.close)()
        visits += 1
    return visits


def run_together(jobs: list[Callable[[], Any]]) -> list[Any]:
    """Do jobs at the same time."""
    with ThreadPoolExecutor(len(jobs)) as pool:
        return [each.result() for each in [pool.submit(job) for job in jobs]]


def load(address: str, camera, visitors: int, seconds: float, server: psutil.Process) -> None:
    """Visitors for a long time, half of whom vanish in the middle and come again; memory every tenth of it."""
    memory_mb: list[int] = []
    ended = threading.Event()

    def sample_memory() -> None:
        while not ended.wait(seconds / 10):
            memory_mb.append(round(server.memory_info().rss / 1e6))

    sampler = threading.Thread(target=sample_memory)
    sampler.start()
    stay = [lambda n=n: visit_moving(address, camera, seconds, 0.7 * n) for n in range(visitors // 2)]
    change = [lambda n=n: visit_repeatedly(address, camera, seconds, n) for n in range(visitors - visitors // 2)]
    results = run_together([*stay, *change])
    ended.set()
    sampler.join()
    rates = [each["rate"] for each in results[: len(stay)]]
    print(
        f"load: {visitors} visitors for {seconds:g} s, of whom {len(change)} came {sum(results[len(stay) :])} times "
        f"and vanished half of them: those who stayed got {min(rates):.1f} to {max(rates):.1f} pictures a second; "
        "memory, MB: " + " ".join(str(megabytes) for megabytes in memory_mb)
    )
    assert server.is_running()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--visitors", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--load", type=float, default=0.0, help="Seconds of the load test; 300 is a good while")
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 800))
    args = parser.parse_args()
    camera = orbit_camera(args.run, *args.size)
    print(f"load of the machine before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    started = start(args.run, camera)
    address = started.address
    try:
        print(f"first picture after {started.seconds:.2f} s, of which the server computed {started.cpu_seconds:.2f} s")
        server = psutil.Process(started.process.pid)
        print(f"memory with the first picture: {server.memory_info().rss / 1e6:.0f} MB")
        one = visit_moving(address, camera, min(args.seconds, 10.0))
        print(
            f"one visitor: {one['rate']:.1f} pictures a second while moving, {one['width']:.0f} px wide, 95 % of gaps "
            f"below {1e3 * one['gap']:.0f} ms, the longest {1e3 * one['longest']:.0f} ms, full picture "
            f"{1e3 * one['rest']:.0f} ms after the camera came to rest"
        )
        before = server.memory_info().rss
        results = run_together(
            [lambda n=n: visit_moving(address, camera, args.seconds, 0.7 * n) for n in range(args.visitors)]
        )
        rates, gaps = [each["rate"] for each in results], [each["gap"] for each in results]
        print(
            f"{len(results)} visitors for {args.seconds:g} s: {min(rates):.1f} to {max(rates):.1f} pictures a second "
            f"each, {np.median([each['width'] for each in results]):.0f} px wide, 95 % of gaps below "
            f"{1e3 * max(gaps):.0f} ms; memory {before / 1e6:.0f} -> {server.memory_info().rss / 1e6:.0f} MB"
        )
        if args.load:
            load(address, camera, args.visitors, args.load, server)
    finally:
        started.process.send_signal(signal.SIGINT)
        started.process.wait()


if __name__ == "__main__":
    main()
