"""Count how many cameras see each anchor of a run, and plot the map of V and its distribution.

python examples/02_count_visibility.py RUN OUTPUT
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import vdgs


def main(run_folder: str, output: str) -> None:
    scene, folder = vdgs.open_run(run_folder).scene, Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    points = scene.positions.numpy()
    # numpy in, numpy out; torch in, torch out.
    visibility = vdgs.count_visibility(points, scene.cameras)
    share = vdgs.visibility_ratio(points, scene.cameras)
    print(f"{len(scene.cameras)} cameras; V is {np.median(visibility):.0f} at the median anchor")
    print(f"{np.mean(share < 0.2):.0%} of the anchors are seen by less than a fifth of the cameras")

    figure, (place, counts) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    drawn = place.scatter(points[:, 0], points[:, 1], c=visibility, s=4)
    place.plot(*np.array([camera.position[:2] for camera in scene.cameras]).T, "r+")
    place.set(title="V of anchors, and cameras (+)", aspect="equal")
    figure.colorbar(drawn, ax=place)
    counts.hist(visibility, bins=np.arange(visibility.max() + 2) - 0.5)
    counts.set(xlabel="V", ylabel="anchors")
    figure.savefig(folder / "visibility.png")
    plt.close(figure)


if __name__ == "__main__":
    main(*sys.argv[1:])
