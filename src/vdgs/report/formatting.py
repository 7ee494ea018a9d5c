"""Figures as people read them; a dash where there is none."""

from __future__ import annotations

from vdgs.system.units import ABSENT


def format_value(value: float | None, form: str) -> str:
    return ABSENT if value is None else form.format(value)


def format_db(value: float | None) -> str:
    return format_value(value, "{:.2f}")


def format_similarity(value: float | None) -> str:
    """SSIM, LPIPS."""
    return format_value(value, "{:.4f}")


def format_percent(value: float | None) -> str:
    return ABSENT if value is None else f"{100 * value:.1f} %"


def format_difference(after: float | None, before: float | None, form: str = "{:+.2f}") -> str:
    """The difference with its sign: a minus as in print, and never one before a zero."""
    if after is None or before is None:
        return ABSENT
    signed = form.format(after - before)
    return signed.replace("-", "−" if float(signed) else "+")
