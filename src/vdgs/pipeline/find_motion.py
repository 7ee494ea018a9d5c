"""What moves between the training photographs, found by the coarse model, as masks for the blocks
(`--block.mask-moving`)."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool
from rich.console import Console

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import View, spread_evenly
from vdgs.captures.image_cache import load_image
from vdgs.captures.image_files import decode_mask
from vdgs.evaluation.comparison_images import write_png
from vdgs.evaluation.moving_pixels import (
    MASK_MARGIN_PX,
    MAX_SHARE,
    MIN_MOVING_SHARE,
    SAMPLED_PHOTOGRAPHS,
    Residual,
    grow,
    make_residual,
    moving_pixels,
    overlapping_views,
)
from vdgs.model.exposure import apply_exposure
from vdgs.model.renderer import render
from vdgs.runs.motion_masks import has_motion_record
from vdgs.runs.open_run import OpenedRun, check_has_anchors
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import MOTION_EXAMPLES
from vdgs.runs.stage_folder import StageFolder
from vdgs.runs.stage_keys import moves_enough
from vdgs.system.atomic_files import read_json, write_array, write_bytes, write_json
from vdgs.system.console import show_share
from vdgs.system.documents import JsonObject
from vdgs.visibility.visibility_counts import NearbyCameras

#: Photographs that the picture for people shows, those of which most moves, and the width of each.
EXAMPLES, EXAMPLE_WIDTH_PX = 6, 480


def find_run_motion(context: RunContext, console: Console, device: str = "cpu") -> None:
    """Write the record and the masks of what moves (`runs.motion_masks`), or continue; nothing where they are there.
    Where the run leaves nothing out any more they are deleted.

    RunError without a coarse model, CaptureError for a photograph that cannot be decoded, Stopped after Ctrl-C.
    """
    run, asked = context.run, context.run.settings().block.mask_moving
    if asked == "off":
        if run.motion_file.parent.exists():
            with run.locked():  # blocks at work read the masks
                shutil.rmtree(run.motion_file.parent, ignore_errors=True)
        return
    if has_motion_record(run):
        if asked == "auto":
            _drop_needless_masks(context)
        console.print(f"{run.motion_file}: already there; nothing to do", highlight=False)
        return
    with run.locked():
        opened, key = context.open_model("coarse", device), run.keys().visibility
        check_has_anchors(run, len(opened.model.anchors))
        StageFolder(run.motion_file.parent).reset_unless(key)
        search = _MotionSearch(opened, run.motion_file.parent, context, console)
        sample = spread_evenly(opened.capture.train_views, SAMPLED_PHOTOGRAPHS)
        share = search.share_of(sample)
        enough = share >= MIN_MOVING_SHARE  # what `auto` goes by, whoever asks
        record: JsonObject = {
            "key": key, "masked": enough or asked == "on", "share": share, "photographs": [],
            "enough": enough, "sampled": len(sample), "sampled_share": share,
        }  # fmt: skip
        if record["masked"]:
            record |= {"share": search.share_of(opened.capture.train_views), "photographs": search.records()}
            with context.drawing_figures():
                _write_examples(run.path / MOTION_EXAMPLES, opened.capture.train_views, search.records(), search.folder)
        else:
            _remove_masks(search.folder, search.records())
        write_json(run.motion_file, record)
        shutil.rmtree(search.folder / "residuals", ignore_errors=True)
    _tell(record, run.path / MOTION_EXAMPLES, console)


def _drop_needless_masks(context: RunContext) -> None:
    """Delete masks that `on` asked for and `auto` does not."""
    run, record = context.run, read_json(context.run.motion_file)
    if not record["masked"] or moves_enough(record):
        return
    with run.locked():
        photographs, share = record["photographs"], record["sampled_share"]
        write_json(run.motion_file, record | {"masked": False, "share": share, "photographs": []})
        _remove_masks(run.motion_file.parent, photographs)
        (run.path / MOTION_EXAMPLES).unlink(missing_ok=True)


def _remove_masks(folder: Path, records: Sequence[JsonObject]) -> None:
    """Delete the masks of these photographs."""
    for record in records:
        if record["mask"] is not None:
            (folder / record["mask"]).unlink(missing_ok=True)


def _tell(record: JsonObject, examples: Path, console: Console) -> None:
    """Say what was found."""
    share, photographs = record["share"], record["photographs"]
    if not record["masked"]:
        console.print(
            f"what moves: {share:.2%} of {record['sampled']} photographs, too little to leave out "
            f"(from {MIN_MOVING_SHARE:.1%}; --block.mask-moving)",
            highlight=False,
        )
        return
    masked = sum(each["mask"] is not None for each in photographs)
    console.print(
        f"what moves: {share:.1%} of the training photographs, in {masked} of {len(photographs)}; the blocks leave it "
        f"out ({examples}; --block.mask-moving)" if masked else "what moves: nothing in the training photographs",
        highlight=False,
    )  # fmt: skip
    if too_much := [each["photograph"] for each in photographs if each["share"] > MAX_SHARE]:
        console.print(
            f"[yellow]note[/] {len(too_much)} photographs differ from the others in more than {MAX_SHARE:.0%} of their "
            f"pixels and are not masked, such as {too_much[0]}",
            highlight=False,
        )


class _MotionSearch:
    """Looks for what moves in some of the training photographs, each once."""

    def __init__(self, opened: OpenedRun, folder: Path, context: RunContext, console: Console) -> None:
        self._opened, self.folder, self._context, self._console = opened, folder, context, console
        self._found, self._unit = dict[int, JsonObject](), camera_height(opened.capture)

    def share_of(self, views: Sequence[View]) -> float:
        """The mean share of the photographs' pixels that moves; writes their masks."""
        known = self._opened.capture.train_views
        cameras = NearbyCameras([view.camera for view in known])
        names = {view.name for view in views}
        chosen = [index for index, view in enumerate(known) if view.name in names]
        step = self._context.run.begin_step("coarse", "looking for what moves", "photographs", len(chosen))
        with show_share(self._console, "looking for what moves") as show:
            for number, index in enumerate(chosen, start=1):
                if index not in self._found:
                    own = self._residual(index)
                    others = [self._residual(other) for other in overlapping_views(index, own, cameras)]
                    self._found[index] = _mask_view(self._opened, index, moving_pixels(own, others), self.folder)
                show(number, len(chosen))
                step(number)
        masked = [self._found[index]["share"] for index in chosen if self._found[index]["mask"] is not None]
        return float(sum(masked)) / len(chosen)

    def records(self) -> list[JsonObject]:
        """What was found in each training photograph."""
        return [self._found[index] for index in sorted(self._found)]

    def _residual(self, index: int) -> Residual:
        view, file = self._opened.capture.train_views[index], self.folder / "residuals" / f"{index:05d}.npy"
        _keep_residual(self._opened, index, view, self._unit, file)
        return _read_residual(view, self._unit, file)


