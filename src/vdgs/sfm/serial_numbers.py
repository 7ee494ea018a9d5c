"""Serial numbers of cameras that are none: fields that count the photographs, or are random."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from vdgs.sfm.image_metadata import SERIAL, ImageMetadata

#: A lens cannot be fitted to so few photographs of its own, and so many such serial numbers of one kind of camera are
#: no cameras (choice).
FEW_OF_A_SERIAL, MANY_SERIALS = 2, 3


def without_odd_serials(photographs: Sequence[ImageMetadata]) -> tuple[list[ImageMetadata], list[str]]:
    """The photographs, without serial numbers that say nothing: of the same maker, model, size and focal length, each
    on one or two photographs. These are of one camera then. And what to say of them."""
    kinds: dict[tuple[str, tuple[int, int], float | None], dict[str, list[ImageMetadata]]] = {}
    for photo in photographs:
        named, found, serial = photo.camera.rpartition(SERIAL)
        if found:
            focal = round(photo.lens.focal, 4) if photo.lens else None
            kinds.setdefault((named, photo.size, focal), {}).setdefault(serial, []).append(photo)
    odd, notes = dict[str, str](), list[str]()
    for (named, *_), serials in kinds.items():
        few = [members for members in serials.values() if len(members) <= FEW_OF_A_SERIAL]
        if len(few) < MANY_SERIALS:
            continue
        names = [photo.name for members in few for photo in members]
        odd |= dict.fromkeys(names, named)
        notes.append(
            f"{named}: {len(names)} photographs have {len(few)} serial numbers of cameras, each on one or two of them; "
            "they are taken for photographs of one camera. Lenses that differ need folders of their own."
        )
    return [replace(photo, camera=odd.get(photo.name, photo.camera)) for photo in photographs], notes
