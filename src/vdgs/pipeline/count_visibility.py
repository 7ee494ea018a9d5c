"""How many training cameras see each anchor of the coarse model (section IV-B), as numbers and as a map.

RUN/visibility/  visibility.safetensors (V of every anchor), visibility.json (its distribution), map.png
"""

from __future__ import annotations

from dataclasses import asdict

from rich.console import Console

from vdgs.partition.plots import block_maps as figures
from vdgs.runs.open_run import check_has_anchors
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.visibility_store import load_or_count_visibility, read_visibility
from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.visibility.visibility_counts import visibility_stats


def is_visibility_counted(run: RunFolder) -> bool:
    """Whether `count_run_visibility` has nothing to do: both files are there, whole and of this coarse model."""
    said = read_json_or_empty(run.visibility / "visibility.json").get("key")
    return said == run.keys().visibility and read_visibility(run) is not None


def count_run_visibility(context: RunContext, console: Console) -> None:
    """V_i of every anchor: its distribution and a map from above. Skipped where it is there for this coarse model.

    RunError without a coarse model, or for one without anchors.
    """
    run = context.run
    file, key = run.visibility / "visibility.json", run.keys().visibility
    if is_visibility_counted(run):
        console.print(f"{file}: already there; nothing to do", highlight=False)
        return
    with run.locked():
        opened = context.open_model("coarse")
        check_has_anchors(run, len(opened.model.anchors))
        visibility = load_or_count_visibility(opened).numpy()
        cameras = [view.camera for view in opened.capture.train_views]
        stats = asdict(visibility_stats(visibility))
        with context.drawing_figures():
            figures.plot_anchor_visibility(
                run.visibility / "map.png", opened.model.anchors.positions.numpy(), visibility, cameras,
                opened.capture.ground.axis_names,
            )  # fmt: skip
        write_json(file, {"key": key, "anchors": len(visibility), "training_views": len(cameras), **stats})
    quantiles = ", ".join(f"{share} %: {value:g}" for share, value in stats["quantiles"].items())
    console.print(
        f"cameras that see an anchor (V), by quantile: {quantiles}; Gini {stats['gini']:.2f}\n"
        f"map: {run.visibility / 'map.png'}",
        highlight=False,
    )
