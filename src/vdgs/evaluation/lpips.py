"""LPIPS with the VGG16 backbone (Zhang et al. 2018), in the two variants that papers mix.

`lpips_vgg` feeds images scaled to [-1, 1], as the metric is defined; `lpips_vgg_01` feeds [0, 1], as
Scaffold-GS and Momentum-GS do. The figures do not compare, so each has its name.

Two files are needed and neither is downloaded: the VGG16 weights of torchvision (0.5 GB) and the
linear heads, 7 kB, which the `torchmetrics` and `lpips` packages ship. Both packages need torchvision
to be imported, so only their data file is read.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from vdgs.errors import VdgsError

VGG16_FILE = "vgg16-397923af.pth"
VGG16_URL = f"https://download.pytorch.org/models/{VGG16_FILE}"
#: Convolutions of VGG16 by stage; a stage ends where LPIPS taps it and a 2 x 2 maximum follows.
VGG_STAGES: tuple[tuple[tuple[int, int, int], ...], ...] = (
    # (index in torchvision's `features`, channels in, channels out)
    ((0, 3, 64), (2, 64, 64)),
    ((5, 64, 128), (7, 128, 128)),
    ((10, 128, 256), (12, 256, 256), (14, 256, 256)),
    ((17, 256, 512), (19, 512, 512), (21, 512, 512)),
    ((24, 512, 512), (26, 512, 512), (28, 512, 512)),
)
#: Where the packages keep the linear heads.
HEAD_FILES = {"torchmetrics": "functional/image/lpips_models/vgg.pth", "lpips": "weights/v0.1/vgg.pth"}
#: ImageNet statistics on the [-1, 1] scale, constants of the metric.
INPUT_SHIFT = (-0.030, -0.088, -0.188)
INPUT_SCALE = (0.458, 0.448, 0.450)
NO_HEADS = "no linear heads. They ship with torchmetrics: pip install 'vdgs[lpips]'."
_EPSILON = 1e-10
#: Four halvings must leave a pixel.
MIN_SIDE_PX = 16


@dataclass(frozen=True)
class LpipsScores:
    """Distances of one image: 0 is identical, larger is further."""

    lpips_vgg: float
    lpips_vgg_01: float


class Lpips:
    """The metric with its weights. One stage of one pair of images is in memory at a time: about 1 kB a
    pixel at the first stage."""

    def __init__(self, backbone: Mapping[str, Tensor], heads: Mapping[str, Tensor]) -> None:
        """Takes tensors under torchvision's names (`features.0.weight` ...) and the heads
        (`lin0.model.1.weight` ...); ValueError where one is missing or has another shape."""
        self._stages: list[list[tuple[Tensor, Tensor]]] = []
        self._heads: list[Tensor] = []
        for number, stage in enumerate(VGG_STAGES):
            layers = []
            for index, inputs, outputs in stage:
                weight = _take(backbone, f"features.{index}.weight", (outputs, inputs, 3, 3))
                layers.append((weight, _take(backbone, f"features.{index}.bias", (outputs,))))
            self._stages.append(layers)
            self._heads.append(_take(heads, f"lin{number}.model.1.weight", (1, stage[-1][2], 1, 1)).reshape(-1))

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], reference: UInt8[np.ndarray, "h w 3"]) -> LpipsScores:
        """Both variants for one pair; ValueError where a side is shorter than 16 pixels."""
        if image.shape != reference.shape or min(image.shape[:2]) < MIN_SIDE_PX:
            raise ValueError(f"LPIPS needs two images of one size, 16 pixels or more a side: {image.shape[:2]}")
        x, y = _planes(image), _planes(reference)
        return LpipsScores(self._distance(2.0 * x - 1.0, 2.0 * y - 1.0), self._distance(x, y))

    @torch.inference_mode()
    def _distance(self, x: Float[Tensor, "1 3 h w"], y: Float[Tensor, "1 3 h w"]) -> float:
        shift, scale = (
            torch.tensor(v, dtype=torch.float32, device="cpu").reshape(1, 3, 1, 1) for v in (INPUT_SHIFT, INPUT_SCALE)
        )
        x, y = (x - shift) / scale, (y - shift) / scale
        total = 0.0
        for number, (layers, head) in enumerate(zip(self._stages, self._heads, strict=True)):
            x, y = (_stage(planes, layers, pool_first=number > 0) for planes in (x, y))
            difference = (_normalized(x) - _normalized(y)).square_()
            total += float(torch.einsum("bchw,c->bhw", difference, head).mean(dtype=torch.float64))
        return total


def load_lpips(weights: Path | None = None, heads: Path | None = None) -> tuple[Lpips | None, str]:
    """The metric, or None and one line that says why and what to do.

    `weights` is torchvision's VGG16 state dict (.pth or .safetensors); without it torch's own download
    folder is looked at. Raises VdgsError where a file that was named, or found, cannot be used.
    """
    head_file = heads or find_heads()
    check_weights_file(weights, head_file)
    cached = default_weights_path()
    source = weights or (cached if cached.is_file() else None)
    if source is None:
        return None, (
            f"LPIPS is null: no VGG16 weights. Download {VGG16_URL} and give --lpips-weights PATH, "
            f"or put it at {cached}." + ("" if head_file else " The linear heads too: pip install 'vdgs[lpips]'.")
        )
    if head_file is None:
        return None, f"LPIPS is null: {NO_HEADS}"
    backbone, linear = _read(source, "VGG16 weights"), _read(head_file, "LPIPS heads")
    try:
        metric = Lpips(backbone, linear)
    except ValueError as error:
        raise VdgsError(
            f"{source} and {head_file} do not make LPIPS: {error}. The weights must be torchvision's VGG16 "
            f"({VGG16_URL}), the heads vgg.pth of torchmetrics or lpips."
        ) from error
    return metric, f"LPIPS from {source.name} ({_weights_origin(source)})"


def check_weights_file(weights: Path | None, heads: Path | None = None) -> None:
    """Raise VdgsError where weights are named and no such file is there, or no linear heads are, without which they
    are of no use."""
    if weights is not None and not weights.is_file():
        raise VdgsError(f"--lpips-weights {weights}: no such file; it should hold the VGG16 weights.")
    if weights is not None and (heads or find_heads()) is None:
        raise VdgsError(f"--lpips-weights {weights}: {NO_HEADS}")


def default_weights_path() -> Path:
    """Where torch keeps torchvision's VGG16 once something has downloaded it (TORCH_HOME moves it)."""
    return Path(torch.hub.get_dir()) / "checkpoints" / VGG16_FILE


