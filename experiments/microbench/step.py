"""Where the time of one whole training step goes: cull, decode, rasterize, loss, its way back to the
splats, from them to anchors that move, statistics.

    python -m experiments.microbench.step [--threads 2] [--visible 20000] [--own 0.125] [--run RUN]

A random anchor scene seen from above, in which all anchors are visible, with about half of the opacities positive
(what a fresh decoder gives). Prints the median of each phase. With `--own` it is the step of a block: this share of
the anchors, to the left, is trained, the others are drawn and never move (all of the view, of which training draws what
the block's splats reach). With `--run` it is the step of a trained run, by processor time, over nine of its training
photographs, with the counts of the rasterizer: a trained scene has about twice the pairs of splat and pixel of a
random one. Memory is the slope of the peak resident size of fresh processes over the number of anchors:
of those in view, with all that a step makes of them, and of those out of view; and for a model half in view the whole
process without what it imports. Saving is what it adds to the resident size.
"""

from __future__ import annotations

import argparse
import os
import statistics as stats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch

from experiments.microbench.hardware_info import describe
from vdgs.captures.image_cache import ImageCache
from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend, set_num_threads
from vdgs.kernels.cpu.extension import get_extension
from vdgs.kernels.kernel_types import OrderedSplats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.renderer import cull_anchors, decode_anchors_for_training, decode_view
from vdgs.runs.open_run import open_run
from vdgs.system.checkpoints import save_checkpoint
from vdgs.system.memory.process_memory import peak_memory_bytes, reset_peak_memory
from vdgs.training import FrozenAnchors, TrainingProblem, initial_state, to_checkpoint
from vdgs.training.optimizer import learning_rates_at
from vdgs.training.training_step import backward_and_step, render_for_training

PHASES = ("cull", "decode", "around", "rasterize", "loss", "backward", "move", "statistics")


def scene(visible: int, width: int, height: int, hidden: int = 0) -> tuple[Anchors, Camera]:
    """Anchors on a bumpy ground that fills the view, one voxel apart, Gaussians about as large as their spacing;
    `hidden` more of them lie far outside the view."""
    rng = np.random.default_rng(0)
    focal, altitude = 1.2 * width, 20.0
    extent = np.array([width, height]) / focal * altitude
    ground = rng.uniform(-0.5, 0.5, (visible, 2)) * extent
    points = np.column_stack([ground, rng.normal(0, 0.2, visible)])
    points = points[np.lexsort(np.floor(points[:, :2] / (extent / 16)).T)]
    spacing = float(np.sqrt(extent.prod() / visible))
    points = np.concatenate([points, points[rng.integers(0, visible, hidden)] + [1000.0, 0.0, 0.0]])
    visible += hidden
    g = torch.Generator().manual_seed(0)
    anchors = Anchors(
        positions=torch.from_numpy(points.astype(np.float32)),
        features=0.5 * torch.randn(visible, 32, generator=g),
        offsets=0.5 * torch.randn(visible, 10, 3, generator=g),
        log_scales=torch.full((visible, 6), float(np.log(spacing))),
    )
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = altitude
    return anchors, Camera(
        camera_from_world=pose, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height
    )


def timed_phase(
    times: dict[str, list[float]], phase: str, work: Callable[[], Any], synchronize: Callable[[], None] | None,
    clock: Callable[[], float] = time.perf_counter,
) -> Any:  # fmt: skip
    begin = clock()
    result = work()
    if synchronize is not None:
        synchronize()
    times[phase].append(1e3 * (clock() - begin))
    return result


