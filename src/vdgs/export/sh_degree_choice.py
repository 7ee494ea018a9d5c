"""Whether the changing colors of a scene are worth the room that they take in a file, where nobody says it.

Formats that round the coefficients keep them in bytes, most of such a file, and scenes of plain ground look the same
without them: the file is drawn as it would be written, and with fixed colors, on the views that losses are measured on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from vdgs.captures.capture import View
from vdgs.evaluation.color_correction import correct_colors
from vdgs.evaluation.evaluate_run import cached_reference_views
from vdgs.evaluation.metrics import psnr_from_mse, squared_error, to_8bit
from vdgs.evaluation.view_exposures import apply_exposure_numpy
from vdgs.export.export_loss import file_exposure, render_file, seen_gaussians, views_to_measure
from vdgs.export.fixed_colors import write_with_fixed_colors
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportScene
from vdgs.export.formats.gaussian_store import GaussianStore
from vdgs.export.local_frame import LocalFrame
from vdgs.geometry.camera import Camera
from vdgs.model.gaussians import Gaussians
from vdgs.runs.open_run import OpenedRun
from vdgs.system.scratch import scratch_folder
from vdgs.system.stop_signals import check_stop_requested

#: Changing colors stay where they are worth so much, in dB: less is not seen, and is what rounding makes.
LEAST_GAIN_DB = 0.05
#: So many views decide.
MAX_VIEWS = 8
#: Of a part of a scene only the pixels count that it covers with so much opacity; a view needs so many.
MIN_COVERAGE, MIN_PIXELS = 0.95, 1000


class FixedColors:
    """The fixed colors of baked scenes (`fixed_colors`), each made once, in temporary files that go with `stack`."""

    def __init__(self, cameras: Sequence[Camera], beside: Path, stack: ExitStack) -> None:
        self._cameras, self._beside, self._stack = cameras, beside, stack
        self._made = list[tuple[GaussianStore, GaussianStore]]()

    def of(self, store: GaussianStore) -> GaussianStore:
        """The Gaussians of a store with fixed colors."""
        for before, made in self._made:
            if before is store:
                return made
        folder = self._stack.enter_context(scratch_folder(self._beside))
        made = write_with_fixed_colors(store, self._cameras, folder / "fixed")
        self._made.append((store, made))
        return made


@dataclass(frozen=True, eq=False)
class CoveredViews:
    """Views and which of their pixels a scene, or the part of one that is written, covers."""

    run: OpenedRun
    views: list[View]
    masks: list[Bool[np.ndarray, "h w"]]

    @staticmethod
    def of(run: OpenedRun, pieces: Iterable[Gaussians]) -> CoveredViews:
        """At most `MAX_VIEWS` of the views that losses are measured on, spread over them; none where none shows enough
        of the Gaussians (ground frame)."""
        every = views_to_measure(run)
        step = max(1, -(-len(every) // MAX_VIEWS))
        spread = [view for first in range(step) for view in every[first::step]]
        gaussians = seen_gaussians(pieces, [view.camera for view in spread])
        views, masks = list[View](), list[np.ndarray]()
        with cached_reference_views(spread) as photographs:
            for view in spread:
                check_stop_requested()
                covered = render_file(gaussians, run, view.camera).alpha.numpy() >= MIN_COVERAGE
                if (mask := photographs.load_mask(view)) is not None:
                    covered &= mask
                if np.count_nonzero(covered) >= MIN_PIXELS:
                    views.append(view)
                    masks.append(covered)
                if len(views) == MAX_VIEWS:
                    break
        return CoveredViews(run, views, masks)

    def psnr(self, pieces: Iterable[Gaussians]) -> float:
        """Of Gaussians (ground frame) against the photographs, over the covered pixels of all views together, in dB;
        colors corrected for each photograph, as its light is not what decides."""
        gaussians, exposure = seen_gaussians(pieces, [view.camera for view in self.views]), file_exposure(self.run)
        errors = list[np.ndarray]()
        with cached_reference_views(self.views) as photographs:
            for view, covered in zip(self.views, self.masks, strict=True):
                check_stop_requested()
                picture = render_file(gaussians, self.run, view.camera).image.numpy()
                if exposure is not None:
                    picture = apply_exposure_numpy(picture, exposure(view))
                reference = photographs.load_image(view)
                shown = to_8bit(correct_colors(to_8bit(picture), reference, covered).image)
                errors.append(squared_error(shown, reference)[covered])
        return psnr_from_mse(float(np.concatenate(errors).mean()))


def choose_fixed_colors(
    run: OpenedRun,
    path: Path,
    frame: LocalFrame,
    make_scene: Callable[[], ExportScene],
    changing: Callable[[], Iterator[Gaussians]],
    fixed: Callable[[], Iterator[Gaussians]],
) -> tuple[bool, str]:
    """Whether a file is better written with fixed colors, and what is to be said of it.

    `make_scene`: what the writer would be given with changing colors; `changing` and `fixed`: the Gaussians in the
    ground frame. A file that can be read counts as it comes from the disk, another as it was baked. Where no view shows
    what is written, colors stay as they are.
    """
    compared = CoveredViews.of(run, changing())
    if not compared.views:
        return False, ""
    if registry.format_from_path(path).read is None:
        with_changes = compared.psnr(changing())
    else:
        with scratch_folder(path) as folder:
            registry.write_scene(folder / path.name, make_scene())
            with_changes = compared.psnr(map(frame.to_ground, registry.read_chunks(folder / path.name)))
    gain = with_changes - compared.psnr(fixed())
    worth = f"worth {gain:+.2f} dB on {len(compared.views)} views"
    if gain < LEAST_GAIN_DB:
        return True, f"colors do not change with the direction: as the file holds changes, they are {worth}"
    return False, f"colors change with the direction: {worth} against --sh-degree 0, which is smaller"
