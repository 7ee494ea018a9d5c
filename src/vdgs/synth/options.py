"""What a person may choose about a generated capture."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

from vdgs.errors import VdgsError

Size = Literal["toy", "village", "town", "district", "city"]
Flight = Literal["uneven", "even", "distant", "orbits", "corridor"]

_SIZES: dict[str, dict[str, float]] = {
    "toy": {"images": 24, "width": 96, "height": 72, "extent_m": 60.0, "points": 1500},
    "village": {"images": 56, "width": 400, "height": 300, "extent_m": 120.0, "points": 5000},
    "town": {"images": 120, "width": 800, "height": 600, "extent_m": 320.0, "points": 40000},
    "district": {"images": 150, "width": 400, "height": 300, "extent_m": 420.0, "points": 30000},
    "city": {"images": 600, "width": 400, "height": 300, "extent_m": 900.0, "points": 120000},
}
_FLIGHTS = ("uneven", "even", "distant", "orbits", "corridor")


@dataclass(frozen=True)
class SynthOptions:
    """A generated aerial capture; whatever is None takes the value that belongs to `size`."""

    seed: int = 0
    """The same seed and options give the same bytes."""
    size: Size = "village"
    """toy: 24 images of 96x72 over 60 m (seconds, for tests); village: 56 images of 400x300 over 120 m; town: 120
    images of 800x600 over 320 m; district: 150 images of 400x300 over 420 m, with towers and a lake; city: 600 images
    of 400x300 over 900 m."""
    images: int | None = None
    """How many photographs the drone takes for training."""
    test_images: int | None = None
    """How many test photographs are taken besides, all over what the flight saw, poorly seen parts included; listed in
    test.txt. Default: an eighth of --images, at least 2."""
    validation_images: int | None = None
    """How many further photographs are kept apart from both, for choosing settings (validation.txt; used with
    --validation). Default: as many as test photographs."""
    width: int | None = None
    """Width of an image in pixels."""
    height: int | None = None
    """Height of an image in pixels."""
    samples_per_pixel: int = 4
    """Rays averaged in every pixel: more is smoother and slower."""
    flight: Flight = "uneven"
    """uneven: dense over the centre, sparse over the outskirts, some obliques; even: one regular grid and obliques;
    distant: a dense middle and obliques far out, over land hardly seen; orbits: rings of obliques about landmarks;
    corridor: along the main street."""
    overlap: float | None = None
    """Share of its side that a photograph has in common with the next, were the flight an even grid: sets the
    altitude. Default: an altitude of half the extent, between 36 and 95 m."""
    points: int | None = None
    """How many sparse points to aim for."""
    noise_px: float = 0.4
    """Standard deviation of the sparse points' observations, in pixels."""
    outliers: float = 0.0
    """Share of the sparse points that are mismatches: at a wrong distance along a ray, as in real models."""
    pose_noise_px: float = 0.0
    """Standard deviation of the error of the written poses, as the shift of the picture that it makes, in pixels."""
    exposure_stops: float = 0.0
    """Standard deviation of the photographs' exposure in stops; it drifts along the flight, its colour a little too."""
    extent_m: float | None = None
    """Side of the square that the flight covers, in metres."""
    truth: bool = False
    """Also write true depth, the true visibility (with occlusion) of test and validation photographs per pixel and
    of every sparse point, and true poses (folder `truth`)."""
    workers: int = 0
    """Threads that render; 0 takes one per core. The result does not depend on it."""

    def resolved(self) -> ResolvedOptions:
        """These options with every None replaced by the value of `size`.

        Raises VdgsError where a value makes no capture.
        """
        defaults = _SIZES.get(self.size)
        if defaults is None:
            raise VdgsError(f"--size {self.size}: there are only {', '.join(_SIZES)}.")
        own = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "size"}
        chosen = own | {name: value if own[name] is None else own[name] for name, value in defaults.items()}
        for name in ("images", "width", "height", "points"):
            chosen[name] = int(chosen[name])
        if chosen["test_images"] is None:
            chosen["test_images"] = max(2, chosen["images"] // 8)
        if chosen["validation_images"] is None:
            chosen["validation_images"] = chosen["test_images"]
        result = ResolvedOptions(**(chosen | {"extent_m": float(chosen["extent_m"])}))
        result.check()
        return result


@dataclass(frozen=True)
class ResolvedOptions:
    """`SynthOptions` with every value known (`overlap` may stay open); the fields mean the same."""

    seed: int
    images: int
    test_images: int
    validation_images: int
    width: int
    height: int
    samples_per_pixel: int
    flight: Flight
    overlap: float | None
    points: int
    noise_px: float
    outliers: float
    pose_noise_px: float
    exposure_stops: float
    extent_m: float
    truth: bool
    workers: int

    def check(self) -> None:
        """Raises VdgsError where a value makes no capture."""
        problems = [
            (self.images < 3 or self.width < 16 or self.height < 16,
             "A generated capture needs at least 3 images of at least 16x16 pixels."),
            (self.test_images < 1 or self.validation_images < 0,
             "--test-images must be at least 1, and --validation-images not negative."),
            (not 40 <= self.extent_m <= 1000, "--extent-m must lie between 40 and 1000 metres."),
            (self.flight not in _FLIGHTS, f"--flight {self.flight}: there are only {', '.join(_FLIGHTS)}."),
            (self.overlap is not None and not 0 <= self.overlap < 0.98, "--overlap must lie between 0 and 0.98."),
            (not 0 <= self.outliers <= 0.5, "--outliers is a share of the points, from 0 to 0.5."),
            (not (0 <= self.noise_px < 100 and 0 <= self.pose_noise_px < 100 and 0 <= self.exposure_stops < 10),
             "--noise-px, --pose-noise-px (below 100) and --exposure-stops (below 10) may not be negative."),
            (self.samples_per_pixel < 1 or self.points < 10 or self.workers < 0 or self.seed < 0,
             "--samples-per-pixel must be at least 1, --points at least 10; --workers and --seed may not be negative."),
        ]  # fmt: skip
        for wrong, message in problems:
            if wrong:
                raise VdgsError(message)

    @property
    def lines(self) -> list[str]:
        """One `name: value` a line, for people; without what does not change the result."""
        stated = replace(self, workers=0)
        return [f"{name}: {value}" for name, value in vars(stated).items() if name != "workers"]
