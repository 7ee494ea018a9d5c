"""A run that a command works on, with its capture and models in memory: each stage passes it on to the next."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from vdgs.captures.capture import Capture
from vdgs.captures.validation import find_doubts
from vdgs.config.commands import ModelName
from vdgs.model.anchor_model import AnchorModel
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.open_run import (
    ModelLocation,
    OpenedRun,
    locate_model,
    open_capture,
    open_mapped,
    relocate_capture,
    with_capture,
)
from vdgs.runs.run_folder import RunFolder


class RunContext:
    """A run folder with its capture, read once, and its models, each read once until it is released.

    Images stay on the disk. The state of stages is read from the disk at every call: other processes may have
    trained blocks meanwhile, and a model whose file or key has changed is read again.
    """

    def __init__(self, run: RunFolder, capture: Capture | None = None) -> None:
        self.run = run
        self._capture = capture
        self._doubts: list[str] | None = None
        #: By their names, each with the identity of the file that it was read from.
        self._models: dict[str, tuple[tuple[object, ...], AnchorModel]] = {}
        #: Seconds of `drawing_figures` so far.
        self.figure_seconds = 0.0

    @staticmethod
    def from_path(path: Path, capture: Path | None = None) -> RunContext:
        """The run in a folder. `capture` is where the capture lies if it was moved: the run remembers it.

        Raises what `relocate_capture` raises.
        """
        run = RunFolder(path)
        return RunContext(run, None if capture is None else relocate_capture(run, capture))

    @property
    def capture(self) -> Capture:
        """The capture, read as the run was started. Raises CaptureError if it is gone or changed its form."""
        if self._capture is None:
            self._capture = open_capture(self.run)
        return self._capture

    def find_doubts(self) -> list[str]:
        """As `validation.find_doubts` of the capture, which is looked at once."""
        if self._doubts is None:
            self._doubts = find_doubts(self.capture)
        return self._doubts

    def open_model(
        self, which: ModelName = "best", device: torch.device | str = "cpu", *, mapped: bool = False
    ) -> OpenedRun:
        """A model of the run on a device, with the capture; nobody may change its tensors. Where it is `mapped`, its
        anchors stay in their file until they are used.

        Raises RunError if it is not trained or was made from another capture, CaptureError as `capture` does.
        """
        capture, location = self.capture, locate_model(self.run, which)
        if mapped:
            return with_capture(open_mapped(self.run, location), capture)
        return with_capture(location.opened(self.run, self._model(location, torch.device(device))), capture)

    def release_models(self, *names: str) -> None:
        """Forget models ("coarse", "merged"), without names all: before work that needs the memory."""
        for name in names or tuple(self._models):
            self._models.pop(name, None)

    @contextmanager
    def drawing_figures(self) -> Iterator[None]:
        """Around what a stage makes only for people to look at: whoever compares methods by time leaves it out."""
        began = time.monotonic()
        try:
            yield
        finally:
            self.figure_seconds += time.monotonic() - began

    def _model(self, location: ModelLocation, device: torch.device) -> AnchorModel:
        """The model of a finished stage. Moved to another device, it leaves the one where it was."""
        stage, file = location.stage, location.stage.model.stat()
        identity = (location.key, stage.status().model_id, file.st_ino, file.st_size, file.st_mtime_ns)
        cached = self._models.pop(location.name, ((), None))
        model = cached[1] if cached[0] == identity else None
        del cached  # before another file is read: two models may not fit into the memory
        model = (load_verified(stage, location.key) if model is None else model).to(device)
        self._models[location.name] = (identity, model)
        return model
