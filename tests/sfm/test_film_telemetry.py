"""What subtitles of films say of places, heights and clocks, and of the moments between their records."""

from __future__ import annotations

import math
from datetime import datetime, timedelta
from itertools import pairwise

import pytest

from vdgs.errors import CaptureError
from vdgs.sfm.films.film_reader import _start_place
from vdgs.sfm.films.record_bends import RecordBends
from vdgs.sfm.films.subtitle_files import read_subtitles
from vdgs.sfm.films.telemetry import read_telemetry, telemetry_at


@pytest.mark.parametrize(
    ("words", "place", "altitude", "relative", "focal"),
    [
        ("[latitude: -47.1] [longitude: 8.2] [rel_alt: 10.5 abs_alt: 400.0]", (-47.1, 8.2), 400.0, 10.5, None),
        ("<font size=\"36\">[focal_len : 240] [dzoom_ratio: 15000, delta:0] [latitude : 47.1] [longtitude : 8.2] "
         "[altitude: 12.3]</font>", (47.1, 8.2), 12.3, None, 36.0),
        ("[focal_len: 24.00] [dzoom_ratio: 1.00] [latitude: 47.1] [longitude: -8.2]", (47.1, -8.2), None, None, 24.0),
        ("HOME(8.1,47.2) 2017.08.05 14:11:51\nGPS(8.2,47.1,16) BAROMETER:1.9\nISO:100", (47.1, 8.2), None, 1.9, None),
        ("F/2.8, SS 206, GPS (8.2, 47.1, 15), D 224.20m, H -58.20m, H.S 0.0m/s", (47.1, 8.2), None, -58.2, None),
        ("RTK (120.08, 30.2, 18), HOME (120.0, 30.0, 103.55m), H 1.03m", (30.2, 120.08), None, 1.03, None),
        ("GPS(W: 117.04, N: 32.96, 32.15m)", (32.96, -117.04), 32.15, None, None),
        ("GPS (30.2, 120.08, 18)", (30.2, 120.08), None, None, None),
        ("2023.08.07 20:10:01\nGPS(-41.3899,174.0177,0.0M) BAROMETER:97.7M", (-41.3899, 174.0177), None, 97.7, None),
        ("2022.06.21 16:06:17\nGPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M", (36.6146, -6.112), None, 0.3, None),
        ("GPS(174.0177,-41.3899,0.0M) BAROMETER:97.7M", (-41.3899, 174.0177), None, 97.7, None),
        ("GPS(8.2,47.1,412.0m)", (47.1, 8.2), 412.0, None, None),
        ("[latitude: 51,4503] [longitude: -2,5927] [rel_alt: 1,300 abs_alt: 132,860] [focal_len: 24,00]",
         (51.4503, -2.5927), 132.86, 1.3, 24.0),
        ("GPS (-2,5927, 51,4503, 15), D 1,41m, H 12,10m", (51.4503, -2.5927), None, 12.1, None),
        ("GPS(E: 8,2, N: 47,1, 412,5m)", (47.1, 8.2), 412.5, None, None),
        ("[latitude: 5.1e1] [longitude: -2.5e-05] [rel_alt: 1.3 abs_alt: 1,32.5]", (51, -2.5e-5), None, 1.3, None),
        ("GPS (-2.5927, 51.4503, 15), D 141.0ft, H 110.0ft, H.S 0.0mph", (51.4503, -2.5927), None, 33.528, None),
        ("[latitude: 51.45] [longitude: -2.5] [rel_alt: 100 ft abs_alt: 1000feet]", (51.45, -2.5), 304.8, 30.48, None),
    ],
)  # fmt: skip
def test_dialects_of_subtitles(words, place, altitude, relative, focal):
    [record] = read_telemetry([(1.0, words)])
    assert record.lat_lon == pytest.approx(place)
    assert record.altitude == (altitude and pytest.approx(altitude))
    assert record.relative_altitude == (relative and pytest.approx(relative))
    assert record.focal_35mm == (focal and pytest.approx(focal))


@pytest.mark.parametrize("angles", ["-90.0°, 0.5°, 12.1°", "-90.0,0.5,12.1", "-90,0°, 0,5°, 12,1°"])
def test_angles_of_gimbals_have_points_or_commas(angles):
    assert read_telemetry([(0.0, f"G.PRY ({angles})")])[0].gimbal == (12.1, -90.0, 0.5)


