"""What a capture holds and where it looks thin, before anyone trains: numbers, figures, report.json.

The visibility V of a sparse point is the number of *training* cameras whose frustum holds it (z > near,
projected centre on the image; no occlusion), as in section III-B of the VDGS paper. Where V is small, a
scene trains badly.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from vdgs.captures.capture import Capture, View
from vdgs.kernels import native as kernels

#: Points looked at when there are more, and fewer where there are many cameras.
MOST_POINTS = 200_000
LEAST_POINTS = 20_000
MOST_PROJECTIONS = 2e8
QUANTILES = (5, 25, 50, 75, 95)
THIN = (3, 5, 10)


@dataclass(frozen=True)
class CaptureReport:
    """Numbers about a capture; lengths are in `unit` of the ground frame."""

    source: str
    images: str
    unit: str
    photographs: int
    train: int
    test: int
    #: Distinct image sizes, (width, height) in pixels, most frequent first.
    image_sizes: list[tuple[int, int]]
    #: Median horizontal focal length in pixels and field of view in degrees.
    focal_px: float
    field_of_view_deg: float
    points: int
    #: Median distance of a sparse point to its nearest neighbour.
    point_spacing: float
    ground: str
    metric: bool
    #: Latitude, longitude (deg) and altitude (m) of the origin, where known.
    origin_geo: tuple[float, float, float] | None
    #: x, y, z between the 1 % and 99 % quantiles of the sparse points.
    extent: tuple[float, float, float]
    #: Minimum, median, maximum height of the cameras above the median sparse point.
    camera_height: tuple[float, float, float]
    tilt_deg: float
    #: Ground sample distance: median of depth / focal length over the views, per pixel.
    ground_sample_distance: float | None
    #: V of the points: quantiles by percent, mean, and Gini coefficient (0 = all seen alike).
    visibility_quantiles: dict[int, float]
    visibility_mean: float
    visibility_gini: float
    #: Share of points that fewer than 3, 5, 10 training cameras see.
    share_below: dict[int, float]
    #: Bytes that all images take in memory, as uint8.
    image_bytes: int
    warnings: list[str]
    figures: list[str]


def inspect_capture(capture: Capture, output: Path) -> CaptureReport:
    """Measure the capture; write report.json and two figures into the folder `output` (made if absent)."""
    from vdgs.inspect_figures import draw_map, draw_visibility

    output.mkdir(parents=True, exist_ok=True)
    few_enough = int(np.clip(MOST_PROJECTIONS / len(capture.train_views), LEAST_POINTS, MOST_POINTS))
    points = sample_points(capture.points, few_enough)
    visibility = count_views(points, capture.train_views)
    report = measure(capture, points, visibility)
    figures = [output / "visibility_map.png", output / "visibility.png"]
    draw_map(capture, report, points, visibility, figures[0])
    draw_visibility(report, visibility, figures[1])
    report = CaptureReport(**{**report.__dict__, "figures": [file.name for file in figures]})
    text = json.dumps(asdict(report), indent=2, ensure_ascii=False)
    (output / "report.json").write_text(text + "\n", encoding="utf-8")
    return report


def sample_points(points: np.ndarray, most: int = MOST_POINTS) -> np.ndarray:
    """At most `most` of the points [n, 3], drawn without replacement with a fixed seed."""
    if len(points) <= most:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), most, replace=False))]


def count_views(points: np.ndarray, views: tuple[View, ...]) -> np.ndarray:
    """V: how many of the views' frusta hold each point [n, 3]; int64 [n]."""
    counts = kernels.count_views(torch.from_numpy(np.ascontiguousarray(points)), [view.camera for view in views])
    return counts.numpy().astype(np.int64)


def gini(values: np.ndarray) -> float:
    """Gini coefficient of non-negative values [n].

    0 where all are equal, towards 1 where few hold everything.
    """
    ordered = np.sort(values.astype(np.float64))
    total = ordered.sum()
    if total == 0:
        return 0.0
    ranks = np.arange(1, len(ordered) + 1)
    return float(2 * (ranks * ordered).sum() / (len(ordered) * total) - (len(ordered) + 1) / len(ordered))


