"""Train a small capture in Python, without a run folder, and save the scene.

python examples/04_train_a_capture.py CAPTURE OUTPUT [ITERATIONS]
"""

import math
import sys
from dataclasses import replace
from pathlib import Path

import vdgs


def main(capture_folder: str, output: str, iterations: str = "3000") -> None:
    capture = vdgs.load_capture(capture_folder)
    print(f"{len(capture.train_views)} training views, {len(capture.points)} sparse points")

    # Settings are frozen dataclasses: begin with a preset, and replace what is to differ.
    settings = vdgs.preset("laptop")
    training = replace(settings.training, iterations=int(iterations))
    block = replace(settings.block, iterations=max(1, int(iterations) // 4))
    settings = replace(settings, training=training, block=block, partition=replace(settings.partition, blocks=2))

    def show(event) -> None:
        if event.iteration % max(1, event.iterations // 5) == 0:
            psnr = "" if math.isnan(event.psnr) else f"{event.psnr:.1f} dB, "  # measured every tenth iteration
            print(f"{event.stage}: {event.iteration} of {event.iterations}, {psnr}{event.anchors} anchors")

    scene = vdgs.train(capture, settings, callbacks=[show])
    path = Path(output) / "scene.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    scene.save(path)
    print(f"{len(scene):,} anchors: {path}. Read it again with vdgs.Scene.load(path, capture)")


if __name__ == "__main__":
    main(*sys.argv[1:])
