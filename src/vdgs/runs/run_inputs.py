"""What a run was made of, as it was when the run read it: RUN/inputs.json lists every file that its command names, or
that lies in the folders that it names.

Copies keep the time at which a file was last written (`cp -p`, `rsync -t`), and a folder that is moved keeps those of
all its files. So a file counts as unchanged only where its size, that time and the time at which the disk last changed
its entry (ctime) are as recorded. Imports nothing heavy: `vdgs status` and finished runs are answered by this.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vdgs.captures.image_suffixes import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES
from vdgs.captures.reconstruction import DIGESTS_FILE, SOURCE_IMAGES_FILE, STEPS_FILE, WORK_FOLDER
from vdgs.captures.strays import is_mask_folder, is_run
from vdgs.config.commands import RunRequest
from vdgs.errors import VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import with_absolute_paths
from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.system.content_digests import file_digest
from vdgs.system.units import first_names

if TYPE_CHECKING:
    from vdgs.captures.capture import Capture

INPUTS_FILE = "inputs.json"
#: What photographs and masks are called.
_PICTURE_SUFFIXES = IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES
#: Files that hold poses, lenses, positions and lists in captures and beside photographs.
_TOLD_SUFFIXES = {".xmp", ".json", ".bin", ".txt", ".xml", ".csv", ".opf", ".p4d", ".nvm", ".geojson", ".npy"}
#: ODM's table, which is read beside the folder of photographs too.
_TABLE_BESIDE = "geo.txt"
#: Larger files count by their size, as photographs of captures do (bytes).
_LARGEST_READ = 1 << 28
#: What `vdgs sfm` keeps in a capture for itself.
_OWN_RECORDS = {SOURCE_IMAGES_FILE, DIGESTS_FILE, STEPS_FILE, WORK_FOLDER}
#: In place of the stamp of a file that changed after the command began to read: no file has it.
_UNKNOWN = [0, 0, 0]


@dataclass(frozen=True)
class _Inputs:
    """Where the inputs of a run lie."""

    own_capture: str
    named: list[str]
    """The files and folders that its command names, absolute."""
    folders: list[str]
    """Further folders, of which only the photographs and masks count."""

    def stamps(self) -> dict[str, list[int]]:
        """Size, time of the content and time of the entry (ns) of every input by its path; that of a file in the run
        is relative to the run, which may move. Raises OSError where one that is named is not there."""
        files = [file for path in self.named for file in _files(path)]
        for folder in self.folders:
            files += [each.path for each in os.scandir(folder) if _is_picture(each.name) and not each.is_dir()]
        found = {file: _stamp(file) for file in files}
        if os.path.isdir(self.own_capture):
            within = len(os.path.dirname(self.own_capture).rstrip(os.sep)) + 1  # faster than relpath for each of them
            for file in _files(self.own_capture):
                if file[within:].split(os.sep)[1] not in _OWN_RECORDS:
                    found[file[within:]] = _stamp(file)
        return found


def note_inputs(run: RunFolder, request: RunRequest, capture: Capture, began_ns: int) -> None:
    """Record what a run is made of: what `request`, as it was given, names, and the capture that was read.

    `began_ns` is when the command began, by `time.time_ns`: what changed since may have been read before, so the next
    command compares it again. Where files are gone meanwhile or the disk refuses, nothing is recorded.
    """
    from vdgs.captures.formats.project_photographs import UNDISTORTED  # these import what quick answers do not need
    from vdgs.captures.output_guard import input_folders

    own = os.path.realpath(run.own_capture)
    written_here = [own, os.path.abspath(request.options.undistorted_folder or capture.root / UNDISTORTED)]
    try:
        named, apart = _named(request), [os.path.abspath(folder) for folder in input_folders(capture)]
        inputs = _Inputs(own, named, [folder for folder in apart if not _lies_in(folder, [*named, own])])
        known, counted = _recorded(run)[1], _counted(request, capture)
        files = dict[str, list[int | str]]()
        for name, stamp in inputs.stamps().items():
            path = os.path.join(os.path.dirname(own), name)
            before = known.get(name, _UNKNOWN)
            content = before[3] if before[:3] == stamp and before[3] else _content(path, counted)
            is_new = stamp[2] > began_ns and not _lies_in(path, written_here)
            files[name] = [*(_UNKNOWN if is_new else stamp), content]
        if _recorded(run) != (inputs, files):
            write_json(run.path / INPUTS_FILE, {"named": named, "folders": inputs.folders, "files": files})
    except (OSError, VdgsError):
        with suppress(OSError):  # a disk that takes no changes; what is recorded there is of other stamps
            (run.path / INPUTS_FILE).unlink(missing_ok=True)


def are_inputs_unchanged(run: RunFolder, request: RunRequest) -> bool:
    """Whether a command names what the run was made of, and all of that is as it was: no file changed, added or gone.
    False too where that is not recorded. Raises OSError where something is not there."""
    inputs, files = _recorded(run)
    if not files or inputs.named != _named(request):
        return False
    return inputs.stamps() == {name: each[:3] for name, each in files.items()}


def input_changes(run: RunFolder, of_photographs: bool) -> str:
    """What changed of the inputs of a run since, for people; empty where nothing did that a result depends on, and
    where they are not there any more (a card that was taken out). `of_photographs`: of a run of photographs, which
    are compared by themselves (`sfm.source_images`); else their masks count too."""
    inputs, files = _recorded(run)
    try:
        if not files or not (of_photographs or inputs.named[0] == run.settings().capture_path):
            return ""
        found, within = inputs.stamps(), run.path.resolve()
    except (OSError, VdgsError):
        return ""
    counted = {name: (each[:3], each[3]) for name, each in files.items() if each[3]}
    gone = [name for name in counted if name not in found]
    changed = [
        name
        for name, (stamp, content) in counted.items()
        if name in found and found[name] != stamp and _content_as(within / name, content) != content
    ]
    added = [] if of_photographs else [name for name in found if name not in files and _is_mask(name)]
    kinds = (("changed", changed), ("gone", gone), ("masks added", added))
    return "; ".join(
        f"{what} since the run read its inputs: {first_names(sorted(map(os.path.basename, names)))}"
        for what, names in kinds
        if names
    )


def _recorded(run: RunFolder) -> tuple[_Inputs, dict[str, list[Any]]]:
    """What `note_inputs` recorded: where inputs lie, and the stamp and the content of each; without any where nothing
    is recorded, or the record is damaged."""
    record, own = read_json_or_empty(run.path / INPUTS_FILE), os.path.realpath(run.own_capture)
    named, folders, files = record.get("named"), record.get("folders"), record.get("files")
    if not (isinstance(named, list) and named and isinstance(folders, list) and isinstance(files, dict)):
        return _Inputs(own, [], []), {}
    return _Inputs(own, named, folders), {name: each for name, each in files.items() if len(each) == 4}


def _named(request: RunRequest) -> list[str]:
    """The files and folders that a command names to be read, absolute, the capture first."""
    options = with_absolute_paths(request.options, request.capture)
    outside = [Path(each) for each in (options.images, options.masks) if each and Path(each).is_absolute()]
    given = {**vars(options), **{f"sfm.{name}": value for name, value in vars(request.sfm).items()}}
    files = [each for name, each in given.items() if isinstance(each, Path) and name != "undistorted_folder"]
    read = [request.capture, *request.extra_image_folders]
    beside = [each for path in read for each in _beside(Path(os.path.realpath(path)))]
    return [os.path.realpath(path) for path in (*read, *beside, *files, *outside)]


def _beside(path: Path) -> list[Path]:
    """What is read with a film or the file of a project: files and folders of its name (`DJI_1.SRT`, `place.files`);
    with a folder of photographs, ODM's table beside it."""
    if path.is_dir():
        return [table] if (table := path.parent / _TABLE_BESIDE).is_file() else []
    others = (each for each in path.parent.iterdir() if each.name.startswith(f"{path.stem}.") and each != path)
    return sorted(each for each in others if each.suffix != ".log" and not is_run(each))


