"""The files of the package and of the experiments beside it."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "vdgs"
#: Beside the package, and checked as it is. What is archived in its reports is not.
EXPERIMENTS = (ROOT / "experiments" / "baselines", ROOT / "experiments" / "bench")


def checked_files() -> list[Path]:
    """The files of the package and of the experiments."""
    return sorted(file for folder in (PACKAGE, *EXPERIMENTS) for file in folder.rglob("*.py"))


def files_with_shapes() -> list[Path]:
    """Those that annotate shapes: where the arithmetic is."""
    return [file for file in checked_files() if "from jaxtyping import" in file.read_text(encoding="utf-8")]


def module_name(file: Path) -> str:
    """A module's name by its file: `vdgs.captures.splits` for src/vdgs/captures/splits.py, `experiments.bench.plan` for
    experiments/bench/plan.py."""
    parts = file.relative_to(PACKAGE.parent if file.is_relative_to(PACKAGE) else ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
