"""The look before the work: what the photographs are, what they can become, how long that takes."""

from __future__ import annotations

import re
import statistics
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import PurePosixPath

import numpy as np
from shapely import MultiPoint

from vdgs.captures.camera_height import height_range
from vdgs.captures.capture_dates import time_of
from vdgs.sfm.flights import LEAST_PHOTOGRAPHS, flights_of, time_order
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.system.units import first_names

#: A file so much smaller than the median of its camera shows little: blurred, dark, water (choice).
SMALL_FILE_RATIO = 0.4
#: Photographs with less overlap than this along the flight often cannot be joined (choice).
MIN_OVERLAP = 0.6
#: A place should be seen by so many photographs (choice).
MIN_VIEWS_PER_POINT = 4.0
#: Where fewer photographs (share) have positions, the steps between these are not those of the flight (choice).
MIN_POSITIONED = 0.9
#: A lens that took this share of the photographs took many; another shows plainly less from so many times its focal
#: length on (choice).
MANY_OF_LENS, LONGER = 0.2, 1.5
#: Positions whose stated error across is smaller (metres) were corrected, as they were taken or afterwards (choice).
RTK_M = 0.2
#: Views farther from straight down than this are oblique (degrees).
OBLIQUE_ANGLE_DEG = 20.0
#: Views that look less down than this (degrees from straight down; median) show walls: neither the flying height nor
#: the height over the median point is how far away what they show is (choice).
LEVEL_TILT_DEG = 60.0


@dataclass(frozen=True, kw_only=True)
class PreflightReport:
    """What the heads of the photographs tell."""

    num_images: int
    num_masks: int
    """How many have a mask beside them."""
    transparent: int
    """How many have an alpha channel, which is a mask too."""
    cameras: list[tuple[str, int]]
    sizes: list[tuple[int, int, int]]
    """Width, height, how many."""
    positions: int
    spread_m: tuple[float, float] | None
    """East and north."""
    altitude_reference: str
    accurate: int
    """How many say how accurate they are."""
    rtk: bool
    """Whether all these are as accurate as with corrections."""
    height_m: float | None
    heights_m: tuple[float, float] | None
    """The lowest and the highest, where they differ much."""
    height_from: str
    tilt_deg: float | None
    """Median of the recorded angles between views and straight down; None where no photograph says."""
    pixel_rad: float | None
    """What a pixel in the middle shows, in metres for each metre that it is away."""
    gsd_m: float | None
    """Metres that such a pixel shows, were the ground level; this and what follows are None for level views."""
    forward_overlap: float | None
    views_per_point: float | None
    """By how many photographs a place is seen, were the ground level and all views as far from straight down."""
    oblique: int | None
    """Views farther than `OBLIQUE_ANGLE_DEG` from straight down; None where no photograph says."""
    days: list[str]
    warnings: list[str]

    @property
    def shows_ground(self) -> bool:
        """Whether the flying height tells how far away what the photographs show is, as far as is recorded."""
        return _shows_ground(self.tilt_deg)


def make_preflight_report(collection: ImageList, positions: GpsPriors) -> PreflightReport:
    """All that can be said without decoding pixels."""
    photographs = collection.images
    heights, height_from = flying_heights(photographs)
    height = statistics.median(heights) if heights else None
    tilts = [photo.attitude.tilt_deg for photo in photographs if photo.attitude]
    wide = _by_widest_lens(photographs)
    tilt, pixel = _median(tilts), _pixel_rad(wide)
    away = _distance_of_ground(height, tilt)
    footprint = _footprint(wide, away)
    days = sorted({f"{when:%Y-%m-%d}" for when in _moments(photographs)})
    accuracies = [max(photo.gps_std[:2]) for photo in photographs if photo.gps_std is not None]
    # What positions tell of the flight needs those of nearly all photographs.
    shown = footprint if len(positions) >= MIN_POSITIONED * len(photographs) else None
    overlap = _overlap(photographs, positions, shown, {photo.name for photo in wide})
    views = _views_per_place(positions, shown, len(wide) / max(1, len(photographs)))
    return PreflightReport(
        num_images=len(photographs),
        num_masks=sum(photo.mask is not None for photo in photographs),
        transparent=sum(photo.has_alpha_channel for photo in photographs),
        cameras=Counter(photo.camera for photo in photographs).most_common(),
        sizes=[(*size, n) for size, n in Counter((photo.width, photo.height) for photo in photographs).most_common()],
        positions=len(positions),
        spread_m=_spread(positions),
        altitude_reference=positions.altitude_reference,
        accurate=len(accuracies),
        rtk=bool(accuracies) and max(accuracies) < RTK_M,
        height_m=height, heights_m=height_range(heights), height_from=height_from, tilt_deg=tilt, pixel_rad=pixel,
        gsd_m=away * pixel if away and pixel else None,
        forward_overlap=overlap, views_per_point=views,
        oblique=sum(tilt > OBLIQUE_ANGLE_DEG for tilt in tilts) if tilts else None,
        days=days,
        warnings=[*positions.notes, *collection.notes, *_warnings(collection, overlap, views, days)],
    )  # fmt: skip


