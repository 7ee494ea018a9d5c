"""Cut the scene of a run into blocks, by place and visibility, and choose the cameras of each.

python examples/03_partition_and_assign.py RUN [NUM_BLOCKS]
"""

import sys

import numpy as np

import vdgs


def main(run_folder: str, num_blocks: str = "2") -> None:
    # The cut is made of the coarse scene: blocks are trained from it.
    scene = vdgs.open_run(run_folder, model="coarse").scene
    visibility = vdgs.count_visibility(scene.positions, scene.cameras)
    blocks = vdgs.partition(scene.positions, visibility, num_blocks=int(num_blocks), lambda_vis=1.0, seed=0)

    # Every block needs ten cameras or more, as far as so many see it.
    settings = vdgs.AssignmentConfig(min_cameras=10)
    assignment = vdgs.assign_cameras(scene, blocks, scene.cameras, settings)

    owner = blocks.owner(scene.positions.double().numpy()[:, :2])
    reasons = ("", "score", "best block", "topped up")
    for index, block in enumerate(blocks.items):
        why = assignment.reasons[:, index]
        counts = ", ".join(f"{np.sum(why == number)} by {reasons[number]}" for number in (1, 2, 3))
        print(
            f"block {index}: {np.sum(owner == index)} anchors on {block.core.area:.0f} square units, "
            f"{assignment.cameras[:, index].sum()} cameras ({counts})"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
