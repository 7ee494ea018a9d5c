"""How a scene with a level-of-detail tree is looked at: the time to the first picture, pictures a second in motion, the
time to the picture at rest and what it lacks against full detail, memory.

    OMP_WAIT_POLICY=PASSIVE python -m experiments.microbench.lod_view RUN [--width 640] [--height 480] [--seconds 4]

The scheduler of `vdgs view` draws for one visitor, in a process of its own; nothing is sent. Three places: over all of
the scene, halfway down to its middle, and in a street there. Each is reached along a path that moves for `--seconds`.
Full detail is drawn without aliasing, as the viewer draws, with aliasing, and with 16 samples a pixel.
"""

from __future__ import annotations

import argparse
import copy
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import torch

from vdgs.captures.first_view import FOV_DEG
from vdgs.geometry.camera import Camera
from vdgs.kernels import configure_threads
from vdgs.kernels.kernel_types import Raster
from vdgs.model.lod_scene import LodScene
from vdgs.model.lod_tree import LodCut
from vdgs.model.renderer import Drawable, render
from vdgs.rendering.camera_paths import look_at_pose
from vdgs.viewer.layers import DisplayOptions, Painter
from vdgs.viewer.live_run import open_run_or_checkpoint
from vdgs.viewer.render_scheduler import RenderedFrame, RenderScheduler
from vdgs.viewer.viewer_scene import REST_ERROR_PX, REST_MAX_COST, ViewerScene

#: A visitor moves so often a second.
MOVES_PER_SECOND = 60
#: Rows of full detail that are drawn at once, and samples of a pixel each way.
STRIP_ROWS, SAMPLES = 16, 4


class Visitor:
    """Takes the pictures of a scheduler, with their times."""

    def __init__(self, scene: ViewerScene) -> None:
        self.scheduler, self.frames = RenderScheduler(), list[tuple[float, RenderedFrame]]()
        self._came = threading.Condition()
        self.session = self.scheduler.add_session(Painter(scene), self._take, self._fail)
        threading.Thread(target=self.scheduler.run, daemon=True).start()

    def _take(self, frame: RenderedFrame) -> None:
        with self._came:
            self.frames.append((time.monotonic(), frame))
            self._came.notify_all()

    def _fail(self, error: Exception) -> None:
        raise error

    def ask(self, camera: Camera) -> None:
        self.scheduler.request_frame(self.session, camera, DisplayOptions())

    def wait(self, full: bool) -> tuple[float, RenderedFrame]:
        """The next picture; a full one, if so asked."""
        with self._came:
            before = len(self.frames)
            while True:
                found = [each for each in self.frames[before:] if each[1].is_full or not full]
                if found:
                    return found[0]
                self._came.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--flight", type=int, default=0, help="steps of a flight from over all into the street")
    parser.add_argument("--motion-only", action="store_true", help="compare with no full detail, which takes minutes")
    options = parser.parse_args()
    configure_threads(0)
    scene = ViewerScene(open_run_or_checkpoint(options.run))
    tree = scene.tree(scene.names[0])
    assert tree is not None, "the run has no level-of-detail tree: vdgs lod RUN"
    places = standpoints(tree, options.width, options.height)
    visitor = Visitor(scene)
    visitor.ask(places["overview"])
    when, _ = visitor.wait(full=False)
    begun = time.time() - psutil.Process().create_time() - (time.monotonic() - when)
    print(f"first picture after {begun:.1f} s ({time.process_time():.1f} s of a processor); {memory()}", flush=True)
    rested = {}
    for name, camera in places.items():
        used = time.process_time()
        rate, pixels, errors = fly(visitor, tree, camera, options.seconds)
        each = (time.process_time() - used) / max(rate * options.seconds, 1)
        began, used = time.monotonic(), time.process_time()
        visitor.ask(camera)
        when, frame = visitor.wait(full=True)
        rested[name] = frame.image
        print(
            f"{name}: {rate:.1f} pictures a second in motion ({each * 1000:.0f} ms of a processor each, "
            f"{pixels / 1000:.0f} thousand pixels, {errors:.1f} px off at most), at rest after {when - began:.2f} s "
            f"({time.process_time() - used:.2f} s of a processor); {memory()}",
            flush=True,
        )
    if options.flight:
        fly_down(tree, places, options.flight)
    for name, camera in () if options.motion_only else places.items():
        compare(name, rested[name] / 255.0, tree, camera, scene.pixel_at_camera_height)


def standpoints(tree: LodScene, width: int, height: int) -> dict[str, Camera]:
    """Cameras over all of a scene, halfway, and in a street."""
    low, high = tree.tree.table.bounds[0, :3], tree.tree.table.bounds[0, 3:]
    size, middle = float((high - low)[:2].max()), (low + high)[:2] / 2
    ground = float(np.quantile(tree.tree.gaussians(0).means[:, 2].numpy(), 0.2))

    def camera(south: float, up: float, target_north: float, target_up: float = 0.0) -> Camera:
        place = np.array([middle[0], middle[1] - south, ground + up], np.float64)
        target = np.array([middle[0], middle[1] + target_north, ground + target_up], np.float64)
        focal = width / 2 / np.tan(np.radians(FOV_DEG) / 2)
        return Camera(
            camera_from_world=look_at_pose(place, target), fx=focal, fy=focal, cx=width / 2, cy=height / 2,
            width=width, height=height,
        )  # fmt: skip

    return {
        "overview": camera(0.75 * size, 0.6 * size, 0.0),
        "halfway": camera(0.2 * size, 0.15 * size, 0.0),
        "street": camera(1.0, 3.0, 30.0, 1.0),
    }


