"""What a run starts with: the defaults, below the preset, below the file of `--config`, below the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vdgs.cli.argument_parser import GivenArguments
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig, TrainConfig, resolve_iterations
from vdgs.config.options import with_values
from vdgs.config.presets import NEW_RUN_PRESET, PRESETS, PresetName

_STEPS = ("training", "iterations")


@dataclass(frozen=True, kw_only=True)
class StartSettings:
    """Settings below those of the command line."""

    preset: PresetName | None
    """None where a run that is there keeps its own settings."""
    options: CaptureOptions
    method: MethodConfig
    reason: str = ""
    """Why the preset was chosen, where nobody named it."""

    def layer(self) -> Mapping[str, Any]:
        """As defaults of `vdgs run`."""
        return {"options": self.options} | vars(self.method)


def start_settings(given: GivenArguments) -> StartSettings:
    """The settings that a command line starts from.

    A run that is there reads its capture as before, and without a preset it keeps its own method; a new one takes
    `NEW_RUN_PRESET`. Raises VdgsError for a file of settings that does not work and for a device that is none.
    """
    named, file = given.get("preset"), given.get("config")
    own = _own_settings(given.get("output"), given.get("capture"))
    preset: PresetName | None = None if named in (None, "auto") else named
    reason = ""
    if preset is None and own is None:
        preset, reason = NEW_RUN_PRESET, _device_of_new_run(given.get("device") or "auto")
    options = CaptureOptions() if own is None else own.capture
    method = own.method if preset is None else PRESETS[preset]
    if file is not None:
        from vdgs.runs.settings_file import read_settings_file

        of_capture, of_method = read_settings_file(file)
        of_method = {path: 0 if _are_by_count(file.parent, path, value) else value for path, value in of_method.items()}
        options, method = with_values(options, of_capture), with_values(method, of_method)
    return StartSettings(preset=preset, options=options, method=method, reason=reason)


def _own_settings(output: Path | None, capture: Path | None) -> Any:
    """The settings of the run in a folder (`RunSettings`), for its capture where it is given; None where there is no
    run."""
    if output is None or not (output / "config.yaml").is_file():
        return None
    from vdgs.runs.run_folder import RunFolder

    own = RunFolder(output).settings()
    if _are_by_count(output, _STEPS, own.method.training.iterations):
        own = with_values(own, {_STEPS: 0})
    return own if capture is None else own.moved(capture.resolve())


def _are_by_count(run: Path, path: Any, value: Any) -> bool:
    """Whether a setting of the run in a folder is the steps of its coarse stage, and these are as many as follow from
    its photographs: of other photographs they follow again."""
    if path != _STEPS:
        return False
    from vdgs.system.atomic_files import read_json_or_empty

    views = read_json_or_empty(run / "capture.json").get("training_views")
    return isinstance(views, list) and value == resolve_iterations(TrainConfig(iterations=0), len(views)).iterations


def _device_of_new_run(device: str) -> str:
    from vdgs.kernels.device_selection import select_device

    selected = select_device(device)
    takes = "steps follow the number of photographs"
    return f"{NEW_RUN_PRESET} ({takes}) on {selected.device} ({selected.reason}); --preset overrides"
