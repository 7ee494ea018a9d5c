"""A large scene for measurements: copies of a trained run side by side, as a run of its own.

    python -m experiments.microbench.lod_copies RUN FOLDER --anchors 10000000 --keep-views 8

FOLDER/capture is a capture in the format of nerfstudio whose photographs are links to those of RUN's capture, of which
every `--keep-views`-th is taken with each copy; FOLDER/run is the run, with one merged model of all copies. The memory
that this takes is about twice the size of the model.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.formats.ply_reader import GRAY
from vdgs.captures.georeference import LOCAL_FRAME
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.runs.open_run import OpenedRun, open_capture, open_run
from vdgs.runs.run_cameras import save_run_cameras
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import write_json
from vdgs.system.tensors import file_id

#: Axes of cameras: OpenGL's from OpenCV's.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
#: Parts of a run that say nothing of its copies.
LEFT_OUT = ("maps", "evaluation", "lod", "export", "visibility", "report.html", "scene.html", ".run", ".lock")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--anchors", type=int, default=1_000_000)
    parser.add_argument("--keep-views", type=int, default=8)
    options = parser.parse_args()
    opened = open_run(options.run, "merged")
    count = max(1, round(options.anchors / len(opened.model.anchors)))
    offsets = copy_offsets(opened.model, count)
    write_capture(options.folder / "capture", opened, offsets, options.keep_views)
    write_run(options.folder, opened, offsets)
    print(f"{options.folder / 'run'}: {count} copies, {count * len(opened.model.anchors):,} anchors")


def copy_offsets(model: AnchorModel, count: int) -> np.ndarray:
    """Where the copies lie: in a square, as far apart as all but the outermost hundredth of the anchors reach."""
    low, high = np.quantile(model.anchors.positions[:, :2].numpy(), (0.01, 0.99), axis=0)
    side = int(np.ceil(np.sqrt(count)))
    cells = np.stack([np.arange(count) % side, np.arange(count) // side], 1) - (side - 1) / 2
    return np.concatenate([cells * (high - low), np.zeros((count, 1))], 1).round(3)


def write_capture(folder: Path, opened: OpenedRun, offsets: np.ndarray, keep: int) -> None:
    """The photographs of all copies, as links, with their cameras."""
    (folder / "images").mkdir(parents=True)
    frames, names_of = [], {"train": list[str](), "test": list[str]()}
    for number, offset in enumerate(offsets):
        for view in opened.capture.views[number % keep :: keep]:
            name = f"images/{number:04d}_{Path(view.name).name}"
            os.link(view.image_path.resolve(), folder / name)
            pose = np.linalg.inv(view.camera.camera_from_world)
            pose[:3, 3] += offset
            camera = view.camera
            frames.append(
                {
                    "file_path": name, "transform_matrix": (pose @ FLIP).tolist(), "fl_x": camera.fx, "fl_y": camera.fy,
                    "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height,
                }
            )  # fmt: skip
            names_of[view.split].append(name)
    chosen = opened.capture.points[:: max(1, len(opened.capture.points) * len(offsets) // 200_000)]
    points = np.concatenate([chosen + offset for offset in offsets])
    with (folder / "points.ply").open("wb") as file:
        names = "".join(f"property float {axis}\n" for axis in "xyz") + "".join(
            f"property uchar {color}\n" for color in ("red", "green", "blue")
        )
        file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}end_header\n".encode())
        rows = np.zeros(len(points), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
        rows["xyz"], rows["rgb"] = points, GRAY
        file.write(rows.tobytes())
    content = {"frames": frames, "ply_file_path": "points.ply"}
    content |= {f"{split}_filenames": names for split, names in names_of.items()}
    (folder / "transforms.json").write_text(json.dumps(content))
    (folder / "georef.json").write_text(json.dumps({"frame": LOCAL_FRAME}))


def write_run(folder: Path, opened: OpenedRun, offsets: np.ndarray) -> None:
    """A run that holds one merged model of all copies."""
    run = RunFolder(folder / "run")
    shutil.copytree(opened.folder.path, run.path, ignore=shutil.ignore_patterns(*LEFT_OUT))
    settings = opened.folder.settings()
    run.config.write(replace(settings, capture_path=str((folder / "capture").resolve())), None)
    capture = open_capture(run)
    assert capture.ground.scale == 1, capture.ground
    assert np.allclose(capture.ground.rotation, np.eye(3)), capture.ground
    model = copied(opened.model, offsets + capture.ground.translation)
    run.merged.model.unlink()
    metadata = replace(opened.model.metadata, capture=capture_metadata(capture))
    replace(model, metadata=metadata).save(run.merged.model)
    run.merged.set_status(
        replace(opened.folder.merged.status(), anchors=len(model.anchors), model_id=file_id(run.merged.model))
    )
    write_json(run.capture_file, capture_metadata(capture))
    save_run_cameras(run, capture)


def copied(model: AnchorModel, offsets: np.ndarray) -> AnchorModel:
    """All copies of a model; anchors of one decoder stand together."""
    rows = [torch.arange(first, last) for first, last, _ in model.decoder_ranges()]
    order = torch.cat([part.repeat(len(offsets)) for part in rows])
    moved = torch.from_numpy(offsets.astype(np.float32))
    shifts = torch.cat([moved.repeat_interleave(len(part), 0) for part in rows])
    anchors = {name: tensor[order] for name, tensor in model.anchors.tensors().items()}
    anchors["positions"] += shifts
    spans = tuple(replace(span, count=span.count * len(offsets)) for span in model.decoder_spans)
    return replace(model, anchors=Anchors(**anchors), decoder_spans=spans)


if __name__ == "__main__":
    main()
