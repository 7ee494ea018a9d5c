"""Films among what a capture is made of: their frames are taken into OUTPUT/frames, and are photographs from there on.

Each film has a folder there; OUTPUT/films.json says which are finished. The same command takes no frame twice.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from vdgs.captures.name_resolution import to_colmap_name
from vdgs.captures.output_guard import check_output
from vdgs.captures.reconstruction import FILMS_FILE, FRAMES_FOLDER, SOURCE_IMAGES_FILE, WORK_FOLDER, read_digests
from vdgs.config.ranges import check_ranges
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm.films.film_positions import check_table, what_is_said
from vdgs.sfm.films.film_reader import (
    Film,
    FilmFrame,
    Subtitles,
    color_picture,
    gray_picture,
    open_film,
    shrink,
    upright_size,
)
from vdgs.sfm.films.frame_choice import MOTION_WIDTH, SHARPNESS_WIDTH, FrameChooser, MotionTracker, sharpness
from vdgs.sfm.films.frame_files import encode_frame, with_tags
from vdgs.sfm.films.record_bends import RecordBends
from vdgs.sfm.films.subtitle_files import subtitle_files
from vdgs.sfm.films.telemetry import Telemetry, telemetry_at
from vdgs.sfm.find_images import films_in
from vdgs.sfm.image_list import MIN_IMAGES
from vdgs.sfm.reconstruction_plan import check_output_folder
from vdgs.sfm.workspace import Workspace, report_progress
from vdgs.system.atomic_files import read_json_or_empty, write_bytes, write_json
from vdgs.system.content_digests import ContentDigests, find_copies
from vdgs.system.file_locks import lock_folder
from vdgs.system.records import record_from_dict, record_to_dict
from vdgs.system.stop_signals import check_stop_requested
from vdgs.system.units import duration, first_names, two_digits

#: So many frames a second are looked at.
LOOKS_PER_SECOND = 15.0
#: A film has at least so many frames of those that are asked for of all.
LEAST_FRAMES = 3


@dataclass(frozen=True, kw_only=True)
class FilmRecord:
    """A film whose frames were taken."""

    film: str
    most: int
    """The bound on its frames."""
    frames: int
    summary: str
    digest: str = ""
    """Of its file; empty where it is not known."""

    def is_of(self, film: Path, content: Mapping[Path, str], most: int) -> bool:
        """Whether it is of a film, whose digest is in `content`."""
        return (self.film, self.digest or None, self.most) == (str(film.resolve()), content[film], most)


@contextmanager
def temporary_frames(request: SfmRequest, console: Console) -> Iterator[SfmRequest]:
    """The request with frames in place of films, for a look that writes nothing into the output: those that were taken
    before, where they are of these films.

    Raises CaptureError for films that cannot be read or show no way, VdgsError for an output that is something else, or
    was begun with other films.
    """
    films, _ = _films(request)
    if not films:
        yield request
        return
    _check(request, films)
    digests = read_digests(request.output)
    if (request.output / SOURCE_IMAGES_FILE).exists() and not request.overwrite:
        _check_same(request, films, digests)
    if _are_taken(request, films, digests):
        yield replace(request, image_folders=_with_folder(request, request.output / FRAMES_FOLDER))
        return
    with tempfile.TemporaryDirectory(prefix="vdgs-frames-") as folder:
        yield replace(request, image_folders=_take(request, Path(folder), console))


def with_frames(request: SfmRequest, console: Console, run: RunFolder | None = None) -> SfmRequest:
    """The request with frames in place of films, which are taken into the output where they are not there yet.

    Raises CaptureError for films that cannot be read or show no way, VdgsError for films that are others than those a
    capture was begun with.
    """
    films, _ = _films(request)
    if not films:
        return request
    check_ranges(request)
    _check(request, films)
    digests = read_digests(request.output)
    if (request.output / SOURCE_IMAGES_FILE).exists() and not request.overwrite:
        _check_same(request, films, digests)
    with run.drive_lock() if run is not None else nullcontext(), lock_folder(request.output):
        return replace(request, image_folders=_take(request, request.output, console, digests))


def _check(request: SfmRequest, films: Sequence[Path]) -> None:
    """Raise, before frames are taken, which lasts, what would be raised later."""
    check_output(request.output)
    check_output_folder(request.output)
    if request.gps is not None:
        check_table(request.gps, films[0])


def _films(request: SfmRequest) -> tuple[list[Path], dict[Path, Path]]:
    """The films that are asked for, and those that are copies of one of them, byte for byte, with that one: the one
    with subtitles beside it, else that of the shortest name (not `DJI_0001 (1).MP4`)."""
    films, copies = films_in(request.image_folders), dict[Path, Path]()
    try:
        for group in find_copies(films):
            first, *others = sorted((films[k] for k in group), key=_copy_order)
            copies |= dict.fromkeys(others, first)
    except OSError as error:
        raise CaptureError(f"{error.filename}: cannot be read ({error.strerror}). Copy the film again.") from None
    return [film for film in films if film not in copies], copies


def _copy_order(film: Path) -> tuple[bool, int]:
    return not subtitle_files(film), len(film.name)


def _check_same(request: SfmRequest, films: Sequence[Path], digests: ContentDigests) -> None:
    """Raise VdgsError where the capture that is there was begun with other films or another bound on their frames."""
    before = _records(request.output)
    changes = _changes(before, films, digests)
    if before and not changes:
        bounds = _bounds(films, request.options.num_frames)
        if sorted(record.most for record in before.values()) != sorted(bounds):
            changes = "--num-frames differs"
    if changes:
        raise VdgsError(
            f"{request.output}: was begun with other films or frames than there are now ({changes}). Add --overwrite "
            "to make it anew, or choose another --output."
        )


def film_changes(output: Path) -> str:
    """What changed of the films that a capture was made of; empty where nothing did, or they are not there any more."""
    records = _records(output).values()
    there = [Path(record.film) for record in records]
    if not there or not all(film.is_file() for film in there):
        return ""
    return _changes(_records(output), there, read_digests(output))


def _changes(before: Mapping[str, FilmRecord], films: Sequence[Path], digests: ContentDigests) -> str:
    known, now = {record.film: record for record in before.values()}, {str(film.resolve()): film for film in films}
    same, content = known.keys() & now.keys(), digests.of_all(films)
    kinds = {
        "added": now.keys() - known.keys(), "removed": known.keys() - now.keys(),
        "changed": {name for name in same if not known[name].is_of(now[name], content, known[name].most)},
    }  # fmt: skip
    parts = [
        f"{len(names)} {kind} ({first_names(sorted(Path(name).name for name in names))})"
        for kind, names in kinds.items()
        if names
    ]
    return f"films: {', '.join(parts)}" if known and parts else ""


def _records(output: Path) -> dict[str, FilmRecord]:
    """Of the films whose frames were taken, by their folders."""
    try:
        found = read_json_or_empty(output / FILMS_FILE)
        return {name: record_from_dict(FilmRecord, value) for name, value in found.items()}
    except ValueError:
        return {}


def _take(
    request: SfmRequest, output: Path, console: Console, digests: ContentDigests | None = None
) -> tuple[Path, ...]:
    """The folders of photographs: those of the request, and the folder of frames; without `digests` nobody asks later
    whether films are others."""
    (films, copies), folder = _films(request), output / FRAMES_FOLDER
    names, before = _folder_names(films), _records(output)
    most = _bounds(films, request.options.num_frames)
    for rest in folder.iterdir() if folder.is_dir() else ():
        if rest.is_dir() and rest.name not in names:
            shutil.rmtree(rest)
    bounds = dict(zip(names, zip(films, most, strict=True), strict=True))
    content = {film: "" if digests is None else digests.of(film) for film in films}  # before frames are taken
    records = {
        name: record
        for name, record in before.items()
        if name in names and (folder / name).is_dir() and record.is_of(bounds[name][0], content, bounds[name][1])
    }
    _write_records(output, records)
    for film, first in copies.items():
        console.print(escape(f"{film}: not used, is a copy of {first}"), highlight=False)
    for name, (film, bound) in bounds.items():
        if name not in records:
            taken = _take_frames(film, folder / name, bound, Workspace(output / WORK_FOLDER), console)
            records[name] = replace(taken, digest=content[film])
            _write_records(output, records)
        known = records[name]
        console.print(escape(f"{film.name}: {known.summary}"), highlight=False)
    if digests is not None:
        digests.write()
    count = sum(record.frames for record in records.values())
    folders = _with_folder(request, folder)
    if count < MIN_IMAGES and folders == (folder,):
        raise CaptureError(
            f"{', '.join(map(str, films))}: {count} frames that differ from each other; a scene needs {MIN_IMAGES} at "
            "the very least. The picture must move: films from one spot show no place from different sides."
        )
    return folders


def _with_folder(request: SfmRequest, frames: Path) -> tuple[Path, ...]:
    """The folders of photographs, and that of frames in place of the films."""
    return (*(path for path in request.image_folders if not films_in((path,))), frames)


def _are_taken(request: SfmRequest, films: Sequence[Path], digests: ContentDigests) -> bool:
    """Whether the output holds all frames of these films."""
    before = _records(request.output)
    if not before:  # no need to read the films
        return False
    content, most = digests.of_all(films), _bounds(films, request.options.num_frames)
    return all(
        name in before and (request.output / FRAMES_FOLDER / name).is_dir() and before[name].is_of(film, content, bound)
        for name, film, bound in zip(_folder_names(films), films, most, strict=True)
    )


def _write_records(output: Path, records: Mapping[str, FilmRecord]) -> None:
    write_json(output / FILMS_FILE, {name: record_to_dict(record) for name, record in records.items()})


def _folder_names(films: Sequence[Path]) -> list[str]:
    """A name for each film, numbered where they are alike."""
    names, used = list[str](), set[str]()
    for film in films:
        name = stem = to_colmap_name(film.stem).strip(".") or "film"
        number = 2
        while name.lower() in used:
            name, number = f"{stem}_{number}", number + 1
        used.add(name.lower())
        names.append(name)
    return names


def _bounds(films: Sequence[Path], total: int) -> list[int]:
    """How many frames are taken of each film at most: by how long they are."""
    if len(films) == 1:
        return [total]
    lengths = []
    for path in films:
        with open_film(path) as film:
            lengths.append(max(film.seconds, 1.0))
    return [max(LEAST_FRAMES, int(total * length / sum(lengths))) for length in lengths]


def _take_frames(path: Path, folder: Path, most: int, work: Workspace, console: Console) -> FilmRecord:
    """Write the frames of a film that are chosen, then what is known of each into the files."""
    shutil.rmtree(folder, ignore_errors=True)
    moments = dict[Path, float]()

    def keep(frame: FilmFrame) -> Path:
        file = folder / f"{folder.name}_{frame.number:06d}.jpg"
        write_bytes(file, encode_frame(color_picture(frame.picture)))
        moments[file] = frame.seconds
        return file

    with open_film(path) as film:
        chooser = FrameChooser[FilmFrame](most, keep, Path.unlink)
        with report_progress(work, console, "frames", max(1, round(film.seconds)), f"{escape(path.name)}, ") as tell:
            last = _look(film, chooser, tell)
        chosen = chooser.finish()
        subtitles = film.telemetry()
        bends, placed, beside = RecordBends(subtitles.records), 0, 0
        for file in chosen:
            between = telemetry_at(subtitles.records, moments[file])
            known = bends.checked(between)
            beside += known is not between
            placed += known.lat_lon is not None
            moment = _moment(film, known, moments[file])
            write_bytes(file, with_tags(file.read_bytes(), folder.name, film.camera, moment, known))
        if beside:
            film.notes.append(f"{beside} frames between records on both sides of a turn have no position")
        if bends.step_m > 1:
            film.notes.append(f"its subtitles round positions to {two_digits(bends.step_m)} m")
        summary = _summary(film, len(chosen), placed, last, subtitles)
    return FilmRecord(film=str(path.resolve()), most=most, frames=len(chosen), summary=summary)


def _look(film: Film, chooser: FrameChooser[FilmFrame], tell) -> FilmFrame:  # type: ignore[no-untyped-def]
    """Show the frames to what chooses; returns the last."""
    tracker, due = MotionTracker(), 0.0
    for frame in film.frames():
        check_stop_requested()
        if frame.seconds < due:
            continue
        due = frame.seconds + 0.99 / LOOKS_PER_SECOND
        gray = gray_picture(frame.picture, SHARPNESS_WIDTH)
        travel = tracker.travel(shrink(gray, MOTION_WIDTH), frame.seconds)
        chooser.offer(travel, sharpness(gray), frame)
        tell(min(round(frame.seconds), max(1, round(film.seconds))))
    return frame


def _moment(film: Film, known: Telemetry, seconds: float) -> datetime | None:
    """When a frame was taken, by the subtitles, else by when the film was begun."""
    return known.moment or (film.created and film.created + timedelta(seconds=seconds))


def _summary(film: Film, count: int, placed: int, last: FilmFrame, subtitles: Subtitles) -> str:
    """96 of 2,400 frames of 1 min 20 s, 3840 x 2160; positions of its subtitles."""
    width, height = upright_size(last.picture)
    notes = [what_is_said(film.path, count, placed, subtitles), *film.notes]
    if film.damaged:
        notes.append(f"{film.damaged} packets are damaged, their frames left out")
    if film.damaged_s > 0:
        notes.append(f"frames of {duration(film.damaged_s)} are damaged, and left out")
    if film.shown_s < 0.9 * film.seconds - 1:
        notes.append(f"ends after {duration(film.shown_s)}: cut off?")
    size = f"{width} x {height}"
    return f"{count:,} of {film.count:,} frames in {duration(film.shown_s)}, {size}; {'; '.join(notes)}"
