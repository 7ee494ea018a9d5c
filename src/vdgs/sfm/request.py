"""What `vdgs run` asks of the reconstruction, where it is given photographs."""

from __future__ import annotations

from vdgs.errors import VdgsError
from vdgs.runs.folder import RunFolder
from vdgs.settings.capture import CaptureOptions
from vdgs.settings.requests import RunRequest
from vdgs.settings.sfm import SfmRequest
from vdgs.sfm.collection import only_photographs


def of_photographs(asked: RunRequest) -> bool:
    """Whether a run is asked for of photographs, not of a capture. VdgsError for several folders that are not all of
    photographs alone."""
    if only_photographs(asked.capture):
        return True
    if asked.photographs:
        raise VdgsError(
            f"{asked.capture}: only folders of photographs alone can be several; a capture is given by itself."
        )
    return False


def sfm_request(asked: RunRequest) -> SfmRequest:
    """Photographs into RUN/capture. Raises VdgsError for options that speak of a capture that is not there yet."""
    options = asked.options
    for flag, value in (("--georef", options.georef), ("--up", None if options.up == "auto" else options.up)):
        if value is not None:
            raise VdgsError(f"{flag} is about a capture's world; photographs get theirs from their positions (--gps).")
    if options.masks != CaptureOptions.masks:
        raise VdgsError(
            f"--masks {options.masks}: names a folder of a capture. Masks of photographs alone are those in "
            f"{CaptureOptions.masks}/ beside them: rename the folder."
        )
    run = RunFolder(asked.output)
    run.refuse_strangers()
    return SfmRequest(
        photographs=(asked.capture, *asked.photographs),
        output=run.own_capture,
        gps=options.gps,
        threads=asked.threads,
        options=asked.sfm,
    )
