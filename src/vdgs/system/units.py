"""Times, sizes and counts as people read them; a dash where there is no figure."""

from __future__ import annotations

import math
from collections.abc import Sequence

ABSENT = "–"


def count(value: float | None) -> str:
    """12,345."""
    return ABSENT if value is None else f"{value:,.0f}"


def data_size(n_bytes: float | None, decimals: int = 2) -> str:
    """638 MB, 1.50 GB, 24.0 GB; so many decimals below 10 GB."""
    if n_bytes is None:
        return ABSENT
    if n_bytes < 1e9:
        return f"{n_bytes / 1e6:,.0f} MB"
    return f"{n_bytes / 1e9:.{decimals}f} GB" if n_bytes < 1e10 else f"{n_bytes / 1e9:,.1f} GB"


def duration(seconds: float | None) -> str:
    """2.3 s, 45 s, 3 min 20 s, 2 h 01 min: a time that was measured."""
    if seconds is None or not 0 <= seconds < 1e9:
        return ABSENT
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def rough_duration(seconds: float) -> str:
    """45 s, 12 min, 3.5 h: a time that was estimated."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes / 60:.1f} h"


def clock(seconds: float) -> str:
    """1:01:11, of the same width while it counts down."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def floor_to_nice_length(limit: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `limit`: what a scale bar shows."""
    power = 10.0 ** math.floor(math.log10(limit))
    return float(max(step * power for step in (1, 2, 5) if step * power <= limit * (1 + 1e-9)))


def format_length(value: float | None, unit: str) -> str:
    """A length for people: centimetres where metres would be small."""
    if value is None:
        return "unknown"
    return f"{three_digits(value * 100)} cm" if unit == "m" and value < 1 else f"{three_digits(value)} {unit}"


def three_digits(value: float) -> str:
    """0.123, 1.23, 12.3, 1,234: a measure that is good to three digits; whole from 100 on."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def two_digits(value: float, sign: str = "") -> str:
    """0.18, 7.3, 120: a measure that is good to two digits, no finer than a thousandth; `+` shows its sign."""
    shown = round(value, 3) + 0.0  # no -0
    power = int(f"{shown:.1e}".partition("e")[2]) if shown and math.isfinite(shown) else 1
    return f"{shown:{sign}.{min(3, max(0, 1 - power))}f}"


def some_names(names: Sequence[str], most: int = 5) -> str:
    """a.jpg, b.jpg, ...: at most so many."""
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def first_names(names: Sequence[str]) -> str:
    """a.jpg, b.jpg, c.jpg and 12 more."""
    more = len(names) - 3
    return ", ".join(names[:3]) + (f" and {more} more" if more > 0 else "")
