"""What `vdgs run` asks of the reconstruction, where it is given photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from vdgs.captures.capture_root import capture_root
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.ranges import to_flag
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm.capture_writer import IMAGE_SIZES
from vdgs.sfm.image_list import is_image_folder


def is_image_input(request: RunRequest) -> bool:
    """Whether a run is asked for of photographs, not of a capture. VdgsError for several folders that are not all of
    photographs alone."""
    if is_image_folder(request.capture):
        return True
    if request.extra_image_folders:
        if request.capture.suffix.lower() in IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES and request.capture.is_file():
            raise VdgsError(f"{request.capture}: is a photograph. Give the folder that the photographs are in.")
        raise VdgsError(
            f"{request.capture}: only folders of photographs alone can be several; a capture is given by itself."
        )
    return False


def _check_capture_options(options: CaptureOptions) -> None:
    """Raise VdgsError for what the capture that is made of photographs will not have, before it is made."""
    made = [name for name, _ in IMAGE_SIZES]
    if options.images is not None and Path(options.images).as_posix() not in made:
        raise VdgsError(
            f"--images {options.images}: the capture made of photographs has {', '.join(made)}. Choose one of these, "
            "or a size of your own: --sfm.max-output-size (pixels of the longer side), --downscale."
        )
    if options.format not in ("auto", "colmap"):
        raise VdgsError(f"--format {options.format}: the capture made of photographs is a COLMAP model. Leave it out.")
    if options.test_list is not None and not options.test_list.is_file():
        raise VdgsError(f"--test-list {options.test_list}: no such file. Give a text file with a name in each line.")
    if options.split == "explicit" and options.test_list is None:
        raise VdgsError("--split explicit: photographs have no split of their own. Add --test-list, or leave it out.")


def size_apart(request: RunRequest) -> tuple[RunRequest, str | None]:
    """The request without the size of photographs that the capture to be made will have, and that size; None where
    --images is a folder that is there, in which the photographs are, or not given."""
    named = request.options.images
    if named is None or Path(named).as_posix() not in [name for name, _ in IMAGE_SIZES]:
        return request, None
    is_there = Path(named).is_dir() or (capture_root(request.capture) / named).is_dir()
    if is_there and not _is_size_of_run(request, named):
        return request, None
    return replace(request, options=replace(request.options, images=None)), named


def _is_size_of_run(request: RunRequest, named: str) -> bool:
    """Whether the run that is there reads the capture in its own folder at this size: then its settings say so."""
    run = RunFolder(request.output)
    if not run.config_file.exists():
        return False
    own = run.settings()
    return Path(own.capture_path) == run.own_capture.resolve() and own.capture.images == named


def print_unused_options(request: RunRequest, console: Console) -> None:
    """Say which options about poses have no effect, because the capture has its own."""
    plain = SfmOptions()
    changed = [to_flag(("sfm", name)) for name, value in vars(request.sfm).items() if value != getattr(plain, name)]
    if changed:
        console.print(
            f"[yellow]note[/] {', '.join(changed)}: without effect, for {escape(str(request.capture))} has its poses. "
            "They are for photographs alone.",
            highlight=False,
        )


def make_posed_request(request: RunRequest) -> SfmRequest:
    """A project of another program without points into RUN/capture. Raises VdgsError where the output holds others."""
    run = RunFolder(request.output)
    run.check_output_empty()
    return SfmRequest(
        image_folders=(request.capture,), output=run.own_capture, threads=request.threads, overwrite=request.overwrite,
        options=request.sfm,
    )  # fmt: skip


def make_sfm_request(request: RunRequest) -> SfmRequest:
    """Photographs into RUN/capture. Raises VdgsError for options that speak of a capture that is not there yet."""
    options = request.options
    for flag, value in (("--georef", options.georef), ("--up", None if options.up == "auto" else options.up)):
        if value is not None:
            raise VdgsError(f"{flag} is about a capture's world; photographs get theirs from their positions (--gps).")
    if options.masks != CaptureOptions.masks:
        raise VdgsError(
            f"--masks {options.masks}: names a folder of a capture. Masks of photographs alone are those in "
            f"{CaptureOptions.masks}/ beside them: rename the folder."
        )
    _check_capture_options(options)
    run = RunFolder(request.output)
    run.check_output_empty()
    return SfmRequest(
        image_folders=(request.capture, *request.extra_image_folders),
        output=run.own_capture,
        gps=options.gps,
        threads=request.threads,
        overwrite=request.overwrite,
        options=request.sfm if options.scale_bar is None else replace(request.sfm, scale_bar=options.scale_bar),
    )
