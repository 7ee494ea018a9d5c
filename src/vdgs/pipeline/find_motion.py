"""`--masks auto`: what moves between the training photographs, found by the coarse model, as masks for the blocks."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.console import Console

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import View
from vdgs.captures.image_cache import load_image
from vdgs.captures.image_files import decode_mask
from vdgs.evaluation.comparison_images import write_png
from vdgs.evaluation.moving_pixels import MAX_SHARE, Residual, make_residual, moving_pixels, overlapping_views
from vdgs.model.exposure import apply_exposure
from vdgs.model.renderer import render
from vdgs.runs.motion_masks import MOTION_EXAMPLES, MOTION_FILE, has_motion_masks, motion_folder, wants_motion_masks
from vdgs.runs.open_run import OpenedRun, check_has_anchors
from vdgs.runs.run_context import RunContext
from vdgs.system.atomic_files import write_array, write_bytes, write_json
from vdgs.system.console import show_share
from vdgs.system.documents import JsonObject

#: Photographs that the picture for people shows, those of which most moves, and the width of each.
EXAMPLES, EXAMPLE_WIDTH_PX = 6, 480


def find_run_motion(context: RunContext, console: Console, device: str = "cpu") -> None:
    """Write the masks of what moves (`runs.motion_masks`), or continue; nothing where they are there. Where the run
    does not want them any more they are deleted.

    RunError without a coarse model, CaptureError for a photograph that cannot be decoded, Stopped after Ctrl-C.
    """
    run = context.run
    if not wants_motion_masks(run):
        shutil.rmtree(motion_folder(run).path, ignore_errors=True)
        return
    if has_motion_masks(run):
        console.print(f"{run.path / MOTION_FILE}: already there; nothing to do", highlight=False)
        return
    with run.locked():
        opened, folder, key = context.open_model("coarse", device), motion_folder(run), run.keys().visibility
        check_has_anchors(run, len(opened.model.anchors))
        folder.reset_unless(key)
        views = opened.capture.train_views
        step = run.begin_step("coarse", "looking for what moves", "photographs", 2 * len(views))
        records = list[JsonObject]()
        with show_share(console, "looking for what moves") as show:
            for index, view in enumerate(views):
                _keep_residual(opened, index, view, _residual_file(folder.path, index))
                show(index + 1, 2 * len(views))
                step(index + 1)
            for index, view in enumerate(views):
                records.append(_mask_view(opened, index, view, folder.path))
                show(len(views) + index + 1, 2 * len(views))
                step(len(views) + index + 1)
        _write_examples(run.path / MOTION_EXAMPLES, views, records, folder.path)
        shares = [record["share"] for record in records if record["mask"] is not None]
        share = sum(shares) / len(views)
        write_json(run.path / MOTION_FILE, {"key": key, "share": share, "photographs": records})
        shutil.rmtree(folder.path / "residuals")
    masked, too_much = len(shares), [record["photograph"] for record in records if record["share"] > MAX_SHARE]
    console.print(
        f"masks auto: {share:.1%} of the training photographs moves, in {masked} of {len(views)}; the blocks leave it "
        f"out ({run.path / MOTION_EXAMPLES})" if masked else "masks auto: nothing moves in the training photographs",
        highlight=False,
    )  # fmt: skip
    if too_much:
        console.print(
            f"[yellow]note[/] {len(too_much)} photographs differ from the others in more than {MAX_SHARE:.0%} of their "
            f"pixels and are not masked, such as {too_much[0]}",
            highlight=False,
        )


def _residual_file(folder: Path, index: int) -> Path:
    return folder / "residuals" / f"{index:05d}.npy"


def _keep_residual(opened: OpenedRun, index: int, view: View, file: Path) -> None:
    """Compare a training photograph with its render, unless that was done before."""
    if file.exists():
        return
    with torch.no_grad():
        drawn = render(opened.model, view.camera, depth=True, image_index=index)
        exposure = opened.model.decoder.exposure_for_image(index)
        shown = drawn.image if exposure is None else apply_exposure(drawn.image, exposure)
        depth = drawn.median_depth
        if depth is None:  # of an implementation that cannot tell
            assert drawn.depth is not None
            depth = torch.where(drawn.alpha > 0.5, drawn.depth / drawn.alpha.clamp(min=1e-6), 0)
    picture = load_image(view)
    mask = None if picture.mask is None else picture.mask.numpy()
    found = make_residual(view.camera, picture.image.numpy(), mask, shown.cpu().numpy(), depth.cpu().numpy())
    scaled = found.depth / camera_height(opened.capture)  # in any unit within the range of 16 bits
    write_array(file, np.concatenate([found.difference, scaled[..., None]], axis=-1).astype(np.float16))


def _read_residual(opened: OpenedRun, index: int, folder: Path) -> Residual:
    values = np.load(_residual_file(folder, index), allow_pickle=False).astype(np.float32)
    height, width = values.shape[:2]
    camera = opened.capture.train_views[index].camera.resized(width, height)
    depth = values[..., 3] * camera_height(opened.capture)
    return Residual(camera, np.ascontiguousarray(values[..., :3]), np.ascontiguousarray(depth))


def _mask_view(opened: OpenedRun, index: int, view: View, folder: Path) -> JsonObject:
    """Find what moves in a view, write its mask where something does, and return its record."""
    cameras = [each.camera for each in opened.capture.train_views]
    own = _read_residual(opened, index, folder)
    others = [_read_residual(opened, other, folder) for other in overlapping_views(index, cameras, own.depth)]
    moves = moving_pixels(own, others)
    record: JsonObject = {"photograph": view.name, "share": float(moves.mean()), "mask": None}
    if not 0 < record["share"] <= MAX_SHARE:
        return record
    size, own_mask = (view.camera.width, view.camera.height), load_image(view).mask
    keep = cv2.resize(moves.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0
    if own_mask is not None:
        keep &= own_mask.numpy() > 0
    record["mask"] = f"{index:05d}.png"
    write_bytes(folder / record["mask"], cv2.imencode(".png", keep.astype(np.uint8) * 255)[1].tobytes())
    return record


def _write_examples(file: Path, views: tuple[View, ...], records: list[JsonObject], folder: Path) -> None:
    """The photographs of which most moves, with what their masks leave out in red; none where nothing moves."""
    masked = [index for index, record in enumerate(records) if record["mask"] is not None]
    most = sorted(masked, key=lambda index: -records[index]["share"])[:EXAMPLES]
    width = min([EXAMPLE_WIDTH_PX, *(views[index].camera.width for index in most)])
    height = min([round(width * views[i].camera.height / views[i].camera.width) for i in most], default=0)
    cells = []
    for index in most:
        cell = cv2.resize(load_image(views[index]).image.numpy(), (width, height), interpolation=cv2.INTER_AREA)
        left_out = ~decode_mask(folder / records[index]["mask"], width, height)
        cell[left_out] = (0.45 * cell[left_out] + 0.55 * np.array([230, 30, 40])).astype(np.uint8)
        cells.append(cell)
    if cells:
        cells += [np.full_like(cells[0], 255)] * (-len(cells) % 3 if len(cells) > 3 else 0)
        rows = [np.concatenate(cells[start : start + 3], axis=1) for start in range(0, len(cells), 3)]
        write_png(file, np.concatenate(rows))