def fly(visitor: Visitor, tree: LodScene, camera: Camera, seconds: float) -> tuple[float, float, float]:
    """Move sideways about a place: pictures a second, their pixels, and how many pixels their cut may be off."""
    began, first = time.monotonic(), len(visitor.frames)
    while (passed := time.monotonic() - began) < seconds:
        pose = np.array(camera.camera_from_world)
        pose[0, 3] += 0.1 * np.sin(2 * passed) * np.linalg.norm(pose[:3, 3]) * 0.1
        visitor.ask(replace(camera, camera_from_world=pose))
        time.sleep(1 / MOVES_PER_SECOND)
    shown = [frame for _, frame in visitor.frames[first:] if not frame.is_full]
    pixels = float(np.median([frame.image.shape[0] * frame.image.shape[1] for frame in shown] or [0]))
    small = camera.limit_size(max(1, round(camera.width * np.sqrt(pixels / camera.width / camera.height))))
    anchors = visitor.session.painter.drawn_anchors
    return len(shown) / seconds, pixels, tree.within(small, anchors * 8 + 1).max_error_px


def fly_down(tree: LodScene, places: dict[str, Camera], steps: int) -> None:
    """Print how much pictures change where nodes take the place of others, on the way down into a street.

    At every step two pictures of the same camera: from the nodes of this step, and from those of the step before.
    """
    path = [places[name] for name in ("overview", "halfway", "street")]
    eyes = np.stack([camera.position for camera in path])
    targets = np.stack([camera.position + camera.forward * camera.position[2] * 1.5 for camera in path])
    for error in (REST_ERROR_PX, 1.0):
        scene, before, found, lost = tree.at_error(error), None, list[float](), list[float]()
        for share in np.linspace(0, 2, steps):
            eye, target = (np.stack([np.interp(share, range(3), p) for p in c.T]) for c in (eyes, targets))
            camera = replace(path[0], camera_from_world=look_at_pose(eye, target))
            cut = scene.tree.cut(camera, error)
            if before is not None and before != cut:
                shown, old = (draw_cut(scene, camera, each) for each in (cut, before))
                found.append(psnr(shown.image.numpy(), old.image.numpy()))
                lost.append(float((shown.alpha - old.alpha).abs().max()))
            before = cut
        print(
            f"flight of {steps} steps at {error:g} px: {len(found)} changes of nodes, {min(found):.1f} dB at least and "
            f"{np.median(found):.1f} dB in the median between the pictures before and after one; opacity changes by "
            f"{np.median(lost):.3f} at most in the median",
            flush=True,
        )


def draw_cut(scene: LodScene, camera: Camera, cut: LodCut) -> Raster:
    """A view drawn from given nodes."""
    tree = copy.copy(scene.tree)
    tree.cut = lambda *_: cut  # type: ignore[method-assign]
    return render(replace(scene, tree=tree), camera)


def compare(name: str, shown: np.ndarray, tree: LodScene, camera: Camera, pixel: float) -> None:
    """Print what a picture at rest lacks."""
    at_rest = tree.at_error(REST_ERROR_PX).within(camera, REST_MAX_COST)
    every = tree.at_error(0.0)
    exact, aliased = (full_detail(each, camera, 1) for each in (every.without_aliasing(pixel), every))
    fine = full_detail(every, camera, SAMPLES)
    print(
        f"{name}: {psnr(shown, exact):.1f} dB against full detail without aliasing, {psnr(shown, fine):.1f} dB against "
        f"it with {SAMPLES**2} samples a pixel (full detail itself: {psnr(exact, fine):.1f} dB, with aliasing "
        f"{psnr(aliased, fine):.1f} dB); "
        f"{at_rest.max_error_px:.2f} px, cost {at_rest.cost(camera):,} of {tree.at_error(0.0).cost(camera):,}",
        flush=True,
    )


@torch.no_grad()
def full_detail(scene: Drawable, camera: Camera, samples: int) -> np.ndarray:
    """The picture from all anchors in view, strip by strip, each pixel the mean of `samples`² of it."""
    large, rows, strips = camera.resized(camera.width * samples, camera.height * samples), STRIP_ROWS * samples, []
    for top in range(0, large.height, rows):
        part = large.cropped(0, top, large.width, min(top + rows, large.height))
        strips.append(render(scene, part).image.clamp(0, 1))
    image = torch.cat(strips).reshape(camera.height, samples, camera.width, samples, 3)
    return image.mean((1, 3)).numpy()


def psnr(shown: np.ndarray, wanted: np.ndarray) -> float:
    return float(-10 * np.log10(max(float(((shown - wanted) ** 2).mean()), 1e-12)))


def memory() -> str:
    """Resident memory now and at most so far."""
    lines = Path("/proc/self/status").read_text().splitlines()
    now, most = (next(int(line.split()[1]) for line in lines if line.startswith(key)) for key in ("VmRSS", "VmHWM"))
    return f"{now / 1e6:.2f} GB resident, {most / 1e6:.2f} GB at most"


if __name__ == "__main__":
    main()
