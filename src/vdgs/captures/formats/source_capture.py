"""What a reader hands over: cameras and points as the files have them, before any choice of ours.

Every reader (COLMAP, transforms.json, Mega-NeRF, MatrixCity, MVSNet, LLFF) yields a `SourceCapture` in its own world,
already in OpenCV camera axes. `loading` turns it into a checked `Capture` in the ground frame.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from vdgs.captures.capture import Observations, Split
from vdgs.captures.georeference import Georef
from vdgs.captures.name_resolution import find_file, without_uri
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import ROUNDING_TOLERANCE, nearest_rotation
from vdgs.system.quoting import shell_word
from vdgs.system.units import first_names

#: COLMAP's camera models: identifier -> (name, number of parameters).
CAMERA_MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4),
    16: ("EUCM", 6),
}  # fmt: skip
MODEL_PARAMETERS = dict(CAMERA_MODELS.values())

#: Models with one focal length; all others start fx, fy, cx, cy.
SINGLE_FOCAL = {
    "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE",
    "SIMPLE_DIVISION", "SIMPLE_FISHEYE",
}  # fmt: skip
#: Models that are a pinhole once all further parameters are zero.
PINHOLE_WHEN_ZERO = {
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION",
    "DIVISION",
}  # fmt: skip
#: The lenses of `brown_lens`, which are none of COLMAP's.
BROWN, GENERAL, GENERAL_FISHEYE, EQUISOLID = OWN_LENSES = ("BROWN", "GENERAL", "GENERAL_FISHEYE", "EQUISOLID")
MAX_SIDE_PX = 100_000
#: In images with larger sides than this a principal point within 1 of the corner is no number of pixels.
LEAST_SIDE_PX = 4
#: The principal point of a photograph as it was taken lies between these shares of its sides (choice).
CENTERED = (0.3, 0.7)
#: Names that messages list, and those of photographs that are gone, which a person must find.
MAX_LISTED, MAX_MISSING_LISTED = 10, 100
#: A capture is used without the photographs that are gone where at least this share is there (choice).
LEAST_THERE = 2 / 3
#: Poses that cannot be used are left out where they are at most this share, or one of three or more (choice).
FEW_BAD = 0.1


class NoTiePoints(CaptureError):
    """A capture or project with poses but without points, which `vdgs sfm` finds."""


class BadPose(CaptureError):
    """A pose that is none."""


@dataclass(frozen=True)
class Intrinsics:
    """A COLMAP camera, or one of `brown_lens`: model name, parameters in its order (pixels), image size in pixels."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    @property
    def focal(self) -> tuple[float, float]:
        """(fx, fy) in pixels."""
        return (self.params[0], self.params[0]) if self.model in SINGLE_FOCAL else self.params[:2]  # type: ignore[return-value]

    @property
    def principal_point(self) -> tuple[float, float]:
        """(cx, cy) in pixels from the corner of the image."""
        start = 1 if self.model in SINGLE_FOCAL else 2
        return self.params[start], self.params[start + 1]

    @property
    def is_distorted(self) -> bool:
        """True unless straight lines stay straight."""
        extra = self.params[3 if self.model in SINGLE_FOCAL else 4 :]
        return self.model not in PINHOLE_WHEN_ZERO or any(value != 0.0 for value in extra)


@dataclass(frozen=True, eq=False, kw_only=True)
class SourceView:
    """One photograph: name relative to the image folder (posix), pose, intrinsics, split where it has one."""

    name: str
    camera_from_world: np.ndarray
    intrinsics: Intrinsics
    split: Split | None = None
    #: Where image and mask are, if the format says so itself; else they are looked up by name.
    image_path: Path | None = None
    mask_path: Path | None = None
    observations: Observations | None = None


@dataclass(frozen=True, eq=False)
class WorldPrior:
    """What a format promises about its world: the similarity to a z-up frame.

    x_ground = scale * rotation @ x_source (the origin is chosen later).
    """

    rotation: np.ndarray
    scale: float
    metric: bool
    how: str


@dataclass(frozen=True, eq=False, kw_only=True)
class SourceCapture:
    """A capture as the files have it; points [n, 3] float64, colors [n, 3] uint8."""

    source: str
    images: str
    views: tuple[SourceView, ...]
    points: np.ndarray
    colors: np.ndarray
    world: WorldPrior | None = None
    #: Of a world that is metres, z up, by its own files: where it lies.
    georef: Georef | None = None
    #: Whether the photographs are those of the camera, whose lenses are undone without being asked.
    original_images: bool = False
    #: Folders in which every image should have a camera.
    image_folders: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = field(default=())


#: The list for the test that a capture may bring, by its names; the first that is there counts.
TEST_LISTS = ("test.txt", "train_test_lists.json")


