"""`vdgs export`: a run's scene baked once, and written into as many files as were asked for."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import Progress

from vdgs.cameras import Camera
from vdgs.captures.outputs import refuse_among_inputs, refuse_in_a_capture
from vdgs.captures.overview import overview
from vdgs.errors import VdgsError
from vdgs.export.baking import Survey, bake, survey
from vdgs.export.between import between
from vdgs.export.formats import registry
from vdgs.export.formats.scene import ROWS, Page, Scene
from vdgs.export.formats.spool import Spooled, spooled
from vdgs.export.frame import FAR, Frame, frame_of, usual_crs
from vdgs.export.loss import loss_of, measured_views
from vdgs.export.refining import refine
from vdgs.export.refit import Baked, refit
from vdgs.model.gaussians import Gaussians
from vdgs.model.world import places
from vdgs.placing.placement import Placement
from vdgs.runs.opening import TrainedRun, open_run
from vdgs.settings.requests import ExportRequest
from vdgs.storage.files import jsonable, write_json
from vdgs.watching.interrupts import stop_if_asked

#: What was written and lost, beside the run's other results.
RECORD = "export.json"
#: How often colours are fitted again to what pictures lack (chosen on validation views, docs/export.md).
REFITS = 2
#: A file goes without Gaussians beyond its reach where they make at most this part of what the training cameras see.
MOST_BEYOND = 1e-3


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
        bounds, page = _bounds(frame, self.spool.means[rows]), _placed(self.page, frame)
        return Scene(chunks, len(rows), self.degree, frame.facts, bounds, page)

    def pieces(self, rows: Int[np.ndarray, " r"]) -> Iterator[Gaussians]:
        """These Gaussians, some thousand at a time."""
        for first in range(0, len(rows), ROWS):
            stop_if_asked()
            yield self.spool.rows(rows[first : first + ROWS])


def page_of(run: TrainedRun, most_bytes: int) -> Page:
    """All of the flight, before the colour that the model has behind it; ground frame."""
    position, target = overview(run.capture)
    red, green, blue = (float(each) for each in run.model.background)
    title = run.capture.root.resolve().name or "scene"
    return Page(_point(position), _point(target), (red, green, blue), title, most_bytes)


def _placed(page: Page, frame: Frame) -> Page:
    """A page in local coordinates."""
    ground = np.array([page.position, page.target])
    position, target = frame.scale * ground @ frame.rotation.T + frame.translation
    return replace(page, position=_point(position), target=_point(target))


def _point(place: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(each) for each in place)
    return x, y, z


def export_run(asked: ExportRequest, console: Console) -> dict[str, Any]:
    """Write what was asked for, on a device that is chosen already; returns what RUN/export.json holds.

    Raises VdgsError, before any Gaussian is baked, for file names of no format, outputs among a capture's inputs, an
    empty choice, and coordinates that a format or the capture does not have.
    """
    _check_names(asked.to)
    if all(registry.format_of(path).fixed for path in asked.to):
        asked = replace(asked, sh_degree=0)
    run = open_run(asked.run, asked.model, asked.device)
    if run.caution:
        console.print(f"[yellow]warning[/] {run.caution}", highlight=False)
    for path in asked.to:
        refuse_among_inputs(path, run.capture)
    centre = np.median(run.model.anchors.positions.cpu().double().numpy(), axis=0)
    frames = {path: _frame(path, run, asked, centre) for path in asked.to}
    began = time.monotonic()
    with Progress(console=console, disable=not console.is_terminal, transient=True) as bar:
        seen = _surveyed(run, bar)
        kept = chosen(seen, run, asked)
        rows = _check_scenes(frames, seen, kept, asked.sh_degree, console)
        console.print(
            f"{run.line}: {len(kept):,} Gaussians of {len(seen.pixels):,} are drawn by the training cameras"
            + (" and asked for" if len(kept) < np.count_nonzero(seen.pixels) else ""),
            highlight=False,
        )
        with _baked(seen, kept, asked, page_of(run, int(asked.html_mb * 1e6)), bar) as baked:
            seconds = time.monotonic() - began
            console.print(f"baked in {seconds:.1f} s", highlight=False)
            files = [_write(path, baked.scene(frames[path], rows[path]), console) for path in asked.to]
            losses = _losses(run, frames, baked, asked, bar, console)
    record = jsonable({
        "model": run.name, "key": run.key, "gaussians": len(kept), "sh_degree": asked.sh_degree,
        "seconds_to_bake": seconds, "seconds_to_refine": asked.refine, "files": files, "losses": losses,
    })  # fmt: skip
    write_json(run.folder.path / RECORD, record)
    return record


def _check_names(paths: tuple[Path, ...]) -> None:
    if not paths:
        raise VdgsError("Nothing to write: give --to FILE, such as --to scene.ply.")
    for path in paths:
        registry.format_of(path)
        refuse_in_a_capture(path)
    twice = sorted({str(path) for path in paths if paths.count(path) > 1})
    if twice:
        raise VdgsError(f"--to {twice[0]}: is given twice.")


def _surveyed(run: TrainedRun, bar: Progress) -> Survey:
    cameras = [view.camera for view in run.capture.train_views]
    task = bar.add_task("what the training cameras see", total=len(cameras))

    def after_view() -> None:
        stop_if_asked()
        bar.advance(task)

    return survey(run.model, cameras, after_view)


def chosen(seen: Survey, run: TrainedRun, asked: ExportRequest) -> Int[np.ndarray, " m"]:
    """The Gaussians to write, ascending: drawn by a training camera, of the block, within the box, most drawn first
    where they are too many. Raises VdgsError where none is left."""
    k = seen.model.anchors.offsets.shape[1]
    wanted = seen.pixels > 0
    if asked.block is not None:
        wanted &= np.repeat(_of_block(run, asked.block), k)
    if asked.bbox is not None:
        x0, y0, x1, y1 = asked.bbox
        if not (x0 < x1 and y0 < y1):
            raise VdgsError(f"--bbox {x0:g} {y0:g} {x1:g} {y1:g}: is empty. Give X0 Y0 X1 Y1, the lower corner first.")
        crs = asked.crs or usual_crs(run.capture.ground, asked.to[0])
        inside = Placement.of(run.capture.ground, crs).places(
            places(seen.model.anchors).cpu().double().reshape(-1, 3).numpy()
        )
        wanted &= (inside[:, :2] >= (x0, y0)).all(1) & (inside[:, :2] <= (x1, y1)).all(1)
        if not wanted.any():
            low, high = inside[seen.pixels > 0, :2].min(0), inside[seen.pixels > 0, :2].max(0)
            raise VdgsError(
                f"--bbox {x0:g} {y0:g} {x1:g} {y1:g}: holds nothing of the scene, which lies within "
                f"{low[0]:.1f} {low[1]:.1f} {high[0]:.1f} {high[1]:.1f} of --crs {crs or 'UTM'}."
            )
    kept = np.flatnonzero(wanted)
    if not len(kept):
        raise VdgsError(f"{run.model_path}: no training camera draws anything of what was asked for.")
    if 0 < asked.max_gaussians < len(kept):
        most = np.argpartition(seen.pixels[kept], -asked.max_gaussians)[-asked.max_gaussians :]
        kept = np.sort(kept[most])
    return kept


def _of_block(run: TrainedRun, block: int) -> np.ndarray:
    """Which anchors of a merged model a block has made."""
    counts = [part.count for part in run.model.parts]
    if run.name != "merged" or not 0 <= block < len(counts):
        have = f"has blocks 0 to {len(counts) - 1}" if counts else "is not made of blocks with decoders of their own"
        raise VdgsError(f"--block {block}: the {run.name} model {have}.")
    return np.repeat(np.arange(len(counts)) == block, counts)


def _frame(path: Path, run: TrainedRun, asked: ExportRequest, centre: np.ndarray) -> Frame:
    """The coordinates of a file: those that do not reach far have their origin nearby."""
    far = min(FAR, registry.format_of(path).reach / 2)
    return frame_of(run.capture.ground, asked.crs or usual_crs(run.capture.ground, path), centre, far)


def _check_scenes(
    frames: dict[Path, Frame], seen: Survey, kept: np.ndarray, degree: int, console: Console
) -> dict[Path, Int[np.ndarray, " r"]]:
    """Which of the Gaussians each file is given. What a format cannot hold is said before the work.

    A format that does not reach far goes without the few Gaussians that lie beyond and of which the photographs show
    next to nothing; more of them are refused.
    """
    means = places(seen.model.anchors).cpu().reshape(-1, 3).numpy()[kept]
    pixels = seen.pixels[kept]
    rows = {}
    for path, frame in frames.items():
        reach = registry.format_of(path).reach
        beyond = (np.abs(_local(frame, means)) >= 0.999 * reach).any(1)
        share = float(pixels[beyond].sum() / pixels.sum())
        if share > MOST_BEYOND:
            beyond[:] = False  # it is refused below
        elif beyond.any():
            console.print(
                f"[yellow]note[/] {path.name}: {np.count_nonzero(beyond):,} of {len(kept):,} Gaussians lie more than "
                f"{reach:.0f} units away, where the format does not reach; they are left out. They make "
                f"{share:.2g} of what the training cameras see.",
                highlight=False,
            )
        rows[path] = np.flatnonzero(~beyond)
        registry.check(path, Scene((), len(rows[path]), degree, frame.facts, _bounds(frame, means[rows[path]])))
    return rows


def _local(frame: Frame, means: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    local: np.ndarray = frame.scale * means.astype(np.float64) @ frame.rotation.T + frame.translation
    return local


def _bounds(
    frame: Frame, means: Float[np.ndarray, "m 3"]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Lowest and highest local coordinates."""
    local = _local(frame, means)
    (x0, y0, z0), (x1, y1, z1) = local.min(axis=0).tolist(), local.max(axis=0).tolist()
    return (x0, y0, z0), (x1, y1, z1)


