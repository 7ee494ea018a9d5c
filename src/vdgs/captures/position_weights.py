"""By how much positions differ in accuracy, as their receivers state it and as far as residuals agree. float64.

Of a flight with RTK some photographs are good to centimetres and others, without a fix, to metres. What receivers state
is no truth, though: it lacks what all positions are off by together with the model, and it may be plainly wrong. The
deviation of a position is therefore sqrt(shared² + stated²), of which residuals tell the part that all share: none
where the stated ones explain them, and so much that all count alike where they do not.
"""

from __future__ import annotations

import numpy as np

from vdgs.captures.plane_fit import ENOUGH_TO_DOUBT
from vdgs.system.units import two_digits

#: Deviations that differ by no more than this factor count as one; none counts as more times better or worse than the
#: median (choice).
ALIKE_TIMES, MOST_TIMES = 2.0, 1000.0
#: Positions that state their accuracy speak for all where they have so much of the weight (choice).
NEARLY_ALL = 0.9
#: Positions that are so many times worse than those that count are told (choice).
GOOD_TIMES = 4.0
#: Degrees of freedom of Student's t, as which residuals spread: outliers tell little of what is shared.
TAILS = 3.0
#: What is shared is looked for in steps by this factor; rounds in which the spread of residuals settles.
STEP, ROUNDS = 1.5, 12
#: Of many positions no more than so many tell it before the last rounds, for the sake of time.
SOME, LAST_ROUNDS = 500, 2
#: Of a residual at least this share is left where the fit follows its position.
LEAST_FREE = 0.1


def with_unstated(deviations: np.ndarray, are_stated: np.ndarray) -> np.ndarray:
    """Deviations [n, k] in which a position that does not state its own [n] bool is no better than the usual one that
    does: receivers say nothing where they have nothing to say."""
    if not are_stated.any():
        return deviations
    usual = np.median(deviations[are_stated], axis=0)
    return np.where(are_stated[:, None], deviations, np.maximum(deviations, usual))


def relative_deviations(deviations: np.ndarray) -> np.ndarray | None:
    """Deviations [n, k] over their median on each axis; None where all count alike: they differ little, or are so few
    that a fit could follow each, of whose accuracy residuals then tell nothing."""
    if len(deviations) < ENOUGH_TO_DOUBT:
        return None
    relative = deviations / np.median(deviations, axis=0)
    if (relative.max(axis=0) <= ALIKE_TIMES * relative.min(axis=0)).all():
        return None
    return np.clip(relative, 1 / MOST_TIMES, MOST_TIMES)


def are_told(deviations: np.ndarray, are_stated: np.ndarray) -> bool:
    """Whether a receiver tells how good the positions are: by each of them [n, k], or by so many and so good ones
    that the others hardly count."""
    if are_stated.all():
        return bool(len(are_stated))
    weights = 1 / deviations**2
    shares = weights[are_stated].sum(axis=0) / weights.sum(axis=0)
    return bool(are_stated.sum() >= ENOUGH_TO_DOUBT and (shares >= NEARLY_ALL).all())


def of_alike(deviations: np.ndarray) -> np.ndarray:
    """The deviation [k] of positions [n, k] that count alike whatever they state: the root mean square, for of few one
    that is off by metres moves the fit of all."""
    return np.asarray(np.sqrt((deviations**2).mean(axis=0)))


def weighing_note(deviations: np.ndarray, inliers: np.ndarray) -> str:
    """What to say of positions [n, k] of so different accuracy that each counts by its own; empty where all are alike.
    Accuracies are those that the positions were found to have, in metres across."""
    across = deviations[inliers, 0]
    best = across <= GOOD_TIMES * typical(across[:, None])[0]
    if best.all():
        return ""
    good, others = (two_digits(float(np.median(across[which]))) for which in (best, ~best))
    return (
        f"positions count by the accuracy that each states: {int(best.sum())} of them, good to {good} m across, place "
        f"the scene; the other {int((~best).sum())}, good to {others} m, hardly count."
    )


def typical(deviations: np.ndarray) -> np.ndarray:
    """The deviation [k] of those positions [n, k] that count: the mean, each by its weight in a fit."""
    return np.asarray((1 / deviations).sum(axis=0) / (1 / deviations**2).sum(axis=0))


def as_many(deviations: np.ndarray) -> np.ndarray:
    """As how many positions that are alike these [n, k] count in a fit [k]."""
    weights = 1 / deviations**2
    return np.asarray(weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0))


def agreed(relative: np.ndarray, residuals: np.ndarray, leverages: np.ndarray) -> np.ndarray:
    """By how many times positions [n, 3] are worse than those that count, as they are stated and as far as residuals
    [n, 3] agree: across together, and up. `leverages` [n, 3] is by how much the fit follows each of them."""
    free = residuals / np.sqrt(np.clip(1 - leverages, LEAST_FREE, 1.0))
    across = _shared(relative[:, :2], free[:, :2])
    up = _shared(relative[:, 2:], free[:, 2:]) if residuals[:, 2].any() else 0.0
    found = np.hypot(relative, [across, across, up])
    return np.asarray(found / typical(found))


def _shared(relative: np.ndarray, residuals: np.ndarray) -> float:
    """What all deviations share, in units of the median stated one: the likeliest."""
    least, most = relative.min() / 2, 16 * relative.max()
    steps = 1 + int(np.ceil(np.log(most / least) / np.log(STEP)))
    floors = np.append(0.0, np.geomspace(least, most, steps))
    weights = 1 / (np.ascontiguousarray(relative.T) ** 2 + floors[:, None, None] ** 2)
    squares = residuals.T**2 * weights
    enough = (weights.sum(axis=2) ** 2 / (weights**2).sum(axis=2)).min(axis=1) >= ENOUGH_TO_DOUBT - 0.5
    spread = _spread(squares)
    ratios = squares / (TAILS * spread[:, None, None])
    cost = (TAILS + 1) * np.log1p(ratios).sum(axis=(1, 2)) - np.log(weights).sum(axis=(1, 2))
    cost += residuals.size * np.log(spread)
    return float(floors[np.where(enough, cost, np.inf).argmin()])


def _spread(squares: np.ndarray) -> np.ndarray:
    """Of squares [m, k, n] the variance [m] of Student's t that they have: some of many positions tell it up to the
    last rounds."""
    some = squares[:, :, :: 1 + squares.shape[2] // SOME].copy()
    spread = np.maximum(np.median(some, axis=(1, 2)), 1e-12)
    for part in [some] * (ROUNDS - LAST_ROUNDS) + [squares] * LAST_ROUNDS:
        found = (part / (TAILS + part / spread[:, None, None])).mean(axis=(1, 2))
        spread = np.maximum((TAILS + 1) * found, 1e-12)
    return np.asarray(spread)
