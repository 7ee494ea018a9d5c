"""What may be wrong with settings, said before any work starts. Only the standard library is imported."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from vdgs.config.method import DensifyConfig, MethodConfig, ResolutionSchedule
from vdgs.config.ranges import find_range_errors, iter_out_of_range, range_missed
from vdgs.config.serialization import from_dict, read_value
from vdgs.config.type_hints import field_hints
from vdgs.config.typed_paths import holds_path, home_path
from vdgs.errors import VdgsError

S = TypeVar("S")


def validate_config(config: MethodConfig) -> list[str]:
    """What is wrong with the settings, one sentence each; empty if nothing is."""
    found = find_range_errors(config)
    training, block = config.training, config.block
    found += _validate_schedule(training.swa_fraction, training.densify, training.resolution_schedule)
    of_block = _validate_schedule(block.swa_fraction, block.densify, block.resolution_schedule)
    found += [f"block.{each}" for each in of_block]
    if block.margin == "ramp" and block.decoder == "own":
        found.append(
            "block.margin ramp needs --block.decoder frozen: a decoder that moves changes anchors that should stay"
        )
    if config.merge.rule == "max-visibility" and block.margin == "frozen":
        found.append(
            "merge.rule max-visibility needs --block.margin ramp or free: a frozen margin has nothing to offer"
        )
    return found


def checked_settings(kind: type[S], values: Mapping[str, Any], where: str) -> S:
    """Settings that a caller in Python gives, as a dataclass; `where` is what messages call their group.

    Raises VdgsError, in the names of the fields, for an unknown one, a value of another type and a number outside its
    range.
    """
    try:
        settings: S = from_dict(kind, _with_homes(kind, values), where, numeric_text=False)
    except ValueError as error:
        raise VdgsError(str(error)) from error
    wrong = next(iter_out_of_range(settings, (where,)), None)
    if wrong is not None:
        raise VdgsError(f"{'.'.join(wrong.path)} is {wrong.value}; it must be {wrong.range}")
    return settings


def _with_homes(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values with the whole paths of home folders that paths among them begin with."""
    hints = field_hints(kind)
    return {
        name: str(home_path(value)) if isinstance(value, (str, Path)) and holds_path(hints.get(name)) else value
        for name, value in values.items()
    }


def checked_value(name: str, value: Any, hint: Any) -> Any:
    """An argument of a function of the API, as its type says. Raises VdgsError for another type or number."""
    try:
        read = read_value(hint, value, name, numeric_text=False)
    except ValueError as error:
        raise VdgsError(str(error)) from error
    if missed := range_missed(hint, read):
        raise VdgsError(f"{name} is {read}; it must be {missed}")
    return read


def check_config(config: MethodConfig) -> None:
    """Raise VdgsError with all that is wrong with the settings."""
    if problems := validate_config(config):
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))


def _validate_schedule(swa_fraction: float, densify: DensifyConfig, resolutions: ResolutionSchedule) -> list[str]:
    """What does not fit together in the course of a training."""
    found, starts = [], [start for start, _ in resolutions]
    if starts[:1] != [0.0]:
        found.append("resolution_schedule must begin at share 0.0")
    if starts != sorted(set(starts)):
        found.append("resolution_schedule: shares must ascend")
    if 0 < swa_fraction < 1 and densify.stop_fraction >= 1:
        found.append("swa_fraction needs growth and pruning to end: densify.stop_fraction must be below 1")
    elif 0 < swa_fraction < 1 and starts and starts[-1] > max(1 - swa_fraction, densify.stop_fraction):
        found.append("swa_fraction would mix models of several image sizes: let resolution_schedule end before it")
    return found
