"""Figures as people read them; a dash where there is none."""

from __future__ import annotations

ABSENT = "–"


def figure_of(value: float | None, form: str) -> str:
    return ABSENT if value is None else form.format(value)


def decibels(value: float | None) -> str:
    return figure_of(value, "{:.2f}")


def similarity(value: float | None) -> str:
    """SSIM, LPIPS."""
    return figure_of(value, "{:.4f}")


def count(value: float | None) -> str:
    return figure_of(value, "{:,.0f}")


def share(value: float | None) -> str:
    return ABSENT if value is None else f"{100 * value:.1f} %"


def gain(after: float | None, before: float | None, form: str = "{:+.2f}") -> str:
    """The difference with its sign: a minus as in print, and never one before a zero."""
    if after is None or before is None:
        return ABSENT
    signed = form.format(after - before)
    return signed.replace("-", "−" if float(signed) else "+")


def duration(seconds: float | None) -> str:
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


def memory(bytes_: float | None) -> str:
    if bytes_ is None or bytes_ <= 0:
        return ABSENT
    return f"{bytes_ / 1e6:,.0f} MB" if bytes_ < 1e9 else f"{bytes_ / 1e9:.2f} GB"
