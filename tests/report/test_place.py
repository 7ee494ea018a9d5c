"""What a report begins with: the place, of a capture with metres and of one without."""

from __future__ import annotations

import html
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from support.captures import tiny_scene, write_colmap
from vdgs.captures.capture_dates import date_taken, exif_form, first_and_last, time_of
from vdgs.captures.loading import load_capture
from vdgs.captures.place_facts import measure_place
from vdgs.captures.place_record import PlaceFacts, format_area, format_flown, place_rows, place_summary
from vdgs.config.capture_options import CaptureOptions
from vdgs.report.status_cli import print_status, status_json
from vdgs.report.write_report import write_report
from vdgs.runs.run_folder import RunFolder
from vdgs.system.records import record_to_dict

METERS = re.compile(r"\bmet(re|er)s?\b|\d\s?(c|k)?m\b|m²")


def place_of(folder: Path, georef: dict[str, object] | None) -> PlaceFacts:
    write_colmap(folder, tiny_scene())
    if georef is not None:
        (folder / "georef.json").write_text(json.dumps(georef))
    return measure_place(load_capture(folder, CaptureOptions() if georef else CaptureOptions(up="z")))


GEOREF = {
    "frame": "ENU", "origin_lat_deg": -34.4, "origin_lon_deg": -119.9, "origin_alt_m": 5.0, "method": "a survey",
    "accuracy": "place ±1.2 m across, scale ±0.8 % (95 %)",
}  # fmt: skip


def run_of(folder: Path, place: PlaceFacts, blocks: int = 1, maps: bool = True) -> RunFolder:
    """A run as far as the place, the cut and the maps."""
    for name in ("partition", "maps", "merged"):
        (folder / name).mkdir(parents=True)
    (folder / "place.json").write_text(json.dumps(record_to_dict(place)))
    (folder / "config.yaml").write_text(json.dumps({"capture": {"path": "/some/where"}}))
    rows = [{"block": index, "cameras": 3, "area": 2.0} for index in range(blocks)]
    (folder / "partition/partition.json").write_text(json.dumps({"blocks": rows}))
    (folder / "merged/status.json").write_text(json.dumps({"state": "done", "model_id": "1-a"}))
    if maps:
        metadata = {
            "model_digest": "1-a", "crs": "EPSG:32711" if place.unit == "m" else "local", "crs_name": "the map's own",
            "unit": place.unit, "gsd": 0.1, "width": 90, "height": 60, "mapped_share": 0.5,
            "north_deg": 0.0 if place.unit == "m" else None, "stretch": 1.0,
        }  # fmt: skip
        (folder / "maps/map.json").write_text(json.dumps(metadata))
        Image.new("RGB", (90, 60), "teal").save(folder / "maps/orthophoto.png")
    return RunFolder(folder)


def page_of(run: RunFolder) -> tuple[str, str]:
    """Source and text."""
    source = write_report(run).read_text(encoding="utf-8")
    text = re.sub(r"<style>.*?</style>", "", source, flags=re.DOTALL)
    return source, " ".join(html.unescape(re.sub(r"<[^>]+>", " ", text)).split())


def test_the_facts_of_a_georeferenced_capture(tmp_path):
    pytest.importorskip("pyproj")
    place = place_of(tmp_path / "beach", GEOREF)
    assert (place.name, place.unit, place.photographs_used, place.photographs_test) == ("beach", "m", 12, 2)
    assert place.latitudes is not None
    assert place.longitudes is not None
    assert place.extent is not None
    assert place.crs_extent is not None
    assert place.latitudes[0] < -34.4 < place.latitudes[1]
    assert place.longitudes[0] < -119.9 < place.longitudes[1]
    assert place.crs_name == "WGS 84 / UTM zone 11S (EPSG:32711)"
    x0, y0, x1, y1 = place.extent
    assert np.subtract(place.crs_extent[2:], place.crs_extent[:2]) == pytest.approx([x1 - x0, y1 - y0], rel=0.05)
    assert 0 < place.area <= (x1 - x0) * (y1 - y0)
    rows = dict(place_rows(place))
    assert rows["Accuracy"] == GEOREF["accuracy"]
    assert rows["Placed by"] == "a survey"
    assert " S, 119." in rows["Latitude, longitude"]
    assert rows["Latitude, longitude"].endswith(" W (WGS 84)")


def test_residuals_are_the_accuracy_of_a_georeference_that_states_none(tmp_path):
    residuals = {**GEOREF, "accuracy": None, "gcp_residual_rms_m_xyz": [0.55, 0.9, 0.02]}
    said = dict(place_rows(place_of(tmp_path / "beach", residuals)))["Accuracy"]
    assert said == "residuals of control points: RMS 0.55 m east, 0.9 m north, 0.02 m up"


def test_nothing_is_in_metres_where_the_unit_is_unknown(tmp_path):
    place = place_of(tmp_path / "somewhere", None)
    assert place.unit == "units"
    for text in (place_summary(place), *(f"{label}: {value}" for label, value in place_rows(place))):
        assert METERS.search(text) is None, text
    source, text = page_of(run_of(tmp_path / "run", place))
    assert METERS.search(text) is None
    assert 'class="north"' not in source
    assert "The direction of north is not known." in text


