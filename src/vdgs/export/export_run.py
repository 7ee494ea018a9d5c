"""`vdgs export`: a run's scene baked once, and written into as many files as were asked for."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int
from rich.console import Console

from vdgs.captures.camera_height import overview
from vdgs.captures.output_guard import refuse_among_inputs, refuse_in_a_capture
from vdgs.config.commands import ExportRequest
from vdgs.distributed.sharded_job import Wish
from vdgs.errors import VdgsError
from vdgs.export.bake import gaussian_count
from vdgs.export.bake_plan import as_files_hold
from vdgs.export.color_refinement import Baked
from vdgs.export.distributed_bake import BakedElsewhere, baked_elsewhere, forget_shards
from vdgs.export.export_loss import loss_of, measured_views
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ROWS, Page, Scene
from vdgs.export.formats.gaussian_store import Spooled
from vdgs.export.formats.tiles_3d import NAME, tiles_of
from vdgs.export.gaussian_optimization import refine
from vdgs.export.gaussian_selection import bounds_of, chosen, frame_for, rows_for
from vdgs.export.local_bake import BakedHere, bar_on
from vdgs.export.local_frame import Frame
from vdgs.export.novel_cameras import endless, round_count
from vdgs.geometry.camera import Camera
from vdgs.model.gaussians import Gaussians
from vdgs.runs.open_run import TrainedRun, open_run
from vdgs.runs.run_folder import REPORT
from vdgs.system.atomic_files import jsonable, write_json
from vdgs.system.documents import ExportedFile, ExportMetadata, JsonObject
from vdgs.system.stop_signals import stop_if_asked

#: What was written and lost, beside the run's other results.
RECORD = "export.json"


@dataclass(frozen=True, eq=False)
class _Baked:
    """The Gaussians of a scene on the disk, in the ground frame."""

    spool: Spooled
    degree: int
    #: How pages show it first, in the ground frame.
    page: Page

    def scene(self, frame: Frame, rows: Int[np.ndarray, " r"]) -> Scene:
        """What a writer is given: the Gaussians of these rows."""
        chunks = (frame.place(piece) for piece in self.pieces(rows))
        bounds, page = bounds_of(frame, self.spool.means[rows]), _placed(self.page, frame)
        return Scene(chunks=chunks, count=len(rows), degree=self.degree, facts=frame.facts, bounds=bounds, page=page)

    def pieces(self, rows: Int[np.ndarray, " r"]) -> Iterator[Gaussians]:
        """These Gaussians, some thousand at a time."""
        for first in range(0, len(rows), ROWS):
            stop_if_asked()
            yield self.spool.rows(rows[first : first + ROWS])
            self.spool.let_go()


def page_of(run: TrainedRun, most_bytes: int) -> Page:
    """All of the flight, before the colour that the model has behind it; ground frame."""
    position, target = overview(run.capture)
    red, green, blue = (float(each) for each in run.model.background)
    title = run.capture.root.resolve().name or "scene"
    return Page(_point(position), _point(target), (red, green, blue), title, most_bytes)


def _placed(page: Page, frame: Frame) -> Page:
    """A page in local coordinates."""
    ground = np.array([page.position, page.target])
    position, target = frame.apply(ground)
    return replace(page, position=_point(position), target=_point(target))


def _point(place: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(each) for each in place)
    return x, y, z


def export_run(asked: ExportRequest, console: Console, wish: Wish | None = None) -> ExportMetadata:
    """Write what was asked for, on a device that is chosen already; returns what RUN/export.json holds.

    The scene is baked in this process, or in shards where a `wish` sends them: the files are the same. Raises
    VdgsError, before any Gaussian is baked, for file names of no format, outputs that are the run's report or among a
    capture's inputs, an empty choice, and coordinates that a format or the capture does not have; and what
    `ShardedJob.send` raises.
    """
    _check_names(asked.run, asked.to)
    asked = as_files_hold(asked)
    run = open_run(asked.run, asked.model, asked.device)
    if run.caution:
        console.print(f"[yellow]warning[/] {run.caution}", highlight=False)
    for path in asked.to:
        refuse_among_inputs(path, run.capture)
    centre = np.median(run.model.anchors.positions.cpu().double().numpy(), axis=0)
    frames = {path: frame_for(path, run, asked, centre) for path in asked.to}
    began = time.monotonic()
    with _baker(run, asked, wish, console) as baker:
        pixels = baker.pixels()
        kept = chosen(pixels, run, asked)
        rows = rows_for(frames, run, pixels, kept, asked.sh_degree, console)
        console.print(
            f"{run.line}: {len(kept):,} Gaussians of {len(pixels):,} are drawn by the training cameras"
            + (" and asked for" if len(kept) < np.count_nonzero(pixels) else ""),
            highlight=False,
        )
        del pixels
        with baker.spool(kept) as spool:
            _refined(Baked(run.model, kept, spool), baker.training, asked.refine, console)
            baked = _Baked(spool, asked.sh_degree, page_of(run, int(asked.html_mb * 1e6)))
            seconds = time.monotonic() - began
            rounds = round_count(asked.rounds, gaussian_count(run.model))
            console.print(f"baked in {seconds:.1f} s, colours fitted again in {rounds} rounds", highlight=False)
            files = [_write(path, baked.scene(frames[path], rows[path]), console) for path in asked.to]
            losses = _losses(run, frames, baked, asked, console)
    record: ExportMetadata = jsonable({
        "model": run.name, "key": run.key, "gaussians": len(kept), "sh_degree": asked.sh_degree, "rounds": rounds,
        "seconds_to_bake": seconds, "seconds_to_refine": asked.refine, "files": files, "losses": losses,
    })  # fmt: skip
    write_json(run.folder.path / RECORD, record)
    return record


def _baker(
    run: TrainedRun, asked: ExportRequest, wish: Wish | None, console: Console
) -> AbstractContextManager[BakedHere | BakedElsewhere]:
    """What bakes the scene: this process, or shards."""
    if wish is not None and wish.sends:
        return baked_elsewhere(run, asked, wish, console)
    forget_shards(run)
    return nullcontext(BakedHere(run, asked, console))


def _refined(baked: Baked, training: Sequence[Camera], seconds: float, console: Console) -> None:
    """Move all that is baked for so many seconds, by this process' clock."""
    if seconds <= 0:
        return
    with bar_on(console) as bar:
        task = bar.add_task("refining", total=seconds)

        def after_step(passed: float) -> None:
            stop_if_asked()
            bar.update(task, completed=passed)

        refine(baked, endless(training), seconds, after_step)


