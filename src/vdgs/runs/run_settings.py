"""What config.yaml of a run holds, typed: everything that the result depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vdgs.captures.capture_root import capture_root
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import AssignmentConfig, BlockConfig, MergeConfig, MethodConfig, PartitionConfig, TrainConfig
from vdgs.config.ranges import iter_out_of_range
from vdgs.config.serialization import from_dict, to_dict

#: The parts of config.yaml.
SECTIONS = ("capture", "training", "partition", "assignment", "block", "merge")


def with_absolute_paths(options: CaptureOptions, capture: Path) -> CaptureOptions:
    """As config.yaml holds them: stages hand the capture on, also to other machines."""
    paths: dict[str, Any] = {name: path.resolve() for name, path in vars(options).items() if isinstance(path, Path)}
    asked = {"images": options.images, "masks": options.masks}
    for name, folder in asked.items() if options.masks != CaptureOptions.masks else [("images", options.images)]:
        if folder and not (capture_root(capture) / folder).is_dir() and Path(folder).is_dir():  # outside the capture
            paths[name] = Path(folder).resolve().as_posix()
    return replace(options, **paths)


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """The settings of a run: where its capture lies, how the capture is read, and the method, section by section."""

    capture_path: str
    capture: CaptureOptions
    training: TrainConfig
    partition: PartitionConfig
    assignment: AssignmentConfig
    block: BlockConfig
    merge: MergeConfig

    @staticmethod
    def create(capture_path: Path | str, capture: CaptureOptions, method: MethodConfig) -> RunSettings:
        """From the settings of a command."""
        return RunSettings(capture_path=str(capture_path), capture=capture, **vars(method))

    @property
    def method(self) -> MethodConfig:
        """All but the capture."""
        return MethodConfig(**{name: getattr(self, name) for name in SECTIONS[1:]})

    def moved(self, to: Path) -> RunSettings:
        """The settings for the same capture at another place, where the files lie too that options name inside it."""
        before = Path(self.capture_path)
        inside: dict[str, Any] = {
            name: type(value)(to / Path(value).relative_to(before))
            for name, value in vars(self.capture).items()
            if isinstance(value, str | Path) and Path(value).is_relative_to(before)
        }
        return replace(self, capture_path=str(to), capture=replace(self.capture, **inside))

    def to_dict(self) -> dict[str, Any]:
        """As config.yaml holds it."""
        return {"capture": {"path": self.capture_path} | to_dict(self.capture)} | to_dict(self.method)

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> RunSettings:
        """The inverse; what is not named keeps its default. Raises ValueError, naming the setting, for one that is
        unknown, of another type or out of its range."""
        sections = dict(content)
        capture = sections.pop("capture", None)
        if not isinstance(capture, Mapping) or not isinstance(capture.get("path"), str):
            raise ValueError("`capture` must be a group of settings with a path")
        options = from_dict(CaptureOptions, {k: v for k, v in capture.items() if k != "path"}, "capture")
        method = from_dict(MethodConfig, sections, "")
        for section in SECTIONS[1:]:
            for each in iter_out_of_range(getattr(method, section), (section,)):
                raise ValueError(f"{'.'.join(each.path)} is {each.value}; it must be {each.range}")
        return RunSettings.create(capture["path"], options, method)
