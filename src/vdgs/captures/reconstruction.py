"""How a capture was made of photographs: `reconstruction.json`, which `vdgs sfm` writes and others show."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vdgs.errors import CaptureError
from vdgs.system.atomic_files import read_json, read_json_or_empty
from vdgs.system.content_digests import ContentDigests
from vdgs.system.records import record_from_dict
from vdgs.system.units import two_digits

RECONSTRUCTION_FILE, RECONSTRUCTION_FIGURE = "reconstruction.json", "reconstruction.png"
#: The model as the photographs alone give it, with their lenses: what positions and control points place.
MAPPED = "mapped"
#: The folder of one that is not finished, or whose intermediate files are kept.
WORK_FOLDER = "work"
#: What says in it, and in the capture, which steps are done.
STEPS_FILE = "steps.json"
#: A step in the file of a finished capture: it is being made anew, and what was trained on it goes once it is replaced.
ANEW = "anew"
#: How far the present step is, in the work folder.
PROGRESS_FILE = "progress.json"
#: The name of the capture in a run of photographs alone.
OWN_CAPTURE = "capture"
#: The photographs that it is made of, in the capture.
SOURCE_IMAGES_FILE = "photographs.json"
#: The digests of what they hold, so that files are read again only where they may have changed.
DIGESTS_FILE = "digests.json"
#: The frames of films that it is made of, a folder for each film; and which films these are.
FRAMES_FOLDER, FILMS_FILE = "frames", "films.json"
#: The stage of a run that makes a capture of photographs, as `vdgs status` names it.
SFM_STAGE = "photographs"
#: What flying heights are over.
OVER_MEDIAN, OVER_GROUND = "the median point", "the ground below each camera"


@dataclass(frozen=True, kw_only=True)
class CameraReport:
    """One camera before and after; the focal length in pixels of its longer side's size."""

    name: str
    photographs: int
    width: int
    height: int
    focal_before_px: float
    focal_source: str
    focal_after_px: float
    radial_distortion: float
    model: str = "SIMPLE_RADIAL"
    """COLMAP's, of the lens as it was fitted."""

    @property
    def is_fisheye(self) -> bool:
        return "FISHEYE" in self.model


@dataclass(frozen=True)
class ImageReport:
    """One photograph: placed minus recorded position in metres, where both are known; or why it is left out."""

    name: str
    residual_m: tuple[float, ...] | None = None
    excluded_reason: str | None = None
    file: str | None = None
    """The own name of one that is left out, where that in the capture is another."""


@dataclass(frozen=True)
class GcpReport:
    """One surveyed point, as the model has it."""

    name: str
    role: str
    """`control`: the model was brought to it; `check`: held out and measured; `not used`: it fits nothing."""
    photographs: int
    """Placed photographs that show it; 0: too few to tell its place."""
    residual_m: tuple[float, ...] | None = None
    """Seen minus surveyed: east, north and, where that was surveyed, up."""
    error_px: float | None = None
    """RMS distance from where photographs show it to where the model puts it there."""


@dataclass(frozen=True, kw_only=True)
class AccuracyFacts:
    """How good a place is; errors are those that 95 % stay below. None: not known, or nothing says it."""

    place_m: tuple[float, ...] | None
    """Of the whole scene, across and up; across alone where no altitudes are known."""
    scale_percent: float | None
    scale_m: float | None
    """What that makes at the edge of the flight."""
    north_deg: float | None
    level_deg: float | None
    positions_m: tuple[float, ...] | None
    """Standard deviation of a recorded position east, north and (where it has one) up, as found from the flight."""
    altitude: str = "used"
    """Recorded altitudes: `used`, `drifts` (with time, left out), `unused`, or `none` where there are none."""
    altitude_drift_m: float = 0.0
    altitude_offsets_m: tuple[float, ...] = ()
    """By how much altitudes of some flights lie over those of another by their datum, left out."""

    @property
    def summary(self) -> str:
        """One line for tables."""
        parts = []
        if self.place_m is not None:
            parts.append(f"place {by_axis(self.place_m, ('across', 'up'), lambda good: f'±{two_digits(good)}')}")
        if self.scale_percent is not None:
            edge = f" (±{two_digits(self.scale_m)} m at the edge)" if self.scale_m is not None else ""
            parts.append(f"scale ±{self.scale_percent:.2g} %{edge}")
        parts += [f"north ±{self.north_deg:.2g}°"] if self.north_deg is not None else []
        parts += [f"level ±{self.level_deg:.2g}°"] if self.level_deg is not None else []
        return f"{', '.join(parts)} (95 %)" if parts else ""


