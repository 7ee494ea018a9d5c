"""Compensated growth in a loop of one's own: gsplat's parameters, optimizers and hooks, trained on a capture.

python examples/06_compensated_growth.py CAPTURE [STEPS]
"""

import sys

import numpy as np
import torch
from PIL import Image

import vdgs


def main(capture_folder: str, steps: str = "2000") -> None:
    capture = vdgs.load_capture(capture_folder)
    views = capture.train_views
    images = [torch.from_numpy(np.array(Image.open(view.image_path).convert("RGB"))) for view in views]
    points = torch.from_numpy(capture.points).float()
    spacing = torch.cdist(points[:1000], points).topk(2, largest=False).values[:, 1].median()
    n, extent = len(points), float((points - points.mean(0)).norm(dim=1).max())

    rgb = torch.from_numpy(capture.point_colors).float() / 255
    params = torch.nn.ParameterDict({
        "means": points, "scales": spacing.log().expand(n, 3).clone(), "quats": torch.tensor([[1.0, 0, 0, 0]] * n),
        "opacities": torch.full((n,), 0.1).logit(), "colors": rgb.clamp(0.01, 0.99).logit(),
    })  # fmt: skip
    rates = {"means": 1e-4 * extent, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "colors": 1e-2}
    optimizers = {name: torch.optim.Adam([params[name]], lr=rate) for name, rate in rates.items()}
    # A Gaussian that fewer than a fifth of a cycle's images show is compensated for (T_low).
    strategy = vdgs.CompensatedGrowth(
        refine_start_iter=100, refine_every=50, compensation=vdgs.CompensationConfig(t_low=0.2), verbose=True
    )
    strategy.check_sanity(params, optimizers)
    state, random = strategy.initialize_state(scene_scale=extent), np.random.default_rng(0)
    for step in range(1, int(steps) + 1):
        index = int(random.integers(len(views)))
        camera = views[index].camera
        K = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]).float()
        picture, _, info = vdgs.ops.rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            params["colors"].sigmoid(), torch.from_numpy(camera.camera_from_world).float()[None], K[None],
            camera.width, camera.height,
        )  # fmt: skip
        loss = vdgs.ops.photometric_loss(picture[0], images[index]).loss
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss.backward()
        strategy.step_post_backward(params, optimizers, state, step, info)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
    print(f"{n} points became {len(params['means'])} Gaussians; loss {loss.item():.3f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
