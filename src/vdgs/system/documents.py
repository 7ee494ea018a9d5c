"""Types of the JSON documents that several packages read and write; keys of older files may be missing."""

from __future__ import annotations

from typing import Any, TypeAlias, TypedDict

#: A JSON object as a file holds it: its reader or writer is the only one that knows what is in it.
JsonObject: TypeAlias = dict[str, Any]


class GroundFrameDocument(TypedDict, total=False):
    """Where the ground frame lies (`captures.capture.GroundFrame`)."""

    scale: float
    rotation: list[list[float]]
    translation: list[float]
    metric: bool
    how: str
    origin_geo: tuple[float, float, float] | None
    axes_geo: tuple[float, float] | None


class CaptureMetadata(TypedDict, total=False):
    """What capture.json and a model say about the capture that they come from."""

    root: str
    source: str
    images: str
    training_views: list[str]
    test_views: list[str]
    points: int
    ground_frame: GroundFrameDocument
    warnings: list[str]
    #: CRC-32 of each part of the capture that results depend on.
    fingerprint: dict[str, int]


class EvaluationMetrics(TypedDict, total=False):
    """metrics.json: means over the views; None where there is no such figure. The figures that are not named here have
    the suffixes of `evaluation.view_metrics` (`_cc`, `_affine`, `_reference_exposure`)."""

    psnr: float | None
    ssim: float | None
    lpips: float | None
    by_visibility: list[JsonObject] | None
    views_by_visibility: list[JsonObject] | None
    covered_pixels: int | None
    opacity_coverage: float | None
    max_oversized_splats: int | None
    max_oversized_splats_view: str | None
    model: str | None
    model_digest: str | None
    key: str | None
    n_anchors: int | None
    model_bytes: int | None
    train_seconds: float | None
    peak_memory_bytes: int | None
    fps: float | None
    test_views: int
    #: Means over the views: shares of what is drawn (`evaluation.splat_artifacts`).
    needles: float | None
    floaters: float | None
    #: Pixels by the angle to the nearest training view, in degrees.
    by_angle: list[JsonObject] | None
    #: Figures of each kind of off-path view.
    sets: dict[str, JsonObject] | None
    notes: list[str]


class BlockMetricsDocument(TypedDict):
    """by_block.json: figures of each block, of all of them, of the seams, and of each view."""

    blocks: list[dict[str, float | None]]
    all: dict[str, float | None]
    seams: JsonObject
    views: list[JsonObject]


class MeasuredAs(TypedDict, total=False):
    """status.json of an evaluation: the model that was measured, and how."""

    key: str | None
    model: str | None
    lpips_weights: str
    bins: int
    exposed: str | None
    #: CRC-32 of the views from where nobody flew and their truth, where those are measured.
    off_path: int


class StageStatusDocument(TypedDict):
    """A stage in what `vdgs status --json` prints."""

    stage: str
    state: str
    reason: str | None
    folder: str
    step: str | None
    iteration: int | None
    """Or how many of the step are done, `iterations` of how many: photographs, pairs, tiles."""
    iterations: int | None
    seconds_left: float | None


class RunStatusDocument(TypedDict):
    """What `vdgs status --json` prints; `place` is RUN/place.json."""

    run: str
    place: JsonObject | None
    complete: bool
    running: bool
    next_command: str | None
    problem: str | None
    """What to mend by hand before any command is of use."""
    stages: list[StageStatusDocument]


class ExportedFile(TypedDict):
    """A file that was exported."""

    #: From the run's folder where it lies in it, else absolute.
    file: str
    gaussians: int
    bytes: int
    seconds: float
    #: The system of its coordinates and where its axes go, for people, and what the third coordinate counts from; None
    #: where that one does not go up.
    crs_name: str
    axes: str
    heights: str | None
    #: What is to be known of that system, and what was lost.
    notes: list[str]


class RecordedFile(ExportedFile):
    """A file in export.json."""

    sh_degree: int
    #: "coarse" or "merged", and its identity (`StatusRecord.model_id`); None where the model says none.
    model: str
    model_id: str | None
    #: Which part of the scene it holds, as it was asked for; None and 0: the whole. The box in coordinates of the file.
    block: int | None
    bbox: tuple[float, float, float, float] | None
    min_visibility: int


class ExportDocument(TypedDict):
    """export.json of a run: its last export, with the files of earlier ones that are still there."""

    gaussians: int
    sh_degree: int
    rounds: int
    seconds_to_bake: float
    seconds_to_refine: float
    files: list[RecordedFile]
    """Those of the last export first."""
    losses: list[JsonObject]


class MapMetadata(TypedDict, total=False):
    """map.json of a folder of maps."""

    software: str
    model: str
    model_digest: str | None
    crs: str | None
    crs_name: str
    unit: str
    heights: str
    georeference: str
    #: Where north is in the middle of the map, in degrees clockwise from its top; None where nobody knows.
    north_deg: float | None
    #: How many times as long as on the ground lengths are on the map, there.
    stretch: float
    gsd: float
    width: int
    height: int
    bounds: list[float]
    samples_per_pixel: int
    sharpened: bool
    lod_error: float | None
    training_cameras: int
    notes: list[str]
    mapped_share: float
    seen_by_fewer_than_5_share: float | None
    #: Of the ground that no training camera sees from nearer to straight above than 60°.
    seen_at_grazing_angles_share: float
    lowest: float | None
    highest: float | None


class FitnessQuestion(TypedDict):
    """What a node is asked to look at before it works on a run (`distributed.node_check`)."""

    folder: str
    files: list[tuple[str, int]]
    code: str
    version: str
    held: str | None


class FitnessAnswer(TypedDict):
    """What a node answers."""

    node: str
    processor: str
    problems: list[str]
