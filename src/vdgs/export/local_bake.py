"""A scene baked by one process: what views show and lack is in its memory, Gaussians are in a temporary file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import Progress

from vdgs.config.commands import ExportRequest
from vdgs.errors import VdgsError
from vdgs.export.bake import Survey, bake, gaussian_count, survey
from vdgs.export.color_refinement import Baked, refit
from vdgs.export.formats.export_scene import Scene
from vdgs.export.formats.gaussian_store import Spooled, spooled
from vdgs.export.novel_cameras import round_count, rounds
from vdgs.runs.open_run import TrainedRun
from vdgs.system.stop_signals import stop_if_asked


def bar_on(console: Console) -> Progress:
    """A bar that shows how far work is, to be used as a context."""
    return Progress(console=console, disable=not console.is_terminal, transient=True)


class BakedHere:
    """Bakes the scene of a run."""

    def __init__(self, run: TrainedRun, asked: ExportRequest, console: Console) -> None:
        self._run, self._asked, self._console = run, asked, console
        self.training = [view.camera for view in run.capture.train_views]
        self._rounds = rounds(self.training, round_count(asked.rounds, gaussian_count(run.model)))
        self._seen: Survey | None = None

    def pixels(self) -> Float[np.ndarray, " g"]:
        """How many pixels each Gaussian of the model makes of what the training cameras see."""
        with bar_on(self._console) as bar:
            task = bar.add_task("what the training cameras see", total=len(self.training))

            def after_view() -> None:
                stop_if_asked()
                bar.advance(task)

            self._seen = survey(self._run.model, self.training, after_view)
        return self._seen.pixels

    @contextmanager
    def spool(self, kept: Int[np.ndarray, " m"]) -> Iterator[Spooled]:
        """These Gaussians in a temporary file beside the first output; `pixels` was asked before."""
        folder = self._asked.to[0].parent
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".baking-") as temporary:
            with bar_on(self._console) as bar:
                try:
                    spool = self._fitted(kept, Path(temporary) / "spool", bar)
                except OSError as error:
                    raise VdgsError(
                        f"{folder}: cannot hold the scene ({error.strerror or error}). Nothing was written."
                    ) from error
                self._improve(Baked(self._run.model, kept, spool), bar)
            yield spool

    def _fitted(self, kept: Int[np.ndarray, " m"], file: Path, bar: Progress) -> Spooled:
        """Gaussians as the training cameras saw them; what these saw is forgotten."""
        assert self._seen is not None
        seen, degree, self._seen = self._seen, self._asked.sh_degree, None
        task = bar.add_task("fitting Gaussians", total=len(kept))

        def after_part(done: int) -> None:
            stop_if_asked()
            bar.update(task, completed=done)

        return spooled(Scene(chunks=bake(seen, kept, degree, after_part), count=len(kept), degree=degree), file)

    def _improve(self, baked: Baked, bar: Progress) -> None:
        """Fit the colours again to what pictures lack."""
        task = bar.add_task("comparing pictures", total=sum(map(len, self._rounds)))

        def after_view() -> None:
            stop_if_asked()
            bar.advance(task)

        for cameras in self._rounds:
            refit(baked, cameras, after_view)
