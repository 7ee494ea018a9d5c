"""The up axis of a world that nobody has told: from cameras and sparse points alone.

Flights look down on what is flat: up is the axis of least variance, against the view. That fails where cameras look
level. At a wall the flat thing is the wall; in a street the cameras are below the median point. But whoever holds a
camera level has horizontal right vectors and image-ups that agree, and these say what up is. A wall taken from
straight in front by parallel views cannot be told from a flight of one heading that looks straight down (the two are
congruent): it is taken for the flight, with a warning. Nor can a steep slope, straight below cameras of one heading,
be told from a ceiling. Positions may tell both (`position_fit.with_likelier_up`).

Ground that slopes is flat too, but not level. Cameras that hang alike and fly in several directions turn about the
vertical: where that axis is clearly another than that of least variance, it is up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vdgs.geometry.similarity import geometric_median

#: Below this cosine between up and the mean view the sign of up is taken from the heights instead.
MIN_VIEW_COSINE = 0.1
#: The length of the mean image-up from which photographs have the same side up: views within 25 degrees of level, or
#: of one heading (choice).
MIN_UP_AGREEMENT = 0.9
#: From this cosine between up and the mean image-up that says which way up is, where the view says it less (choice).
MIN_UPRIGHT_COSINE = 0.5
#: From this product of the two on, up by the upper sides is where cameras look: at a ceiling, or down on a slope of 30
#: degrees and more (choice).
MIN_SIDES_PRODUCT = 0.4
#: Nobody rolls cameras by so much (squared sine, mean): an axis that asks for it is not up (choice). Right vectors that
#: spread by less are parallel; they fit a hillside too, so that only an axis along them is ruled out.
MAX_ROLL, MAX_ROLL_PARALLEL = float(np.sin(np.radians(10.0))) ** 2, 0.5
#: An axis is clearly the better up if it asks for less than this share of the other's roll, where that is more than of
#: hands (squared sine; choice).
MAX_ROLL_RATIO, CLEAR_ROLL = 0.25, float(np.sin(np.radians(2.5))) ** 2
#: Directions with a larger cosine are near each other (choice).
NEAR_COSINE = 0.9
#: Roll for which right vectors count as much as the mean image-up does: where they spread by less, that decides.
ROLL_PRIOR = 0.002
#: Views whose mean is so long look down alike; it agrees with the shape of the flight within so many degrees (choice).
LOOKS_DOWN, AGREE_DEG = 0.85, 12.0
#: And below this cosine between both the shape of the flight does not say what up is (choice).
MIN_DOWN_COSINE = 0.5
#: Below this ratio of singular values of the mean rotation cameras turned about one axis by enough to tell how they
#: hang from how the world lies (choice).
TURNED = 0.75
#: The axis that cameras turn about is up, not that of least variance, from so many degrees between both on, where these
#: are so many times as many as cameras hang otherwise than on average: more than views of flat ground are off (choice).
MIN_SLOPE_DEG, MIN_SLOPE_RATIO = 4.0, 1.5
#: Fewer photographs may agree by chance on an axis that is not up (choice).
MIN_TURNING = 8
#: Standard deviations of up in degrees: by views that look down, by cameras that are held level, where in doubt.
VIEWS_DEG, LEVEL_DEG, UNCERTAIN_DEG = 3.0, 5.0, 20.0
#: A told up axis farther than this from the estimated one is worth a warning.
MAX_UP_DEVIATION_DEG = 30.0
#: How up was found where the upper sides of photographs say which way it is.
UPPER_SIDES = "upper sides of the photographs up"
#: What may be taken for what where photographs all look one way.
OR_WALL = (
    "all photographs look the same way with the same side up: straight down on ground, or level at a wall. Taken for "
    "down"
)
OR_CEILING = (
    "all photographs look the same way with the same side up: straight down on a slope, or up at a ceiling. Taken for "
    "down"
)
OR_LEVEL = (
    "all photographs have the same side up and are rolled less if that is up: down from a plane that rolls, or level "
    "at a wall and its ground. Taken for the plane"
)
HINT = "--up x|y|z|-x|-y|-z says it outright."


class OtherUp(NamedTuple):
    """Up if photographs that all look one way were taken the other way that looks alike."""

    direction: np.ndarray
    """Unit [3], in the world of the cameras."""
    doubt: str
    """What may be taken for what, in words: a sentence without its end."""
    ruled_out_deg: float | None = None
    """The standard deviation of the up that was taken, once this one is ruled out; None where that changes nothing."""


class UpByViews(NamedTuple):
    """Up as views tell it."""

    direction: np.ndarray
    """Unit [3], in the world of the cameras."""
    deviation_deg: float
    sure: bool
    """Whether up cannot be down."""
    other: OtherUp | None = None
    """None where photographs that were taken otherwise would not look alike."""


class _Views(NamedTuple):
    """How cameras look, together."""

    rights: np.ndarray
    """The right vector of each [n, 3]."""
    image_up: np.ndarray
    """The mean of their image-ups [3]."""
    forward: np.ndarray
    """The mean of their views [3]."""
    same_side: bool
    """Whether all have the same side up."""
    parallel: bool
    """Whether their right vectors are parallel."""


def estimate_up(
    centers: np.ndarray, rotations: np.ndarray, points: np.ndarray, warnings: list[str]
) -> tuple[np.ndarray, str]:
    """Unit up vector [3] in the source world, and how it was found; what is doubtful goes to `warnings`.

    `centers` [n, 3], `rotations` [n, 3, 3] (rows: right, down and forward of a camera) and `points` [m, 3] in the
    source world. All of it turns with the world (no per-axis medians).
    """
    views, doubts = _views(rotations), list[str]()
    up, how, _ = _estimate(views, centers, points, doubts)
    warnings += doubts
    looks_down = float(np.linalg.norm(views.forward)) >= LOOKS_DOWN and _is_against_view(how)
    vertical = _turn_axis(rotations) if looks_down and not doubts else None
    if vertical is None:
        return up, how
    axis = -vertical.axis if vertical.axis @ views.forward > 0 else vertical.axis
    slope = float(np.degrees(np.arccos(np.clip(up @ axis, -1, 1))))
    if slope <= max(MIN_SLOPE_DEG, MIN_SLOPE_RATIO * vertical.scatter_deg):
        return up, how
    return axis, f"the axis that cameras turn about, over a slope of {slope:.0f} degrees"


def _estimate(
    views: _Views, centers: np.ndarray, points: np.ndarray, warnings: list[str]
) -> tuple[np.ndarray, str, OtherUp | None]:
    """What `estimate_up` gives, and what else up may be."""
    axis, how = _axis(views, centers, points, warnings)
    own, looking = float(views.image_up @ axis), float(views.forward @ axis)
    other = _other_up(views, axis)
    warnings += [f"{other.doubt}; if that is wrong, {HINT}"] if other is not None else []
    is_in_doubt = other is not None and other.doubt == OR_CEILING
    if abs(own) >= max(MIN_UPRIGHT_COSINE, abs(looking)) and not is_in_doubt:
        return (-axis if own < 0 else axis), f"{how}, {UPPER_SIDES}", other
    if abs(looking) >= MIN_VIEW_COSINE:
        return (-axis if looking > 0 else axis), f"{how}, against the view", other
    above = float(np.median(centers @ axis) - np.median(points @ axis))
    warnings.append("the cameras look level on average; up is taken to be the side of the cameras. --up overrides.")
    return (-axis if above < 0 else axis), f"{how}, cameras above", None


def contradict_up(rotations: np.ndarray, told: np.ndarray, up: np.ndarray) -> bool:
    """Whether cameras with these rotations [n, 3, 3], as for `estimate_up`, contradict an up axis that was told, unit
    [3], by the one that is estimated without a doubt: they are rolled clearly less about that; or it is far away, they
    are rolled no more about it, and their upper sides are not down."""
    views = _views(rotations)
    ours, theirs = _roll(views.rights, up), _roll(views.rights, told)
    if theirs > CLEAR_ROLL and ours < MAX_ROLL_RATIO * theirs:
        return True
    is_far = float(told @ up) < np.cos(np.radians(MAX_UP_DEVIATION_DEG))
    return is_far and ours <= max(theirs, CLEAR_ROLL) and float(views.image_up @ up) > -MIN_VIEW_COSINE


def _is_against_view(how: str) -> bool:
    """Whether up was found as of a flight that looks down: not of cameras that are held level or upright."""
    return not how.startswith("level") and UPPER_SIDES not in how


class _TurnAxis(NamedTuple):
    """The axis that cameras turn about."""

    axis: np.ndarray
    """Unit [3], of either sign, in the world of the cameras."""
    scatter_deg: float
    """The root mean square of the angles by which cameras hang about it otherwise than on average."""


def _turn_axis(rotations: np.ndarray) -> _TurnAxis | None:
    """The axis that cameras with these rotations [n, 3, 3] turn about; None where they turn too little, or are too few,
    to tell.

    It is the direction of the world that is most nearly the same in all cameras: the singular vector of their mean
    rotation for the largest singular value, which is the mean cosine between it and where it is on average. A tilt
    that all cameras share does not move it, however many fly which way.
    """
    _, values, axes = np.linalg.svd(rotations.mean(axis=0))
    if len(rotations) < MIN_TURNING or values[1] >= TURNED:
        return None
    return _TurnAxis(axes[0], float(np.degrees(np.sqrt(2 * max(0.0, 1 - float(values[0]))))))


def _other_up(views: _Views, axis: np.ndarray) -> OtherUp | None:
    """What else up may be than an axis, of the sign that `_estimate` gives it: of photographs with one side up."""
    own, looking = float(views.image_up @ axis), float(views.forward @ axis)
    if not views.same_side or max(abs(own) / MIN_UPRIGHT_COSINE, abs(looking) / MIN_VIEW_COSINE) < 1:
        return None
    level = _level(views.rights, views.image_up)
    level = -level if level @ views.image_up < 0 else level
    if _is_leveller(level, axis, views):
        return OtherUp(level, OR_LEVEL)
    if not views.parallel or _turn_about(axis, views.rights, views.image_up):
        return None
    if own * looking >= MIN_SIDES_PRODUCT:
        return OtherUp(np.sign(own) * axis, OR_CEILING)
    return OtherUp(level, OR_WALL) if 2 * abs(own) < abs(looking) else None


def _views(rotations: np.ndarray) -> _Views:
    rights, image_up, forward = rotations[:, 0], -rotations[:, 1].mean(axis=0), rotations[:, 2].mean(axis=0)
    same_side = float(np.linalg.norm(image_up)) >= MIN_UP_AGREEMENT
    parallel = bool(np.linalg.eigvalsh(rights.T @ rights / len(rights))[1] < MAX_ROLL)
    return _Views(rights, image_up, forward, same_side, parallel)


def _axis(views: _Views, centers: np.ndarray, points: np.ndarray, warnings: list[str]) -> tuple[np.ndarray, str]:
    """Up, of either sign, and how it was found: by the shape of the flight, or by cameras that are held level."""
    axis, uncertain, how = _flight_axis(views, centers, points)
    neither = abs(views.forward @ axis) < MIN_VIEW_COSINE and abs(views.image_up @ axis) < MIN_UPRIGHT_COSINE
    rolled = _roll(views.rights, axis) > (MAX_ROLL_PARALLEL if views.parallel else MAX_ROLL)
    if views.same_side and (neither or rolled or (uncertain and not views.parallel)):
        if views.parallel:
            warnings.append(
                "the photographs look one way or its opposite: up is taken from their upper sides, and is off by as "
                f"much as they look up or down on average. {HINT}"
            )
        return _level(views.rights, views.image_up), "level cameras"
    if uncertain:
        warnings.append(
            "the up axis is uncertain: cameras and points spread about as far up as sideways. "
            f"Look at the figures of `vdgs inspect`; {HINT}"
        )
    return axis, how


def _flight_axis(views: _Views, centers: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, bool, str]:
    """The axis of least variance, whether it is uncertain, and of what it is."""
    axis, uncertain = _least_variance(centers, points)
    forward = views.forward
    if not views.same_side and np.linalg.norm(forward) >= LOOKS_DOWN and abs(forward @ axis) < MIN_DOWN_COSINE:
        # All look the same way, which is across the axis: cameras of several heights spread farther up than sideways.
        flat, doubt = _least_variance(points)
        if abs(forward @ flat) >= MIN_DOWN_COSINE:
            return flat, doubt, "least variance of points"
    return axis, uncertain, "least variance of cameras and points"


def _least_variance(*places: np.ndarray) -> tuple[np.ndarray, bool]:
    """The axis [3], of either sign, of least variance of places (camera centers, points), and whether it is uncertain.

    All covariances are divided by their trace, so that each counts alike, and added; places beyond the 95 % quantile
    of distance to the median are left out.
    """
    values, vectors = np.linalg.eigh(np.sum([_shape(each) for each in places], axis=0))
    return vectors[:, 0], bool(values[0] > 0.5 * values[1])


def _shape(points: np.ndarray) -> np.ndarray:
    """Covariance divided by its trace, [3, 3]; zero for a single place."""
    offset = points - geometric_median(points)
    distance = np.linalg.norm(offset, axis=1)
    core = points[distance <= np.quantile(distance, 0.95)]
    covariance = np.cov(core, rowvar=False, bias=True) if len(core) > 1 else np.zeros((3, 3))
    trace = np.trace(covariance)
    return covariance / trace if trace > 0 else np.zeros((3, 3))


def _roll(rights: np.ndarray, up: np.ndarray) -> float:
    """Mean squared sine of the angle by which cameras with these right vectors [n, 3] are rolled if `up` is up."""
    return float(((rights @ up) ** 2).mean())


def _is_leveller(level: np.ndarray, axis: np.ndarray, views: _Views) -> bool:
    """Whether cameras are rolled clearly less about their mean image-up than about an axis: before a wall and its
    ground the axis of least variance lies between both. A strip of a plane that rolls has the same geometry."""
    mean = views.image_up / np.linalg.norm(views.image_up)
    if level @ mean < NEAR_COSINE or abs(level @ axis) > NEAR_COSINE:
        return False
    changes = float(np.var(views.rights @ axis))  # of the roll: on a hillside alone all cameras are rolled alike
    return changes > CLEAR_ROLL and _roll(views.rights, level) < MAX_ROLL_RATIO * changes


def _turn_about(axis: np.ndarray, rights: np.ndarray, image_up: np.ndarray) -> bool:
    """Whether right vectors [n, 3] turn about an axis clearly more than they leave the plane across it: the yaw of
    flights that look along it."""
    return _roll(rights, axis) < MAX_ROLL_RATIO * _roll(rights, image_up / np.linalg.norm(image_up))


def _level(rights: np.ndarray, image_up: np.ndarray) -> np.ndarray:
    """Up of cameras that are held level, of either sign: most orthogonal to their right vectors [n, 3], and near their
    mean image-up where those are too parallel to tell."""
    mean = image_up / np.linalg.norm(image_up)
    moment = rights.T @ rights / len(rights) + ROLL_PRIOR * (np.eye(3) - np.outer(mean, mean))
    return np.asarray(np.linalg.eigh(moment)[1][:, 0])


def up_by_views(centers: np.ndarray, rotations: np.ndarray, points: np.ndarray) -> UpByViews:
    """Up of a flight over flat ground or of level cameras, joined with the mean view where that looks down."""
    doubts: list[str] = []
    up, how, other = _estimate(_views(rotations), centers, points, doubts)
    mean = -rotations[:, 2].mean(axis=0)
    length = float(np.linalg.norm(mean))
    # Level at a wall, or nearly so: all views are one, but not down.
    if length < LOOKS_DOWN or not _is_against_view(how):
        return UpByViews(up, UNCERTAIN_DEG if doubts else LEVEL_DEG, not doubts, other)
    mean = mean / length
    if up @ mean < np.cos(np.radians(AGREE_DEG)):  # a slope, or a lone oblique look: the views are nearer to the truth
        apart = float(np.degrees(np.arccos(np.clip(up @ mean, -1, 1))))
        left = float(np.linalg.svd(rotations.mean(axis=0), compute_uv=False)[1])
        doubt = min(_lean_deg(length, left), apart / 2) if left < TURNED else apart / 2
        is_ceiling = other is not None and other.doubt == OR_CEILING
        return UpByViews(mean, max(VIEWS_DEG, doubt), not is_ceiling and bool(up @ mean > 0), other)
    one_way = np.linalg.norm(rotations[:, 1].mean(axis=0)) > MIN_UP_AGREEMENT  # how the camera hangs does not cancel
    middle = up + (1 if one_way else 2) * mean
    looking_down = VIEWS_DEG * (2 if one_way else 1)
    deviation = UNCERTAIN_DEG if doubts and one_way else looking_down  # maybe level at a wall
    other = None if other is None else other._replace(ruled_out_deg=looking_down)
    return UpByViews(middle / np.linalg.norm(middle), deviation, not doubts, other)


def _lean_deg(length: float, left: float) -> float:
    """By how much the mean view leans, in degrees, where cameras that are tilted alike turn about up: `length` is that
    of the mean of their unit views, `left` what is left of the mean of those across up (1: no turn, 0: all around)."""
    across = float(np.sqrt(max(0.0, 1 - length**2) / max(1 - left**2, 1e-9)))  # the sine of the tilt
    return float(np.degrees(np.arctan2(left * across, np.sqrt(max(0.0, 1 - across**2)))))