def test_where_the_film_began_tells_the_order_of_two_numbers():
    blocks = [(float(k), f"GPS (47.1{k}, 8.2, 12)") for k in range(3)]
    assert read_telemetry(blocks, (47.1, 8.2))[0].lat_lon == (47.10, 8.2)
    assert read_telemetry(blocks)[0].lat_lon == (8.2, 47.10)  # as DJI documents it
    in_m = [(0.0, "GPS(47.1,8.2,0.0M) BAROMETER:1.0M")]
    assert read_telemetry(in_m, (8.2, 47.1))[0].lat_lon == (8.2, 47.1)
    assert read_telemetry(in_m)[0].lat_lon == (47.1, 8.2)  # as the Matrice 300 writes it


@pytest.mark.parametrize("tag", ["+00.0000+000.0000/", "+0.0000+0.0000/", "+36.6146-006.1120+000.000/", None])
def test_a_film_that_began_without_a_fix_tells_no_order_of_two_numbers(tag):
    """0, 0 is as far from one order as from the other."""
    place = _start_place({"location": tag} if tag else {})
    [record] = read_telemetry([(0.0, "GPS(36.6146,-6.1120,0.0M) BAROMETER:10.3M")], place)
    assert record.lat_lon == (36.6146, -6.112)
    assert (place is None) == (tag is None or "36" not in tag)
    known = {"location": "+00.0000+000.0000/", "location-eng": "+36.6146-006.1120/"}
    assert _start_place(known) == (36.6146, -6.112)


def test_no_fix_and_no_place_are_no_position():
    for words in ("[latitude: 0.000000] [longitude: 0.000000]", "GPS(0.0, 0.0, 0)", "[latitude: 95] [longitude: 8]"):
        assert all(record.lat_lon is None for record in read_telemetry([(0.0, words)]))
    assert read_telemetry([(0.0, "Turn left at the lights.")]) == ()


@pytest.mark.parametrize("text", ["", "x", "1\n\n[latitude: 47.0] [longitude: 8.0]\n", "\x00\x31\x00\x0a"])
def test_subtitles_without_times_say_nothing(text):
    assert read_subtitles(text) == []


def test_fractions_of_seconds_of_subtitles_have_one_to_three_digits():
    times = ("00:00:01,5", "00:01:00.25", "01:00:00,125")
    text = "\n\n".join(f"{k}\n{time} --> {time}\n" for k, time in enumerate(times, 1))
    assert [seconds for seconds, _ in read_subtitles(text)] == [1.5, 60.25, 3600.125]


def test_the_moment_of_a_frame_is_that_of_the_record_before_it_and_the_time_since():
    records = read_telemetry([(1.0, "2026-06-01 10:00:07.500 [latitude: 47.0] [longitude: 8.0]")])
    assert telemetry_at(records, 1.25).moment == datetime(2026, 6, 1, 10, 0, 7, 750_000)


def test_positions_lie_between_those_of_the_records_and_are_not_made_up():
    text = "1\n00:00:01,000 --> 00:00:02,000\n{a}\n\n2\n00:00:02,000 --> 00:00:03,000\n{b}\n"
    a, b = ("[latitude: 47.0] [longitude: 8.0] [rel_alt: 10.0]", "[latitude: 47.1] [longitude: 8.4] [rel_alt: 20.0]")
    records = read_telemetry(read_subtitles(text.format(a=a, b=b)))
    between = telemetry_at(records, 1.25)
    assert between.lat_lon == pytest.approx((47.025, 8.1))
    assert between.relative_altitude == pytest.approx(12.5)
    assert telemetry_at(records, 60.0).lat_lon is None
    assert telemetry_at(records, 0.2).lat_lon == records[0].lat_lon
    assert [telemetry_at(records, outside).lat_lon for outside in (-0.2, 3.5)] == [None, None]
    assert telemetry_at((), 1.0).lat_lon is None


