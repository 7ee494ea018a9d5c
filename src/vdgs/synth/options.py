"""What a person may choose about a generated capture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from vdgs.errors import VdgsError

_SIZES: dict[str, dict[str, float]] = {
    "toy": {"images": 56, "width": 400, "height": 300, "extent_m": 120.0, "points": 5000},
    "town": {"images": 120, "width": 800, "height": 600, "extent_m": 320.0, "points": 40000},
}


@dataclass(frozen=True)
class SynthOptions:
    """A generated aerial capture; whatever is None takes the value that belongs to `size`."""

    seed: int = 0
    """The same seed and options give the same bytes."""
    size: Literal["toy", "town"] = "toy"
    """toy: 56 images of 400x300 over 120 m; town: 120 images of 800x600 over 320 m."""
    images: int | None = None
    """How many photographs the drone takes."""
    width: int | None = None
    """Width of an image in pixels."""
    height: int | None = None
    """Height of an image in pixels."""
    samples_per_pixel: int = 4
    """Rays averaged in every pixel: more is smoother and slower."""
    flight: Literal["uneven", "even"] = "uneven"
    """uneven: dense over the centre, sparse over the outskirts, some obliques; even: one regular grid."""
    points: int | None = None
    """How many sparse points to aim for."""
    noise_px: float = 0.4
    """Standard deviation of the sparse points' observations, in pixels."""
    extent_m: float | None = None
    """Side of the square that the flight covers, in metres."""
    truth: bool = False
    """Also write true depth maps and the true visibility of every sparse point (folder `truth`)."""
    workers: int = 0
    """Threads that render; 0 takes one per core. The result does not depend on it."""

    def resolved(self) -> ResolvedOptions:
        """These options with every None replaced by the value of `size`.

        Raises VdgsError where a value makes no capture.
        """
        defaults = _SIZES.get(self.size)
        if defaults is None:
            raise VdgsError(f"--size {self.size}: there are only {' and '.join(_SIZES)}.")
        given = {name: getattr(self, name) for name in defaults}
        chosen = {name: defaults[name] if value is None else value for name, value in given.items()}
        if chosen["images"] < 3 or chosen["width"] < 16 or chosen["height"] < 16:
            raise VdgsError("A generated capture needs at least 3 images of at least 16x16 pixels.")
        if chosen["extent_m"] < 40 or chosen["extent_m"] > 1000:
            raise VdgsError("--extent-m must lie between 40 and 1000 metres.")
        if self.samples_per_pixel < 1 or self.noise_px < 0 or chosen["points"] < 10 or self.workers < 0:
            raise VdgsError(
                "--samples-per-pixel must be at least 1, --points at least 10, and neither --noise-px "
                "nor --workers may be negative."
            )
        return ResolvedOptions(
            seed=self.seed,
            images=int(chosen["images"]),
            width=int(chosen["width"]),
            height=int(chosen["height"]),
            samples_per_pixel=self.samples_per_pixel,
            flight=self.flight,
            points=int(chosen["points"]),
            noise_px=self.noise_px,
            extent_m=float(chosen["extent_m"]),
            truth=self.truth,
            workers=self.workers,
        )


@dataclass(frozen=True)
class ResolvedOptions:
    """`SynthOptions` with every value known; the fields mean the same."""

    seed: int
    images: int
    width: int
    height: int
    samples_per_pixel: int
    flight: Literal["uneven", "even"]
    points: int
    noise_px: float
    extent_m: float
    truth: bool
    workers: int

    @property
    def lines(self) -> list[str]:
        """One `name: value` a line, for people; without what does not change the result."""
        stated = replace(self, workers=0)
        return [f"{name}: {value}" for name, value in vars(stated).items() if name != "workers"]
