"""Markers of a chunk of Metashape that have surveyed places."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from vdgs.captures.coordinate_systems import ToGeodetic, to_geodetic
from vdgs.captures.formats.project import ProjectView
from vdgs.captures.formats.surveyed_points import SurveyedPoint, survey_note
from vdgs.captures.formats.xml_documents import xml_numbers
from vdgs.errors import CaptureError

_REMEDY = (
    "To have it where they were surveyed, check the markers in Metashape's Reference pane, press Update Transform or "
    "Optimize Cameras, and export again."
)
_FALSE = ("0", "false")
#: Of each marker by its number, the cameras that show it, by theirs, and pixels.
Marks = Mapping[str, Sequence[tuple[str, str]]]


def marks_of(frame: Element | None) -> dict[str, list[tuple[str, str]]]:
    """The marks in a frame that a person placed: of each marker the numbers of the cameras and the texts `x y`."""
    found: dict[str, list[tuple[str, str]]] = {}
    for marker in frame.iterfind("markers/marker") if frame is not None else ():
        marks = [
            (each.get("camera_id", ""), f"{each.get('x')} {each.get('y')}")
            for each in marker.iterfind("location")
            if each.get("pinned", "1") not in _FALSE
        ]
        found.setdefault(marker.get("marker_id", ""), []).extend(marks)
    return found


def marker_note(
    markers: Iterable[Element],
    marks: Marks,
    views: Mapping[str, ProjectView],
    wkt: str,
    geodetic: ToGeodetic | None,
    file: Path,
) -> list[str]:
    """What to say of markers with places in the system `wkt`, with views by the numbers of their cameras."""
    surveyed = [each for each in markers if all(_place(each))]
    points = []
    try:
        change = to_geodetic(wkt, file)[0] if wkt and geodetic is not None else None
        for marker in surveyed if change is not None else ():
            place = np.array(xml_numbers(" ".join(_place(marker)), 3, file, f"the marker {marker.get('label', '?')!r}"))
            seen = [
                (views[camera], _pixel(text, file))
                for camera, text in marks.get(marker.get("id", ""), ())
                if camera in views
            ]
            assert change is not None
            points.append(SurveyedPoint(change(place[None])[0], seen))
    except CaptureError:  # a damaged number, or a system that is not known: they are counted alone
        points = []
    return survey_note(len(surveyed), "markers with surveyed places", _REMEDY, points, geodetic)


def _place(marker: Element) -> list[str]:
    reference = marker.find("reference")
    return [reference.get(axis, "") if reference is not None else "" for axis in "xyz"]


def _pixel(text: str, file: Path) -> tuple[float, float]:
    x, y = xml_numbers(text, 2, file, "a mark")
    return x, y
