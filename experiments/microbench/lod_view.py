"""How a scene with a level-of-detail tree is looked at: the time to the first picture, pictures a second in motion, the
time to the picture at rest and what it lacks against full detail, how it then comes nearer to that, memory.

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
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil
import torch

from vdgs.captures.first_view import FOV_DEG
from vdgs.geometry.camera import Camera
from vdgs.kernels import configure_threads
from vdgs.kernels.kernel_types import Raster
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.lod_scene import LodScene
from vdgs.model.lod_tree import ANCHOR_COST, LodCut
from vdgs.model.renderer import Drawable, render
from vdgs.rendering.camera_paths import look_at_pose
from vdgs.viewer.layers import DisplayOptions, Painter
from vdgs.viewer.live_run import open_run_or_checkpoint
from vdgs.viewer.render_scheduler import RenderedFrame, RenderScheduler
from vdgs.viewer.viewer_scene import PART_CACHE_BYTES, REST_ERROR_PX, REST_MAX_COST, ViewerScene
from vdgs.visibility.visibility_counts import FADE_BELOW

#: A visitor moves so often a second.
MOVES_PER_SECOND = 60
#: Rows of full detail that are drawn at once.
STRIP_ROWS = 16
#: What is near enough to full detail, in dB.
NEAR_DB = 35.0
#: Standpoints are found from so many anchors: the model is mapped, and what is read of it is resident.
SAMPLED_ANCHORS = 1000
#: A visitor who moves on while a picture becomes better does so after so many seconds.
INTERRUPT_SECONDS = (0.6, 1.1, 1.6, 2.1)


class Visitor:
    """Takes the pictures of a scheduler, with their times."""

    def __init__(self, scene: ViewerScene, display: DisplayOptions) -> None:
        self._display = display
        #: With the time of the clock and of the processors.
        self.scheduler, self.frames = RenderScheduler(), list[tuple[float, float, RenderedFrame]]()
        self._came = threading.Condition()
        self.session = self.scheduler.add_session(Painter(scene), self._take, self._fail)
        threading.Thread(target=self.scheduler.run, daemon=True).start()

    def _take(self, frame: RenderedFrame) -> None:
        with self._came:
            self.frames.append((time.monotonic(), time.process_time(), frame))
            self._came.notify_all()

    def _fail(self, error: Exception) -> None:
        raise error

    def ask(self, camera: Camera) -> None:
        self.scheduler.request_frame(self.session, camera, self._display)

    def wait(self, full: bool) -> tuple[float, RenderedFrame]:
        """The next picture; a full one, if so asked."""
        with self._came:
            before = len(self.frames)
            while True:
                for when, _, frame in self.frames[before:]:
                    if frame.is_full or not full:
                        return when, frame
                self._came.wait()

    def whole(self) -> None:
        """Wait until the picture at rest is drawn in full detail."""
        with self._came:
            while self.session.full_due:
                self._came.wait(0.05)


@dataclass(frozen=True)
class Picture:
    """A picture at rest, and what had passed by then: by the clock, and (in brackets) of the processors."""

    seconds: float
    processor_seconds: float
    image: np.ndarray

    def __str__(self) -> str:
        return f"{self.seconds:.1f} s ({self.processor_seconds:.1f} s)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--samples", type=int, default=4, help="of a pixel each way, of the picture compared with")
    parser.add_argument("--flight", type=int, default=0, help="steps of a flight from over all into the street")
    parser.add_argument(
        "--min-visibility", type=int, default=FADE_BELOW, help="cameras below which the scene fades out"
    )
    parser.add_argument("--motion-only", action="store_true", help="compare with no full detail, which takes minutes")
    options = parser.parse_args()
    configure_threads(0)
    scene = ViewerScene(open_run_or_checkpoint(options.run))
    tree = scene.tree(scene.names[0])
    assert tree is not None, "the run has no level-of-detail tree: vdgs lod RUN"
    places = standpoints(scene.model(scene.names[0]), options.width, options.height)
    visitor = Visitor(scene, DisplayOptions(min_visibility=options.min_visibility))
    visitor.ask(places["overview"])
    when, _ = visitor.wait(full=False)
    begun = time.time() - psutil.Process().create_time() - (time.monotonic() - when)
    print(f"first picture after {begun:.1f} s ({time.process_time():.1f} s of a processor); {memory()}", flush=True)
    rested = dict[str, np.ndarray]()
    for name, camera in places.items():
        fly(visitor, name, tree, camera, options.seconds)
        rested[name] = rest(visitor, name, camera)
    if options.flight:
        fly_down(tree, places, options.flight)
    for name, camera in () if options.motion_only else places.items():
        compare(name, rested[name] / 255.0, tree, camera, scene.pixel_at_camera_height, options.samples)


def standpoints(model: AnchorModel, width: int, height: int) -> dict[str, Camera]:
    """Cameras over all of a scene, halfway, and in a street."""
    some = model.anchors.positions
    some = some[:: max(1, len(some) // SAMPLED_ANCHORS)].numpy()
    low, high = some.min(0), some.max(0)
    size, middle = float((high - low)[:2].max()), (low + high)[:2] / 2
    ground = float(np.quantile(some[:, 2], 0.2))

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


def fly(visitor: Visitor, name: str, tree: LodScene, camera: Camera, seconds: float) -> None:
    """Move sideways about a place: print pictures a second, their pixels, and how many pixels their cut may be off."""
    began, used, first = time.monotonic(), time.process_time(), len(visitor.frames)
    while (passed := time.monotonic() - began) < seconds:
        visitor.ask(moved(camera, 0.01 * np.sin(2 * passed)))
        time.sleep(1 / MOVES_PER_SECOND)
    used = time.process_time() - used
    shown = [frame for _, _, frame in visitor.frames[first:] if not frame.is_full]
    pixels = float(np.median([frame.image.shape[0] * frame.image.shape[1] for frame in shown] or [0]))
    small = camera.limit_size(max(1, round(camera.width * np.sqrt(pixels / camera.width / camera.height))))
    errors = tree.within(small, visitor.session.painter.drawn_anchors * ANCHOR_COST + 1).max_error_px
    print(
        f"{name}: {len(shown) / seconds:.1f} pictures a second in motion ({used / max(len(shown), 1) * 1000:.0f} ms of "
        f"a processor each, {pixels / 1000:.0f} thousand pixels, {errors:.1f} px off at most)",
        flush=True,
    )


def moved(camera: Camera, share: float) -> Camera:
    """The camera a part of its distance from the middle of the scene farther sideways."""
    pose = np.array(camera.camera_from_world)
    pose[0, 3] += share * np.linalg.norm(pose[:3, 3])
    return replace(camera, camera_from_world=pose)


def rest(visitor: Visitor, name: str, camera: Camera) -> np.ndarray:
    """The first picture of a camera at rest. Print how near it and those that follow are to the last one, which is in
    full detail, with their times, and how soon a picture is there for who moves on before that."""
    began, used, first = time.monotonic(), time.process_time(), len(visitor.frames)
    visitor.ask(camera)
    when, _ = visitor.wait(full=True)
    print(
        f"{name}: at rest after {when - began:.2f} s ({time.process_time() - used:.2f} s of a processor); {memory()}",
        flush=True,
    )
    visitor.whole()
    pictures = [Picture(at - began, cpu - used, each.image) for at, cpu, each in visitor.frames[first:] if each.is_full]
    course = [(each, psnr(each.image / 255.0, pictures[-1].image / 255.0)) for each in pictures]
    near = next(each for each, found in course if found >= NEAR_DB)
    print(
        f"{name}: {course[0][1]:.1f} dB to full detail at first, {NEAR_DB:g} dB after {near}, all of it after "
        f"{pictures[-1]}; {memory()}",
        flush=True,
    )
    waits = list[str]()
    for number, seconds in enumerate(INTERRUPT_SECONDS):
        visitor.ask(moved(camera, 0.001 * (number + 1)))
        visitor.wait(full=True)
        time.sleep(seconds)
        began, used = time.monotonic(), time.process_time()
        visitor.ask(moved(camera, 0.001 * (number + 1.5)))
        waited = visitor.wait(full=False)[0] - began
        waits.append(f"{waited * 1000:.0f} ({(time.process_time() - used) * 1000:.0f})")
    print(f"{name}: who moves on meanwhile gets a picture after {', '.join(waits)} ms; {memory()}", flush=True)
    return pictures[0].image


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


def compare(name: str, shown: np.ndarray, tree: LodScene, camera: Camera, pixel: float, samples: int) -> None:
    """Print what a picture at rest lacks."""
    at_rest = tree.at_error(REST_ERROR_PX).within(camera, REST_MAX_COST)
    every = tree.in_detail(tree.tree.with_own_cache(PART_CACHE_BYTES))
    exact, aliased = (full_detail(each, camera, 1) for each in (every.without_aliasing(pixel), every))
    fine = full_detail(every, camera, samples)
    print(
        f"{name}: {psnr(shown, exact):.1f} dB against full detail without aliasing, {psnr(shown, fine):.1f} dB against "
        f"it with {samples**2} samples a pixel (full detail itself: {psnr(exact, fine):.1f} dB, with aliasing "
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
