"""What a person may choose about a generated capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from vdgs.config.commands import MAX_RENDER_SIDE_PX
from vdgs.config.ranges import WORKER_COUNT, Range, check_ranges
from vdgs.errors import VdgsError

SizeName = Literal["toy", "village", "town", "district", "city"]
FlightName = Literal["uneven", "even", "distant", "orbits", "corridor", "horizon", "heights"]

_SIZES: dict[str, dict[str, Any]] = {
    "toy": {"num_images": 24, "width": 96, "height": 72, "extent_m": 60.0, "num_points": 1500},
    "village": {"num_images": 56, "width": 400, "height": 300, "extent_m": 120.0, "num_points": 5000},
    "town": {"num_images": 120, "width": 800, "height": 600, "extent_m": 320.0, "num_points": 40000},
    "district": {"num_images": 150, "width": 400, "height": 300, "extent_m": 420.0, "num_points": 30000},
    "city": {"num_images": 600, "width": 400, "height": 300, "extent_m": 900.0, "num_points": 120000},
}


@dataclass(frozen=True, kw_only=True)
class SynthOptions:
    """A generated aerial capture; whatever is None takes the value that belongs to `size`."""

    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """The same seed and options give the same bytes."""
    size: SizeName = "village"
    """Size of the place. toy: 24 images of 96x72 over 60 m (seconds, for tests); village: 56 images of 400x300 over
    120 m; town: 120 images of 800x600 over 320 m; district: 150 images of 400x300 over 420 m, with towers and a lake;
    city: 600 images of 400x300 over 900 m."""
    num_images: Annotated[int | None, Range(3, 100_000)] = None
    """How many photographs the drone takes for training."""
    num_test_images: Annotated[int | None, Range(1, 100_000)] = None
    """How many test photographs are taken besides, all over what the flight saw, poorly seen parts included; listed in
    test.txt. Default: an eighth of --num-images, at least 2."""
    num_validation_images: Annotated[int | None, Range(0, 100_000)] = None
    """How many further photographs are kept apart from both, for choosing settings (validation.txt; used with
    --validation). Default: as many as test photographs."""
    num_off_path_images: Annotated[int | None, Range(0, 100_000)] = None
    """How many photographs of each of three kinds are taken from where the drone never was: low and oblique, from the
    street, from outside. Every second one is for validation. Default: a twelfth of --num-images, even, 2 to 12."""
    num_moving_objects: Annotated[int, Range(0, 100_000)] = 0
    """How many cars, buses and people move about the streets of the whole place: each training photograph shows them
    elsewhere (what moves is black in truth/masks). Test, validation and off-path photographs show none."""
    moving_water: bool = False
    """The pond lies in the middle of the town, and each training photograph meets other waves, which mirror sky and sun
    elsewhere (what differs from still water is black in truth/masks). Other photographs show still water."""
    width: Annotated[int | None, Range(16, MAX_RENDER_SIDE_PX)] = None
    """Width of an image in pixels."""
    height: Annotated[int | None, Range(16, MAX_RENDER_SIDE_PX)] = None
    """Height of an image in pixels."""
    samples_per_pixel: Annotated[int, Range(1, 1024)] = 4
    """Rays averaged in every pixel: more is smoother and slower."""
    flight: FlightName = "uneven"
    """How the drone flies. uneven: dense over the center, sparse over the outskirts, some obliques; even: one regular
    grid and obliques; distant: a dense middle and obliques far out, over land hardly seen; orbits: rings of obliques
    about landmarks; corridor: along the main street; horizon: a grid, and obliques that show the horizon below a cloudy
    sky; heights: the even flight, and a grid from four times as high."""
    overlap: Annotated[float | None, Range(0, 0.98, exclusive_max=True)] = None
    """Share of its side that a photograph has in common with the next, were the flight an even grid: sets the
    altitude. Default: an altitude of half the extent, between 36 and 95 m."""
    num_points: Annotated[int | None, Range(10, 100_000_000)] = None
    """How many sparse points to aim for."""
    noise_px: Annotated[float, Range(0, 100, exclusive_max=True)] = 0.4
    """Standard deviation of the sparse points' observations, in pixels."""
    outlier_fraction: Annotated[float, Range(0, 0.5)] = 0.0
    """Share of the sparse points that are mismatches: at a wrong distance along a ray, as in real models."""
    pose_noise_px: Annotated[float, Range(0, 100, exclusive_max=True)] = 0.0
    """Standard deviation of the error of the written poses, as the shift of the picture that it makes, in pixels."""
    exposure_stops: Annotated[float, Range(0, 10, exclusive_max=True)] = 0.0
    """Standard deviation of the photographs' exposure in stops; it drifts along the flight, its color a little too."""
    extent_m: Annotated[float | None, Range(40, 1000)] = None
    """Side of the square that the flight covers, in metres."""
    truth: bool = False
    """Also write true depth, the true visibility (with occlusion) of test and validation photographs per pixel and
    of every sparse point, and true poses (folder `truth`)."""
    workers: Annotated[int, WORKER_COUNT] = 0
    """Threads that render; 0 takes one per core. The result does not depend on it."""

    def resolved(self) -> ResolvedOptions:
        """These options with every None but `overlap` replaced by the value of `size`.

        Raises VdgsError where a value makes no capture.
        """
        if self.size not in _SIZES:
            raise VdgsError(f"--size {self.size}: there are only {', '.join(_SIZES)}.")
        if self.flight not in get_args(FlightName):
            raise VdgsError(f"--flight {self.flight}: there are only {', '.join(get_args(FlightName))}.")
        check_ranges(self)
        defaults = _SIZES[self.size]
        values = vars(self) | {name: value for name, value in defaults.items() if getattr(self, name) is None}
        if values["num_test_images"] is None:
            values["num_test_images"] = max(2, values["num_images"] // 8)
        if values["num_validation_images"] is None:
            values["num_validation_images"] = values["num_test_images"]
        if values["num_off_path_images"] is None:
            values["num_off_path_images"] = 2 * min(6, max(1, values["num_images"] // 24))
        return ResolvedOptions(**(values | {"extent_m": float(values["extent_m"])}))


@dataclass(frozen=True, kw_only=True)
class ResolvedOptions(SynthOptions):
    """`SynthOptions` with every value known; `overlap` alone may stay open."""

    num_images: int
    num_test_images: int
    num_validation_images: int
    num_off_path_images: int
    width: int
    height: int
    num_points: int
    extent_m: float

    @property
    def has_motion(self) -> bool:
        """Whether anything differs between training photographs of one place."""
        return self.moving_water or self.num_moving_objects > 0

    @property
    def to_lines(self) -> list[str]:
        """One `name: value` a line, for people; without what does not change the result."""
        unused = {"size", "workers"} | {name for name in ("num_moving_objects", "moving_water") if not vars(self)[name]}
        return [f"{name}: {value}" for name, value in vars(self).items() if name not in unused]
