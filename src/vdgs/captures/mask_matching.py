"""Masks: which of them belong to which photographs, and whether they can."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from vdgs.captures.formats.source_capture import SourceView
from vdgs.captures.image_files import find_images, find_mask, find_mask_beside, read_header, same_aspect
from vdgs.captures.name_resolution import largest_shrunk
from vdgs.captures.strays import MASK_FOLDERS
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.units import some_names


def find_masks(
    root: Path, images: str, views: Sequence[SourceView], paths: Sequence[Path], options: CaptureOptions,
    warnings: list[str],
) -> dict[str, Path | None]:  # fmt: skip
    """The mask of every photograph by its view's name, None where it has none; says which masks and photographs have no
    partner.

    `paths` are the photographs of the views, which may have other names than these: a model may know other folders,
    cases and extensions. Masks are looked up by the photograph's own name first, then by that of its view.

    Raises `CaptureError` for a folder of masks that was asked for and is not there, and where masks are there but none
    of them is of a photograph.
    """
    asked_for = options.masks != CaptureOptions.masks
    folder = _mask_folder(root, options)
    if asked_for and not folder.is_dir():
        moving = (
            " Of what moves they are made by --masks masks --block.mask-moving on." if options.masks == "auto" else ""
        )
        raise CaptureError(f"{folder}: no such folder, though --masks asks for it.{moving}")
    named = {view.name: _names(view, path, root / images) for view, path in zip(views, paths, strict=True)}
    masks = {
        view.name: _mask_of(view, path, named[view.name], root / images, folder)
        for view, path in zip(views, paths, strict=True)
    }
    named_masks = any(view.mask_path for view in views)
    if folder.is_dir() and not named_masks:
        _compare(folder, masks, mask_name(next(iter(named.values()))[0]), asked_for, warnings)
    without = [name for name, mask in masks.items() if mask is None]
    if 0 < len(without) < len(masks):
        remedy = "name the missing masks with mask_path as well, or " if named_masks else ""
        example = folder / mask_name(named[without[0]][0])
        warnings.append(
            f"{len(masks) - len(without)} of {len(masks)} photographs have a mask; the others count whole. If that is "
            f"not meant, {remedy}put the missing masks there, such as {example}."
        )
    return masks


def _mask_folder(root: Path, options: CaptureOptions) -> Path:
    """The folder that `--masks` names, in the capture or from where the person stands; else one of those known."""
    if options.masks == CaptureOptions.masks:
        shrunk = largest_shrunk(root, CaptureOptions.masks)  # as nerfstudio has them beside images_2, images_4, ...
        names = (*MASK_FOLDERS, *([shrunk] if shrunk else []))
        return next((root / name for name in names if (root / name).is_dir()), root / options.masks)
    inside, elsewhere = root / options.masks, Path(options.masks)
    return elsewhere if not inside.is_dir() and elsewhere.is_dir() else inside


def _names(view: SourceView, path: Path, images: Path) -> Sequence[str]:
    """What a photograph is called: by its file in the folder of images, if it lies there, then by its view."""
    own = [path.relative_to(images).as_posix()] if path.is_relative_to(images) else []
    return list(dict.fromkeys([*own, view.name]))


def _mask_of(view: SourceView, path: Path, names: Sequence[str], images: Path, folder: Path) -> Path | None:
    """The mask that the view names, else that in the folder of masks, else that beside its photograph."""
    mask = view.mask_path or _first(find_mask(folder, name) for name in names)
    if mask is not None and mask.is_file() and mask.samefile(path):
        raise CaptureError(
            f"{mask}: is the photograph itself, not a mask of it. Name the folder of the masks (--masks)."
        )
    places = [(path.parent, path.name), *((images, name) for name in names)]
    return mask or _first(find_mask_beside(where, name, path) for where, name in dict.fromkeys(places))


def _first(masks: Iterable[Path | None]) -> Path | None:
    return next((mask for mask in masks if mask is not None), None)


def _compare(
    folder: Path, masks: dict[str, Path | None], example: str, asked_for: bool, warnings: list[str]
) -> None:  # fmt: skip
    """Hold the files of a folder of masks against the masks that were found; `example` is the name that one of them
    would have."""
    used = {mask for mask in masks.values() if mask is not None}
    spare = [name for name, path in find_images(folder).items() if path not in used]
    if not used and spare:
        raise CaptureError(
            f"{folder}: holds {len(spare)} masks, none of them of a photograph. Name them like the photographs "
            f"({example}; {spare[0]} is there), or choose another folder with --masks."
        )
    if not used and asked_for:
        raise CaptureError(f"{folder}: holds no masks, though --masks asks for them. Put them there as {example}.")
    if not used:
        warnings.append(f"{folder} holds no masks; all photographs count whole.")
    elif spare:
        warnings.append(unused_masks_note(folder, spare))


def unused_masks_note(folder: Path, spare: Sequence[str]) -> str:
    """What to say of masks in a folder, by these names, that belong to no photograph."""
    return f"{folder}: {len(spare)} masks belong to no photograph and are not used ({some_names(spare)})."


def mask_name(name: str) -> str:
    """What the mask of a photograph is called."""
    return Path(name).with_suffix(".png").as_posix()


def check_mask(mask: Path, photograph: Path) -> None:
    """Raise `CaptureError` unless a mask is there and has the shape of its photograph, at that size or another."""
    if not mask.is_file():
        raise CaptureError(f"{mask}: no such mask, though {photograph.name} is said to have it. Copy it there.")
    header, wanted = read_header(mask), read_header(photograph)
    if not same_aspect((header.width, header.height), (wanted.width, wanted.height)):
        raise CaptureError(
            f"{mask}: is {header.width}x{header.height}, but its photograph is {wanted.width}x{wanted.height}: another "
            "shape, so the two do not belong together. Make the mask from this photograph."
        )
