"""The anchor model: points that carry features, from which Gaussians are decoded per view.

Dimensions: n anchors, k offsets per anchor, 32 features. Positions are float32 in the ground frame.
Equations: Scaffold-GS eqs. 3-8; VDGS section III-B.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.errors import VdgsError
from vdgs.kernels.kernel_types import FEATURE_SIZE
from vdgs.model.anchors import TRAINED_TENSORS, Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.local_exposure import LocalExposure
from vdgs.model.model_metadata import ANCHOR_MODEL_FORMAT, MULTI_DECODER_FORMAT, NO_METADATA, ModelMetadata
from vdgs.system.atomic_files import write_atomic
from vdgs.system.tensors import REBUILD_HINT, map_tensors, read_tensors, tensors_crc32, write_tensors

#: The name of `AnchorModel.local_exposure` in a file.
LOCAL_EXPOSURE = "local_exposure"
#: Anchors checked at once.
CHECK_CHUNK = 1 << 16


@dataclass(frozen=True)
class DecoderSpan:
    """So many anchors of a model, one after another, and the decoder that they share."""

    count: int
    decoder: Decoder


@dataclass(frozen=True, kw_only=True)
class AnchorModel:
    """A scene: anchors, what decodes them, and what is needed to use them again."""

    anchors: Anchors
    #: That of all anchors, or of the coarse stage where blocks have their own (`parts`).
    decoder: Decoder
    #: Edge of the voxel grid on which the anchors started, in units of the ground frame.
    voxel_size: float
    #: Color drawn where nothing is, RGB in [0, 1].
    background: tuple[float, float, float]
    #: Size of a pixel of the photographs (`scale_bounds`): drawn from nearer, Gaussians are as blurred as it; 0: none.
    photograph_pixel: float = 0.0
    metadata: ModelMetadata = NO_METADATA
    #: A merged scene whose blocks trained decoders of their own: all anchors, block by block. Else empty.
    decoder_spans: tuple[DecoderSpan, ...] = ()
    #: What photographs of a place depart by in the mean, which colors are drawn with; None: one exposure for all.
    local_exposure: LocalExposure | None = None

    @property
    def envmap(self) -> Float[Tensor, "rows columns 3"] | None:
        """What is drawn in place of `background` (`model.envmap`); None: nothing is."""
        return self.decoder.envmap

    def decoder_ranges(self) -> list[tuple[int, int, Decoder]]:
        """Which rows of the anchors each decoder decodes: first, one past the last, decoder; ascending."""
        bounds = np.cumsum([0, *(part.count for part in self.decoder_spans)]).tolist()
        spans = [(a, b, part.decoder) for (a, b), part in zip(pairwise(bounds), self.decoder_spans, strict=True)]
        return spans or [(0, len(self.anchors), self.decoder)]

    def select_anchors(self, kept: Bool[Tensor, " n"]) -> AnchorModel:
        """The model with some of its anchors, each with the decoder that it has."""
        counts = [int(each.sum()) for each in kept.split([span.count for span in self.decoder_spans] or len(kept))]
        spans = tuple(replace(span, count=n) for span, n in zip(self.decoder_spans, counts, strict=False))
        return replace(self, anchors=self.anchors.select(kept), decoder_spans=spans)

    def to(self, device: torch.device) -> AnchorModel:
        """The same model on a device."""
        parts = tuple(replace(part, decoder=part.decoder.to(device)) for part in self.decoder_spans)
        exposure = None if self.local_exposure is None else self.local_exposure.to(device)
        return replace(
            self, anchors=self.anchors.to(device), decoder=self.decoder.to(device), decoder_spans=parts,
            local_exposure=exposure,
        )  # fmt: skip

    def without_local_exposure(self) -> AnchorModel:
        """The model in one exposure for all, from which the exposures of photographs depart (`Decoder.exposure`)."""
        return self if self.local_exposure is None else replace(self, local_exposure=None)

    def with_all_levels(self) -> AnchorModel:
        """The model of which every view draws all levels of the anchors; itself where they have none."""
        anchors = self.anchors.with_all_levels()
        return self if anchors is self.anchors else replace(self, anchors=anchors)

    def without_anchors(self) -> AnchorModel:
        """The decoders of the model, whose spans still say which rows they decode."""
        none = torch.zeros(0, dtype=torch.long, device=self.anchors.positions.device)
        return replace(self, anchors=self.anchors.select(none))  # copies: slices would keep the tensors in memory

    def save(self, path: Path) -> None:
        """Write one safetensors file, atomically; without factors of opacities (`Anchors.opacity_factors`)."""
        tensors = {f"anchors.{k}": v for k, v in replace(self.anchors, opacity_factors=None).tensors().items()}
        for prefix, decoder in self._decoders():
            tensors |= {prefix + name: tensor for name, tensor in decoder.tensors().items()}
        content: dict[str, object] = {
            "voxel": self.voxel_size,
            "background": self.background,
            "photograph_pixel": self.photograph_pixel,
            "facts": self.metadata.to_dict(),
        }
        if (local := self.local_exposure) is not None:
            tensors[LOCAL_EXPOSURE] = local.departures
            content[LOCAL_EXPOSURE] = [local.x, local.y, local.spacing]
        content["crc32"] = tensors_crc32(tensors)
        if self.decoder_spans:
            content["parts"] = [part.count for part in self.decoder_spans]
        # A single key: several would be written in an order that varies.
        header = {MULTI_DECODER_FORMAT if self.decoder_spans else ANCHOR_MODEL_FORMAT: json.dumps(content)}
        write_atomic(path, lambda temporary: write_tensors(temporary, tensors, header))

    @staticmethod
    def load(path: Path, *, checked: bool = True, remedy: str = REBUILD_HINT) -> AnchorModel:
        """Read a model. Raises VdgsError if the file is missing, damaged (`remedy` is what to do then) or not an anchor
        model.

        Unless `checked`, numbers are neither read nor checked: they stay in the file, which is mapped, until they are
        used.
        """
        tensors, header = read_tensors(path, remedy)
        found = next((name for name in (ANCHOR_MODEL_FORMAT, MULTI_DECODER_FORMAT) if name in header), None)
        if found is None:
            raise VdgsError(
                f"{path}: is not a vdgs anchor model (its header has neither {ANCHOR_MODEL_FORMAT!r} nor "
                f"{MULTI_DECODER_FORMAT!r})"
            )
        try:
            anchors = Anchors(
                **{n: tensors[f"anchors.{n}"] for n in ("positions", *TRAINED_TENSORS)},
                max_pixels=tensors.get("anchors.max_pixels"),
            )
            known = json.loads(header[found])
            decoder = _decoder_of(tensors, "decoder.")
            counts = known["parts"] if found == MULTI_DECODER_FORMAT else []
            parts = tuple(DecoderSpan(int(n), _decoder_of(tensors, f"part.{i}.")) for i, n in enumerate(counts))
            if checked and known["crc32"] != tensors_crc32(tensors):
                raise ValueError("its checksum does not agree")
            red, green, blue = (float(value) for value in known["background"])
            model = AnchorModel(
                anchors=anchors, decoder=decoder, voxel_size=float(known["voxel"]), background=(red, green, blue),
                photograph_pixel=_pixel_size(known["photograph_pixel"]),
                metadata=ModelMetadata.from_dict(known["facts"]), decoder_spans=parts,
                local_exposure=_local_exposure(tensors, known),
            )  # fmt: skip
            if checked:
                model.check()
        except (KeyError, ValueError, TypeError) as error:
            raise VdgsError(f"{path}: is damaged or incomplete ({error}). {remedy}") from error
        return model

    def check(self) -> None:
        """Raise ValueError unless shapes and dtypes agree and all numbers are finite."""
        n, k = len(self.anchors), self.anchors.offsets.shape[1] if self.anchors.offsets.ndim == 3 else 0
        shapes = {"positions": (n, 3), "features": (n, FEATURE_SIZE), "offsets": (n, k, 3), "log_scales": (n, 6)}
        for name, shape in shapes.items():
            tensor = getattr(self.anchors, name)
            if tuple(tensor.shape) != shape or tensor.dtype != torch.float32:
                raise ValueError(f"{name} is {tensor.dtype} {tuple(tensor.shape)}, not float32 {shape}")
            # In chunks: `isfinite` of all takes more memory than the tensor.
            if not all(bool(torch.isfinite(chunk).all()) for chunk in tensor.split(CHECK_CHUNK)):
                raise ValueError(f"{name} holds numbers that are not finite")
        largest = self.anchors.max_pixels
        if largest is not None and not (tuple(largest.shape) == (n,) and bool((largest > 0).all())):
            raise ValueError(f"max_pixels is {largest.dtype} {tuple(largest.shape)}, not {n} numbers above 0")
        for _, decoder in self._decoders():
            decoder.check(k)
        if self.local_exposure is not None:
            self.local_exposure.check()
        total = sum(span.count for span in self.decoder_spans)
        if self.decoder_spans and total != n:
            raise ValueError(f"its parts hold {total} anchors, not {n}")

    def _decoders(self) -> list[tuple[str, Decoder]]:
        """Every decoder with the prefix of its tensors in a file."""
        return [("decoder.", self.decoder), *((f"part.{i}.", s.decoder) for i, s in enumerate(self.decoder_spans))]


def has_envmap(path: Path) -> bool:
    """Whether the model in a file has an environment map, by its header; False for a file that cannot be read."""
    try:
        return "decoder.envmap" in map_tensors(path)[0]
    except (OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError):
        return False


def _pixel_size(value: float) -> float:
    """The size of a pixel as a file states it. Raises ValueError or TypeError for what is none."""
    if not 0.0 <= value < math.inf:
        raise ValueError(f"its pixels are of size {value!r}")
    return float(value)


def _local_exposure(tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> LocalExposure | None:
    if LOCAL_EXPOSURE not in tensors:
        return None
    x, y, spacing = map(float, header[LOCAL_EXPOSURE])
    return LocalExposure(tensors[LOCAL_EXPOSURE], x, y, spacing)


def _decoder_of(tensors: Mapping[str, Tensor], prefix: str) -> Decoder:
    return Decoder.from_tensors({n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)})
