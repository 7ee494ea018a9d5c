"""How bright photographs are beside each other, from the colours of the points that several of them show.

log colour of point p in photograph i = gain of i + colour of p: what a place looks like cancels out, so that it is
known before anything is trained whether the camera changed its exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import LinearOperator, cg

from vdgs.captures.capture import View
from vdgs.captures.images import ImageCache

#: Photographs are looked at in the smallest size that training has of them with so many pixels along the longest side.
LONGEST_SIDE_PX = 256
#: Photographs are blurred by this share of their longest side, and by half a pixel at least: points are not found to
#: the pixel, and edges fall on either side.
BLUR = 0.006
#: Added to colours of 0 to 255 before their logarithm is taken: nothing is quite black, and noise is.
LEAST_LIGHT = 4.0
#: Weighs a gain of nothing as so many points do (choice): what a point looks like changes a little with the distance
#: that it is seen from, and over a long chain of photographs that adds up to gains which no camera made.
NEUTRAL_POINTS = 10.0
#: So many times each photograph's gain is moved by the median of what its points leave.
MEDIANS = 5


def difference(images: ImageCache, before_each: Callable[[], object]) -> float | None:
    """By how much the photographs of a cache differ in brightness (`deviation`); None where no points tell.

    `before_each` is called before each of them is looked at.
    """
    side = max(max(view.camera.width, view.camera.height) for view in images.views)
    factor = max((each for each in images.downscales if side / each >= LONGEST_SIDE_PX), default=min(images.downscales))

    def read(index: int) -> np.ndarray:
        before_each()
        return images.get(index, factor).image.numpy()

    gains = gains_of(images.views, read)
    return None if gains is None else deviation(gains)


def gains_of(views: Sequence[View], read: Callable[[int], np.ndarray]) -> Float[np.ndarray, "n 3"] | None:
    """Logarithms of how much brighter each photograph is than the mean, in red, green and blue; NaN for one that shows
    no known point. None where none does: not every kind of capture says which photograph shows which point.

    `read(index)` gives the pixels of a view, [h, w, 3] uint8 RGB.
    """
    shown = [0 if view.sightings is None else len(view.sightings.numbers) for view in views]
    if not sum(shown):
        return None
    numbers, colours = [np.zeros(0, np.int64)] * len(views), [np.zeros((0, 3))] * len(views)
    for index in np.flatnonzero(shown).tolist():
        numbers[index], colours[index] = _seen(views[index], read(index))
    gains = _fitted(numbers, colours)
    gains[[not len(each) for each in numbers]] = np.nan
    return gains


def deviation(gains: Float[np.ndarray, "n 3"]) -> float:
    """By how much photographs deviate from one exposure: the root mean square of their gains, about a share of their
    brightness."""
    return float(np.sqrt(np.nanmean(gains**2))) if np.isfinite(gains).any() else 0.0


def _seen(view: View, picture: np.ndarray) -> tuple[Int64[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    """The numbers of points that a photograph shows, and logarithms of their colours in it."""
    assert view.sightings is not None
    height, width = picture.shape[:2]
    blurred = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), max(BLUR * max(height, width), 0.5))
    camera = view.camera.resized(width, height)
    pixels = view.sightings.rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    kept = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    column, row = np.floor(pixels[kept]).astype(np.int64).T
    return view.sightings.numbers[kept], np.log(blurred[row, column].astype(np.float64) + LEAST_LIGHT)


def _fitted(numbers: Sequence[np.ndarray], colours: Sequence[np.ndarray]) -> Float[np.ndarray, "n 3"]:
    """Gains of photographs, 0 in the mean of those with points, from logarithms of colours of points: by least squares,
    then by medians of what is left, which heed no point that something moving hides."""
    much = np.array([len(each) for each in numbers])
    image, values = np.repeat(np.arange(len(much)), much), np.concatenate(list(colours))
    _, point = np.unique(np.concatenate(list(numbers)), return_inverse=True)
    sees = coo_matrix((np.ones(len(image)), (point, image)), shape=(int(point.max(initial=-1)) + 1, len(much))).tocsr()
    often = np.asarray(sees.sum(1)).ravel()[:, None]
    of_points = coo_matrix(
        (np.ones(len(image)), (point, np.arange(len(image)))), shape=(len(often), len(image))
    ).tocsr()

    def normal(gains: np.ndarray) -> np.ndarray:
        # The colours of points, eliminated: each takes the mean of what the photographs of it leave.
        left: np.ndarray = (much + NEUTRAL_POINTS) * gains - sees.T @ ((sees @ gains) / often[:, 0])
        return left

    from_points = values - ((of_points @ values) / often)[point]
    wanted = np.stack([np.bincount(image, column, len(much)) for column in from_points.T], axis=1)
    operator = LinearOperator((len(much), len(much)), matvec=normal, dtype=np.float64)
    gains = np.stack([cg(operator, column)[0] for column in wanted.T], axis=1)
    for _ in range(MEDIANS):
        left = from_points - gains[image] + ((sees @ gains) / often)[point]
        for index, rows in enumerate(np.split(left, np.cumsum(much)[:-1])):
            gains[index] += np.median(rows, axis=0) if len(rows) else 0.0
    centred: np.ndarray = gains - gains[much > 0].mean(axis=0)
    return centred
