"""How long the export of a large scene takes, and how much memory: a synthetic model of many anchors.

    export OMP_WAIT_POLICY=PASSIVE
    python -m experiments.microbench.export --anchors 20000 60000 200000 [--output a.ply b.spz]
    python -m experiments.microbench.export --anchors 1000000 --folder /large/disk --no-evaluate

Each anchor has 10 Gaussians; there are as many photographs to an anchor as in a real flight (one for 1600), 400 x 300
pixels, and a place is seen by about ten. Every size runs in a process of its own. Seconds are wall clock and processor
time of the whole; the exponents are those between the first and the last size (1: in proportion). Peak memory counts
pages of the temporary file as far as they lie in memory.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from rich.console import Console

from vdgs.captures.capture import Capture, View
from vdgs.config.commands import ExportRequest
from vdgs.export.export_run import export_run, resolve_request
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.kernels import get_backend, get_num_threads, set_num_threads
from vdgs.kernels.kernel_types import FEATURE_SIZE
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.runs.open_run import OpenedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StatusRecord

OFFSETS, ANCHORS_PER_VIEW, SEEN_BY, SPACING = 10, 1600, 10, 1.0
WIDTH, HEIGHT = 400, 300
#: Test views, whose photographs are gray: what they show does not matter here.
TESTED = 40


def synthetic_flight(anchors: int) -> tuple[AnchorModel, list[Camera]]:
    """Anchors on a square of ground, one in each unit, in the order in which training leaves them, and a flight above
    that looks straight down."""
    side = math.ceil(math.sqrt(anchors))
    generator = torch.Generator().manual_seed(0)
    row, column = torch.arange(anchors) // side, torch.arange(anchors) % side
    positions = torch.stack([column, row, torch.rand(anchors, generator=generator)], 1).float() * SPACING
    positions = positions[get_backend(positions.device).morton_order(positions)]
    log_scales = torch.randn(anchors, 6, generator=generator) * 0.2 + math.log(0.7 * SPACING)
    tensors = Decoder.init_random(OFFSETS, True, 0, 0, generator).tensors()
    # Every Gaussian is drawn, and none hides all behind it.
    tensors["opacity_w2"].zero_()
    tensors["opacity_b2"].fill_(0.2)
    model = AnchorModel(
        anchors=Anchors(positions, torch.randn(anchors, FEATURE_SIZE, generator=generator),
                0.4 * torch.randn(anchors, OFFSETS, 3, generator=generator), log_scales),
        decoder=Decoder.from_tensors(tensors), voxel_size=SPACING, background=(0.5, 0.5, 0.5),
    )  # fmt: skip
    count = max(4, anchors // ANCHORS_PER_VIEW)
    # A picture holds SEEN_BY / count of the ground: its width at 4 to 3, from one focal length of 400 pixels.
    width = math.sqrt(4 / 3 * SEEN_BY * ANCHORS_PER_VIEW) * SPACING
    along = max(1, round(math.sqrt(count)))
    places = (np.stack(np.meshgrid(np.arange(along), np.arange(math.ceil(count / along))), -1).reshape(-1, 2)[:count]
              + 0.5) * side * SPACING / [along, math.ceil(count / along)]  # fmt: skip
    cameras = []
    for x, y in places:
        rotation = np.diag([1.0, -1.0, -1.0])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ np.array([x, y, width])
        cameras.append(
            Camera(
                camera_from_world=matrix, fx=WIDTH, fy=WIDTH, cx=WIDTH / 2, cy=HEIGHT / 2, width=WIDTH, height=HEIGHT
            )
        )
    return model, cameras


def one(anchors: int, folder: Path, names: list[str], measure: bool) -> None:
    """Export one size and print what it took, as JSON."""
    model, cameras = synthetic_flight(anchors)
    photograph = folder / "gray.png"
    Image.new("RGB", (WIDTH, HEIGHT), (128, 128, 128)).save(photograph)
    every = max(4, len(cameras) // TESTED)
    views = tuple(
        View(
            name=f"{i:05d}.png",
            camera=camera,
            image_path=photograph,
            mask_path=None,
            split="test" if i % every == 0 else "train",
        )
        for i, camera in enumerate(cameras)
    )
    ground = GroundFrame(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description="synthetic", origin_geo=None
    )
    capture = Capture(
        root=folder, source="synthetic", images=".", views=views, points=np.zeros((1, 3)),
        point_colors=np.zeros((1, 3), np.uint8), ground=ground,
    )  # fmt: skip
    file = folder / "run" / "coarse" / "model.safetensors"
    model.save(file)
    run = OpenedRun(
        folder=RunFolder(folder / "run"), model=model, model_path=file, name="coarse", status=StatusRecord(), key="key",
        warning="", capture=capture,
    )  # fmt: skip
    set_num_threads(get_num_threads())
    began, before = time.monotonic(), time.process_time()
    args = ExportRequest(
        run=folder / "run", output=tuple(folder / name for name in names), evaluate=measure, device="cpu"
    )
    record = export_run(run, resolve_request(args), Console(quiet=True))
    print(json.dumps({
        "anchors": anchors, "gaussians": record["gaussians"], "views": len(cameras),
        "seconds": time.monotonic() - began, "processor": time.process_time() - before,
        "baking": record["seconds_to_bake"], "bytes": sum(each["bytes"] for each in record["files"]),
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }))  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--anchors", type=int, nargs="+", default=[20_000, 60_000])
    parser.add_argument("--output", nargs="+", default=["scene.ply"])
    parser.add_argument("--folder", type=Path, default=None, help="where files are written for a while")
    parser.add_argument("--evaluate", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        one(args.anchors[0], args.folder, args.output, args.evaluate)
        return
    rows = []
    for anchors in args.anchors:
        with tempfile.TemporaryDirectory(dir=args.folder) as folder:
            command = [
                sys.executable,
                "-m",
                "experiments.microbench.export",
                "--one",
                "--anchors",
                str(anchors),
                "--folder",
                folder,
            ]
            command += ["--output", *args.output, "--evaluate" if args.evaluate else "--no-evaluate"]
            row = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout.splitlines()[-1])
        rows.append(row)
        print(
            f"{row['anchors']:9,} anchors, {row['gaussians']:10,} Gaussians, {row['views']:4} views: "
            f"{row['seconds']:.1f} s (baking {row['baking']:.1f}), processor {row['processor']:.1f} s, "
            f"{row['memory'] / 1e9:.2f} GB, files {row['bytes'] / 1e9:.2f} GB",
            flush=True,
        )
    if len(rows) > 1:
        first, last = rows[0], rows[-1]
        times = last["gaussians"] / first["gaussians"]
        exponents = (
            f"{what} {math.log(last[what] / first[what]) / math.log(times):.2f}" for what in ("processor", "memory")
        )
        print("exponents: " + ", ".join(exponents))


if __name__ == "__main__":
    main()
