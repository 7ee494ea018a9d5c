"""Which cameras of a project show the scene in colors: those of other bands (thermal, near infrared) are no photographs
of it as people see it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from vdgs.system.units import first_names

#: What programs call the bands of color photographs, in lower case: one name for all, or three among others.
_COLOR, _COLORS = {"visible", "rgb", "srgb", "color", "colour"}, ({"red", "green", "blue"}, {"r", "g", "b"})


def color_cameras(cameras: Sequence[tuple[str, tuple[str, ...]]]) -> tuple[list[bool], list[str]]:
    """Which cameras are used, and a warning about the others, of names and the bands that each shows (none where the
    project does not say). All in color are; where none is, those of the bands that most have."""
    bands = [frozenset(band.strip().lower() for band in shown) for _, shown in cameras]
    used = [not shown or bool(shown & _COLOR) or any(shown >= colors for colors in _COLORS) for shown in bands]
    if not any(used) and bands:
        usual = Counter(bands).most_common(1)[0][0]
        used = [shown == usual for shown in bands]
    left = [camera for camera, is_used in zip(cameras, used, strict=True) if not is_used]
    if not left:
        return used, []
    shown = ", ".join(dict.fromkeys(band.strip() for _, each in left for band in each))
    names = first_names([name for name, _ in left])
    return used, [f"{len(left)} cameras show other bands ({shown}) than the rest and are left out ({names})."]
