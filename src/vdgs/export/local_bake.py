"""A scene baked by one process: what views show and lack is in its memory, Gaussians are in a temporary file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import Progress

from vdgs.config.commands import ExportRequest
from vdgs.export.bake import BakeContributions, bake, collect_contributions, gaussian_count
from vdgs.export.color_refinement import BakedGaussians, refine_colors
from vdgs.export.formats.export_scene import ExportScene
from vdgs.export.formats.gaussian_store import GaussianStore, write_store
from vdgs.export.novel_cameras import color_iteration_cameras, color_iteration_count
from vdgs.runs.open_run import OpenedRun
from vdgs.system.atomic_files import explain_disk_errors
from vdgs.system.console import make_progress_bar
from vdgs.system.scratch import scratch_folder
from vdgs.system.stop_signals import check_stop_requested

#: What scratch folders of the Gaussians are named after.
BAKING = "baking"


class LocalBake:
    """Bakes the scene of a run."""

    def __init__(self, run: OpenedRun, request: ExportRequest, console: Console) -> None:
        self._run, self._asked, self._console = run, request, console
        self.training = [view.camera for view in run.capture.train_views]
        self._rounds = color_iteration_cameras(
            self.training, color_iteration_count(request.color_iterations, gaussian_count(run.model))
        )
        self._seen: BakeContributions | None = None

    def pixels(self) -> Float[np.ndarray, " g"]:
        """How many pixels each Gaussian of the model makes of what the training cameras see."""
        with make_progress_bar(self._console) as bar:
            task = bar.add_task("what the training cameras see", total=len(self.training))

            def after_view() -> None:
                check_stop_requested()
                bar.advance(task)

            self._seen = collect_contributions(self._run.model, self.training, after_view)
        return self._seen.pixels

    @contextmanager
    def spool(self, kept: Int[np.ndarray, " m"]) -> Iterator[GaussianStore]:
        """These Gaussians in a temporary file beside the first output; `pixels` was asked before."""
        output = self._asked.output[0]
        with scratch_folder(output.parent / BAKING) as temporary:
            with make_progress_bar(self._console) as bar:
                with explain_disk_errors(output):
                    spool = self._fitted(kept, temporary / "spool", bar)
                self._improve(BakedGaussians(self._run.model, kept, spool), bar)
            yield spool

    def _fitted(self, kept: Int[np.ndarray, " m"], file: Path, bar: Progress) -> GaussianStore:
        """Gaussians as the training cameras saw them; what these saw is forgotten."""
        assert self._seen is not None
        seen, degree, self._seen = self._seen, self._asked.baked_sh_degree, None
        task = bar.add_task("fitting Gaussians", total=len(kept))

        def after_part(done: int) -> None:
            check_stop_requested()
            bar.update(task, completed=done)

        return write_store(
            ExportScene(chunks=bake(seen, kept, degree, after_part), count=len(kept), degree=degree), file
        )

    def _improve(self, baked: BakedGaussians, bar: Progress) -> None:
        """Fit the colors again to what pictures lack."""
        task = bar.add_task("comparing pictures", total=sum(map(len, self._rounds)))

        def after_view() -> None:
            check_stop_requested()
            bar.advance(task)

        for cameras in self._rounds:
            refine_colors(baked, cameras, after_view)
