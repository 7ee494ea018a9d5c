"""Wall-clock times of functions run side by side."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def medians_ms(functions: dict[str, Callable[[], object]], rounds: int = 9) -> dict[str, float]:
    """Median milliseconds of each function, after one call to warm up.

    The functions take turns, so that what else the machine does falls on all of them alike: compare the
    medians of one call with each other.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    for function in functions.values():
        function()
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}
