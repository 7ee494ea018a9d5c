"""How bright photographs are beside each other, from the colors of the points that several of them show.

log color of point p in photograph i = gain of i + color of p: what a place looks like cancels out, so that it is
known before anything is trained whether the camera changed its exposure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int64
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, cg

from vdgs.captures.capture import View
from vdgs.captures.image_cache import DecodedImage, ImageCache, resize_area

#: So many photographs are looked at, evenly taken.
MAX_IMAGES = 500
#: They are looked at with so many pixels along their longest side, or fewer where they have fewer.
LONGEST_SIDE_PX = 512
#: They are blurred by this share of it, and by half a pixel at least: points are not found to the pixel, and edges fall
#: on either side.
BLUR = 0.006
#: Added to colors of 0 to 255 before their logarithm is taken: nothing is quite black, and noise is.
LOG_OFFSET = 4.0
#: Of a photograph that shares fewer points with others nothing is known.
MIN_SHARED_POINTS = 20
#: So many times each photograph's gain is moved by the median of what its points leave.
MEDIAN_ITERATIONS = 5


@dataclass(frozen=True, eq=False)
class PointColors:
    """Points as photographs show them: s sightings, of point `point[s]` in photograph `image[s]` (in the order of
    photographs), whose color has the logarithm `color[s]` there. Every point is shown by two photographs or more."""

    image: Int64[np.ndarray, " s"]
    point: Int64[np.ndarray, " s"]
    color: Float[np.ndarray, "s 3"]

    def gains(self) -> dict[int, Float[np.ndarray, " 3"]]:
        """Logarithms of how much brighter than the mean each photograph is, in red, green and blue, by its number."""
        numbers, image = np.unique(self.image, return_inverse=True)
        gains = self._fitted(image, len(numbers))
        return dict(zip(numbers.tolist(), gains - gains.mean(axis=0), strict=True))

    def gain_spread(self) -> float:
        """How differently photographs show the same point for their gains: the standard deviation of the gains of those
        that show it, over all points and colors; about a share of their brightness. Slow drifts count by what they
        make between photographs of one place."""
        numbers, image = np.unique(self.image, return_inverse=True)
        gains = self._fitted(image, len(numbers))[image]
        departures = gains - self._means()(gains)[self.point]
        freedom = len(self.point) - len(np.unique(self.point))
        return float(np.sqrt((departures**2).sum(axis=0) / freedom).mean())

    def _means(self) -> Callable[[np.ndarray], np.ndarray]:
        """The mean over the sightings of each point, of values [s, c]."""
        ones = np.ones(len(self.point))
        of_points = csr_matrix((ones, (self.point, np.arange(len(self.point)))))
        often = np.asarray(of_points.sum(axis=1))
        return lambda values: np.asarray(of_points @ values) / often

    def _fitted(self, image: np.ndarray, count: int) -> Float[np.ndarray, "n 3"]:
        """Gains of photographs 0 to count − 1: by least squares, then by medians of what is left, which heed no point
        that something moving hides."""
        mean, much = self._means(), np.bincount(image, minlength=count)[:, None]

        def by_image(values: np.ndarray) -> np.ndarray:
            return np.stack([np.bincount(image, column, count) for column in values.T], axis=1)

        def normal(gains: np.ndarray) -> np.ndarray:
            # The colors of points, eliminated: each takes the mean of what the photographs of it leave.
            gains = gains.reshape(count, -1)
            return much * gains - by_image(mean(gains[image])[self.point])

        departures = self.color - mean(self.color)[self.point]
        # Singular: a gain for all alike says nothing. From 0, conjugate gradients find the least gains of all that fit.
        operator = LinearOperator((count, count), matvec=normal, dtype=np.float64)
        gains = np.stack([cg(operator, wanted)[0] for wanted in by_image(departures).T], axis=1)
        starts = np.flatnonzero(np.diff(image)) + 1
        for _ in range(MEDIAN_ITERATIONS):
            left = departures - gains[image] + mean(gains[image])[self.point]
            medians = np.stack([np.median(rows, axis=0) for rows in np.split(left, starts)])
            gains = gains + medians
        return gains


def collect_point_colors(
    images: ImageCache, on_progress: Callable[[int, int], None], most_images: int = MAX_IMAGES
) -> PointColors | None:
    """What photographs show of the points that several of them show; None where these are too few to compare any: not
    every capture says which photograph shows which point.

    At most `most_images` photographs, spread over all, are looked at.
    `on_progress(done, of)` is called before each photograph is looked at, and may raise. Raises what reading them does.
    """
    chosen = np.unique(np.linspace(0, len(images.views) - 1, min(len(images.views), most_images)).astype(int)).tolist()
    shows = [index for index in chosen if images.views[index].observations is not None]
    factor, found = _factor(images), []
    for done, index in enumerate(shows):
        on_progress(done, len(shows))
        images.prefetch(shows[done : done + 3], factor)
        numbers, colors = _seen(images.views[index], images.get(index, factor))
        found.append((np.full(len(numbers), index), numbers, colors))
    if not found:
        return None
    return _compared(*(np.concatenate(each) for each in zip(*found, strict=True)))


def _factor(images: ImageCache) -> float:
    """The coarsest size that photographs are kept in, of those that are not too small to compare; else the finest."""
    side = max(max(view.camera.width, view.camera.height) for view in images.views)
    return max((each for each in images.downscales if side / each >= LONGEST_SIDE_PX), default=min(images.downscales))


def _seen(view: View, image: DecodedImage) -> tuple[Int64[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    """The numbers of points that a photograph shows, each once, and logarithms of their colors in it."""
    assert view.observations is not None
    side = max(image.image.shape[:2])
    if side > LONGEST_SIDE_PX:
        height, width = (max(1, round(each * LONGEST_SIDE_PX / side)) for each in image.image.shape[:2])
        image = resize_area(image, width, height)
    height, width = image.image.shape[:2]
    camera = view.camera.resized(width, height)
    pixels = view.observations.rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    numbers, once = np.unique(view.observations.point_ids, return_index=True)
    inside = ((pixels[once] >= 0) & (pixels[once] < (width, height))).all(axis=1)
    column, row = np.floor(pixels[once][inside]).astype(np.int64).T
    light, counts = _blurred(image)
    kept = counts[row, column]
    return numbers[inside][kept], np.log(light[row, column][kept].astype(np.float64) + LOG_OFFSET)


def _blurred(image: DecodedImage) -> tuple[Float[np.ndarray, "h w 3"], np.ndarray]:
    """A photograph, blurred, and which of its pixels count: nothing of what is masked gets into them."""
    sigma = max(BLUR * max(image.image.shape[:2]), 0.5)
    light = image.image.numpy().astype(np.float32)
    if image.mask is None:
        return cv2.GaussianBlur(light, (0, 0), sigma), np.ones(light.shape[:2], bool)
    counts = image.mask.numpy() > 0
    weight = counts.astype(np.float32)
    share = cv2.GaussianBlur(weight, (0, 0), sigma)[..., None]
    return cv2.GaussianBlur(light * weight[..., None], (0, 0), sigma) / np.maximum(share, 1e-6), counts


def _compared(image: np.ndarray, number: np.ndarray, color: np.ndarray) -> PointColors | None:
    """The sightings that say something: of points that several photographs show, in photographs that share enough."""
    shared = _shared(number)
    enough = np.bincount(image[shared], minlength=int(image.max(initial=0)) + 1) >= MIN_SHARED_POINTS
    kept = shared & enough[image]
    kept[kept] = _shared(number[kept])
    if not kept.any():
        return None
    _, point = np.unique(number[kept], return_inverse=True)
    return PointColors(image[kept], point.astype(np.int64), color[kept])


def _shared(number: np.ndarray) -> np.ndarray:
    _, place, often = np.unique(number, return_inverse=True, return_counts=True)
    seen_again: np.ndarray = often[place] > 1
    return seen_again