def _check_names(run: Path, paths: tuple[Path, ...]) -> None:
    if not paths:
        raise VdgsError("Nothing to write: give --to FILE, such as --to scene.ply.")
    for path in paths:
        registry.format_of(path)
        refuse_in_a_capture(path)
        if path.name.lower() == REPORT and os.path.realpath(path.parent) == os.path.realpath(run):
            raise VdgsError(
                f"--to {path}: is the report of the run, which would be overwritten, and written again over the page. "
                "Choose another name, such as scene.html."
            )
    twice = sorted({str(path) for path in paths if paths.count(path) > 1})
    if twice:
        raise VdgsError(f"--to {twice[0]}: is given twice.")


def _write(path: Path, scene: Scene, console: Console) -> ExportedFile:
    began = time.monotonic()
    lost = registry.write(path, scene)
    seconds, size = time.monotonic() - began, _size(path)
    console.print(f"{path}: {size / 1e6:,.1f} MB in {seconds:.1f} s", highlight=False)
    for each in lost:
        console.print(f"[yellow]note[/] {path.name}: {each}", highlight=False)
    return {"file": str(path.resolve()), "gaussians": scene.count, "bytes": size, "seconds": seconds,
            "notes": list(lost)}  # fmt: skip


def _size(path: Path) -> int:
    """Bytes of a file, with the tiles that it names."""
    tiles = tiles_of(path) if registry.format_of(path).ending == NAME else []
    return sum(file.stat().st_size for file in (path, *tiles))


def _losses(
    run: TrainedRun, frames: dict[Path, Frame], baked: _Baked, asked: ExportRequest, console: Console
) -> list[JsonObject]:
    """What each file that can be read back loses, or, where none can, the Gaussians that were written."""
    if not asked.measure:
        return []
    readable: list[Path | None] = [path for path in asked.to if registry.format_of(path).read]
    losses = []
    with bar_on(console) as bar:
        task = bar.add_task("comparing with the model", total=len(readable or [None]) * len(measured_views(run)))

        def after_view() -> None:
            stop_if_asked()
            bar.advance(task)

        for path in readable or [None]:
            every = np.arange(len(baked.spool.means))
            pieces = baked.pieces(every) if path is None else map(frames[path].to_ground, registry.pieces(path))
            loss = loss_of(run, pieces, after_view)
            what = "as baked" if path is None else f"{path.name}, read back"
            console.print(
                f"{what}, on {loss.views} {loss.of} views: PSNR {loss.psnr:.2f} → {loss.psnr_baked:.2f} dB "
                f"({loss.psnr_baked - loss.psnr:+.2f}; with the exposure of each photograph corrected "
                f"{loss.psnr_cc:.2f} → {loss.psnr_cc_baked:.2f}, {loss.psnr_cc_baked - loss.psnr_cc:+.2f}), "
                f"SSIM {loss.ssim:.3f} → {loss.ssim_baked:.3f}",
                highlight=False,
            )
            losses.append({"file": None if path is None else str(path.resolve()), **asdict(loss)})
    return losses
