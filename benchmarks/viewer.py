"""How quick `vdgs view` is: to the first picture, while a camera moves, at rest, and with several visitors.

    python benchmarks/viewer.py RUN [--visitors 8] [--seconds 20] [--size 1280 800]

Visitors speak the browser's protocol on the loopback address; the server is another process. Prints one line each.
"""

from __future__ import annotations

import argparse
import math
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from vdgs.cameras import Camera
from vdgs.films.paths import look_at
from vdgs.runs.opening import open_run
from vdgs.viewer.navigation import FOV_DEG, whole_scene
from viewer_support import Guest

SERVER = "import sys\nfrom vdgs.cli import main\nmain(sys.argv[1:])"
#: How often a visitor's mouse moves, a second.
MOVES = 30.0


def around(run: Path, width: int, height: int):
    """A camera on a circle about the scene, by its angle in radians."""
    stand = whole_scene(open_run(run).capture)
    away, focal = stand.position - stand.look_at, 0.5 * height / math.tan(math.radians(FOV_DEG / 2))

    def camera(angle: float) -> Camera:
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
        pose = look_at(stand.look_at + turn @ away, stand.look_at)
        return Camera(pose, focal, focal, width / 2, height / 2, width, height)

    return camera


def first_picture(run: Path, camera) -> tuple[subprocess.Popen, str, float]:
    """Start the server; its process, its address, and seconds until a visitor has a picture."""
    began = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-c", SERVER, "view", str(run)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    address = next(found[0] for line in process.stdout if (found := re.findall(r"http://\S+", line)))
    guest = Guest(address)
    guest.stand(camera(0.0))
    next(guest.pictures())
    taken = time.perf_counter() - began
    guest.close()
    return process, address, taken


def moving(address: str, camera, seconds: float, start: float = 0.0) -> dict[str, float]:
    """A visitor whose camera turns for so long and then rests: pictures a second, their size, gaps, time to full."""
    guest, arrivals, sizes, stopped = Guest(address), [], [], threading.Event()

    def move() -> None:
        began = time.perf_counter()
        while (now := time.perf_counter() - began) < seconds:
            guest.stand(camera(start + 0.3 * now))
            time.sleep(1 / MOVES)
        stopped.set()

    mover = threading.Thread(target=move)
    mover.start()
    full = camera(0.0)
    rest = math.nan
    for picture in guest.pictures():
        now = time.perf_counter()
        if stopped.is_set():
            ended = arrivals[-1] if arrivals else now
            if picture.shape[:2] == (full.height, full.width):
                rest = now - ended
                break
        arrivals.append(now)
        sizes.append(picture.shape[1])
    mover.join()
    guest.close()
    gaps = np.diff(arrivals)
    return {
        "rate": len(arrivals) / seconds, "width": float(np.median(sizes)), "gap": float(np.quantile(gaps, 0.95)),
        "rest": rest,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--visitors", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 800))
    asked = parser.parse_args()
    camera = around(asked.run, *asked.size)
    process, address, taken = first_picture(asked.run, camera)
    try:
        print(f"first picture after {taken:.2f} s")
        server = psutil.Process(process.pid)
        one = moving(address, camera, min(asked.seconds, 10.0))
        print(
            f"one visitor: {one['rate']:.1f} pictures a second while moving, {one['width']:.0f} px wide, 95 % of gaps "
            f"below {1e3 * one['gap']:.0f} ms, full picture {1e3 * one['rest']:.0f} ms after the last of them"
        )
        before, found = server.memory_info().rss, list[dict[str, float]]()
        threads = [
            threading.Thread(target=lambda n=n: found.append(moving(address, camera, asked.seconds, 0.7 * n)))
            for n in range(asked.visitors)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        rates = [each["rate"] for each in found]
        print(
            f"{len(found)} visitors for {asked.seconds:g} s: {min(rates):.1f} to {max(rates):.1f} pictures a second "
            f"each; memory {before / 1e6:.0f} -> {server.memory_info().rss / 1e6:.0f} MB"
        )
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


if __name__ == "__main__":
    main()
