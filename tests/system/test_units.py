"""Times, sizes and counts in words."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from vdgs.system.units import ABSENT, clock, count, data_size, duration, rough_duration, two_digits


def test_figures_that_are_not_there_are_a_dash():
    assert [count(None), data_size(None), duration(None), duration(-1.0), duration(float("nan"))] == [ABSENT] * 5


def test_figures_as_people_read_them():
    assert count(12345.4) == "12,345"
    assert [data_size(b) for b in (0, 638_279_680, 1.5e9, 24e9)] == ["0 MB", "638 MB", "1.50 GB", "24.0 GB"]
    assert data_size(1.44e9, decimals=1) == "1.4 GB"
    assert [duration(s) for s in (2.34, 45, 59.6, 146.4, 7260)] == [
        "2.3 s", "45 s", "1 min 00 s", "2 min 26 s", "2 h 01 min",
    ]  # fmt: skip
    assert [rough_duration(s) for s in (0.2, 89, 90, 700, 12_600)] == ["1 s", "89 s", "2 min", "12 min", "3.5 h"]
    assert clock(3671.4) == "1:01:11"


@given(seconds=st.floats(0, 1e6))
def test_a_clock_reads_back_as_the_seconds_it_shows(seconds):
    hours, minutes, rest = (int(part) for part in clock(seconds).split(":"))
    assert hours * 3600 + minutes * 60 + rest == round(seconds)
    assert minutes < 60 > rest


@given(n_bytes=st.floats(0, 1e13))
def test_a_size_is_right_to_its_last_digit(n_bytes):
    number, unit = re.fullmatch(r"([\d,.]+) ([MG]B)", data_size(n_bytes)).groups()
    shown = float(number.replace(",", "")) * {"MB": 1e6, "GB": 1e9}[unit]
    assert abs(shown - n_bytes) <= max(0.5e6, 0.01 * n_bytes)


@given(value=st.floats(-1e5, 1e5))
def test_two_digits_of_a_measure_are_right_and_keep_its_sign(value):
    shown = two_digits(value, "+")
    assert abs(float(shown) - value) <= max(0.051 * abs(value), 0.0005)
    assert "e" not in shown
    assert shown[0] == ("-" if float(shown) < 0 else "+")


def test_small_and_large_measures_as_people_read_them():
    said = {0.18: "0.18", -0.04: "-0.040", 9.96: "10", 7.3: "7.3", 119.6: "120", 4321.0: "4321", -0.0001: "0"}
    assert {value: two_digits(value) for value in said} == said