def test_in_a_long_gap_of_records_a_place_holds_as_long_as_at_the_ends():
    blocks = [(t, f"[latitude: {47 + t / 100}] [longitude: 8.0] [rel_alt: {t}]") for t in (0.0, 1.0, 2.0, 8.0, 9.0)]
    records = read_telemetry(blocks)
    known = {t: telemetry_at(records, t) for t in (1.5, 2.5, 3.5, 5.0, 6.5, 7.5, 8.5)}
    assert [t for t, each in known.items() if each.lat_lon is None] == [3.5, 5.0, 6.5]
    assert known[5.0].relative_altitude is None
    assert known[2.5].lat_lon == records[2].lat_lon
    assert known[7.5].lat_lon == records[3].lat_lon
    assert known[8.5].lat_lon == pytest.approx((47.085, 8.0))


def test_a_record_without_a_fix_changes_nothing_around_it():
    """Drones write 0 for the place and the heights then; the gimbal and the clock go on."""
    words = "2026-06-01 10:00:{t:02d}.000 [latitude: {lat}] [longitude: {lon}] [rel_alt: {h} abs_alt: {h}] [gb_yaw: {t}"
    words += " gb_pitch: -90.0 gb_roll: 0.0]"
    lost = {2, 5, 6, 7}
    blocks = [
        (float(t), words.format(t=t, **({"lat": 0.0, "lon": 0.0, "h": 0.0} if t in lost else
                                        {"lat": 47 + t / 100, "lon": 8.0, "h": 100.0})))
        for t in range(10)
    ]  # fmt: skip
    records = read_telemetry(blocks)
    for seconds in (1.5, 2.0, 2.5):
        known = telemetry_at(records, seconds)
        assert known.lat_lon == pytest.approx((47 + seconds / 100, 8.0))
        assert (known.altitude, known.relative_altitude) == (100.0, 100.0)
    assert [telemetry_at(records, t).lat_lon for t in (5.5, 6.0, 6.5)] == [None] * 3
    known = telemetry_at(records, 6.25)
    assert (known.altitude, known.relative_altitude) == (None, None)
    assert known.gimbal == (6.0, -90.0, 0.0)
    assert known.moment == datetime(2026, 6, 1, 10, 0, 6, 250_000)
    heights = read_telemetry([(0.0, "H 10.0m"), (1.0, "H 20.0m")])  # of a film without any place
    assert telemetry_at(heights, 0.5).relative_altitude == pytest.approx(15)


def test_moments_rise_along_a_film_whose_records_have_whole_seconds():
    blocks = [
        (k / 30, f"2026-06-01 10:00:{int(7.4 + k / 30):02d} [latitude: 47.0] [longitude: 8.0]") for k in range(90)
    ]
    records = read_telemetry(blocks)
    moments = [telemetry_at(records, k / 30).moment for k in range(90)]
    assert moments == sorted(set(moments))
    assert abs((moments[0] - datetime(2026, 6, 1, 10, 0, 7, 400_000)).total_seconds()) < 0.05
    gap = [block for k, block in enumerate(blocks) if not 10 < k < 80]
    at = [telemetry_at(read_telemetry(gap), t / 10).moment for t in range(32)]
    assert at == sorted(set(at))


@pytest.mark.parametrize(("rate", "joined_s"), [(60, 0), (1, 1800)])
def test_clocks_that_run_otherwise_than_the_film_are_left_alone(rate, joined_s):
    """Hyperlapses, and films that a person joined."""
    starts = [int(rate * k / 30) + joined_s * (k >= 60) for k in range(120)]
    words = [str(datetime(2026, 6, 1, 10) + timedelta(seconds=each)) for each in starts]
    records = read_telemetry([(k / 30, f"{word} [latitude: 47] [longitude: 8]") for k, word in enumerate(words)])
    assert [str(record.moment) for record in records] == words


def test_positions_between_records_on_both_sides_of_the_antimeridian_lie_between_them():
    blocks = [(float(k), f"[latitude: -16.8] [longitude: {179.99998 * side}]") for k, side in enumerate((1, -1))]
    records = read_telemetry(blocks)
    for seconds, expected in ((0.25, 179.99999), (0.75, -179.99999)):
        assert telemetry_at(records, seconds).lat_lon == pytest.approx((-16.8, expected), abs=1e-9)


