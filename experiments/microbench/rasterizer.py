"""How fast the rasterizer draws and differentiates: nine scenes, one and two threads, every instruction set.

    python -m experiments.microbench.rasterizer
    python -m experiments.microbench.rasterizer --prototype DIR     beside the feasibility study in DIR, interleaved
    python -m experiments.microbench.rasterizer --run RUN           test views of a trained run instead

Times are medians in milliseconds of the public function, autograd included, from tensors to gradients;
the study is timed from arrays to arrays. Repetitions alternate, so that a busy machine slows both alike:
believe the ratios. `share` is the contributing pairs of splat and pixel per second of the forward pass
with one thread, as a share of what one core blends at best with everything in its first-level cache.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: spinning threads disturb the others

import argparse
import importlib.util
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments.microbench.hardware_info import describe
from vdgs.kernels.cpu.extension import load_extension, supported_isas
from vdgs.kernels.cpu.rasterize import rasterize
from vdgs.kernels.kernel_types import Splats

COUNTS = (20_000, 200_000, 1_000_000)
SIZES = ((400, 300), (800, 600), (1600, 1200))
THREADS = (1, 2)
PROTOTYPE_BUILDS = {"avx512": "splat_native", "avx2": "splat_v3"}


@dataclass(frozen=True)
class Scene:
    """Projected splats in random order, and the gradient of the picture."""

    width: int
    height: int
    means: np.ndarray
    conics: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray
    depths: np.ndarray
    background: np.ndarray
    picture_gradient: np.ndarray

    def rows(self) -> tuple[np.ndarray, ...]:
        return self.means, self.conics, self.colors, self.opacities, self.depths


def make_scene(n: int, width: int, height: int) -> Scene:
    """Log-normal sizes (median sigma 2 px, at most 60), dilated by 0.3 px^2; logistic-normal opacities."""
    g = np.random.default_rng(0)
    means = np.stack([g.uniform(-0.05 * side, 1.05 * side, n) for side in (width, height)], axis=1)
    sigma = np.exp(g.normal(np.log(2.0), 0.75, n))
    aspect = np.exp(np.abs(g.normal(0, 0.6, n)))
    long, short = (np.clip(s, 0.05, 60) for s in (sigma * np.sqrt(aspect), sigma / np.sqrt(aspect)))
    angle = g.uniform(0, np.pi, n)
    cos, sin = np.cos(angle), np.sin(angle)
    xx = (cos * long) ** 2 + (sin * short) ** 2 + 0.3
    xy = cos * sin * (long**2 - short**2)
    yy = (sin * long) ** 2 + (cos * short) ** 2 + 0.3
    conics = np.stack([yy, -xy, xx], axis=1) / (xx * yy - xy**2)[:, None]
    opacities = 1 / (1 + np.exp(-g.normal(0, 1.7, n)))
    colors, depths = g.uniform(0, 1, (n, 3)), g.uniform(1, 100, n)
    gradient = np.random.default_rng(1).normal(size=(height, width, 3))
    arrays = (means, conics, colors, opacities, depths, np.array([0.2, 0.3, 0.4]), gradient)
    return Scene(width, height, *(a.astype(np.float32) for a in arrays))


@dataclass
class Timing:
    forward: list[float] = field(default_factory=list)
    both: list[float] = field(default_factory=list)

    def add(self, forward: float, backward: float) -> None:
        self.forward.append(1e3 * forward)
        self.both.append(1e3 * (forward + backward))

    def median(self) -> tuple[float, float]:
        # The first repetition also fetches memory from the system.
        return float(np.median(self.forward[1:])), float(np.median(self.both[1:]))


class Ours:
    def __init__(self, isa: str, scene: Scene, threads: int) -> None:
        self.module, self.threads, self.scene = load_extension(isa), threads, scene
        self.tensors = [torch.from_numpy(a).requires_grad_() for a in scene.rows()]
        self.background = torch.from_numpy(scene.background)
        self.gradient = torch.from_numpy(scene.picture_gradient)

    def run(self) -> tuple[float, float]:
        self.module.set_threads(self.threads)
        for tensor in self.tensors:
            tensor.grad = None
        start = time.perf_counter()
        size = self.scene.width, self.scene.height
        means, conics, colors, opacities, depths = self.tensors
        splats = Splats(means, conics, depths, colors, opacities)
        raster = rasterize(splats, self.background, *size, module=self.module)
        middle = time.perf_counter()
        torch.autograd.backward(raster.image, self.gradient)
        return middle - start, time.perf_counter() - middle

    def pairs(self) -> int:
        """Contributing pairs of splat and pixel."""
        s = self.scene
        image, alpha = np.empty((s.height, s.width, 3), np.float32), np.empty((s.height, s.width), np.float32)
        background = tuple(float(c) for c in s.background)
        frame = self.module.rasterize_forward(
            *s.rows(), background, s.width, s.height, image, alpha, None, None, counting=True
        )
        return int(frame.statistics["pairs"])


class Prototype:
    def __init__(self, module: Any, scene: Scene, threads: int) -> None:
        self.module, self.threads, self.scene = module, threads, scene
        self.radii = np.ones(len(scene.means), np.int32)

    def run(self) -> tuple[float, float]:
        s = self.scene
        start = time.perf_counter()
        image, through = (
            np.empty((s.height, s.width, 3), np.float32),
            np.empty((s.height, s.width), np.float32),
        )
        rows = (s.means, s.conics, s.opacities, s.colors, s.depths, self.radii, s.background)
        frame = self.module.forward(*rows, image, through, s.height, s.width, self.threads, False)
        middle = time.perf_counter()
        outputs = [np.empty_like(a) for a in (s.means, s.conics, s.opacities, s.colors)]
        self.module.backward(frame, s.background, s.picture_gradient, None, *outputs, self.threads)
        return middle - start, time.perf_counter() - middle


def scenes_of_run(run: Path, views: int) -> list[tuple[str, Scene]]:
    """What the first test views of a trained run draw."""
    from vdgs.model.renderer import cull_anchors, decode_anchors
    from vdgs.runs.open_run import open_run

    opened, scenes = open_run(run), []
    for view in opened.capture.test_views[:views]:
        camera = view.camera
        seen = cull_anchors(opened.model.anchors, camera)
        with torch.no_grad():
            splats = decode_anchors(opened.model.anchors, seen, opened.model.decoder.weights_for_image(None), camera)
        rows = (splats.means_px, splats.conics, splats.colors, splats.opacities, splats.depths)
        gradient = np.random.default_rng(1).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
        background = np.array(opened.model.background, np.float32)
        means, conics, colors, opacities, depths = (row.numpy() for row in rows)
        size = camera.width, camera.height
        scene = Scene(*size, means, conics, colors, opacities, depths, background, gradient)
        scenes.append((f"{len(rows[0]) // 1000}k {camera.width}x{camera.height}", scene))
    return scenes


def build_prototype(source: Path, folder: Path) -> dict[str, Any]:
    """Build the study with its own flags; its modules by instruction set."""
    configure = ["cmake", "-S", str(source), "-B", str(folder), "-DCMAKE_BUILD_TYPE=Release"]
    subprocess.run([*configure, f"-DPython_EXECUTABLE={sys.executable}"], check=True, stdout=subprocess.DEVNULL)
    targets = list(PROTOTYPE_BUILDS.values())
    subprocess.run(
        ["cmake", "--build", str(folder), "-j2", "--target", *targets], check=True, stdout=subprocess.DEVNULL
    )
    return {isa: _import_from(folder, name) for isa, name in PROTOTYPE_BUILDS.items() if isa in supported_isas()}


def _import_from(folder: Path, name: str) -> Any:
    path = next(folder.glob(f"{name}*.so"))
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def geometric_mean(values: list[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))


@dataclass
class Report:
    limits: dict[str, float]
    ratios: dict[tuple[str, int], list[tuple[float, float]]] = field(default_factory=dict)
    speedups: dict[str, list[tuple[float, float]]] = field(default_factory=dict)

    def measure(self, scene: Scene, name: str, isas: list[str], prototypes: dict[str, Any], repeats: int) -> None:
        for isa in isas:
            ours = {threads: Ours(isa, scene, threads) for threads in THREADS}
            others = {t: Prototype(prototypes[isa], scene, t) for t in THREADS} if isa in prototypes else {}
            mine, theirs = ({threads: Timing() for threads in THREADS} for _ in range(2))
            for _ in range(repeats + 1):
                for threads in THREADS:
                    mine[threads].add(*ours[threads].run())
                    if others:
                        theirs[threads].add(*others[threads].run())
            pairs = ours[1].pairs()
            for threads in THREADS:
                forward, both = mine[threads].median()
                line = f"{name:<20} {isa:<9} {threads}   {forward:7.1f} {both:7.1f}"
                if others:
                    f, b = theirs[threads].median()
                    self.ratios.setdefault((isa, threads), []).append((f / forward, b / both))
                    line += f"   {f:7.1f} {b:7.1f}   {f / forward:5.2f} {b / both:5.2f}"
                if threads == 1:
                    rate = pairs / (1e-3 * forward)
                    line += f"   {rate / 1e9:5.2f} G/s  {rate / self.limits[isa]:4.0%}"
                else:
                    alone = mine[1].median()
                    speedup = (alone[0] / forward, alone[1] / both)
                    self.speedups.setdefault(isa, []).append(speedup)
                    line += f"   x {speedup[0]:.2f} {speedup[1]:.2f}"
                print(line, flush=True)

    def summary(self) -> None:
        print("\ngeometric means over the scenes (forward, forward+backward), worst scene in brackets")
        for isa, speedups in self.speedups.items():
            print(f"two threads against one   {isa:<9} {_means(speedups)}")
        for (isa, threads), ratios in self.ratios.items():
            print(f"prototype / ours          {isa:<9} {threads} thread{'s' * (threads > 1)}  {_means(ratios)}")
        every = [r for ratios in self.ratios.values() for r in ratios]
        if every:
            print(f"prototype / ours          all       {_means(every)}")


def _means(pairs: list[tuple[float, float]]) -> str:
    columns = [list(column) for column in zip(*pairs, strict=True)]
    return "  ".join(f"{geometric_mean(c):.2f} ({min(c):.2f})" for c in columns)


def _scenes(arguments: argparse.Namespace) -> Iterator[tuple[str, Scene]]:
    if arguments.run:
        yield from scenes_of_run(arguments.run, views=3)
        return
    for n in arguments.counts:
        for width, height in SIZES:
            yield f"{n // 1000}k {width}x{height}", make_scene(n, width, height)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prototype", type=Path, help="source folder of the study to compare with")
    parser.add_argument("--run", type=Path, help="a trained run whose first test views are drawn")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--isa", nargs="*", default=[i for i in supported_isas() if i != "portable"] or ["portable"])
    parser.add_argument("--counts", nargs="*", type=int, default=list(COUNTS), help="numbers of splats")
    arguments = parser.parse_args()
    print(describe())
    limits = {isa: load_extension(isa).blend_limit() for isa in arguments.isa}
    print(
        "blend limit ",
        ", ".join(f"{isa} {limit / 1e9:.2f} G pairs/s a core" for isa, limit in limits.items()),
    )
    report = Report(limits)
    with tempfile.TemporaryDirectory() as folder:
        prototypes = build_prototype(arguments.prototype, Path(folder)) if arguments.prototype else {}
        beside = "   prototype ms        ratio    " if prototypes else ""
        print(f"\n{'splats, picture':<20} {'isa':<9} threads  fwd    f+b ms{beside}   pairs, share / speed-up")
        for name, scene in _scenes(arguments):
            report.measure(scene, name, arguments.isa, prototypes, arguments.repeats)
    report.summary()


if __name__ == "__main__":
    main()