@dataclass(frozen=True, kw_only=True)
class ReconstructionReport:
    """What a person should know about a reconstruction."""

    found: int
    registered: int
    components: tuple[int, ...]
    """Photographs of each part that holds together; the first is used."""
    pairs: int
    points: int
    track_length: float
    """Photographs that see a point, mean."""
    reprojection_px: float
    georeferenced: str
    """How the model was brought to metres, or why it could not."""
    altitude_reference: str
    origin: tuple[float, ...] | None
    residual_rms_m: tuple[float, ...] | None
    """East, north, up; without the last where no altitudes are known."""
    positions_rejected: int
    focal_fixed: bool
    focal_reason: str
    height_m: float | None
    """Median height of the cameras over what `height_over` says."""
    recorded_height_m: float | None
    tilt_deg: float | None
    """Median angle of the views to straight down."""
    attitude_difference_deg: float | None
    """Between down as the model has it and as the drone recorded it, without how the camera hangs on the drone."""
    cameras: tuple[CameraReport, ...]
    photographs: tuple[ImageReport, ...]
    warnings: tuple[str, ...]
    advice: tuple[str, ...]
    seconds: float
    """Of the last part of the work, where it was interrupted."""
    survey: tuple[GcpReport, ...] = ()
    """Surveyed points, those that placed the model and those held out."""
    accuracy: AccuracyFacts | None = None
    """Of the place; None where there is none."""
    up: str = ""
    """By what z is up in a world without metres; empty where nothing tells, and for worlds with metres."""
    heights_m: tuple[float, ...] | None = None
    """The lowest and the highest camera, where they fly at several heights."""
    height_over: str = OVER_MEDIAN
    """What these heights are over: the ground itself where the flight follows it up and down."""
    flown: tuple[str, ...] = ()
    """When the first and the last photograph were taken, as EXIF has it; empty where it says nothing."""

    def gcp_rmse_m(self, used_as: str) -> tuple[float, ...] | None:
        """East, north and, of those with heights, up of check points, or of control points; None where there are
        none."""
        known = [each.residual_m for each in self.survey if each.role == used_as and each.residual_m]
        axes = [[off[axis] for off in known if axis < len(off)] for axis in range(3)]
        return tuple(math.sqrt(sum(value**2 for value in axis) / len(axis)) for axis in axes if axis) or None


def is_reconstruction(root: Path) -> bool:
    """Whether a folder is a capture made of photographs here, finished or not."""
    made = isinstance(read_json_or_empty(root / STEPS_FILE).get("begun"), dict)  # of a project, without a report
    begun = any((root / name).is_file() for name in (f"{WORK_FOLDER}/{STEPS_FILE}", FILMS_FILE))
    return made or begun or _is_ours(root / RECONSTRUCTION_FILE)


def _is_ours(file: Path) -> bool:
    """Whether there is a file of facts; OpenSfM's of the same name is a list."""
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return not stream.read(64).lstrip().startswith(b"[")


def place_name(root: Path) -> str:
    """What the place that a capture shows is called where people read it: as its folder, or, of a capture that a run
    made of photographs, as the run."""
    folder = root.resolve()
    return folder.parent.name if folder.name == OWN_CAPTURE and is_reconstruction(folder) else folder.name


def is_finished(root: Path) -> bool:
    """Whether a capture that was begun here is placed, its last step, and not being made anew."""
    steps = read_json_or_empty(root / STEPS_FILE)
    begun, done = ({} if not isinstance(steps.get(which), dict) else steps[which] for which in ("begun", "done"))
    return (root / RECONSTRUCTION_FILE).is_file() and "placed" in done and ANEW not in begun


def read_digests(output: Path) -> ContentDigests:
    """The digests of the photographs and masks of a capture that are known."""
    return ContentDigests.read(output / DIGESTS_FILE)


def read_reconstruction(root: Path) -> ReconstructionReport | None:
    """The facts of a capture that was made of photographs here; None for others. CaptureError if they are damaged."""
    file = root / RECONSTRUCTION_FILE
    if not _is_ours(file):
        return None
    try:
        return record_from_dict(ReconstructionReport, read_json(file))
    except ValueError as error:
        raise CaptureError(f"{file}: is damaged ({error}). Remove it to do without.") from error


def told_up(root: Path) -> str:
    """By what z is up in a capture that was made of photographs here and has no metres; empty where nothing tells."""
    told = read_json_or_empty(root / RECONSTRUCTION_FILE).get("up")
    return told if isinstance(told, str) else ""


