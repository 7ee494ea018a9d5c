"""Photographs that lists name: `test.txt` and its like, and the lists of transforms.json."""

from __future__ import annotations

from collections.abc import Sequence

from vdgs.captures.formats.source_capture import format_list
from vdgs.captures.name_resolution import NameLookup, ambiguity_message
from vdgs.errors import CaptureError
from vdgs.system.units import first_names


def find_listed(
    written: Sequence[str], names: Sequence[str], where: str, *, strict: bool = False
) -> tuple[set[str], list[str]]:
    """Those of `names` that a list means, and a warning about lines that mean none of them: their photographs have no
    camera, or are not there.

    A line may leave folders out or have more of them, in another case or with another extension. Raises CaptureError,
    which says `where` the list is, where a line may mean several, and where none means any, or where a person is
    `strict` one does not.
    """
    if not names:
        return set(), []
    lookup = NameLookup((name, name) for name in dict.fromkeys(names))
    found = {line: lookup.find(line)[1] for line in written}
    for line, meant in found.items():
        if len(meant) > 1:
            raise CaptureError(f"{where}: {ambiguity_message(line, meant[0], meant[1])}")
    unknown = [line for line, meant in found.items() if not meant]
    if unknown and (strict or len(unknown) == len(found)):
        raise CaptureError(
            f"{where}: {len(unknown)} of its {len(found)} names are not of photographs of this capture. Write them as "
            f"they are called here, such as {names[0]}, or ignore lists with --split every.{format_list(unknown)}"
        )
    warnings = [
        f"{where}: {len(unknown)} of its {len(found)} names are of no photograph that has a camera and is there; the "
        f"others are used ({first_names(unknown)})."
    ] if unknown else []  # fmt: skip
    return {meant[0] for meant in found.values() if meant}, warnings