def refuse_many_missing(missing: Sequence[str], count: int, where: Path, strict: bool = False) -> list[str]:
    """A warning about photographs that have a camera but are not there; CaptureError where too few are left, and of any
    where a person is `strict`."""
    if not missing:
        return []
    if strict:
        raise CaptureError(
            f"{where}: {len(missing)} of {count} images that have a camera are missing. Copy them there, or leave "
            f"--strict out to use the others.{format_list(missing, MAX_MISSING_LISTED)}"
        )
    if count - len(missing) < max(1, LEAST_THERE * count):
        raise CaptureError(
            f"{where}: {len(missing)} of {count} images that have a camera are missing; at least "
            f"{LEAST_THERE:.0%} must be there. Copy them there, or choose another folder with --images."
            f"{format_list(missing, MAX_MISSING_LISTED)}"
        )
    more = len(missing) - MAX_MISSING_LISTED
    shown = ", ".join(missing[:MAX_MISSING_LISTED]) + (f", ... and {more} more" if more > 0 else "")
    return [f"{where}: {len(missing)} of {count} images that have a camera are missing; the others are used ({shown})."]


def refuse_lost_tests(lost: Sequence[str], count: int, where: Path, root: Path, options: CaptureOptions) -> list[str]:
    """A warning about test photographs of a set that are not there, of `count`; CaptureError where none is, unless a
    person has chosen another split, by a list in the capture too: photographs that the set trains on would be tested on
    instead."""
    if not lost or options.test_list is not None or options.split not in ("auto", "explicit"):
        return []
    if any((root / name).is_file() for name in TEST_LISTS):  # which counts more than what the set says
        return []
    if len(lost) == count:
        raise CaptureError(
            f"{where}: none of its {count} test photographs is there. Copy them there, choose the folder that test "
            "and training photographs are in with --images, name others with --test-list, or keep some of those that "
            f"train for the test: --split every.{format_list(lost, MAX_MISSING_LISTED)}"
        )
    return [
        f"{where}: {len(lost)} of its {count} test photographs are missing; figures are of the others, not of the "
        "whole test set."
    ]


def without_tested(views: list[SourceView], tested: Collection[str]) -> tuple[list[SourceView], list[str]]:
    """The views without those for training whose photographs, by their names, are `tested` too, and what to say of
    these."""
    kept = [view for view in views if view.split == "test" or view.name not in tested]
    both = [view.name for view in views if view.split != "test" and view.name in tested]
    return kept, tested_only(both)


def tested_only(both: Sequence[str]) -> list[str]:
    """What to say of photographs that a set names for training and for the test."""
    if not both:
        return []
    said = "among the photographs for training and among those for the test; only for the test, not for training"
    return [f"{first_names(both)}: {said} ({len(both)} in all)."]


def leave_out_bad_poses(bad: Mapping[str, CaptureError], count: int, file: Path, strict: bool = False) -> list[str]:
    """A warning about photographs whose pose cannot be used, by their names, with the errors; the first of these is
    raised where they are more than a few of `count`, or a person is `strict`."""
    if not bad:
        return []
    error = next(iter(bad.values()))
    if strict or count < 3 or len(bad) > max(1, FEW_BAD * count):
        raise error
    why = str(error).removeprefix(f"{file}: ")
    return [f"{file.name}: {first_names(list(bad))}: left out, for the pose cannot be used. {why}"]


def one_view_each(views: Sequence[SourceView], file: Path, bad: dict[str, CaptureError]) -> list[SourceView]:
    """The views, each name once: the first of those with one pose. Names with several poses go to `bad`."""
    named: dict[str, list[SourceView]] = {}
    for view in views:
        named.setdefault(view.name, []).append(view)
    for name, doubles in named.items():
        poses = np.array([view.camera_from_world for view in doubles])
        if len({view.intrinsics for view in doubles}) > 1 or not np.allclose(poses, poses[0], rtol=1e-6, atol=1e-6):
            bad[name] = CaptureError(
                f"{file}: the same image occurs more than once, with different poses. Keep one.{format_list([name])}"
            )
    return [doubles[0] for name, doubles in named.items() if name not in bad]


def format_list(names: Iterable[str], most: int = MAX_LISTED) -> str:
    """Up to ten names, or as many as asked for, one a line, and how many more there are."""
    names = list(names)
    shown = "".join(f"\n  {name}" for name in names[:most])
    more = len(names) - most
    return shown + (f"\n  ... and {more} more" if more > 0 else "")


