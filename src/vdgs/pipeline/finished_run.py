"""Whether `vdgs run` has nothing to do, found out without the libraries that its stages need."""

from __future__ import annotations

import os
import shlex
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from vdgs.captures.capture_root import capture_root
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES
from vdgs.captures.reconstruction import read_digests
from vdgs.captures.strays import is_run
from vdgs.config.commands import RunRequest
from vdgs.errors import VdgsError
from vdgs.evaluation.measured_as import is_evaluated
from vdgs.rendering.ortho.map_status import has_ortho_dependencies, is_ortho_current
from vdgs.report.status_cli import full_run_status, next_line
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import with_absolute_paths
from vdgs.sfm.source_images import SourceImages
from vdgs.system.atomic_files import read_json_or_empty

#: What photographs and masks are called.
PICTURE_SUFFIXES = IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES

#: Options of `vdgs run`, beside `--sfm.*` and the folders (words without an option), that a capture of photographs
#: depends on; a file of settings may name a table of positions or a scale bar.
_PHOTOGRAPH_FLAGS = ("", "--gps", "--scale-bar", "--config")


def nothing_to_do(request: RunRequest, command: str, files: Sequence[Path] = ()) -> str:
    """What to say of a run that is whole, with the settings of the request and newer than the capture; empty for all
    others, which the stages look at more closely. `files` are further ones that the command reads."""
    run = RunFolder(request.output)
    if not run.config_file.is_file():
        return ""
    try:
        if not (_same_request(run, request, command) and _is_whole(run, request)):
            return ""
        if any(_gone_files(run)):
            return ""
        made = run.capture_file.stat().st_mtime_ns
        if any(time > made for time in (*_input_times(request, files), *_photograph_times(run))):
            return ""
    except (OSError, VdgsError):
        return ""
    return f"nothing to do: {run.path} is whole\n{next_line(full_run_status(run))}"


def _same_request(run: RunFolder, request: RunRequest, command: str) -> bool:
    """Whether the run has the settings that are asked for, and is of this capture or of these photographs."""
    own = run.settings()
    if request.capture.resolve() != Path(own.capture_path):
        if run.config.command() != command and not same_photographs(run, command):
            return False
        gps, scale_bar = own.capture.gps, own.capture.scale_bar  # used by the reconstruction of the photographs alone
        request = replace(request, options=replace(request.options, gps=gps, scale_bar=scale_bar))
    method, training = request.method(), request.training
    if not training.iterations:  # follows from the number of photographs, which are the same
        method = replace(method, training=replace(training, iterations=own.training.iterations))
    return method == own.method and with_absolute_paths(request.options, request.capture) == own.capture


def same_photographs(run: RunFolder, command: str) -> bool:
    """Whether a command names the photographs that the run made its capture of, with the options that it was made with:
    other words about the method, or another place of the run, do not count."""
    made = SourceImages.read(run.own_capture)
    if made is None or Path(run.settings().capture_path) != run.own_capture.resolve():
        return False
    return (made.command or "").startswith("vdgs run ") and _about_photographs(made.command or "") == (
        _about_photographs(command)
    )


def _about_photographs(command: str) -> list[list[str]]:
    """The words of `vdgs run` that say of which photographs a capture is made, and how."""
    groups = [[""]]
    for word in shlex.split(command)[2:]:
        groups = [*groups, [word]] if word.startswith("--") else [*groups[:-1], [*groups[-1], word]]
    kept = [group for group in groups if "sfm." in group[0] or group[0] in _PHOTOGRAPH_FLAGS]
    return sorted(kept)


def _is_whole(run: RunFolder, request: RunRequest) -> bool:
    measured = (
        is_evaluated(run, name, request.lpips_weights, request.visibility_bins) for name in ("coarse", "merged")
    )
    maps = not request.ortho or not has_ortho_dependencies() or is_ortho_current(run)
    status = full_run_status(run)
    return status.is_complete and not status.is_running and maps and all(measured)


def _input_times(request: RunRequest, files: Sequence[Path]) -> Iterator[int]:
    """When the files and folders that a command names changed last, but for the runs among them."""
    options = with_absolute_paths(request.options, request.capture)
    outside = [Path(each) for each in (options.images, options.masks) if each and Path(each).is_absolute()]
    named = [each for each in vars(options).values() if isinstance(each, Path)]
    for path in (request.capture, *request.extra_image_folders, *named, *outside, *files):
        yield from _times(path, request.output)


def _gone_files(run: RunFolder) -> Iterator[Path]:
    """Of the photographs and masks that the run was made of, those that are gone: files of its capture, and those
    around the run that this was made of here."""
    root = capture_root(Path(run.settings().capture_path))
    for view in read_json_or_empty(run.cameras_file).get("views", ()):
        yield from _gone([root / view[name] for name in ("file", "mask") if view.get(name)])
    if not run.own_capture.is_dir():
        return
    sources = SourceImages.read(run.own_capture)
    used = None if sources is None else Counter(digest for each in sources.files for digest in (each.digest, each.mask))
    alike = defaultdict[str, list[Path]](list)
    for file, digest in read_digests(run.own_capture).files().items():
        if _is_around(file.parent, run.path):
            alike[digest].append(file)
    for digest, files in alike.items():
        # Digests are kept of files that were renamed or removed before the capture was made anew, too: as many must be
        # there as were used.
        gone = _gone(files)
        if len(files) - len(gone) < (1 if used is None else used[digest]):
            yield from gone


def _gone(files: Sequence[Path]) -> list[Path]:
    return [file for file in files if not os.path.exists(file)]


def _is_around(folder: str | Path, output: Path) -> bool:
    return Path(os.path.realpath(output)).is_relative_to(os.path.realpath(folder))


def _photograph_times(run: RunFolder) -> Iterator[int]:
    """When the photographs and masks of the capture changed last, which of a project may lie anywhere, and the folders
    that they are in."""
    root = capture_root(Path(run.settings().capture_path))
    for folder in read_json_or_empty(run.cameras_file).get("input_folders", ()):
        names = [each.name for each in os.scandir(root / folder) if _is_picture(each.name) and not each.is_dir()]
        yield from _times_in(root / folder, names, run.path)


def _is_picture(name: str) -> bool:
    return Path(name).suffix.lower() in PICTURE_SUFFIXES


def _times_in(folder: str | Path, names: Sequence[str], output: Path) -> Iterator[int]:
    """When these files of a folder changed last, and when one was added, removed or renamed.

    In a folder around the run, where runs and what is written beside them come and go, the times at which pictures came
    there or were renamed tell that in place of the folder's own, and `_gone_files` which are gone.
    """
    around = _is_around(folder, output)
    if not around:
        yield os.stat(folder).st_mtime_ns
    for name in names:
        status = os.stat(os.path.join(folder, name))
        yield max(status.st_mtime_ns, status.st_ctime_ns) if around and _is_picture(name) else status.st_mtime_ns


def _times(path: Path, output: Path) -> Iterator[int]:
    """When a file changed last; of a folder, also of everything in the folder, also by links to other folders, but for
    runs."""
    if not path.is_dir():
        yield path.stat().st_mtime_ns
    seen = set[tuple[int, int]]()  # a link may lead to a folder around it
    for folder, inner, names in os.walk(path, followlinks=True):
        status = os.stat(folder)
        if (status.st_dev, status.st_ino) in seen:
            inner.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        inner[:] = [name for name in inner if not is_run(Path(folder, name))]
        yield from _times_in(folder, names, output)