@contextmanager
def _baked(seen: Survey, kept: np.ndarray, asked: ExportRequest, page: Page, bar: Progress) -> Iterator[_Baked]:
    """The Gaussians in a temporary file beside the first output."""
    folder, degree = asked.to[0].parent, asked.sh_degree
    task = bar.add_task("fitting Gaussians", total=len(kept))

    def after_part(done: int) -> None:
        stop_if_asked()
        bar.update(task, completed=done)

    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".baking-") as temporary:
        try:
            spool = spooled(Scene(bake(seen, kept, degree, after_part), len(kept), degree), Path(temporary) / "spool")
        except OSError as error:
            raise VdgsError(
                f"{folder}: cannot hold the scene ({error.strerror or error}). Nothing was written."
            ) from error
        _improved(Baked(seen.model, kept, spool), seen.cameras, asked.refine, bar)
        yield _Baked(spool, degree, page)


def _improved(baked: Baked, cameras: Sequence[Camera], seconds: float, bar: Progress) -> None:
    """Fit the colours again to what pictures lack, and move all else for so many seconds."""
    all_cameras = [*cameras, *between(cameras)]
    task = bar.add_task("comparing pictures", total=REFITS * len(all_cameras))

    def after_view() -> None:
        stop_if_asked()
        bar.advance(task)

    for _ in range(REFITS):
        refit(baked, all_cameras, after_view)
    if seconds > 0:
        task = bar.add_task("refining", total=seconds)

        def after_step(passed: float) -> None:
            stop_if_asked()
            bar.update(task, completed=passed)

        refine(baked, all_cameras, seconds, after_step)


