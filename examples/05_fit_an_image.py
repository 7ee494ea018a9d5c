"""Fit Gaussians to an image with `vdgs.ops.rasterization`: gsplat's signature, on a CPU.

python examples/05_fit_an_image.py OUTPUT [STEPS] [IMAGE]
"""

import math
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from vdgs.ops import rasterization


def load_target(image: str | None, side: int = 128) -> torch.Tensor:
    if image is not None:
        picture = Image.open(image).convert("RGB").resize((side, side))
        return torch.from_numpy(np.array(picture)).float() / 255
    target = torch.ones(side, side, 3)
    target[: side // 2, : side // 2] = torch.tensor([1.0, 0.0, 0.0])
    target[side // 2 :, side // 2 :] = torch.tensor([0.0, 0.0, 1.0])
    return target


def main(output: str, steps: str = "300", image: str | None = None, count: int = 1000) -> None:
    torch.manual_seed(0)
    target = load_target(image)
    height, width, _ = target.shape
    means = 4 * (torch.rand(count, 3) - 0.5)
    quats, scales = torch.randn(count, 4), torch.rand(count, 3) * 0.2
    opacities, colors = torch.zeros(count), torch.rand(count, 3)
    trained = [tensor.requires_grad_() for tensor in (means, quats, scales, opacities, colors)]
    # A camera that looks along z from four units before the Gaussians, with a view of 53 degrees.
    viewmat, focal = torch.eye(4), width / (2 * math.tan(math.radians(53) / 2))
    viewmat[2, 3] = 4.0
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    optimizer = torch.optim.Adam(trained, lr=0.02)
    for step in range(int(steps)):
        picture, _, meta = rasterization(
            means, quats, scales, opacities.sigmoid(), colors.sigmoid(), viewmat[None], K[None], width, height
        )
        loss = torch.nn.functional.mse_loss(picture[0], target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 0 or step + 1 == int(steps):
            print(f"step {step}: {-10 * loss.log10().item():.1f} dB, {len(meta['gaussian_ids'])} Gaussians drawn")
    Path(output).mkdir(parents=True, exist_ok=True)
    Image.fromarray((picture[0].detach().clamp(0, 1) * 255).byte().numpy()).save(Path(output) / "fitted.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
