"""Which pairs of splat and pixel a trained view could do without: shares of the pairs, and of their weight in the image,
that lie behind a transmittance, below an alpha, or below a weight.

    python -m experiments.reports.analyses.pair_weights RUN [--view 16]

Six windows of 48 x 48 pixels of one training view, blended by the twin's arithmetic.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from vdgs.kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from vdgs.kernels.kernel_types import Splats
from vdgs.model.renderer import decode_view
from vdgs.runs.open_run import open_run

WINDOW_PX, REACH_PX = 48, 60
#: Windows begin at these shares of the width and the height.
PLACES = ((0.12, 0.18), (0.48, 0.46), (0.72, 0.72), (0.3, 0.76), (0.84, 0.15), (0.46, 0.1))


def blended_pairs(splats: Splats, left: float, top: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Alpha of each contributing pair of a window, and the transmittance before it."""
    middle = torch.tensor([left, top]) + WINDOW_PX / 2
    near = ((splats.means_px - middle).abs().amax(1) < WINDOW_PX / 2 + REACH_PX).nonzero()[:, 0]
    near = near[torch.argsort(splats.depths[near], stable=True)]
    steps = torch.arange(WINDOW_PX) + 0.5
    pixels = torch.stack(torch.meshgrid(steps + left, steps + top, indexing="xy"), -1).reshape(-1, 2)
    d = pixels[None] - splats.means_px[near][:, None]
    a, b, c = (conic[:, None] for conic in splats.conics[near].unbind(1))
    quadratic = a * d[..., 0] ** 2 + 2 * b * d[..., 0] * d[..., 1] + c * d[..., 1] ** 2
    alpha = (splats.opacities[near][:, None] * torch.exp(-0.5 * quadratic)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha < ALPHA_MIN, 0.0, alpha)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    drawn = (alpha > 0) & (after >= TRANSMITTANCE_MIN)
    return alpha[drawn], before[drawn]


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--view", type=int, default=16)
    arguments = parser.parse_args()
    opened = open_run(arguments.run, "coarse")
    camera = opened.capture.train_views[arguments.view].camera
    _, splats = decode_view(opened.model, camera)
    corners = [(int(x * camera.width), int(y * camera.height)) for x, y in PLACES]
    found = [blended_pairs(splats, *corner) for corner in corners]
    alpha, before = (torch.cat(part) for part in zip(*found, strict=True))
    weight = alpha * before
    print(f"{len(alpha) / (len(PLACES) * WINDOW_PX**2):.1f} pairs a pixel")
    limits = {"transmittance before": (before, (0.1, 0.05, 0.02, 0.01, 0.004, 0.001)),
              "alpha": (alpha, (1 / 128, 1 / 64, 1 / 32, 0.1)), "weight": (weight, (0.001, 0.004, 0.01))}  # fmt: skip
    for name, (values, steps) in limits.items():
        for step in steps:
            below = values < step
            share = f"{float(below.float().mean()):.3f} of the pairs, {float(weight[below].sum() / weight.sum()):.4f}"
            print(f"{name} < {step:.4f}: {share} of the weight")
    print("opacity, quartiles:", torch.quantile(splats.opacities, torch.tensor([0.25, 0.5, 0.75])).tolist())


if __name__ == "__main__":
    main()
