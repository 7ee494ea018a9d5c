"""Scenes that are folders: captures of one's own, beside the scenes that have names."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from experiments.bench.definitions import BenchScene, Budget
from experiments.bench.scenes import LAPTOP_BUDGET, SCENES
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_fingerprint
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig, resolve_iterations
from vdgs.config.presets import PRESETS
from vdgs.errors import VdgsError

#: A block is topped up to this share of the training photographs, within these limits (choice): of a few dozen, a
#: hundred would be all.
MIN_CAMERA_SHARE, MIN_CAMERAS, MAX_CAMERAS = 1 / 8, 16, 100


def resolve_scenes(texts: Sequence[str], options: CaptureOptions, validation: bool) -> tuple[BenchScene, ...]:
    """The scenes that names and folders stand for; `options` say how the folders are read.

    A known name is that scene, whatever lies in the working directory; what holds a slash, or is a folder there, is a
    capture. Raises VdgsError for anything else, for a scene named twice and for options that no folder is read with;
    CaptureError for a folder that is no capture that can be used.
    """
    scenes: dict[str | Path, BenchScene] = {}
    for text in texts:
        folder = _folder(text)
        key = text if folder is None else folder.resolve()
        if key in scenes:
            raise VdgsError(f"--scenes: {text} is there twice")
        taken = {*SCENES, *(scene.name for scene in scenes.values())}
        scenes[key] = SCENES[text] if folder is None else _scene_from_folder(folder, options, validation, taken)
    if not any(scene.folder for scene in scenes.values()):
        flags = [f"--{name.replace('_', '-')}" for name in _non_default_options(options)]
        if flags:
            raise VdgsError(
                f"{', '.join(flags)}: say how a capture is read that is given as a folder (--scenes ./my-place); "
                "scenes with names have options of their own. Leave them out."
            )
    return tuple(scenes.values())


def budget_for(training_views: int) -> Budget:
    """As many coarse iterations as the preset `laptop` takes for so many photographs, and as many for all blocks
    together: that of the small real captures, in proportion."""
    coarse = resolve_iterations(PRESETS["laptop"].training, training_views).iterations
    return LAPTOP_BUDGET.scaled(coarse / LAPTOP_BUDGET.coarse)


def _folder(text: str) -> Path | None:
    """The folder that is meant; None for the name of a scene."""
    if text in SCENES:
        return None
    if "/" in text or Path(text).is_dir():
        return Path(text)
    raise VdgsError(
        f"there is no scene {text!r}. There are: {', '.join(SCENES)}. A capture of your own is given as its folder, "
        "such as ./my-place."
    )


def _scene_from_folder(folder: Path, options: CaptureOptions, validation: bool, taken: Collection[str]) -> BenchScene:
    capture = load_capture(folder, options)
    if validation:
        load_capture(folder, replace(options, validation=True))  # what cannot be held out is said now
    name, training = _name(folder, taken), len(capture.train_views)
    return BenchScene(
        name, name, budget_for(training), options=_non_default_options(options), override=_limit_min_cameras(training),
        folder=folder.resolve(), contents=capture_fingerprint(capture), note=_note(capture),
    )  # fmt: skip


def _name(folder: Path, taken: Collection[str]) -> str:
    """The folder's own name, as a folder's name anywhere, with a number where another scene has it."""
    name = re.sub(r"[^\w.+-]+", "-", folder.resolve().name).strip("-.") or "capture"
    numbered = (f"{name}-{number}" for number in range(2, len(taken) + 3))
    return next(each for each in (name, *numbered) if each not in taken)


def _non_default_options(options: CaptureOptions) -> dict[str, Any]:
    """What is not as it is by default; files by their full paths, since processes read them."""
    values = {each.name: getattr(options, each.name) for each in fields(options) if each.name != "validation"}
    defaults = CaptureOptions()
    return {
        name: value.resolve() if isinstance(value, Path) else value
        for name, value in values.items()
        if value != getattr(defaults, name)
    }


def _limit_min_cameras(training: int) -> Callable[[MethodConfig], MethodConfig]:
    cameras = min(max(round(MIN_CAMERA_SHARE * training), MIN_CAMERAS), MAX_CAMERAS)
    return lambda config: replace(config, assignment=replace(config.assignment, min_cameras=cameras))


def _note(capture: Capture) -> str:
    training, camera = len(capture.train_views), capture.train_views[0].camera
    return (
        f"A capture given as a folder: {training:,} training and {len(capture.test_views):,} test photographs of "
        f"{camera.width} x {camera.height} pixels (from {capture.images})."
    )
