"""Open a run and draw its first test view, with depth.

python examples/01_open_and_render.py RUN OUTPUT
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import vdgs


def main(run_folder: str, output: str) -> None:
    run, folder = vdgs.open_run(run_folder), Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    view = (run.capture.test_views or run.capture.train_views)[0]
    print(f"{len(run.scene):,} anchors; {view.name}: {view.camera.width}x{view.camera.height} pixels")

    out = vdgs.render(run.scene, view.camera, mode="rgb+depth")
    picture = (out.rgb.clamp(0, 1) * 255).round().byte().numpy()
    Image.fromarray(picture).save(folder / "view.png")

    # Depth is NaN where the scene is not half opaque.
    depth = out.depth.numpy()
    low, high = np.nanpercentile(depth, [2, 98])
    gray = np.nan_to_num((depth - low) / max(high - low, 1e-6)).clip(0, 1)
    Image.fromarray((255 * gray).astype(np.uint8)).save(folder / "depth.png")
    print(f"depth {low:.1f} to {high:.1f} {run.capture.ground.unit}; {folder}/view.png and depth.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