def one_step(
    state: Any, camera: Camera, target: torch.Tensor, step: int, times: dict[str, list[float]],
    synchronize: Callable[[], None] | None = None, surroundings: FrozenAnchors | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[int, int]:  # fmt: skip
    """The work of vdgs.training.training_step, phase by phase, where the anchors are; `synchronize` waits for it."""
    device = state.anchors.positions.device
    kernels, rates = get_backend(device), learning_rates_at(TrainConfig().lr, 0.1)

    def timed(phase: str, work: Callable[[], Any]) -> Any:
        return timed_phase(times, phase, work, synchronize, clock)

    weights = state.decoder.weights_for_image(0)
    with torch.no_grad():
        rows = timed("cull", lambda: cull_anchors(state.anchors, camera))
        waiting = [timed("decode", lambda: decode_anchors_for_training(state.anchors, rows, weights, camera))]
        around = timed("around", lambda: None if surroundings is None else decoded(surroundings, camera))
        view = timed(
            "rasterize", lambda: render_for_training(waiting.pop(), camera, torch.zeros(3, device=device), around)
        )
    view.image.requires_grad_(True)

    def loss() -> torch.Tensor:
        photometric = kernels.photometric_loss(view.image, target, None)
        return torch.autograd.grad(photometric.loss, view.image)[0]

    image_gradient = timed("loss", loss)
    gradients = timed("backward", lambda: view.backward(image_gradient, 0.01))

    def move() -> None:
        states = state.optimizer.anchor_states(state.anchors, rates, TrainConfig().lr_warm_boost)
        backward_and_step(state.anchors, rows, gradients, weights, camera, states, state.optimizer.updates)
        state.optimizer.update_decoder(state.decoder, rates, step)

    timed("move", move)
    timed("statistics", lambda: kernels.add_view_statistics(
        state.statistics, rows, kernels.mark_visible(state.anchors.positions[rows], camera), view.source,
        view.opacities, gradients.means_px, camera.width, camera.height,
    ))  # fmt: skip
    return len(rows), len(view.source)


def decoded(surroundings: FrozenAnchors, camera: Camera) -> OrderedSplats:
    """What lies around a block, as the view sees it."""
    anchors, weights = surroundings.anchors, surroundings.decoder.weights_for_image(0)
    return decode_anchors_for_training(anchors, cull_anchors(anchors, camera), weights, camera)


def prepare(
    visible: int, width: int, height: int, hidden: int = 0, device: torch.device | None = None
) -> tuple[Any, Camera, torch.Tensor]:
    device = device or torch.device("cpu")
    anchors, camera = scene(visible, width, height, hidden)
    anchors = anchors.to(device)
    decoder = Decoder.init_random(10, False, 0, 1, torch.Generator().manual_seed(0)).to(device)
    nothing: Any = None  # no photographs: a random target instead
    state = initial_state(
        anchors,
        decoder,
        TrainingProblem(config=TrainConfig(), images=nothing, num_images=1, voxel_size=1.0, camera_height=1.0),
    )
    target = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    return state, camera, target.to(device)


def cut(state: Any, own: float) -> tuple[Any, FrozenAnchors]:
    """The training of the leftmost share of the anchors, and the others, which stay."""
    x = state.anchors.positions[:, 0]
    left = x < torch.quantile(x, own)
    nothing: Any = None
    block = initial_state(
        state.anchors.select(left),
        state.decoder,
        TrainingProblem(config=TrainConfig(), images=nothing, num_images=1, voxel_size=1.0, camera_height=1.0),
    )
    return block, FrozenAnchors(state.anchors.select(~left), state.decoder.copy())


def measure(visible: int, width: int, height: int, repeats: int, own: float) -> None:
    state, camera, target = prepare(visible, width, height)
    surroundings = None
    if own < 1:
        state, surroundings = cut(state, own)
    times: dict[str, list[float]] = {phase: [] for phase in PHASES}
    for step in range(1, repeats + 4):
        seen, splats = one_step(state, camera, target, step, times, surroundings=surroundings)
    medians = {phase: stats.median(values[3:]) for phase, values in times.items()}
    total = stats.median(sum(step) for step in zip(*(values[3:] for values in times.values()), strict=True))
    parts = "  ".join(f"{phase} {value:.1f}" for phase, value in medians.items())
    print(f"{width}x{height}  {seen} visible anchors, {splats} splats: {total:.1f} ms a step   ({parts})", flush=True)


def measure_run(path: Path, repeats: int) -> None:
    """Median processor time of each phase of a step that continues the coarse model of a run."""
    opened = open_run(path, "coarse")
    views = opened.capture.train_views
    chosen = sorted({round(i) for i in np.linspace(0, len(views) - 1, 9)})
    with ImageCache([views[i] for i in chosen], 1 << 30, downscales=(1,)) as images:
        problem = TrainingProblem(
            config=TrainConfig(), images=images, num_images=len(chosen), voxel_size=1.0, camera_height=1.0
        )
        state = initial_state(opened.model.anchors, opened.model.decoder.copy(), problem)
        times: dict[str, list[float]] = {phase: [] for phase in PHASES}
        for step in range(1, repeats * len(chosen) + 1):
            camera, (target, _) = images.camera(step % len(chosen)), images.get(step % len(chosen))
            one_step(state, camera, target, step, times, clock=time.process_time)
    print(f"{path}: {len(opened.model.anchors):,} anchors, {views[0].camera.width}x{views[0].camera.height}")
    print("  ".join(f"{phase} {stats.median(values):.1f}" for phase, values in times.items()), "ms of processor time")
    for i in chosen[:: len(chosen) // 2]:
        print_counts(opened.model, views[i].camera)


def print_counts(model: AnchorModel, camera: Camera) -> None:
    """What the rasterizer does with one view."""
    rows, splats = decode_view(model, camera)
    image, alpha = torch.empty(camera.height, camera.width, 3), torch.empty(camera.height, camera.width)
    counts = get_extension().rasterize_forward(
        *(t.contiguous().numpy() for t in splats.tensors), (0.0, 0.0, 0.0), camera.width, camera.height,
        image.numpy(), alpha.numpy(), None, None, True,
    ).statistics  # fmt: skip
    pairs = counts["pairs"] / (camera.width * camera.height)
    print(f"  a view: {len(rows):,} anchors, {counts}, {pairs:.1f} pairs a pixel, alpha {float(alpha.mean()):.4f}")


def peaks(visible: int, hidden: int) -> tuple[int, int, int]:
    """Bytes of a fresh process: once all is imported, at most during three steps, and what saving adds after them."""
    args = [sys.executable, "-m", "experiments.microbench.step", "--peak", str(visible), str(hidden)]
    imported, steps, saving = subprocess.run(args, check=True, capture_output=True, text=True).stdout.split()
    return int(imported), int(steps), int(saving)


def print_peaks(visible: int, hidden: int) -> None:
    imported = peak_memory_bytes()
    state, camera, target = prepare(visible, 400, 300, hidden)
    for step in range(1, 4):
        one_step(state, camera, target, step, {phase: [] for phase in PHASES})
    steps = peak_memory_bytes()
    reset_peak_memory()
    before = peak_memory_bytes()
    with tempfile.TemporaryDirectory() as folder:
        save_checkpoint(Path(folder), to_checkpoint(state))
    print(imported, steps, peak_memory_bytes() - before)


def report_memory(step: int = 100_000) -> None:
    imported, base, saving = peaks(step, 0)
    in_view = (peaks(2 * step, 0)[1] - base) / step
    out_of_view = (peaks(step, 4 * step)[1] - base) / (4 * step)
    half = (peaks(step, step)[1] - imported) / (2 * step)
    print(f"memory: {in_view:.0f} B for each anchor in view, {out_of_view:.0f} B for each out of view")
    print(f"        {half:.0f} B an anchor where half of {2 * step:,} are in view: the whole process but its imports")
    print(f"        {saving / step:.0f} B an anchor more while a state is saved ({saving / 1e6:.1f} MB)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--visible", type=int, default=20_000)
    parser.add_argument("--own", type=float, default=1.0)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--peak", type=int, nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.peak:
        print_peaks(*arguments.peak)
        return
    set_num_threads(arguments.threads)
    print(describe())
    if arguments.run:
        measure_run(arguments.run, arguments.repeats)
        return
    for width, height in ((400, 300), (800, 600)):
        measure(arguments.visible, width, height, arguments.repeats, arguments.own)
    if arguments.own == 1:
        report_memory()


if __name__ == "__main__":
    main()
