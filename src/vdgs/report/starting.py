"""The last look at a capture before a training of it starts: all that can be known without training."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape

from vdgs.captures.capture import Capture
from vdgs.captures.image_checks import check_images
from vdgs.captures.validation import refuse_unsound


def refuse_unworkable(capture: Capture, console: Console) -> None:
    """Say what is doubtful about a capture and what masks leave out. Raises `CaptureError` for one that cannot become a
    scene, and for photographs or masks that are damaged."""
    soundness = refuse_unsound(capture)
    checked = check_images(capture)
    for warning in (*capture.warnings, *soundness.warnings, *checked.warnings):
        console.print(f"[yellow]note[/] {escape(warning)}", highlight=False)
    if checked.masked_share:
        console.print(f"masks leave out {checked.masked_share:.1%} of the photographs", highlight=False)
