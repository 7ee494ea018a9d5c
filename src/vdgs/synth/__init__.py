"""A generated aerial capture of a small town: something to try every stage on, with known truth.

Only `vdgs.synth.synth_options` is imported here, so that the command line stays quick to start.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from vdgs.synth.synth_options import SynthOptions

if TYPE_CHECKING:
    from vdgs.synth.true_visibility import FlightStats

__all__ = ["SynthOptions", "generate"]


def generate(
    output: Path, options: SynthOptions | None = None, on_progress: Callable[[str, int, int], None] | None = None
) -> FlightStats:
    """Build a town, fly over it and write a COLMAP capture to `output` (which must not hold anything yet).

    Returns how unevenly the flight sees the town; calls `on_progress(stage, done, total)`. The same options give the
    same bytes. Raises VdgsError where the extra `synth` is not installed, an option makes no capture, or `output`
    holds something already.
    """
    from vdgs.synth.generation import generate as run

    return run(Path(output), options or SynthOptions(), on_progress or (lambda stage, done, total: None))
