"""What a model file says of the model: which settings, steps and capture made it. Imports no tensors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vdgs.system.documents import CaptureMetadata

ANCHOR_MODEL_FORMAT = "vdgs-anchors-1"
#: Of a model whose blocks have decoders of their own, which readers of one decoder must refuse.
MULTI_DECODER_FORMAT = "vdgs-anchors-2"


@dataclass(frozen=True, kw_only=True)
class ModelMetadata:
    """Where a model comes from; None: not known, or not of this kind of model."""

    capture: CaptureMetadata | None = None
    #: The version of vdgs that wrote it.
    version: str | None = None
    #: Steps of training that the model has seen.
    iterations: int | None = None
    #: Of the settings that it was made with (`runs.stage_keys`).
    key: str | None = None
    #: Of a block: its number, how many photographs trained it, and its setting `decoder`.
    block: int | None = None
    views: int | None = None
    decoder: str | None = None

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON, without what is None, in the order in which the stages have always written it."""
        names = ORDER if self.block is None else ORDER_OF_BLOCK
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> ModelMetadata:
        """The inverse; keys that a newer version wrote are left out. Raises ValueError for a value of another kind."""
        if not isinstance(values, Mapping):
            raise ValueError("its metadata are not an object")
        kinds = {"capture": Mapping, "iterations": int, "block": int, "views": int}
        known = {name: values[name] for name in ORDER if values.get(name) is not None}
        for name, value in known.items():
            if not isinstance(value, kinds.get(name, str)):
                raise ValueError(f"{name} of its metadata is {value!r}")
        return ModelMetadata(**known)


NO_METADATA = ModelMetadata()
ORDER = ("capture", "version", "iterations", "key", "block", "views", "decoder")
ORDER_OF_BLOCK = ("capture", "version", "block", "views", "key", "iterations", "decoder")


def read_model_metadata(path: Path) -> ModelMetadata:
    """The metadata in the header of a model file. Raises OSError, ValueError, KeyError or TypeError for other files."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
        if size > path.stat().st_size:
            raise ValueError(f"{path}: has no header")
        header = json.loads(file.read(size))["__metadata__"]
    content = json.loads(header.get(ANCHOR_MODEL_FORMAT) or header[MULTI_DECODER_FORMAT])
    return ModelMetadata.from_dict(content["facts"])


def is_cut_off(path: Path) -> bool:
    """Whether a safetensors file is shorter than its header says, or has no header that can be read."""
    try:
        with path.open("rb") as file:
            size = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(min(size, path.stat().st_size)))
        ends = [entry["data_offsets"][1] for name, entry in header.items() if name != "__metadata__"]
        return path.stat().st_size < 8 + size + max(ends, default=0)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError):
        return True
