"""Tables of figures for the console."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from vdgs.evaluation.by_visibility import format_bounds
from vdgs.system.units import data_size

#: key in metrics.json, what people call it, format
QUALITY_METRICS = (
    ("psnr", "PSNR (dB) ↑", "{:.2f}"),
    ("ssim", "SSIM ↑", "{:.4f}"),
    ("lpips_vgg", "LPIPS vgg ↓", "{:.4f}"),
    ("lpips_vgg_01", "LPIPS vgg, [0,1] input ↓", "{:.4f}"),
)
#: Figures over the pixels that training cameras cover; those that are null are not shown.
COVERAGE_METRICS = (
    ("opacity_coverage", "opaque (alpha ≥ 0.95) ↑", "{:.2%}"),
    ("psnr_covered_own_background", "PSNR on its own background (dB) ↑", "{:.2f}"),
    ("psnr_covered_black", "PSNR on black (dB) ↑", "{:.2f}"),
    ("psnr_covered_white", "PSNR on white (dB) ↑", "{:.2f}"),
    ("depth_error_median_expected", "median error of expected depth (camera heights) ↓", "{:.2%}"),
    ("depth_error_median_median", "median error of median depth (camera heights) ↓", "{:.2%}"),
    ("depth_within_1_percent_expected", "expected depth within 1 % of the camera height ↑", "{:.2%}"),
    ("depth_within_1_percent_median", "median depth within 1 % of the camera height ↑", "{:.2%}"),
    ("depth_within_2_percent_median", "median depth within 2 % of the camera height ↑", "{:.2%}"),
)
#: Figures of each kind of off-path view: key, what people call it, format.
SET_METRICS = (
    ("views", "views", "{}"),
    ("psnr", "PSNR (dB) ↑", "{:.2f}"),
    ("ssim", "SSIM ↑", "{:.4f}"),
    ("depth_within_2_percent_median", "depth within 2 % ↑", "{:.1%}"),
    ("needles", "needles ↓", "{:.1%}"),
    ("floaters", "floaters ↓", "{:.1%}"),
)


def make_metrics_table(result: Mapping[str, Any], title: str) -> RenderableType:
    """What `metrics.json` holds: quality raw, color-corrected, after an affine map of the colors and, where pictures
    are exposed, in neutral colors; quality by visibility, opacity, size and speed."""
    quality = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
    besides = {"_cc": "color-corrected", "_affine": "affine fit"}
    if result["psnr_reference_exposure"] is not None:
        besides["_reference_exposure"] = "neutral colors"
    for column in ("", "raw", *besides.values()):
        quality.add_column(column, justify="left" if not column else "right")
    for key, label, form in QUALITY_METRICS:
        others = (format_value(result.get(f"{key}{suffix}"), form) for suffix in besides)
        quality.add_row(label, format_value(result[key], form), *others)
    parts: list[RenderableType] = [quality]
    if result.get("sets"):
        parts.append(_sets_table(result["sets"]))
    if len(result.get("by_angle") or []) > 1:
        parts.append(_angle_table(result["by_angle"]))
    if result["by_visibility"]:
        parts.append(_visibility_table(result["by_visibility"]))
    if result["psnr_covered_own_background"] is not None:
        parts.append(_opacity_table(result))
    if result["max_oversized_splats"]:
        parts.append(Text(_splats_line(result)))
    parts.append(Text(_model_line(result), style="dim"))
    return Group(*parts)


def format_value(value: float | None, form: str) -> str:
    """The figure, or a dash where there is none."""
    return "–" if value is None else form.format(value)


def format_angles(lower: float, upper: float | None) -> str:
    """The bounds of a bin by angle for people: `10 to 20°`."""
    return f"above {lower:g}°" if upper is None else f"{lower:g} to {upper:g}°"


def _sets_table(sets: Mapping[str, Mapping[str, Any]]) -> Table:
    title = "by kind of view"
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
    for column in ("", *(label for _, label, _ in SET_METRICS)):
        table.add_column(column, justify="right" if column else "left", no_wrap=not column)
    for name, figures in sets.items():
        table.add_row(name, *(format_value(figures[key], form) for key, _, form in SET_METRICS))
    return table


def _angle_table(bins: list[Mapping[str, Any]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, title="by angle to the nearest training view", title_justify="left")
    for column in ("angle", "share", "PSNR (dB)", "SSIM", "depth within 2 %"):
        table.add_column(column, justify="right")
    total = sum(each["pixels"] for each in bins)
    for each in bins:
        table.add_row(
            format_angles(each["lower"], each["upper"]), f"{each['pixels'] / total:.1%}",
            format_value(each["psnr"], "{:.2f}"), format_value(each["ssim"], "{:.4f}"),
            format_value(each.get("depth_within_2_percent"), "{:.1%}"),
        )  # fmt: skip
    return table


def _visibility_table(bins: list[Mapping[str, Any]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, title="by visibility (training cameras that see a pixel)", title_justify="left")
    for column in ("V", "pixels", "PSNR (dB)", "SSIM", "PSNR corrected"):
        table.add_column(column, justify="right")
    for each in bins:
        bounds = "nothing drawn" if each["lower"] is None else format_bounds(each["lower"], each["upper"])
        table.add_row(
            bounds, f"{each['pixels']:,}", format_value(each["psnr"], "{:.2f}"), format_value(each["ssim"], "{:.4f}"),
            format_value(each.get("psnr_cc"), "{:.2f}"),
        )  # fmt: skip
    return table


def _opacity_table(result: Mapping[str, Any]) -> Table:
    table = Table(
        box=box.SIMPLE_HEAD, show_header=False, title="of the pixels that at least 3 training cameras see",
        title_justify="left",
    )  # fmt: skip
    table.add_column("")
    table.add_column("", justify="right")
    for key, label, form in COVERAGE_METRICS:
        if result[key] is not None:
            table.add_row(label, form.format(result[key]))
    return table


def _splats_line(result: Mapping[str, Any]) -> str:
    return (
        f"splats larger than the picture: {result['oversized_splats']:,}, most of them "
        f"({result['max_oversized_splats']:,}) in {result['max_oversized_splats_view']}"
    )


def _model_line(result: Mapping[str, Any]) -> str:
    parts = []
    if result["fps"] is not None:
        parts.append(f"{result['fps']:.3g} images a second")
    if result["n_anchors"] is not None:
        parts.append(f"{result['n_anchors']:,} anchors")
    if result["model_bytes"] is not None:
        parts.append(f"{result['model_bytes'] / 1e6:.1f} MB")
    if result["train_seconds"] is not None:
        parts.append(f"trained in {result['train_seconds']:,.0f} s")
    if result["peak_memory_bytes"] is not None:
        parts.append(f"peak memory {data_size(result['peak_memory_bytes'])}")
    return " · ".join(parts)
