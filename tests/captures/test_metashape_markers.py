"""Markers with surveyed places in Metashape's cameras.xml, compared with the poses of the file."""

from __future__ import annotations

import pytest

from support.metashape_files import metashape_xml, read_export
from support.true_flight import ORIGIN, TrueFlight, assert_true, true_flight
from vdgs.geometry.geodesy import geodetic_from_enu


def with_markers(flight: TrueFlight, off: tuple[float, float, float]) -> str:
    """An export with three markers, of which the chunk's transform is off by metres east, north and up, and one that
    was not surveyed."""
    shown = [dict(zip(numbers.tolist(), pixels, strict=True)) for pixels, numbers in map(flight.pixels, range(8))]
    often = sorted(range(len(flight.points)), key=lambda k: -sum(k in each for each in shown))[:3]
    surveyed = geodetic_from_enu(flight.points[often] - off, ORIGIN).tolist()
    listed, marked = '<marker id="9" label="target 9"/>', ""
    for k, (latitude, longitude, height) in zip(often, surveyed, strict=True):
        place = f'x="{longitude!r}" y="{latitude!r}" z="{height!r}"'
        listed += f'<marker id="{k}" label="m{k}"><reference {place}/></marker>'
        marks = [(camera, *each[k]) for camera, each in enumerate(shown) if k in each]
        marks = [f'<location camera_id="{n}" pinned="true" x="{x:.4f}" y="{y:.4f}"/>' for n, x, y in marks]
        guess = '<location camera_id="0" pinned="false" x="3" y="3"/>'
        marked += f'<marker marker_id="{k}">{guess}{"".join(marks)}</marker>'
    whole = metashape_xml(flight).replace("<frames ", f"<markers>{listed}</markers><frames ")
    cameras = '<cameras><camera camera_id="0"/></cameras>'
    return whole.replace("<markers/>", f"{cameras}<markers>{marked}</markers>")


@pytest.mark.parametrize(
    ("off", "said"),
    [
        ((0.0, 0, 0), "its poses agree with 3 of them"),
        ((3.0, -2, 30), "put them 3.00 m east, 2.00 m south and 30.00 m above"),
    ],
)
def test_markers_are_compared_with_the_poses(tmp_path, off, said):
    flight = true_flight()
    source = read_export(tmp_path, with_markers(flight, off), flight)
    assert_true(source, flight)
    note = next(each for each in source.warnings if "markers" in each)
    assert note.startswith("3 markers with surveyed places are in the project and not used")
    assert said in note
    assert ("Update Transform" in note) == any(off)
