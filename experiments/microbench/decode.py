"""How long culling and decoding take, and their derivative: native kernels beside the torch twin.

    OMP_WAIT_POLICY=PASSIVE python -m experiments.microbench.decode [--anchors 20000 100000] [--isa avx512 avx2]

The best of the repeats, which on a busy machine says more than the median; ns are per visible anchor
(cull: per anchor of the model). Forward and backward are those of the public function, autograd included.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from unittest import mock

import numpy as np
import torch

from vdgs.geometry.camera import Camera
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.cull import cull as native_cull
from vdgs.kernels.cpu.decode import decode as native_decode
from vdgs.kernels.kernel_types import AnchorSplats, DecoderWeights
from vdgs.kernels.torch_ref.cull import cull as twin_cull
from vdgs.kernels.torch_ref.decode import decode as twin_decode


def overhead_camera() -> Camera:
    """800 x 600 from ten units above the ground."""
    camera_from_world = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 10], [0, 0, 0, 1]])
    return Camera(camera_from_world=camera_from_world, fx=800.0, fy=800.0, cx=400.0, cy=300.0, width=800, height=600)


def scene(v: int, k: int, frozen: bool = False) -> tuple:
    """Anchors on the ground within the picture, half of their splats opaque."""
    g = torch.Generator().manual_seed(0)
    positions = (2 * torch.rand(v, 3, generator=g) - 1) * torch.tensor([4.5, 3.3, 0.3])
    features = torch.randn(v, 32, generator=g)
    offsets = 0.5 * torch.randn(v, k, 3, generator=g)
    log_scales = 0.3 * torch.randn(v, 6, generator=g) - 3.5
    weights = DecoderWeights.random(k, False, g).map(lambda t: t.requires_grad_(not frozen))
    return positions, *(t.requires_grad_() for t in (features, offsets, log_scales)), weights


def best_ms(run: Callable[[], object], repeats: int) -> float:
    """Least wall time of `run` after one warm-up."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times)


def decode_times(decode: Callable[..., AnchorSplats], arguments: tuple, repeats: int) -> tuple[float, float, int]:
    """Forward ms, backward ms (of the decoder alone), and how many splats came out."""
    camera = overhead_camera()
    splats = decode(*arguments, camera)
    names = ("means_px", "conics", "depths", "colors", "opacities", "volumes")
    outputs = [getattr(splats, name) for name in names]
    gradients = [torch.randn_like(t) for t in outputs]
    *tensors, weights = arguments
    leaves = [t for t in (*tensors, *weights.tensors()) if t.requires_grad]
    forward = best_ms(lambda: decode(*arguments, camera), repeats)
    backward = best_ms(lambda: torch.autograd.grad(outputs, leaves, gradients, retain_graph=True), repeats)
    return forward, backward, len(splats.source)


def report_decode(v: int, k: int, repeats: int, isas: list[str]) -> None:
    """One line per implementation, number of threads and frozen or free decoder."""
    for frozen in (False, True):
        arguments = scene(v, k, frozen)
        for threads in (1, 2):
            torch.set_num_threads(threads)
            rows = [("torch twin", twin_decode, None, max(3, repeats // 5))]
            rows += [(f"native {isa}", native_decode, isa, repeats) for isa in isas]
            for name, decode, isa, n in rows:
                if isa:
                    use(isa, threads)
                forward, backward, m = decode_times(decode, arguments, n)
                print(
                    f"{v:7d} anchors, {m:7d} splats, {'frozen' if frozen else 'free  '} decoder, "
                    f"{threads} thread(s), {name:16s} "
                    f"forward {forward:7.2f} ms ({1e6 * forward / v:5.0f} ns)   "
                    f"backward {backward:7.2f} ms ({1e6 * backward / v:5.0f} ns)   "
                    f"both {forward + backward:7.2f} ms"
                )


def use(isa: str, threads: int) -> None:
    """Run the kernels of one instruction set on so many threads."""
    chosen = extension.load_extension(isa)
    chosen.set_threads(threads)
    mock.patch.object(extension, "get_extension", return_value=chosen).start()


def report_cull(n: int, isas: list[str]) -> None:
    """A model of n anchors of which the camera sees a part, sorted along a curve as models are."""
    g = torch.Generator().manual_seed(1)
    positions = (2 * torch.rand(n, 3, generator=g) - 1) * torch.tensor([12.0, 12.0, 0.3])
    cells = (positions[:, :2] * 4).floor()
    order = torch.from_numpy(np.lexsort((cells[:, 0].numpy(), cells[:, 1].numpy())))
    positions, log_scales = positions[order].contiguous(), 0.3 * torch.randn(n, 6, generator=g) - 3.5
    for name, camera in (
        ("part in view", overhead_camera()),
        ("oblique", replace(overhead_camera(), cx=-300.0)),
    ):
        seen = len(twin_cull(positions, log_scales, camera))
        for threads in (1, 2):
            torch.set_num_threads(threads)
            times = [("torch twin", best_ms(lambda c=camera: twin_cull(positions, log_scales, c), 3))]
            for isa in isas:
                use(isa, threads)
                times.append((isa, best_ms(lambda c=camera: native_cull(positions, log_scales, c), 15)))
            listed = ", ".join(f"{label} {ms:.2f} ms ({1e6 * ms / n:.1f} ns)" for label, ms in times)
            print(f"cull {n} anchors, {name} ({seen} seen), {threads} thread(s): {listed}")


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anchors", type=int, nargs="*", default=[20_000, 100_000])
    parser.add_argument("--offsets", type=int, default=10)
    parser.add_argument("--isa", nargs="*", default=list(extension.supported_isas()))
    parser.add_argument("--cull", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    for v in options.anchors:
        report_decode(v, options.offsets, options.repeats, options.isa)
    if options.cull:
        report_cull(options.cull, options.isa)


if __name__ == "__main__":
    main()