def test_the_arrow_over_the_map_leads_north_and_lengths_are_those_of_the_ground(tmp_path):
    run = run_of(tmp_path / "run", place_of(tmp_path / "beach", GEOREF))
    file = run.path / "maps/map.json"
    noted = json.loads(file.read_text())
    file.write_text(json.dumps({**noted, "north_deg": 92.04, "stretch": 2.0}))
    source, text = page_of(run)
    assert '<div class="north" style="--north:92.0deg">N</div>' in source
    assert '<div class="bar" style="width:22.222%">1 m</div>' in source  # 4.5 m on the ground
    assert "6.75 m² mapped" in text


def test_the_report_opens_with_the_place_then_pictures_then_metrics(tmp_path):
    source, text = page_of(run_of(tmp_path / "run", place_of(tmp_path / "beach", GEOREF)))
    order = [source.index(part) for part in ("<h1>beach", 'class="sheet"', "Photographs<", '"views"', '"metrics"')]
    assert order == sorted(order)
    assert '<div class="bar" style="width:22.222%">2 m</div>' in source  # of a map of 9 m
    assert '<div class="north">N</div>' in source
    assert "12 of 12 used (10 for training, 2 for tests)" in text
    assert "10 cm, 27 m² mapped" in text


def test_sections_that_say_nothing_of_one_block_are_not_there(tmp_path):
    place = place_of(tmp_path / "beach", GEOREF)
    one, _ = page_of(run_of(tmp_path / "one", place, blocks=1))
    two, _ = page_of(run_of(tmp_path / "two", place, blocks=2))
    for name in ("blocks", "cameras", "seams"):
        assert f'<section id="{name}">' not in one
        assert f'href="#{name}"' not in one
        assert f'<section id="{name}">' in two


def test_maps_of_another_model_are_not_shown_as_the_place(tmp_path):
    run = run_of(tmp_path / "run", place_of(tmp_path / "beach", GEOREF))
    (run.path / "merged/status.json").write_text(json.dumps({"state": "done", "model_id": "2-b"}))
    source, text = page_of(run)
    assert 'class="sheet"' not in source
    assert "There is no orthophoto of this model yet" in text


def test_maps_from_levels_of_detail_are_called_so(tmp_path):
    run = run_of(tmp_path / "run", place_of(tmp_path / "beach", GEOREF))
    file = run.path / "maps/map.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"lod_error": 0.5}))
    assert page_of(run)[1].count("drawn from levels of detail (off by 0.5 px at most)") == 2


def test_status_says_the_same(tmp_path):
    place = place_of(tmp_path / "beach", GEOREF)
    run, stream = run_of(tmp_path / "run", place), io.StringIO()
    print_status(run, Console(file=stream, width=1000))
    assert stream.getvalue().splitlines()[0] == place_summary(place)
    told = status_json(run)["place"]
    assert told is not None
    assert told["accuracy"] == GEOREF["accuracy"]
    (run.path / "place.json").write_text("[1, {")
    assert status_json(run)["place"] is None


def test_when_a_place_was_flown(tmp_path):
    for name, moment in (("a", "2026:06:23 16:31:59"), ("b", "2026:06:23 16:40:02")):
        picture, exif = Image.new("RGB", (8, 8)), Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = moment
        picture.save(tmp_path / f"{name}.jpg", exif=exif)
    Image.new("RGB", (8, 8)).save(tmp_path / "none.png")
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    flown = first_and_last(date_taken(file) for file in sorted(tmp_path.iterdir()))
    assert flown == ("2026-06-23 16:31", "2026-06-23 16:40")
    assert format_flown(flown) == "2026-06-23, 16:31 to 16:40 by the camera's clock"
    assert format_flown(("2026-06-23 16:31", "2026-06-25 09:00")) == "2026-06-23 to 2026-06-25"
    assert first_and_last(["0000:00:00 00:00:00", "", "yesterday"]) == ()


@pytest.mark.parametrize("moment", ["2026-06-23 16:31:59", "2026-06-23T16:31:59Z", "2026/06/23 16:31:59.25"])
def test_dates_with_other_signs_are_those_of_exif(moment):
    plain = "2026:06:23 16:31:59"
    assert exif_form(moment)[:19] == plain
    assert time_of(moment) == time_of(plain) is not None
    assert first_and_last([moment]) == first_and_last([plain]) == ("2026-06-23 16:31",) * 2
    assert [exif_form(never) for never in ("0000:00:00 00:00:00", "    :  :     :  :  ", "0000-00-00")] == [""] * 3
    assert (exif_form("a day"), time_of("2026-13-01 10:00:00")) == ("a day", None)


@pytest.mark.parametrize(
    ("longitude", "said"), [(179.9999, "179.99"), (-179.99999, "179.99"), (8.0, "° E"), (-8.0, "° W")]
)
def test_longitudes_run_on_across_the_antimeridian(tmp_path, longitude, said):
    place = place_of(tmp_path / "island", GEOREF | {"origin_lon_deg": longitude})
    west, east = place.longitudes
    assert 0 < east - west < 0.1
    text = dict(place_rows(place))["Latitude, longitude"]
    assert said in text
    assert ("° E to 179.99" in text) is (abs(longitude) > 179)


def test_areas_for_people():
    assert [format_area(area, "m") for area in (None, 812.4, 25_300.0, 3_400_000.0)] == [
        "unknown", "812 m²", "2.53 ha", "3.4 km²"
    ]  # fmt: skip
    assert format_area(1_234_000_000.0, "m") == "1,234 km²"
    assert format_area(25_300.0, "units") == "25,300 square units"
