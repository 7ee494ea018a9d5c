"""In which order photographs were taken, as far as their names tell."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import NamedTuple

#: Folders that part the photographs of a flight into those that train and others.
SPLIT_FOLDER_NAMES = {"train", "val", "test"}


class FlightPosition(NamedTuple):
    """Where in a flight a photograph was taken."""

    #: The folder of its name: photographs of other folders belong to other flights.
    flight: str
    #: From 0, counting all photographs of the flight that are known.
    number: int


def flight_positions(names: Iterable[str]) -> dict[str, FlightPosition]:
    """The place of each photograph, by its name: within its folder in natural order, DJI_2 before DJI_10. Folders of
    splits (Mega-NeRF's train/ and val/) do not part a flight."""
    flights = defaultdict[str, list[str]](list)
    for name in names:
        flights["/".join(part for part in PurePosixPath(name).parent.parts if part not in SPLIT_FOLDER_NAMES)].append(
            name
        )
    return {
        name: FlightPosition(flight, number)
        for flight, taken in flights.items()
        for number, name in enumerate(sorted(taken, key=lambda name: (natural_key(PurePosixPath(name).name), name)))
    }


def natural_key(name: str) -> tuple[list[list[tuple[int, str]]], str]:
    """A key to sort names by, folder by folder: digits count as the number that they are; those that are then equal by
    their letters."""
    # Text and digits take turns, text first: numbers stand at the same places of all names.
    split = [re.split(r"([0-9]+)", part) for part in PurePosixPath(name).parts]
    return [[(int(text), "") if k % 2 else (0, text) for k, text in enumerate(part)] for part in split], name
