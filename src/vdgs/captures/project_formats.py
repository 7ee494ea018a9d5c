"""Which files are projects of photogrammetry programs, and who reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from vdgs.captures.capture_root import capture_root
from vdgs.captures.formats import (
    blocks_exchange,
    bundler,
    metashape,
    opensfm,
    opf,
    pix4d,
    realityscan,
    sfm_data,
    visualsfm,
)
from vdgs.captures.formats.project import Project, project_capture
from vdgs.captures.formats.source_capture import SourceCapture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError


class ProjectFormat(NamedTuple):
    """A program's files: its name, those in a folder that may be opened, whether a file is one, and the reader."""

    program: str
    find: Callable[[Path], list[Path]]
    is_file: Callable[[Path], bool]
    read: Callable[[Path, CaptureOptions], Project]


#: In the order in which they are looked for, by what `--format` calls them.
PROJECTS: dict[str, ProjectFormat] = {
    "metashape": ProjectFormat("Metashape", metashape.find_files, metashape.is_file, metashape.read),
    "blocks-exchange": ProjectFormat(
        "ContextCapture or DJI Terra (BlocksExchange)", blocks_exchange.find_files, blocks_exchange.is_file,
        blocks_exchange.read,
    ),
    "opf": ProjectFormat("Pix4D (OPF)", opf.find_files, opf.is_file, opf.read),
    "pix4d": ProjectFormat("PIX4Dmapper (parameters)", pix4d.find_files, pix4d.is_file, pix4d.read),
    "opensfm": ProjectFormat("OpenSfM or ODM", opensfm.find_files, opensfm.is_file, opensfm.read),
    "realityscan": ProjectFormat("RealityScan", realityscan.find_files, realityscan.is_file, realityscan.read),
    "openmvg": ProjectFormat("OpenMVG", sfm_data.find_openmvg, sfm_data.is_openmvg, sfm_data.read_openmvg),
    "alicevision": ProjectFormat(
        "Meshroom (AliceVision)", sfm_data.find_alicevision, sfm_data.is_alicevision, sfm_data.read_alicevision
    ),
    "visualsfm": ProjectFormat("VisualSFM", visualsfm.find_files, visualsfm.is_file, visualsfm.read),
    "bundler": ProjectFormat("Bundler", bundler.find_files, bundler.is_file, bundler.read),
}  # fmt: skip


def find_projects(path: Path) -> Iterator[tuple[str, Path]]:
    """The formats and files of the projects that a folder holds, or that a file is."""
    for name, form in PROJECTS.items():
        if path.is_file():
            if form.is_file(path):
                yield name, path
        elif path.is_dir():
            yield from ((name, file) for file in form.find(path))


def is_project(path: Path) -> bool:
    """Whether a folder holds a project of another program, or a file is one."""
    return next(find_projects(path), None) is not None


def project_file(path: Path, name: str) -> Path:
    """The one project of a format in a folder, or the file itself. Raises `CaptureError` for several."""
    found = [file for form, file in find_projects(path) if form == name]
    if len(found) > 1:
        shown = ", ".join(file.relative_to(path).as_posix() for file in found)
        raise CaptureError(f"{path}: holds several projects ({shown}). Give one of these files instead of the folder.")
    if not found:
        raise CaptureError(f"{path}: is no project of {PROJECTS[name].program}.")
    return found[0]


def read_project(path: Path, name: str, options: CaptureOptions, *, needs_points: bool = True) -> SourceCapture:
    """The capture of the project in a folder, or in a file. Without `needs_points` one without points is read too: what
    finds them needs its poses."""
    project = PROJECTS[name].read(project_file(path, name), options)
    return project_capture(project, capture_root(path), options, needs_points=needs_points)