@pytest.mark.parametrize(
    ("words", "place"),
    [
        ("[latitude: 33.5S] [longitude: 70.6 W]", (-33.5, -70.6)),
        ("[latitude: -33.5S] [longitude: -70.6W]", (-33.5, -70.6)),
        ("GPS(W: -70.6, S: -33.5)", (-33.5, -70.6)),
        ("GPS(W: 70.6, S: 33.5)", (-33.5, -70.6)),
        ("HOME(lat: 1.5, lon: 2.5) [latitude: 47.1] [longitude: 8.2]", (47.1, 8.2)),
        ("[latitude: 47 07.407] [longitude: 8°12.5'E]", (47.12345, 8.208333)),
        ("[latitude: 33.5E] [longitude: 70.6W]", None),
        ("lat: 47.1 12:03:04 lon: 8.2 13", (47.1, 8.2)),
    ],
)
def test_angles_have_sides_minutes_and_are_not_those_of_the_take_off(words, place):
    found = [record.lat_lon for record in read_telemetry([(0.0, f"H 10.0m {words}")])]
    assert found == [place and pytest.approx(place, abs=1e-6)]


def _srt(starts, first, clock=0.0):
    times = [f"00:00:{int(t):02d},{round(1000 * (t % 1)):03d}" for t in (*starts, 2 * starts[-1] - starts[-2])]
    return "".join(
        f"{k}\n{one} --> {other}\n2026-06-01 10:00:{int(clock + k):02d} [latitude: {first + k}] [longitude: 8.0]\n\n"
        for k, (one, other) in enumerate(pairwise(times))
    )


def test_joined_subtitles_follow_each_other_where_they_are_as_long_as_the_film():
    one, other = _srt(range(10), 10), _srt(range(5), 40, clock=20)
    for film_s in (15.0, 14.2):
        records = read_telemetry(read_subtitles(one + other, film_s))
        assert [record.lat_lon for record in records] == [(lat, 8.0) for lat in (*range(10, 20), *range(40, 45))]
        assert records[10].seconds == pytest.approx(10, abs=0.5)
    for text, film_s in ((one + other, 30.0), (one + one, 10.0), (other + one, 15.0)):
        with pytest.raises(CaptureError, match="its times begin again, as of 2 files"):
            read_subtitles(text, film_s)
    assert read_subtitles(one, 60.0) == read_subtitles(one)


def test_blocks_out_of_order_are_no_joined_files():
    parts = _srt(range(10), 10).split("\n\n")
    whole, turned = (read_telemetry(read_subtitles("\n\n".join(each))) for each in (parts, parts[5:] + parts[:5]))
    assert turned == whole


def _records(metres: list[tuple[float, float]], decimals: int, step_s: float = 1.0):
    words = ((47 + north / 111e3, 8 + east / 76e3) for east, north in metres)
    text = (f"[latitude: {lat:.{decimals}f}] [longitude: {lon:.{decimals}f}]" for lat, lon in words)
    return read_telemetry([(step_s * k, each) for k, each in enumerate(text)])


def test_between_two_records_around_a_turn_there_is_no_position():
    """That would cut the corner, on the inner side of the flight."""
    there_and_back = [(15.0 * k, 0.0) for k in (0, 1, 2, 3, 2.5, 1.5, 0.5)]
    records = _records(there_and_back, 7)
    bends = RecordBends(records)
    placed = [bends.checked(telemetry_at(records, t)).lat_lon is not None for t in (0.5, 1.5, 3.0, 3.3, 3.7, 5.5)]
    assert placed == [True, True, True, False, False, True]


@pytest.mark.parametrize("radius", [15.0, 30.0])
def test_around_something_positions_between_records_stay(radius):
    """At 10 m/s and a record a second they cut the arc by 0.8 m and 0.4 m."""
    turns = [10.0 * k / radius for k in range(40)]
    records = _records([(radius * math.cos(turn), radius * math.sin(turn)) for turn in turns], 7)
    bends = RecordBends(records)
    assert bends.beside_m(20.5) == pytest.approx(radius * (1 - math.cos(5 / radius)), rel=0.05)
    assert all(bends.checked(telemetry_at(records, t / 4)).lat_lon is not None for t in range(156))


@pytest.mark.parametrize(("decimals", "step_m"), [(4, 11.1), (5, 1.11), (7, 0.0)])
def test_rounding_on_a_straight_way_is_no_turn(decimals, step_m):
    records = _records([(3.1 * k, 4.3 * k) for k in range(40)], decimals)
    bends = RecordBends(records)
    assert bends.step_m == pytest.approx(step_m, rel=0.01)
    assert all(bends.checked(telemetry_at(records, t / 4)).lat_lon is not None for t in range(156))