def report_rows(metadata: ReconstructionReport) -> list[tuple[str, str]]:
    """The facts as pairs of what and how much, for tables."""
    parts = f" (parts that do not hold together: {', '.join(map(str, metadata.components))})"
    rows = [
        (
            "Photographs placed",
            f"{metadata.registered} of {metadata.found}" + (parts if len(metadata.components) > 1 else ""),
        ),
        (
            "Reconstruction",
            f"{metadata.points:,} points, seen by {metadata.track_length:.1f} photographs each; reprojection error "
            f"{metadata.reprojection_px:.2f} px",
        ),
        ("Georeference", metadata.georeferenced),
    ]
    rows += _accuracy_rows(metadata.accuracy) if metadata.accuracy is not None else []
    if metadata.residual_rms_m is not None:
        left_out = f"; {metadata.positions_rejected} positions not trusted" if metadata.positions_rejected else ""
        rows.append(("Position residuals", f"RMS {by_axis(metadata.residual_rms_m)}{left_out}"))
    rows += _survey_rows(metadata)
    held = "held" if metadata.focal_fixed else "fitted"
    for camera in metadata.cameras:
        rows.append(
            (
                "Lens",
                f"{camera.name}: {'fisheye, ' if camera.is_fisheye else ''}focal length "
                f"{camera.focal_before_px:.0f} px by {camera.focal_source}, "
                f"{camera.focal_after_px:.0f} px now ({held}: {metadata.focal_reason}), k "
                f"{camera.radial_distortion:+.4f}",
            )
        )
    if metadata.height_m is not None:
        take_off = " over the take-off" if metadata.height_over == OVER_GROUND else ""
        recorded = (
            f", {metadata.recorded_height_m:.1f} m recorded{take_off}" if metadata.recorded_height_m is not None else ""
        )
        height = flying_height(metadata.height_m, metadata.heights_m)
        rows.append(("Flying height", f"{height} over {metadata.height_over}{recorded}"))
    if metadata.tilt_deg is not None:
        against = metadata.attitude_difference_deg
        recorded = f"; down is {against:.1f}° from what the drone recorded" if against is not None else ""
        rows.append(("Tilt of the views", f"{metadata.tilt_deg:.1f}° (median){recorded}"))
    return rows


def flying_height(height_m: float, heights_m: tuple[float, ...] | None) -> str:
    """A median height, and the lowest and the highest where these differ much (`camera_height.height_range`)."""
    return f"{height_m:.1f} m" + (f" (median; {heights_m[0]:.1f} to {heights_m[1]:.1f} m)" if heights_m else "")


def by_axis(
    values: tuple[float, ...],
    axes: tuple[str, ...] = ("east", "north", "up"),
    number: Callable[[float], str] = "{:.2f}".format,
) -> str:
    """Metres along each axis, with the names of the axes; without the last where no altitudes are known."""
    return ", ".join(f"{number(value)} m {axis}" for value, axis in zip(values, axes, strict=False))


def _accuracy_rows(accuracy: AccuracyFacts) -> list[tuple[str, str]]:
    rows = [("Accuracy", accuracy.summary)] if accuracy.summary else []
    if accuracy.positions_m is not None:
        words = {
            "none": "; no altitudes",
            "drifts": f"; altitudes drift by {two_digits(accuracy.altitude_drift_m, '+')} m, left out",
            "unused": "; altitudes are of no use, left out",
        }.get(accuracy.altitude, "")
        if accuracy.altitude_offsets_m:
            over = ", ".join(f"{two_digits(off, '+')} m" for off in accuracy.altitude_offsets_m)
            words = f"; altitudes of flights differ by {over}, left out{words}"
        found = f"{by_axis(accuracy.positions_m, number=two_digits)} (one standard deviation, by the flight itself)"
        rows.append(("Positions are good to", f"{found}{words}"))
    return rows


def _survey_rows(metadata: ReconstructionReport) -> list[tuple[str, str]]:
    rows = []
    for label, used_as, what in (
        ("Control points", "control", "place the model"),
        ("Check points", "check", "held out"),
    ):
        rmse = metadata.gcp_rmse_m(used_as)
        if rmse is not None:
            count = sum(each.role == used_as and each.residual_m is not None for each in metadata.survey)
            axes = ", ".join(f"{v:.3f} m {axis}" for v, axis in zip(rmse, ("east", "north", "up"), strict=False))
            rows.append((label, f"{count}, {what}: RMSE {axes}"))
    return rows


def gcp_table(metadata: ReconstructionReport) -> list[tuple[str, str, str, str, str, str, str]]:
    """Surveyed points as rows of words: name, what for, photographs, east, north, up in metres, pixels."""
    rows = []
    for each in metadata.survey:
        known = each.residual_m or ()
        off = [f"{value:+.3f}" for value in known] + ["–"] * (3 - len(known))
        pixels = f"{each.error_px:.1f}" if each.error_px is not None else "–"
        rows.append((each.name, each.role, str(each.photographs), *off, pixels))
    return rows  # type: ignore[return-value]


def excluded_lines(metadata: ReconstructionReport) -> list[str]:
    """Photographs that are not used, each with the reason."""
    return [
        f"{photo.file or photo.name}: {photo.excluded_reason}"
        for photo in metadata.photographs
        if photo.excluded_reason is not None
    ]
