"""What every writer is given: chunks of Gaussians, how many there are, and where on Earth they stand.

Coordinates of a `ExportScene` are those of the ground frame: local, z up, float32. A format that has an up axis of its
own turns them (`formats.axes`); its reader turns them back, so that what is read from disk can be drawn with the run's
own cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import expit
from torch import Tensor

from vdgs import __version__
from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Z_UP, Axes
from vdgs.kernels.spherical_harmonics import SH_C0
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_json

#: Writers work on so many Gaussians at a time, however large the chunks are that they are given: about 100 MB.
CHUNK_SIZE = 1 << 17
#: Of w, x, y, z the three others, by which is the largest.
OTHER_PARTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


@dataclass(frozen=True)
class ExportMetadata:
    """What a file should say beside the Gaussians, as far as its format can."""

    #: Added to local coordinates it gives those of `crs`; float64. Zero where there is none.
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: Coordinate reference system of origin + local coordinates: a name such as EPSG:32633+5773, or WKT.
    crs: str | None = None
    #: Unit of local coordinates.
    unit: str = "metre"
    #: Latitude and longitude (deg) and ellipsoidal height (m) of the local origin; x is then east, y north, z up.
    geodetic: tuple[float, float, float] | None = None
    #: Whether x is east and y north, in any of these systems; else the scene has no place on Earth.
    has_compass: bool = False
    #: Who wrote the file.
    program: str = f"vdgs {__version__}"

    def to_dict(self) -> dict[str, object]:
        """JSON-able, without what is not known, and without what the words on the axes say."""
        return {name: value for name, value in asdict(self).items() if value is not None and name != "has_compass"}


@dataclass(frozen=True)
class InitialView:
    """How a page first shows a scene, in local coordinates."""

    #: Where one stands and what one looks at.
    position: tuple[float, float, float]
    target: tuple[float, float, float]
    #: Color behind the scene, RGB in 0 .. 1.
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    title: str = "scene"
    #: The file may have so many bytes.
    max_bytes: int = 30_000_000
    #: How many training cameras see places [n, 3] in these coordinates, V; None: not known.
    count_visibility: Callable[[Tensor], Tensor] | None = None


@dataclass(frozen=True, kw_only=True)
class ExportScene:
    """Gaussians on their way into a file. They are gone through once."""

    chunks: Iterable[Gaussians]
    count: int
    #: Degree of the spherical harmonics of every chunk.
    degree: int
    metadata: ExportMetadata = ExportMetadata()
    #: Lowest and highest coordinates of the means, where known beforehand: what cannot be held is refused before work.
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    #: For those formats that show the scene themselves; they find a view of their own where it is not given.
    page: InitialView | None = None
    #: How the axes of the file shall stand; None: as readers of its format expect them.
    axes: Axes | None = None
    #: Version of an SPZ.
    spz_version: int = 3
    #: Whether the Gaussians are meant to be drawn anti-aliased, as some programs train them: a PLY and an SPZ say so.
    antialiased: bool = False

    @staticmethod
    def of(gaussians: Gaussians, metadata: ExportMetadata | None = None) -> ExportScene:
        """A scene of Gaussians that are all in memory."""
        low, high = gaussians.means.amin(0).tolist(), gaussians.means.amax(0).tolist()
        return ExportScene(
            chunks=[gaussians],
            count=len(gaussians),
            degree=gaussians.sh_degree,
            metadata=metadata or ExportMetadata(),
            bounds=(tuple(low), tuple(high)),
        )

    def pieces(self, axes: Axes = Z_UP) -> Iterator[Gaussians]:
        """At most `CHUNK_SIZE` Gaussians at a time, on the CPU, unit quaternions, along these axes.

        Raises VdgsError for numbers that are not finite, ValueError where chunks are not what was announced.
        """
        done = 0
        for chunk in self.chunks:
            if chunk.sh_degree != self.degree:
                raise ValueError(f"a chunk has degree {chunk.sh_degree}, announced was {self.degree}")
            for start in range(0, len(chunk), CHUNK_SIZE):
                piece = _clean(
                    chunk.select(torch.arange(start, min(start + CHUNK_SIZE, len(chunk)), device="cpu")), done
                )
                yield axes.of_ground(piece)
                done += len(piece)
        if done != self.count:
            raise ValueError(f"{self.count} Gaussians were announced, {done} came")


def _clean(piece: Gaussians, first: int) -> Gaussians:
    for name, tensor in piece.tensors().items():
        if not bool(torch.isfinite(tensor).all()):
            row = int((~torch.isfinite(tensor.reshape(len(tensor), -1))).any(1).nonzero()[0, 0])
            raise VdgsError(
                f"Gaussian {first + row}: its {name.replace('_', ' ')} are not finite numbers. The model is damaged: "
                "train it again."
            )
    tensors = {name: tensor.detach().cpu().float() for name, tensor in piece.tensors().items()}
    tensors["quaternions"] = torch.nn.functional.normalize(tensors["quaternions"], dim=-1)
    return Gaussians(**tensors)


def concatenate(pieces: Iterable[Gaussians]) -> Gaussians:
    """Pieces of a scene, at least one, as one."""
    tensors = [piece.tensors() for piece in pieces]
    return Gaussians(**{name: torch.cat([each[name] for each in tensors]) for name in tensors[0]})


def opacities(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """In 0 .. 1."""
    opacity: np.ndarray = expit(gaussians.opacity_logits.numpy())  # of scipy: torch's depends on where a number stands
    return opacity


def gaussian_scales(gaussians: Gaussians) -> Float[np.ndarray, "n 3"]:
    """Standard deviations along the Gaussians' own axes."""
    return np.exp(gaussians.log_scales.numpy())


def logits_from_opacity(opacity: Float[np.ndarray, " n"], steps: int = 255) -> Float[Tensor, " n"]:
    """Opacities before the sigmoid. Those of a file in steps are kept half a step away from 0 and 1."""
    return torch.logit(torch.from_numpy(np.clip(opacity, 0.5 / steps, 1 - 0.5 / steps).astype(np.float32)))


def smallest_three(quaternions: Float[np.ndarray, "n 4"]) -> tuple[np.ndarray, Float[np.ndarray, "n 3"]]:
    """Which of w, x, y, z is largest [n], and the others in their order where that one is positive."""
    rows, largest = np.arange(len(quaternions)), np.abs(quaternions).argmax(1)
    signed = np.where(quaternions[rows, largest][:, None] < 0, -quaternions, quaternions)
    return largest, np.take_along_axis(signed, OTHER_PARTS[largest], 1)


def base_colors(gaussians: Gaussians) -> Float[np.ndarray, "n 3"]:
    """Colors without the part that changes with the direction; not clamped to 0 .. 1."""
    return (0.5 + SH_C0 * gaussians.sh0).numpy()


def to_uint8(unit: Float[np.ndarray, "*shape"]) -> np.ndarray:
    """0 .. 1 as uint8, rounded; what is beyond is cut off."""
    return np.clip(np.rint(unit * 255), 0, 255).astype(np.uint8)


def metadata_path(path: Path) -> Path:
    """Where the facts of a file stand whose format has no room for them: FILE.json."""
    return path.with_name(path.name + ".json")


def write_metadata_file(path: Path, metadata: ExportMetadata, axes: Axes) -> None:
    """Write the facts beside a file, with what its axes mean."""
    write_json(metadata_path(path), {"file": path.name, **metadata.to_dict(), "axes": axes.words(metadata.has_compass)})