def safe_name(name: str, file: Path, what: str = "image name", root: Path | None = None) -> str:
    """A name in posix form. Raises `CaptureError`, saying `what` it is, if it leaves its folder.

    An absolute one may be meant too, if it lies in `root`: it is then relative to that; so may one of another machine
    or folder, if its end is a file in `root`, with its extension or without.
    """
    name = f"/{plain}" if (plain := without_uri(name)) != name else name
    if root is not None and Path(name).is_absolute():
        with suppress(ValueError):
            name = Path(name).relative_to(root.absolute()).as_posix()
        with suppress(ValueError, OSError):
            name = Path(name).resolve().relative_to(root.resolve()).as_posix() if Path(name).is_absolute() else name
    posix = name.replace("\\", "/")
    parts = PurePosixPath(posix).parts
    climbs = ".." in parts or posix.startswith("/") or bool(PureWindowsPath(name).drive)
    if climbs and root is not None:
        ends = ["/".join(parts[k:]) for k in range(1, len(parts)) if ".." not in parts[k:]]
        inside = next((end for end in ends if "\0" not in end and find_image(root, end) is not None), None)
        if inside is not None:
            return inside
    if not parts or climbs or any(ord(letter) < 32 for letter in name):
        raise CaptureError(
            f"{file}: the {what} {name!r} is not a path inside the {'image folder' if root is None else 'capture'}. "
            "Names must be relative, without '..'; mend the file or export the model again."
        )
    return str(PurePosixPath(posix))


def say_of_panoramas(lens: str) -> str:
    """What to add to the refusal of a lens that is one of panoramas; nothing of others."""
    is_panorama = any(name in lens.upper() for name in ("EQUIRECTANGULAR", "LATLONG"))
    return " Panoramas of 360° are read without a model: vdgs sfm IMAGES --output CAPTURE" if is_panorama else ""


def no_points(root: Path, images: str | None, what: str, other: str) -> NoTiePoints:
    """The error of a capture whose poses come without points: what finds them, and what else to do."""
    return NoTiePoints(
        f"{what} no 3D points, from which the scene starts. This finds them, with the poses as they are: "
        f"{points_command(root, images)}\n{other}"
    )


def points_command(path: Path, images: str | None) -> str:
    """What finds points for poses, of photographs in the folder that `--images` names."""
    where = "" if images is None else f" --images {shell_word(images)}"
    return f"vdgs sfm {shell_word(path)}{where} --output CAPTURE"


def find_image(root: Path, name: str) -> Path | None:
    """The file of an image's name below a folder; the name may lack its extension, and shrunk folders may hold another.
    None where it is gone."""
    suffixes, path = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG"), PurePosixPath(name)
    others = [str(path.with_name(path.name + suffix)) for suffix in suffixes]
    others += [str(path.with_suffix(suffix)) for suffix in suffixes]
    return next((found for found in (find_file(root, each) for each in (name, *others)) if found is not None), None)


def check_intrinsics(intrinsics: Intrinsics, file: Path, label: str) -> Intrinsics:
    """The intrinsics, if they can belong to a real camera, or to a part of its image; else `CaptureError`."""
    width, height = intrinsics.width, intrinsics.height
    problem = None
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        problem = f"an image size of {width}x{height}"
    elif not np.isfinite(intrinsics.params).all():
        problem = f"parameters that are not numbers: {intrinsics.params}"
    else:
        longest = max(width, height)
        if not all(0.01 * longest < f < 1000 * longest for f in intrinsics.focal):
            problem = f"a focal length of {intrinsics.focal} px for an image of {width}x{height}"
        elif not all(-s <= c <= 2 * s for c, s in zip(intrinsics.principal_point, (width, height), strict=True)):
            problem = f"a principal point of {intrinsics.principal_point} for an image of {width}x{height}"
    if problem:
        raise CaptureError(f"{file}: {label} has {problem}. The file is damaged; copy or export it again.")
    cx, cy = intrinsics.principal_point
    if max(abs(cx), abs(cy)) <= 1 and min(width, height) > LEAST_SIDE_PX:
        raise CaptureError(
            f"{file}: {label} has its principal point at {cx:g}, {cy:g}, and the image is {width}x{height} pixels: it "
            f"seems to be a share of the sides (normalised). Write it in pixels, from the upper left corner: "
            f"{cx * width:g}, {cy * height:g} where it counts from there, {width / 2:g}, {height / 2:g} for the middle."
        )
    return intrinsics


def to_rigid(
    matrix: np.ndarray, file: Path, label: str, tolerance: float = ROUNDING_TOLERANCE, *,
    remedy: str = "The file is damaged or of another convention.",
) -> np.ndarray:  # fmt: skip
    """A rigid motion [4, 4] float64 from one that is rigid up to rounding.

    The rotation is replaced by the nearest orthonormal one (SVD). Raises `CaptureError` if an entry is not
    finite, or if R R^T is further than `tolerance` from the identity, or if R is a reflection.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    problem = None
    if matrix.shape not in ((3, 4), (4, 4)):
        problem = f"a pose of shape {matrix.shape} instead of 4x4"
    elif not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e12:
        problem = "a pose that is not a finite number everywhere"
    elif np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() > tolerance:
        problem = "a pose whose rotation is not orthonormal (scaled or sheared)"
    elif np.linalg.det(matrix[:3, :3]) < 0:
        problem = "a pose that mirrors the world"
    if problem:
        raise BadPose(f"{file}: {label} has {problem}. {remedy}")
    result = np.eye(4)
    result[:3, :3] = nearest_rotation(matrix[:3, :3])
    result[:3, 3] = matrix[:3, 3]
    return result