def _keep_residual(opened: OpenedRun, index: int, view: View, unit: float, file: Path) -> None:
    """Compare a training photograph with its render, unless that was done before; depths are in units of `unit`."""
    if file.exists():
        return
    with torch.no_grad():
        drawn = render(opened.model.without_local_exposure(), view.camera, depth=True, image_index=index)
        exposure = opened.model.decoder.exposure_for_image(index)
        shown = drawn.image if exposure is None else apply_exposure(drawn.image, exposure)
        depth = drawn.median_depth
        if depth is None:  # of an implementation that cannot tell
            assert drawn.depth is not None
            depth = torch.where(drawn.alpha > 0.5, drawn.depth / drawn.alpha.clamp(min=1e-6), 0)
    picture = load_image(view)
    mask = None if picture.mask is None else picture.mask.numpy()
    found = make_residual(view.camera, picture.image.numpy(), mask, shown.cpu().numpy(), depth.cpu().numpy())
    scaled = found.depth / unit  # within the range of 16 bits
    write_array(file, np.concatenate([found.difference, scaled[..., None]], axis=-1).astype(np.float16))


def _read_residual(view: View, unit: float, file: Path) -> Residual:
    values = np.load(file, allow_pickle=False).astype(np.float32)
    height, width = values.shape[:2]
    depth = np.ascontiguousarray(values[..., 3] * unit)
    return Residual(view.camera.resized(width, height), np.ascontiguousarray(values[..., :3]), depth)


def _mask_view(opened: OpenedRun, index: int, moves: Bool[np.ndarray, "h w"], folder: Path) -> JsonObject:
    """Write the mask of a view where something moves, and return its record."""
    view = opened.capture.train_views[index]
    record: JsonObject = {"photograph": view.name, "share": float(moves.mean()), "mask": None}
    if not 0 < record["share"] <= MAX_SHARE:
        return record
    size, own_mask = (view.camera.width, view.camera.height), load_image(view).mask
    keep = cv2.resize(grow(moves, MASK_MARGIN_PX).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0
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