def measure(capture: Capture, points: np.ndarray, visibility: np.ndarray) -> CaptureReport:
    """The report on a capture, given (a sample of) its points and their V."""
    cameras = [view.camera for view in capture.views]
    ground_height = float(np.median(points[:, 2]))
    heights = np.array([camera.position[2] for camera in cameras]) - ground_height
    sizes, counts = np.unique([(c.width, c.height) for c in cameras], axis=0, return_counts=True)
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    spacing = cKDTree(points).query(points, k=2)[0][:, 1] if len(points) > 1 else np.zeros(1)
    focal = float(np.median([camera.fx for camera in cameras]))
    fields = [2 * np.degrees(np.arctan(camera.width / 2 / camera.fx)) for camera in cameras]
    tilts = [np.degrees(np.arccos(np.clip(-camera.forward[2], -1, 1))) for camera in cameras]
    masked = sum(view.camera.width * view.camera.height for view in capture.views if view.mask_path)
    origin = capture.ground.origin_geo
    return CaptureReport(
        source=capture.source,
        images=capture.images,
        unit="m" if capture.ground.metric else "units",
        photographs=len(cameras),
        train=len(capture.train_views),
        test=len(capture.test_views),
        image_sizes=[(int(w), int(h)) for w, h in sizes[np.argsort(-counts, kind="stable")]],
        focal_px=focal,
        field_of_view_deg=float(np.median(fields)),
        points=len(capture.points),
        point_spacing=float(np.median(spacing)),
        ground=capture.ground.how,
        metric=capture.ground.metric,
        origin_geo=None if origin is None else (float(origin[0]), float(origin[1]), float(origin[2])),
        extent=tuple(float(value) for value in high - low),  # type: ignore[arg-type]
        camera_height=(float(heights.min()), float(np.median(heights)), float(heights.max())),
        tilt_deg=float(np.median(tilts)),
        ground_sample_distance=_ground_sample_distance(capture, points),
        visibility_quantiles={q: float(np.percentile(visibility, q)) for q in QUANTILES},
        visibility_mean=float(visibility.mean()),
        visibility_gini=gini(visibility),
        share_below={limit: float((visibility < limit).mean()) for limit in THIN},
        image_bytes=sum(3 * camera.width * camera.height for camera in cameras) + masked,
        warnings=[*capture.warnings, *_findings(visibility)],
        figures=[],
    )


def _ground_sample_distance(capture: Capture, points: np.ndarray) -> float | None:
    few = sample_points(points, 20_000)
    distances = []
    for view in capture.views:
        depth = view.camera.project(few)[1][view.camera.sees(few)]
        if len(depth):
            distances.append(float(np.median(depth)) / view.camera.fx)
    return float(np.median(distances)) if distances else None


def _findings(visibility: np.ndarray) -> list[str]:
    """What the visibility says that a person should know."""
    thin = float((visibility < THIN[0]).mean())
    if thin <= 0.05:
        return []
    return [
        f"{thin:.0%} of the points are seen by fewer than {THIN[0]} training cameras; "
        "expect these parts to come out poorly (see the map)."
    ]


def print_report(report: CaptureReport, console: Console | None = None) -> None:
    """The report as a table for people."""
    console = console or Console()
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for label, value in _rows(report):
        table.add_row(label, value)
    console.print(table)
    for warning in report.warnings:
        console.print(f"[yellow]Warning:[/] {warning}", highlight=False)


def _rows(report: CaptureReport) -> list[tuple[str, str]]:
    unit = report.unit
    sizes = ", ".join(f"{width} x {height}" for width, height in report.image_sizes[:3])
    more = len(report.image_sizes) - 3
    quantiles = ", ".join(f"{value:g} ({q} %)" for q, value in report.visibility_quantiles.items())
    below = ", ".join(f"{share:.1%} by < {limit}" for limit, share in report.share_below.items())
    low, middle, high = report.camera_height
    rows = [
        ("Photographs", f"{report.photographs} ({report.train} train, {report.test} test), {report.source}"),
        (
            "Images",
            f"{report.images or '.'}/: {sizes}" + (f" and {more} more sizes" if more > 0 else "") + " px",
        ),
        ("Focal length", f"{report.focal_px:.1f} px ({report.field_of_view_deg:.0f}° across)"),
        ("Sparse points", f"{report.points}, median spacing {length(report.point_spacing, unit)}"),
        ("Ground frame", report.ground + ("" if report.metric else " (not metric)")),
        ("Extent", " x ".join(f"{value:.4g}" for value in report.extent) + f" {unit} (1-99 % of the points)"),
        ("Camera height", f"{middle:.4g} {unit} (from {low:.4g} to {high:.4g}), tilt {report.tilt_deg:.1f}°"),
        ("Ground sample distance", f"{length(report.ground_sample_distance, unit)} per pixel"),
        ("Cameras per point V", quantiles),
        ("Poorly seen points", f"{below} cameras; Gini {report.visibility_gini:.2f}"),
        ("Images in memory", f"{report.image_bytes / 2**20:.0f} MiB"),
    ]
    if report.origin_geo is not None:
        latitude, longitude, altitude = report.origin_geo
        rows.insert(5, ("Origin", f"{latitude:.7f}, {longitude:.7f}, {altitude:.1f} m"))
    return rows


def length(value: float | None, unit: str) -> str:
    """A length for people: centimetres where metres would be small."""
    if value is None:
        return "unknown"
    return f"{value * 100:.3g} cm" if unit == "m" and value < 1 else f"{value:.3g} {unit}"