def _counted(request: RunRequest, capture: Capture) -> dict[str, bool]:
    """Of pictures and files that are named, those on which the result depends: whether by what they hold (True), or, as
    for the fingerprint of a capture, by their size."""
    views = [*capture.views, *capture.off_path_views]
    pictures = {os.path.abspath(view.image_path): False for view in views}
    masks = {os.path.abspath(view.mask_path): True for view in views if view.mask_path is not None}
    return pictures | masks | {path: True for path in _named(request) if os.path.isfile(path)}


def _content(path: str, counted: dict[str, bool]) -> str:
    """What is kept of a file to tell whether it changed; empty for one on which no result depends."""
    is_told = counted.get(path, Path(path).suffix.lower() in _TOLD_SUFFIXES or None)
    if is_told is None:
        return ""
    size = os.stat(path).st_size
    return file_digest(Path(path)) if is_told and size <= _LARGEST_READ else f"{size} bytes"


def _content_as(path: Path, content: str) -> str:
    """The same of a file as it is now, in the way that `content` is."""
    try:
        return f"{path.stat().st_size} bytes" if content.endswith(" bytes") else file_digest(path)
    except OSError:
        return ""


def _is_mask(name: str) -> bool:
    return _is_picture(name) and any(is_mask_folder(folder.name) for folder in Path(name).parents)


def _is_picture(name: str) -> bool:
    return Path(name).suffix.lower() in _PICTURE_SUFFIXES


def _stamp(file: str) -> list[int]:
    status = os.stat(file)
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns]


def _files(path: str) -> Iterator[str]:
    """A file; of a folder, all files in it and below, also by links to other folders, but for runs, logs, and what
    systems hide. A link to what is not there is no file."""
    if not os.path.isdir(path):
        yield path
        return
    seen = set[tuple[int, int]]()  # a link may lead to a folder around it
    for folder, inner, names in os.walk(path, followlinks=True):
        status = os.stat(folder)
        if (status.st_dev, status.st_ino) in seen:
            inner.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        inner[:] = [name for name in inner if not name.startswith(".") and not is_run(Path(folder, name))]
        for name in names:
            if not name.startswith(".") and not name.endswith(".log") and os.path.exists(os.path.join(folder, name)):
                yield os.path.join(folder, name)


def _lies_in(path: str, folders: Sequence[str]) -> bool:
    return any(path == folder or path.startswith(f"{folder.rstrip(os.sep)}{os.sep}") for folder in folders)