def find_heads() -> Path | None:
    """The linear heads inside an installed package, found without importing it; None where there are none."""
    for package, inside in HEAD_FILES.items():
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or []) if spec else []:
            if (file := Path(folder) / inside).is_file():
                return file
    return None


def _weights_origin(weights: Path) -> str:
    """Whether these are torchvision's weights: the name of its file holds the start of its SHA-256."""
    digest = hashlib.sha256()
    with weights.open("rb") as stream:
        while block := stream.read(1 << 22):
            digest.update(block)
    name = digest.hexdigest()[:8]
    return "torchvision's" if name == "397923af" else f"not torchvision's file, sha256 {name}"


def _read(path: Path, what: str) -> dict[str, Tensor]:
    unreadable = (
        f"{path} cannot be read as {what}: it must be a state dict of tensors, saved by torch or as "
        f".safetensors. Perhaps the download was cut off; download it again."
    )
    try:
        is_safetensors = path.suffix == ".safetensors"
        tensors = load_file(path) if is_safetensors else torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise VdgsError(f"{path}: no such file; it should hold the {what}.") from error
    except Exception as error:
        # weights_only raises pickle's own error, and pickle is not imported here
        expected = SafetensorError, OSError, EOFError, RuntimeError, ValueError, KeyError
        if not isinstance(error, expected) and type(error).__name__ != "UnpicklingError":
            raise
        raise VdgsError(unreadable) from error
    if not isinstance(tensors, Mapping):
        raise VdgsError(unreadable)
    return {name: value for name, value in tensors.items() if isinstance(value, Tensor)}


def _take(tensors: Mapping[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    if name not in tensors:
        raise ValueError(f"{name} is missing")
    if tuple(tensors[name].shape) != shape:
        raise ValueError(f"{name} has shape {list(tensors[name].shape)}, not {list(shape)}")
    return tensors[name].detach().to(torch.float32)


def _planes(image: UInt8[np.ndarray, "h w 3"]) -> Float[Tensor, "1 3 h w"]:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))[None]).to(torch.float32) / 255.0


def _stage(planes: Tensor, layers: list[tuple[Tensor, Tensor]], pool_first: bool) -> Tensor:
    if pool_first:
        planes = functional.max_pool2d(planes, kernel_size=2)
    for weight, bias in layers:
        planes = functional.conv2d(planes, weight, bias, padding=1).relu_()
    return planes


def _normalized(features: Tensor) -> Tensor:
    """Unit length over the channels at each place."""
    return features / (features.square().sum(dim=1, keepdim=True).sqrt_() + _EPSILON)