def _write(path: Path, scene: Scene, console: Console) -> dict[str, Any]:
    began = time.monotonic()
    lost = registry.write(path, scene)
    seconds, size = time.monotonic() - began, _size(path)
    console.print(f"{path}: {size / 1e6:,.1f} MB in {seconds:.1f} s", highlight=False)
    for each in lost:
        console.print(f"[yellow]note[/] {path.name}: {each}", highlight=False)
    return {"file": str(path.resolve()), "gaussians": scene.count, "bytes": size, "seconds": seconds,
            "notes": list(lost)}  # fmt: skip


def _size(path: Path) -> int:
    """Bytes of a file, or of all the tiles about it."""
    if registry.format_of(path).ending == registry.NAME:
        return sum(file.stat().st_size for file in path.parent.rglob("*") if file.is_file())
    return path.stat().st_size


def _losses(
    run: TrainedRun, frames: dict[Path, Frame], baked: _Baked, asked: ExportRequest, bar: Progress, console: Console
) -> list[dict[str, Any]]:
    """What each file that can be read back loses, or, where none can, the Gaussians that were written."""
    if not asked.measure:
        return []
    readable: list[Path | None] = [path for path in asked.to if registry.format_of(path).read]
    task = bar.add_task("comparing with the model", total=len(readable or [None]) * len(measured_views(run)))

    def after_view() -> None:
        stop_if_asked()
        bar.advance(task)

    losses = []
    for path in readable or [None]:
        every = np.arange(len(baked.spool.means))
        pieces = baked.pieces(every) if path is None else map(frames[path].to_ground, registry.pieces(path))
        loss = loss_of(run, pieces, after_view)
        what = "as baked" if path is None else f"{path.name}, read back"
        console.print(
            f"{what}, on {loss.views} {loss.of} views: PSNR {loss.psnr:.2f} → {loss.psnr_baked:.2f} dB "
            f"({loss.psnr_baked - loss.psnr:+.2f}; with the exposure of each photograph corrected {loss.psnr_cc:.2f} → "
            f"{loss.psnr_cc_baked:.2f}, {loss.psnr_cc_baked - loss.psnr_cc:+.2f}), "
            f"SSIM {loss.ssim:.3f} → {loss.ssim_baked:.3f}",
            highlight=False,
        )
        losses.append({"file": None if path is None else str(path.resolve()), **asdict(loss)})
    return losses
