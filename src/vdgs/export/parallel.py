"""Parts of a work on several threads, their results in order, never more than a few at once in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Int, Int32, Int64
from torch import Tensor

from vdgs.kernels import get_num_threads, set_num_threads

P = TypeVar("P")
R = TypeVar("R")
#: Beyond so many threads memory would grow more than speed.
MAX_WORKERS = 8


def sort_segments(
    numbers: Int[Tensor, " p"], first: int, count: int
) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " m"]]:
    """How pairs whose Gaussians are given, of `count` from `first` on, are brought into the order of these, keeping
    their own among those of each; and how many pairs each of the `count` has.

    numpy sorts 16 bits by their digits, five times as fast as torch sorts 64.
    """
    small = np.uint16 if count <= 2**16 else np.uint32
    keys = (numbers.numpy() - first).astype(small)
    order = torch.from_numpy(np.argsort(keys, kind="stable"))
    return order, torch.from_numpy(np.bincount(keys, minlength=count))


def index_range(ascending: Int32[Tensor, " p"], first: int, end: int) -> tuple[int, int]:
    """Where those numbers begin and end that are at least `first` and below `end`.

    With bounds of another type numpy would copy all of the numbers.
    """
    low, high = np.searchsorted(ascending.numpy(), np.array([first, end], np.int32))
    return int(low), int(high)


def parallel_map(work: Callable[[P], R], parts: Iterable[P]) -> Iterator[R]:
    """work(part) of every part, in their order, on as many threads as kernels use, which they share among the parts.

    Each part has one thread of torch, so that the last bits of a product do not depend on how many there are.
    """
    workers = max(1, min(MAX_WORKERS, get_num_threads()))
    with _divided_threads(workers), ThreadPoolExecutor(workers) as pool:
        under_way: deque[Future[R]] = deque()
        try:
            for part in parts:
                under_way.append(pool.submit(work, part))
                if len(under_way) > workers:
                    yield under_way.popleft().result()
            while under_way:
                yield under_way.popleft().result()
        finally:
            for each in under_way:
                each.cancel()


def map_views(work: Callable[[P], R], views: Iterable[P], device: torch.device) -> Iterator[R]:
    """The same for views that are drawn on a device: side by side on the processor, one after the other on a card."""
    return parallel_map(work, views) if device.type == "cpu" else map(work, views)


@contextmanager
def _divided_threads(workers: int) -> Iterator[None]:
    """Parts side by side need few threads each: more would wait for each other (a tenth of the time, on two cores)."""
    of_torch, of_kernels = torch.get_num_threads(), get_num_threads()
    set_num_threads(max(1, of_kernels // workers))
    torch.set_num_threads(1)
    try:
        yield
    finally:
        set_num_threads(of_kernels)
        torch.set_num_threads(of_torch)
