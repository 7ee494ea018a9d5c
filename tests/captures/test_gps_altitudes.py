"""Which altitudes of positions are believed, and what is said of the others."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from support.flights import small_photographs
from vdgs.captures.gps_tables import read_gps_table
from vdgs.errors import CaptureError
from vdgs.sfm.gps_priors import read_gps_priors

NAMES = [f"{k}.jpg" for k in range(4)]


def test_altitudes_that_a_table_lacks_are_those_of_the_photographs(tmp_path):
    seen = small_photographs(tmp_path, [f"{k}.jpg" for k in range(4)])
    file = tmp_path / "gps.csv"
    file.write_text("name,lat,lon,alt\n" + "".join(f"{k}.jpg,-33.5{k},-70.6,\n" for k in range(4)))
    assert all(math.isnan(row.position[2]) for row in read_gps_table(file).rows)
    rasters = tmp_path / "rasters.csv"
    for unit in (" [ft]", ""):
        rasters.write_text(file.read_text().replace("-70.6,", "-70.6,-9999").replace("alt", f"alt{unit}"))
        assert all(math.isnan(row.position[2]) for row in read_gps_table(rasters).rows)
    found = read_gps_priors(seen, file, (1.0, 2.0))
    assert len(found) == 4
    for latitude, says in ((-33.5, False), (-34.5, True)):
        placed = [replace(photo, lat_lon=(latitude, -70.6)) for photo in seen]
        notes = read_gps_priors(placed, rasters, (1.0, 2.0)).notes
        assert any("rasters.csv: its positions lie 109 km from those in" in note for note in notes) is says
    assert np.ptp(found.enu[:, 2]) == pytest.approx(3, abs=0.6)
    assert any("gives no altitude for 0.jpg" in note for note in found.notes)


@pytest.mark.parametrize(
    ("altitude", "said"), [("{0}", ""), ("{1}", "450 m below"), ("{2}", "60 m above"), ("{3}", "348 m below")]
)
def test_altitudes_of_a_table_that_are_not_those_of_the_photographs_are_said(tmp_path, altitude, said):
    seen = [replace(photo, lat_lon=(-33.5, -70.6 + k / 1e4), altitude=500.0 + k)
            for k, photo in enumerate(small_photographs(tmp_path, NAMES))]  # fmt: skip
    rows = [f"{photo.name},-33.5,{photo.lat_lon[1]},{altitude}".format(500 + k, 50 + k, 560 + k, 152.4 + k)
            for k, photo in enumerate(seen)]  # fmt: skip
    (tmp_path / "gps.csv").write_text("\n".join(["name,lat,lon,alt", *rows]))
    notes = read_gps_priors(seen, tmp_path / "gps.csv", (1, 2)).notes
    assert any(said in note and "those in the photographs" in note for note in notes) is bool(said)


def test_altitudes_of_a_table_that_are_those_of_the_photographs_in_feet_are_refused(tmp_path):
    seen = [replace(photo, lat_lon=(-33.5, -70.6 + k / 1e4), altitude=500.0 + k)
            for k, photo in enumerate(small_photographs(tmp_path, NAMES))]  # fmt: skip
    rows = [f"{photo.name},-33.5,{photo.lat_lon[1]},{photo.altitude / 0.3048}" for photo in seen]
    (tmp_path / "gps.csv").write_text("\n".join(["name,lat,lon,alt", *rows]))
    with pytest.raises(CaptureError, match=r"gps\.csv: its altitudes are in feet"):
        read_gps_priors(seen, tmp_path / "gps.csv", (1, 2))
    (tmp_path / "gps.csv").write_text("\n".join(["name,lat,lon,alt_ft", *rows]))
    assert read_gps_priors(seen, tmp_path / "gps.csv", (1, 2)).origin[2] == pytest.approx(501.5, abs=1)


def test_positions_without_any_altitude_count_in_the_plane(tmp_path):
    seen = [replace(photo, relative_altitude=None) for photo in small_photographs(tmp_path, NAMES)]
    (tmp_path / "gps.csv").write_text("name,lat,lon\n" + "".join(f"{k}.jpg,-33.5{k},-70.6\n" for k in range(4)))
    tagged = [replace(photo, lat_lon=(-33.5 - k / 100, -70.6), altitude=None) for k, photo in enumerate(seen)]
    for found in (read_gps_priors(seen, tmp_path / "gps.csv", (1, 2)), read_gps_priors(tagged, None, (1, 2))):
        assert len(found) == 4
        assert not found.has_altitudes
        assert found.origin == pytest.approx((-33.515, -70.6, 0))
        assert np.abs(found.enu[:, 2]).max() < 1  # the Earth is round
        assert any("no altitudes" in note for note in found.notes)
    some = [replace(photo, altitude=2500.0 + k if k else None) for k, photo in enumerate(tagged)]
    found = read_gps_priors(some, None, (1, 2))
    assert found.image_indices.tolist() == [1, 2, 3]
    assert found.has_altitudes


@pytest.mark.parametrize("altitude", [0.0, None])
def test_altitudes_that_are_all_zero_are_a_default(tmp_path, altitude):
    seen = small_photographs(tmp_path, NAMES)
    seen = [replace(photo, lat_lon=(-33.5 - k / 1000, -70.6), altitude=altitude) for k, photo in enumerate(seen)]
    found = read_gps_priors(seen, None, (1.0, 2.0))
    assert np.ptp(found.enu[:, 2]) == pytest.approx(3, abs=0.1)
    assert found.altitude_reference == "above the take-off, by XMP"
    assert any("exactly 0" in note for note in found.notes)


def test_altitudes_of_exactly_zero_among_others_are_none(tmp_path):
    seen = small_photographs(tmp_path, [f"{k}.jpg" for k in range(8)])
    heights = [0.0, 501, 502, 503, 504, 505, 506, 507]
    seen = [
        replace(photo, lat_lon=(-33.5 - k / 1000, -70.6), altitude=height)
        for k, (photo, height) in enumerate(zip(seen, heights, strict=True))
    ]
    found = read_gps_priors(seen, None, (1.0, 2.0))
    assert found.image_indices.tolist() == list(range(1, 8))
    assert any("0.jpg: the position has no altitude; not used" in note for note in found.notes)
    beach = [replace(photo, altitude=float(k)) for k, photo in enumerate(seen)]
    assert len(read_gps_priors(beach, None, (1.0, 2.0))) == 8
    none = [replace(photo, altitude=0.0, relative_altitude=None) for photo in seen]
    assert not read_gps_priors(none, None, (1.0, 2.0)).has_altitudes