def flying_heights(photographs: Sequence[ImageMetadata]) -> tuple[list[float], str]:
    """Heights above the take-off in metres, none where too few photographs say theirs; and what says so."""
    heights = [
        photo.relative_altitude for photo in photographs if photo.relative_altitude and photo.relative_altitude > 1
    ]
    if 2 * len(heights) < len(photographs):
        return [], "the photographs do not say it"
    return heights, "above the take-off, by XMP"


def _spread(positions: GpsPriors) -> tuple[float, float] | None:
    """How far positions reach east and north in metres."""
    if not len(positions):
        return None
    east, north = np.ptp(positions.enu[:, :2], axis=0)
    return float(east), float(north)


def _shows_ground(tilt_deg: float | None) -> bool:
    """Whether views of this median tilt look down, for all that is known."""
    return tilt_deg is None or tilt_deg <= LEVEL_TILT_DEG


def _distance_of_ground(height: float | None, tilt_deg: float | None) -> float | None:
    """Metres along the view to level ground so far below; None where views do not look down."""
    if height is None or not _shows_ground(tilt_deg):
        return None
    return height / float(np.cos(np.radians(tilt_deg or 0.0)))


def _by_widest_lens(photographs: Sequence[ImageMetadata]) -> list[ImageMetadata]:
    """The photographs by the widest lens that took many of them, and by lenses nearly as wide: what a zoom beside it
    shows overlaps less, and is in the pictures of that lens."""
    focals = [photo.lens.focal if photo.lens else None for photo in photographs]
    known = sorted(focal for focal in focals if focal)
    if not known:
        return list(photographs)
    most = LONGER * known[int(MANY_OF_LENS * len(known))]
    return [photo for photo, focal in zip(photographs, focals, strict=True) if focal is None or focal <= most]


def _pixel_rad(photographs: Sequence[ImageMetadata]) -> float | None:
    focal = _median(photo.lens.focal * max(photo.width, photo.height) for photo in photographs if photo.lens)
    return 1 / focal if focal else None


def _median(values: object) -> float | None:
    found = list(values)  # type: ignore[call-overload]
    return statistics.median(found) if found else None


def _footprint(photographs: Sequence[ImageMetadata], away: float | None) -> tuple[float, float] | None:
    """Longer and shorter side in metres of what a view shows, square to it, of ground so many metres away: of level
    ground an oblique view shows more."""
    focal = _median(photo.lens.focal for photo in photographs if photo.lens)
    shape = _median(min(photo.width, photo.height) / max(photo.width, photo.height) for photo in photographs)
    return None if not away or not focal or not shape else (away / focal, away / focal * shape)


def _overlap(
    photographs: Sequence[ImageMetadata],
    positions: GpsPriors,
    footprint: tuple[float, float] | None,
    counted: Collection[str],
) -> float | None:
    """Along the flight, if the shorter side points forwards: from the steps between the photographs that are counted,
    by their names, in order of time, of each flight and camera for itself."""
    if footprint is None or len(positions) < 3:
        return None
    taken = [photographs[index] for index in positions.image_indices.tolist()]
    before = dict[int, int]()
    pairs = list[tuple[int, int]]()
    lenses = _lenses_of(taken)
    for k in time_order(taken):
        if taken[k].name not in counted:
            continue
        if lenses[k] in before:
            pairs.append((before[lenses[k]], k))
        before[lenses[k]] = k
    if not pairs:
        return None
    first, second = np.array(pairs).T
    steps = np.linalg.norm(positions.enu[second, :2] - positions.enu[first, :2], axis=1)
    return float(np.clip(1 - np.median(steps) / footprint[1], 0, 1))


