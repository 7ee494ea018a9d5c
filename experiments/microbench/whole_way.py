"""From photographs to a report, stage by stage: time by the clock and of the processors, memory and quality.

    python -m experiments.microbench.whole_way DATA WORK [--scenes copr-2 ...] [--before CHECKOUT] \\
      [--settings "--preset laptop --iterations 600"] [--beside "opensplat {capture} -o {output}/splat.ply"]
    python -m experiments.microbench.whole_way DATA WORK --table

DATA holds copr, seneca, brighton and photographs/ (captures with images_2 and images_4, and cards as cameras wrote
them). Every stage is the verb of `vdgs` in a process of its own, as a person would type it, Python's start included.
With `--before`, a checkout of another version with its compiled modules, each stage runs with both versions, one right
after the other, so that a machine that others load slows both alike: believe the ratios, and processor time before the
clock. Memory is that of the largest process. A stage that WORK/whole_way.jsonl has is not run again. `--beside` times
another program on the capture of each scene; its pictures are for its own tools to judge.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from experiments.microbench.hardware_info import describe

ROOT = Path(__file__).resolve().parents[2]
RESULTS = "whole_way.jsonl"
#: Verbs after a run is there, in their order.
STAGES = ("visibility", "partition", "train-blocks", "merge", "eval", "ortho", "report")
#: Verbs and figures of versions that call them otherwise: those whose verbs lie in src/vdgs/verbs.
FORMER_VERBS = {"train-coarse": "coarse", "train-blocks": "train", "ortho": "map"}
FORMER_FIGURES = {
    "psnr_reference_exposure": "psnr_neutral",
    "ssim_reference_exposure": "ssim_neutral",
    "opacity_coverage": "solid_share",
}
TOWN = ("--num-images", "70", "--width", "1000", "--height", "750")


@dataclass(frozen=True)
class Scene:
    """A capture of DATA, or its photographs, whose capture `sfm` makes first; the town is generated."""

    name: str
    folder: str
    images: str | None


SCENES = (
    Scene("seneca-4", "seneca", "images_4"),
    Scene("seneca-2", "seneca", "images_2"),
    Scene("copr-4", "copr", "images_4"),
    Scene("copr-2", "copr", "images_2"),
    Scene("brighton-4", "brighton", "images_4"),
    Scene("brighton-photographs", "photographs/brighton", "images"),
    Scene("seneca-photographs", "photographs/seneca", "images_2"),
    Scene("town", "", None),
)


@dataclass(frozen=True)
class Measured:
    """What one stage of one scene took with one version."""

    scene: str
    stage: str
    version: str
    seconds: float
    processor_seconds: float
    peak_gb: float
    exit_code: int


def measure(command: list[str], log: Path, source: Path | None) -> tuple[float, float, float, int]:
    """Seconds, processor seconds, GB of the largest process, and exit code of a command with its children."""
    environment = os.environ | {"OMP_WAIT_POLICY": "PASSIVE"}
    if source is not None:
        environment["PYTHONPATH"] = str(source / "src")
    start = time.perf_counter()
    with log.open("ab") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env=environment)
        _, status, usage = os.wait4(process.pid, 0)
    code = process.returncode = os.waitstatus_to_exitcode(status)
    return time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e6, code


def commands(scene: Scene, data: Path, work: Path, settings: list[str]) -> dict[str, list[str]]:
    """The arguments of `vdgs` for each stage of a scene whose files lie in `work`."""
    capture, run = data / scene.folder, work / "run"
    stages: dict[str, list[str]] = {}
    if not scene.folder:
        capture = work / "capture"
        stages["synth"] = ["synth", str(capture), *TOWN]
    elif scene.folder.startswith("photographs/"):
        stages["sfm"] = ["sfm", str(capture), "--output", str(work / "capture")]
        capture = work / "capture"
    chosen = ["--images", scene.images] if scene.images and "--images" not in settings else []
    stages["train-coarse"] = ["train-coarse", str(capture), "--output", str(run), *chosen, *settings]
    return stages | {stage: [stage, str(run)] for stage in STAGES}


def quality(run: Path) -> dict[str, float]:
    """Metrics of the test views of the merged model as measured, in neutral colors, and the opaque share."""
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    return {
        name: metrics[name] if name in metrics else metrics[FORMER_FIGURES[name]]
        for name in ("psnr", "ssim", *FORMER_FIGURES)
    }


def run_scene(scene: Scene, arguments: argparse.Namespace, done: set[tuple[str, str, str]]) -> None:
    """Every stage of a scene that is not measured yet, with each version in turn."""
    versions = {"after": ROOT} | ({"before": arguments.before} if arguments.before else {})
    stages = commands(scene, arguments.data, Path(), [])
    for stage in stages:
        for version, source in versions.items():
            work = arguments.work / scene.name / version
            work.mkdir(parents=True, exist_ok=True)
            if (scene.name, stage, version) in done:
                continue
            verb, *words = commands(scene, arguments.data, work, arguments.settings)[stage]
            former = source is not None and (source / "src" / "vdgs" / "verbs").is_dir()
            module, verb = ("vdgs.cli", FORMER_VERBS.get(verb, verb)) if former else ("vdgs", verb)
            record(
                arguments.work,
                scene,
                stage,
                version,
                measure([sys.executable, "-m", module, verb, *words], work / "log", source),
            )
        if stage == arguments.last_stage:
            return
    if arguments.beside and (scene.name, "beside", "other") not in done:
        capture = (
            arguments.data / scene.folder if (arguments.data / scene.folder / "sparse").is_dir() else work / "capture"
        )
        output = arguments.work / scene.name / "beside"
        output.mkdir(parents=True, exist_ok=True)
        words = [word.format(capture=capture, output=output) for word in shlex.split(arguments.beside)]
        record(arguments.work, scene, "beside", "other", measure(words, output / "log", None))


def record(work: Path, scene: Scene, stage: str, version: str, taken: tuple[float, float, float, int]) -> None:
    """Append a line to the results. Raises SystemExit where the stage failed: the next ones cannot run."""
    seconds, processor, peak, code = taken
    line = Measured(scene.name, stage, version, seconds, processor, peak, code)
    print(f"{scene.name:22} {stage:14} {version:7} {seconds:8.1f} s {processor:8.1f} s {peak:6.2f} GB", flush=True)
    if code:
        raise SystemExit(
            f"{scene.name}: {stage} ({version}) ended with exit code {code}; its output: {work / scene.name}/*/log"
        )
    with (work / RESULTS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(line)) + "\n")


def read_results(work: Path) -> list[Measured]:
    """What is measured already."""
    file = work / RESULTS
    return [Measured(**json.loads(line)) for line in file.read_text().splitlines()] if file.exists() else []


def table(work: Path) -> str:
    """A Markdown table of all that is measured: processor seconds (clock) of each version, their ratio, memory."""
    rows = read_results(work)
    lines = ["| scene | stage | before | after | ratio | memory |", "|---|---|---|---|---|---|"]
    for scene in dict.fromkeys(row.scene for row in rows):
        own = [row for row in rows if row.scene == scene]
        stages = list(dict.fromkeys(row.stage for row in own))
        for stage in [*stages, "all"]:
            taken = {
                version: [row for row in own if row.version == version and stage in (row.stage, "all")]
                for version in ("before", "after", "other")
            }
            lines.append(_table_line(scene, stage, taken))
        for version in ("before", "after"):
            run = work / scene / version / "run"
            if (run / "evaluation" / "metrics.json").is_file():
                shown = ", ".join(f"{name} {value:.4g}" for name, value in quality(run).items())
                lines.append(f"| {scene} | test views, {version} | {shown} | | | |")
    return "\n".join(lines)


def _table_line(scene: str, stage: str, taken: dict[str, list[Measured]]) -> str:
    sums = {version: sum(row.processor_seconds for row in rows) for version, rows in taken.items()}
    clock = {version: sum(row.seconds for row in rows) for version, rows in taken.items()}
    after = "other" if taken["other"] and not taken["after"] else "after"
    shown = {version: f"{sums[version]:.1f} s ({clock[version]:.1f} s)" if taken[version] else "" for version in taken}
    ratio = f"{sums['after'] / sums['before']:.2f}" if taken["before"] and taken["after"] else ""
    peak = max((row.peak_gb for rows in taken.values() for row in rows), default=0.0)
    return f"| {scene} | {stage} | {shown['before']} | {shown[after]} | {ratio} | {peak:.2f} GB |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument(
        "--scenes", nargs="+", choices=[scene.name for scene in SCENES], default=[s.name for s in SCENES]
    )
    parser.add_argument("--last-stage", help="end with this stage, such as sfm")
    parser.add_argument("--before", type=Path, help="checkout of the version to compare with")
    parser.add_argument(
        "--settings",
        type=shlex.split,
        default=["--preset", "laptop"],
        help="options of train-coarse; --config FILE holds those of the blocks too, --images goes before the scene's",
    )
    parser.add_argument("--beside", help="command of another program, with {capture} and {output}")
    parser.add_argument("--table", action="store_true", help="only print the table of what is measured")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    if not arguments.table:
        print(describe(), flush=True)
        done = {(row.scene, row.stage, row.version) for row in read_results(arguments.work)}
        for scene in SCENES:
            if scene.name in arguments.scenes:
                run_scene(scene, arguments, done)
    print(table(arguments.work))


if __name__ == "__main__":
    main()
