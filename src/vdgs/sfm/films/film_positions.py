"""Where positions of a film's frames may come from besides its own subtitles: what lies beside it, and `--gps`."""

from __future__ import annotations

from pathlib import Path

from vdgs.captures.gps_columns import BY_TIME
from vdgs.captures.gps_tables import read_gps_table
from vdgs.captures.tables_beside import tracks, why_track
from vdgs.errors import CaptureError
from vdgs.sfm.films.film_reader import Subtitles
from vdgs.sfm.films.subtitle_files import other_subtitle_files
from vdgs.sfm.films.telemetry import places
from vdgs.system.quoting import shell_word
from vdgs.system.units import duration


def check_table(table: Path, film: Path) -> None:
    """Raise CaptureError for a table that cannot be one of frames: before these are taken, which lasts."""
    if table.suffix.lower() == ".srt":
        raise CaptureError(
            f"{table}: holds subtitles of a film, and is no table of photographs. Put it beside the film under its "
            f"name ({film.stem}.SRT), and leave --gps out."
        )
    if why := why_track(table):
        raise CaptureError(f"{why.removesuffix(BY_TIME)}by time and not by photograph. Films: {_way_of_track(table)}.")
    read_gps_table(table)


def what_is_said(film: Path, count: int, placed: int, subtitles: Subtitles) -> str:
    """What is said of the positions of a film's frames, of which so many (`placed` of `count`) have one."""
    records, source = subtitles.records, subtitles.source
    if placed:
        return f"positions of {source}" + (f" for {placed} of the frames" if placed < count else "")
    if any(places(records)):
        said = f"those of {source} are of other times ({duration(records[0].seconds)} to "
        said += f"{duration(records[-1].seconds)}); the subtitles of another film?"
    elif subtitles.refused:
        said = subtitles.refused
    elif source:
        said = f"none is understood in {source} (without GPS, or without a fix?); give a table with --gps"
    else:
        return f"no positions ({_ways_to_positions(film)})"
    return f"no positions: {said}"


def _ways_to_positions(film: Path) -> str:
    """How to come by positions of a film that says none, by what lies beside it."""
    named = [f"{other.name} beside it: rename it to {film.stem}.SRT if it is of this film"
             for other in other_subtitle_files(film)]  # fmt: skip
    by_time = [f"{track.name} beside it has some by time: {_way_of_track(track)}" for track in tracks([film.parent])]
    ways = [*named[:1], *by_time[:1]] or ["drones write them into subtitles where captions are switched on"]
    return "; or ".join([*ways, "give a table with --gps"])


def _way_of_track(track: Path) -> str:
    """How to use a track for a film, whose frames have the moments of the film's clock, UTC, in EXIF."""
    return (
        "once the frames are taken, copy OUTPUT/frames/FILM to FRAMES, let exiftool write the positions into these "
        f"(exiftool -geotag {shell_word(track)} '-geotime<${{SubSecDateTimeOriginal}}+00:00' FRAMES), and give FRAMES "
        "in place of the film"
    )
