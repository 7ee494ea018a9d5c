"""What `vdgs run` asks of the reconstruction, where it is given photographs."""

from __future__ import annotations

from dataclasses import replace

from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm.image_list import is_image_folder


def is_image_input(request: RunRequest) -> bool:
    """Whether a run is asked for of photographs, not of a capture. VdgsError for several folders that are not all of
    photographs alone."""
    if is_image_folder(request.capture):
        return True
    if request.extra_image_folders:
        raise VdgsError(
            f"{request.capture}: only folders of photographs alone can be several; a capture is given by itself."
        )
    return False


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
    run = RunFolder(request.output)
    run.check_output_empty()
    return SfmRequest(
        image_folders=(request.capture, *request.extra_image_folders),
        output=run.own_capture,
        gps=options.gps,
        threads=request.threads,
        options=request.sfm if options.scale_bar is None else replace(request.sfm, scale_bar=options.scale_bar),
    )
