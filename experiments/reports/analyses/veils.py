"""Whether some blocks of a run hang before the ground of others.

    python -m experiments.reports.analyses.veils RUN --blocks 0 5

Draws the anchors of these blocks alone, on the test views, with the coarse and with the merged model, and prints their
mean alpha over pixels that look at ground (height 0) of other blocks.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from experiments.microbench.machine import describe

from vdgs.model.anchor_model import AnchorModel
from vdgs.model.render import render
from vdgs.partition.blocks import Blocks, places_of
from vdgs.runs.open_run import blocks_of
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import open_capture, open_model


def alone(model: AnchorModel, blocks: Blocks, chosen: list[int]) -> AnchorModel:
    """The anchors of some blocks, of a model whose anchors have one decoder."""
    if len(model.decoder_ranges()) != 1:
        raise SystemExit("this model has several decoders: run with --block.decoder frozen")
    own = np.isin(blocks.owner(places_of(model.anchors.positions)), chosen)
    return replace(model, anchors=model.anchors.select(torch.from_numpy(own).nonzero()[:, 0]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--blocks", type=int, nargs="+", required=True)
    arguments = parser.parse_args()
    print(describe())
    run = RunFolder(arguments.run)
    blocks, cameras = blocks_of(run), [view.camera for view in open_capture(run).test_views]
    for name in ("coarse", "merged"):
        model = alone(open_model(run, name).model, blocks, arguments.blocks)
        found = []
        for camera in cameras:
            rays = camera.unproject(np.ones((camera.height, camera.width))) - camera.position
            ground = camera.position - rays * (camera.position[2] / rays[..., 2])[..., None]
            owner = blocks.owner(ground[..., :2].reshape(-1, 2)).reshape(ground.shape[:2])
            found.append(render(model, camera).alpha.numpy()[~np.isin(owner, arguments.blocks)])
        pixels = np.concatenate(found)
        print(f"{name}: alpha {pixels.mean():.3f} over {len(pixels):,} pixels of other blocks' ground")


if __name__ == "__main__":
    main()
