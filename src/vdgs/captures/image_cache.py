"""The photographs' pixels in memory: uint8 within a byte budget, prefetched by threads."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from vdgs.captures.capture import View
from vdgs.captures.image_files import decode_image, decode_mask, same_aspect
from vdgs.errors import CaptureError
from vdgs.geometry.camera import Camera

#: Prefetches beyond this many are dropped: a hint, not a promise.
MAX_PREFETCH = 16


class DecodedImage(NamedTuple):
    """Pixels [h, w, 3] uint8 RGB, and the mask [h, w] uint8 (1 = keep, 0 = leave out) where there is one."""

    image: Tensor
    mask: Tensor | None

    @property
    def nbytes(self) -> int:
        return self.image.nbytes + (0 if self.mask is None else self.mask.nbytes)


class ImageCache:
    """Least-recently-used cache of decoded pictures; safe to use from several threads.

    `budget_bytes` bounds what is kept; beyond it there is only what callers hold and, per thread, the picture
    being decoded. A single picture larger than the budget is handed out and not kept. Tensors are shared with
    the cache: do not write into them.

    The picture at downscale s is made from the one at downscale 1 (the size of the view's camera) by area
    averaging, so that its pixels do not depend on what happened to be cached.
    """

    def __init__(
        self, views: Sequence[View], budget_bytes: int, downscales: Sequence[float] = (1,), threads: int = 1
    ) -> None:
        if budget_bytes < 0 or not downscales or min(downscales) < 1:
            raise ValueError("a cache needs a budget of at least 0 bytes and downscales of at least 1")
        self.views = tuple(views)
        self.budget_bytes = budget_bytes
        self.downscales = tuple(downscales)
        self._kept: OrderedDict[tuple[int, float], DecodedImage] = OrderedDict()
        self._bytes = 0
        self._pending: dict[tuple[int, float], Future[DecodedImage]] = {}
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max_workers=threads, thread_name_prefix="images")
        self._closed = False

    def __enter__(self) -> ImageCache:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def nbytes(self) -> int:
        """Bytes kept now; never above the budget."""
        return self._bytes

    def camera(self, index: int, downscale: float = 1) -> Camera:
        """The view's camera at the size of `get(index, downscale)`: floor(w / s) x floor(h / s)."""
        camera = self.views[index].camera
        return camera.resized(*self._size(index, downscale)) if downscale != 1 else camera

    def get(self, index: int, downscale: float = 1) -> DecodedImage:
        """The picture of view `index`. Raises `CaptureError` naming the file if it cannot be decoded."""
        key = self._key(index, downscale)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
            future = self._pending.get(key)
            mine = future is None
            if future is None:
                # Announced before decoding, so that a second caller waits instead of decoding again.
                future = self._pending[key] = Future()
        if mine:
            self._run(key, future)
        try:
            return future.result()
        except BaseException:
            with self._lock:  # the next call tries again
                if self._pending.get(key) is future:
                    del self._pending[key]
            raise

    def prefetch(self, indices: Iterable[int], downscale: float = 1) -> None:
        """Decode these views in the background, in order. What goes wrong is raised by `get`."""
        for index in indices:
            key = self._key(index, downscale)
            with self._lock:
                if key in self._kept or key in self._pending:
                    continue
                if len(self._pending) >= MAX_PREFETCH:
                    return
                future: Future[DecodedImage] = Future()
                self._pending[key] = future
                self._pool.submit(self._run, key, future)

    def close(self) -> None:
        """Stop the threads and drop everything kept. Idempotent."""
        with self._lock:
            self._closed = True
        self._pool.shutdown(wait=True)
        with self._lock:
            self._kept.clear()
            self._pending.clear()
            self._bytes = 0

    # ------------------------------------------------------------------------------------- inside

    def _key(self, index: int, downscale: float) -> tuple[int, float]:
        if self._closed:
            raise ValueError("the image cache is closed")
        if not 0 <= index < len(self.views):
            raise IndexError(f"view {index} of {len(self.views)}")
        if downscale not in self.downscales:
            raise ValueError(f"downscale {downscale} was not announced; announced: {self.downscales}")
        return index, downscale

    def _size(self, index: int, downscale: float) -> tuple[int, int]:
        camera = self.views[index].camera
        return max(1, int(camera.width / downscale)), max(1, int(camera.height / downscale))

    def _run(self, key: tuple[int, float], future: Future[DecodedImage]) -> None:
        """Make the picture, keep it, hand it to all who wait. A failure stays until `get` raises it."""
        try:
            if self._closed:
                raise ValueError("the image cache is closed")
            picture = self._make(*key)
        except BaseException as error:  # raised again in whoever asks for the picture
            future.set_exception(error)
            return
        with self._lock:
            self._keep(key, picture)
            self._pending.pop(key, None)
        future.set_result(picture)

    def _keep(self, key: tuple[int, float], image: DecodedImage) -> None:
        if image.nbytes > self.budget_bytes or self._closed:
            return
        self._kept[key] = image
        self._bytes += image.nbytes
        while self._bytes > self.budget_bytes:
            _, dropped = self._kept.popitem(last=False)
            self._bytes -= dropped.nbytes

    def _make(self, index: int, downscale: float) -> DecodedImage:
        if downscale == 1:
            return load_image(self.views[index])
        with self._lock:
            full = self._kept.get((index, 1))
        full = full or load_image(self.views[index])
        return resize_area(full, *self._size(index, downscale))


def load_image(view: View) -> DecodedImage:
    """Decode a view's photograph and mask at the size of its camera."""
    pixels, opaque = decode_image(view.image_path)
    height, width = pixels.shape[:2]
    keep = opaque
    if view.mask_path is not None:
        masked = decode_mask(view.mask_path, width, height)
        keep = masked if opaque is None else masked & opaque
    picture = DecodedImage(
        torch.from_numpy(np.ascontiguousarray(pixels)),
        None if keep is None else torch.from_numpy(keep.astype(np.uint8)),
    )
    camera = view.camera
    if not same_aspect((camera.width, camera.height), (width, height)):
        raise CaptureError(
            f"{view.image_path}: is {width}x{height} now, but was another shape when the capture was read "
            f"(camera {camera.width}x{camera.height}). Do not change images while they are in use."
        )
    return resize_area(picture, camera.width, camera.height)


def resize_area(photo: DecodedImage, width: int, height: int) -> DecodedImage:
    """The picture at another size by area averaging.

    A shrunk pixel is kept only if everything that it covers is kept: else masked colors would bleed in.
    """
    if photo.image.shape[:2] == (height, width):
        return photo
    image = cv2.resize(photo.image.numpy(), (width, height), interpolation=cv2.INTER_AREA)
    mask = None
    if photo.mask is not None:
        share = cv2.resize(photo.mask.numpy().astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        mask = torch.from_numpy((share >= 1 - 1e-4).astype(np.uint8))
    return DecodedImage(torch.from_numpy(image), mask)