def _lenses_of(photographs: Sequence[ImageMetadata]) -> list[int]:
    """The number of the flight and lens of each photograph: lenses of a rig are told by names that differ in more than
    digits (DSC00001_W, DSC00001_E)."""
    flights = flights_of(photographs).tolist()
    words = [re.sub(r"\d", "", PurePosixPath(photo.name).stem) for photo in photographs]
    counts = Counter(zip(flights, words, strict=True))
    told = {flight for flight in flights if all(n >= LEAST_PHOTOGRAPHS for (f, _), n in counts.items() if f == flight)}
    keys = [(flight, word if flight in told else "") for flight, word in zip(flights, words, strict=True)]
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return [numbers[key] for key in keys]


def _views_per_place(positions: GpsPriors, footprint: tuple[float, float] | None, share: float) -> float | None:
    """By how many of the photographs a place is seen, of which a `share` shows the `footprint`."""
    if footprint is None or not positions.usable:
        return None
    area = MultiPoint(positions.enu[:, :2]).convex_hull.buffer(min(footprint) / 4).area
    count = share * len(positions)
    return float(min(count, count * footprint[0] * footprint[1] / area))


def _warnings(collection: ImageList, overlap: float | None, views: float | None, days: Sequence[str]) -> list[str]:
    photographs = collection.images
    found = [*_of_lenses(photographs), *_of_files(photographs)]
    is_covered = views is not None and views >= 2 * MIN_VIEWS_PER_POINT  # by another drone, or strips across
    if overlap is not None and overlap < MIN_OVERLAP and not is_covered:
        found.append(f"they overlap by about {overlap:.0%} along the flight; below {MIN_OVERLAP:.0%} gaps come.")
    if views is not None and views < MIN_VIEWS_PER_POINT:
        found.append(
            f"a place is seen by about {views:.1f} photographs; from {MIN_VIEWS_PER_POINT:g} on scenes become good."
        )
    moments = _moments(photographs)
    if moments and max(moments) - min(moments) > timedelta(days=1):
        found.append(f"taken on {len(days)} days, {days[0]} to {days[-1]}: light, shadows and plants may differ.")
    return found


def _moments(photographs: Sequence[ImageMetadata]) -> list[datetime]:
    return [when for when in (time_of(photo.datetime) for photo in photographs) if when is not None]


def _of_lenses(photographs: Sequence[ImageMetadata]) -> list[str]:
    """What to say of lenses that are unknown, doubted, or of panoramas."""
    unknown = [photo for photo in photographs if photo.lens is None and not photo.is_panorama]
    return [
        *_said_of(unknown, "nothing says the focal length; it is fitted from a guess."),
        *_doubts(photographs),
        *_said_of(
            [photo for photo in photographs if photo.is_panorama],
            "panoramas of 360°; each is cut into six views of 90° that move as one (pano_front/NAME, "
            "pano_right/NAME, ...).",
        ),
        *_said_of(
            [photo for photo in unknown if photo.width == 2 * photo.height],
            "exactly twice as wide as high, of an unknown lens. If these are panoramas of 360°: --camera-model "
            "equirectangular",
        ),
    ]


def _of_files(photographs: Sequence[ImageMetadata]) -> list[str]:
    """What to say of files that were cut off, or may show little."""
    endless = [photo for photo in photographs if not photo.whole]
    return [
        *_said_of(endless, "the file lacks its end marker, but nothing of the picture; used."),
        *_said_of(_small_files(photographs), "far smaller files than the others: blurred, dark, or showing little?"),
    ]


def _said_of(photographs: Sequence[ImageMetadata], text: str) -> list[str]:
    return [f"{first_names([photo.name for photo in photographs])}: {text}"] if photographs else []


def _doubts(photographs: Sequence[ImageMetadata]) -> list[str]:
    """What tags say that is not believed, each with the photographs that it is about; values are those of the first."""
    names, texts = dict[str, list[str]](), dict[str, str]()
    for photo in photographs:
        for doubt in photo.doubts:
            kind = doubt.partition(" (")[0]
            names.setdefault(kind, []).append(photo.name)
            texts.setdefault(kind, doubt)
    return [f"{first_names(names[kind])}: {text.rstrip('.')}." for kind, text in texts.items()]


def _small_files(photographs: Sequence[ImageMetadata]) -> list[ImageMetadata]:
    """Those with far fewer bytes than others of their camera and size."""
    kinds: dict[tuple[str, int, str], list[ImageMetadata]] = {}
    for photo in photographs:
        kinds.setdefault((photo.camera, photo.width * photo.height, photo.path.suffix.lower()), []).append(photo)
    medians = {kind: statistics.median(photo.file_bytes for photo in alike) for kind, alike in kinds.items()}
    return [
        photo for kind, alike in kinds.items() for photo in alike if photo.file_bytes < SMALL_FILE_RATIO * medians[kind]
    ]
