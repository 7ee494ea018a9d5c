"""The photographs of one or several folders: which are used, under which names, and which are left out, and why."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from vdgs.captures.foreign_poses import foreign_poses
from vdgs.captures.formats.colmap import partial_model
from vdgs.captures.formats.source_capture import format_list
from vdgs.captures.image_files import decode_image
from vdgs.captures.image_suffixes import HEIF_SUFFIXES, IMAGE_SUFFIXES, PROXY_SUFFIXES, RAW_SUFFIXES
from vdgs.captures.name_resolution import jpeg_name, match_key
from vdgs.captures.nested_captures import check_no_foreign_file, model_below
from vdgs.captures.output_guard import is_capture
from vdgs.captures.reconstruction import is_reconstruction
from vdgs.captures.strays import check_no_run, walk
from vdgs.config.sfm_options import Brackets, CameraModel
from vdgs.errors import CaptureError
from vdgs.sfm.brackets import unused_exposures
from vdgs.sfm.cross_checks import cross_checked, strays
from vdgs.sfm.edited_names import say_copy
from vdgs.sfm.find_images import (
    check_decoders,
    find_files,
    is_archive,
    is_dangling,
    is_film,
    is_photograph,
    nothing_found,
)
from vdgs.sfm.image_metadata import ImageMetadata, UnusableImage, is_twice_as_wide, read_image_metadata
from vdgs.sfm.mask_files import check_mask, find_masks
from vdgs.sfm.photograph_versions import taken_apart
from vdgs.sfm.rig_folders import with_sensors
from vdgs.sfm.serial_numbers import without_odd_serials
from vdgs.sfm.sidecars import list_folder, with_sidecars
from vdgs.sfm.take_off_heights import without_default_heights
from vdgs.sfm.used_bands import unused_bands
from vdgs.system.content_digests import find_copies
from vdgs.system.quoting import shell_word
from vdgs.system.units import first_names

#: Fewer photographs are no scene.
MIN_IMAGES = 3
#: What to do where poses are there that are not wanted, or cannot be read.
HOW_TO_MAKE_NEW_POSES = (
    "To make new poses of the photographs instead, give a folder of them without poses of other programs in it."
)
#: So many photographs of 16 bits are decoded before work begins: they come from one camera.
_LOOKED_AT = 3
#: Folders in which data sets keep photographs for training, and those for the test or for validation.
_TRAIN, _TEST = {"train", "training"}, {"test", "testing", "val", "validation"}


@dataclass(frozen=True)
class ExcludedImage:
    """A photograph that is not used, and why."""

    name: str
    reason: str
    file: str | None = None
    """Its own name, where that in the capture is another."""

    @property
    def line(self) -> str:
        """Both for people, who look for the file."""
        return f"{self.file or self.name}: {self.reason}"


@dataclass(frozen=True)
class ImageList:
    """Photographs in order of their names, and what else lay in their folders."""

    folders: tuple[Path, ...]
    images: tuple[ImageMetadata, ...]
    excluded: tuple[ExcludedImage, ...]
    other_files: int
    notes: tuple[str, ...] = ()
    """What people should know of their masks."""


def collect_images(
    folders: Sequence[Path], camera_model: CameraModel = "auto", brackets: Brackets = "middle"
) -> ImageList:
    """Read the heads of all photographs in the folders and those below them; the others are as in `SfmOptions`.

    Raises CaptureError for folders that are not there or hold no photographs, captures, names that are alike but for
    blanks, masks that belong to nothing, and where too few are usable.
    """
    folders = list(dict.fromkeys(folders))
    for folder in folders:
        _check_folder(folder)
    found = find_files(folders)
    if not found.named:
        raise nothing_found(folders, found)
    check_decoders(folders, found)
    masks, mask_notes = find_masks(folders, found.named.values())
    named = {name: path for name, path in found.named.items() if path in masks}
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(partial(_read, cache(list_folder)), named.values(), named.keys(), masks.values()))
    chosen = _chosen([each for each in read if isinstance(each, ImageMetadata)], camera_model, brackets)
    left_out = [ExcludedImage(name, why) for name, why in found.left_out.items()]
    left_out += [each for each in read if isinstance(each, ExcludedImage)]
    left_out = [replace(each, file=found.renamed.get(each.name)) for each in (*left_out, *chosen.left_out)]
    notes = [
        *found.notes(),
        *mask_notes,
        *chosen.notes,
        *_kind_notes(chosen.photographs),
        *_split_notes(chosen.photographs),
        *_undecodable(chosen.photographs),
    ]
    notes += [f"not read: {poses}. Poses are made anew." for folder in folders for poses in foreign_poses(folder)]
    if len(chosen.photographs) < MIN_IMAGES:
        unused = filter(None, (found.films_beside(), found.dangling_links()))
        raise _too_few(folders, len(chosen.photographs), [*unused, *(each.line for each in left_out)])
    return ImageList(tuple(folders), tuple(chosen.photographs), tuple(left_out), found.others, tuple(notes))


def _check_folder(folder: Path) -> None:
    """Raise CaptureError for a path that is no folder or film, and for what is made of photographs."""
    if not folder.is_dir() and not is_capture(folder):
        check_no_foreign_file(folder)
        if is_archive(folder):
            raise CaptureError(f"{folder}: is an archive. Unpack it, and give the folder of the photographs.")
        if folder.suffix.lower() in PROXY_SUFFIXES and folder.is_file():
            raise CaptureError(
                f"{folder}: is a copy of a film in low resolution (a proxy). Give the film itself (.MP4), or rename "
                f"the copy to {shell_word(folder.stem + '.mp4')} where there is nothing better."
            )
        what = "is a file, and no film" if folder.is_file() else "no such folder or film"
        raise CaptureError(f"{folder}: {what}. Give the folder that the photographs are in.")
    check_no_run(folder)
    if is_capture(folder):
        raise CaptureError(
            f"{folder}: is a capture already. Use it as it is: vdgs run {shell_word(folder)} --output RUN\n"
            f"{HOW_TO_MAKE_NEW_POSES}"
        )
    if is_reconstruction(folder):
        raise CaptureError(
            f"{folder}: is a capture that is not finished. Give its photographs and --output {shell_word(folder)}"
        )
    below = model_below(folder)
    if below:
        raise CaptureError(
            f"{below}\nTo make new poses of photographs instead, give their own folder, without a model below it."
        )


class _Chosen(NamedTuple):
    """What is used of photographs that can be read, what not, and what people should know of both."""

    photographs: list[ImageMetadata]
    left_out: list[ExcludedImage]
    notes: list[str]


def _chosen(photographs: list[ImageMetadata], camera_model: CameraModel, brackets: Brackets) -> _Chosen:
    photographs, doubled = _drop_duplicates(photographs)
    photographs, odd_serials = without_odd_serials(photographs)
    unused, spectral = unused_bands(photographs)
    photographs, strange = _of_the_flight([photo for photo in photographs if photo.name not in unused])
    exposures, bracketed = unused_exposures(photographs) if brackets == "middle" else ({}, [])
    unused |= exposures
    photographs, lone = _with_models([photo for photo in photographs if photo.name not in exposures], camera_model)
    photographs, rigs = with_sensors(without_default_heights(photographs))
    left_out = [*doubled, *strange, *lone, *(ExcludedImage(name, why) for name, why in unused.items())]
    return _Chosen(photographs, left_out, [*odd_serials, *spectral, *bracketed, *rigs])


def _too_few(folders: Sequence[Path], count: int, left_out: Sequence[str]) -> CaptureError:
    return CaptureError(
        f"{', '.join(map(str, folders))}: {count} photograph{'s' if count != 1 else ''} that "
        f"can be used; a scene needs {MIN_IMAGES} at the very least, and each place two or three that show "
        f"it from different positions.{format_list(left_out)}"
    )


def is_image_folder(folder: Path) -> bool:
    """Whether a path is a film, or photographs or films lie in the folder or below it and no capture, whole or in part,
    is there."""
    if is_film(folder):
        return True
    if (
        not folder.is_dir()
        or is_capture(folder)
        or is_reconstruction(folder)
        or partial_model(folder)
        or (folder / "sparse").exists()
    ):
        return False
    # Without their decoder, or the disk that links lead to, the error of `collect_images` says what to do.
    decoded = HEIF_SUFFIXES | RAW_SUFFIXES
    return any(
        is_photograph(path)
        or is_film(path)
        or path.suffix.lower() in decoded
        or (is_dangling(path) and path.suffix.lower() in IMAGE_SUFFIXES)
        for _, files, _ in walk(folder)
        for path in files
    )


def _undecodable(photographs: Sequence[ImageMetadata]) -> list[str]:
    """What is wrong with the pixels of photographs of 16 bits, whose values may be those of fewer, by some of them.
    Raises CaptureError where none of a set can be decoded, before any work."""
    deep = [photo for photo in photographs if "16 bits" in photo.kind]
    looked_at, faults = deep[:: max(1, len(deep) // _LOOKED_AT)][:_LOOKED_AT], list[str]()
    for photo in looked_at:
        try:
            decode_image(photo.path)
        except CaptureError as error:
            faults.append(str(error))
    if faults and len(faults) == len(looked_at) and len(deep) == len(photographs):
        raise CaptureError(faults[0])
    return [f"{fault.rstrip('.')} ({len(faults)} of {len(looked_at)} looked at)." for fault in faults[:1]]


def _split_notes(photographs: Sequence[ImageMetadata]) -> list[str]:
    """That folders of training and of test photographs, as data sets have them, decide nothing."""
    folders = [{part.lower() for part in PurePosixPath(photo.name).parent.parts} for photo in photographs]
    trains, tests = (sum(not names.isdisjoint(of) for of in folders) for names in (_TRAIN, _TEST))
    if not (trains and tests):
        return []
    return [
        f"{trains} photographs lie in train/ and {tests} in test/ or val/: that is not kept, all are used for the "
        "poses, and of all every n-th is for the test. For the set's own test name its photographs, one a line, "
        "in a file: --test-list FILE (vdgs run, vdgs train)."
    ]


def _kind_notes(photographs: Sequence[ImageMetadata]) -> list[str]:
    """What is done with photographs that are no 8-bit sRGB pictures which all programs read."""
    kinds: dict[str, list[str]] = {}
    for photo in photographs:
        kinds.setdefault(photo.kind, []).append(photo.name)
    how = {
        "raw": "developed alike (the daylight white balance of the camera, no automatic exposure) to 8-bit sRGB",
        "": "converted to 8-bit sRGB",
    }
    return [
        f"{first_names(names)}: {kind}; {how.get(kind, how[''])} and written as JPEG ({jpeg_name(names[0])})."
        for kind, names in kinds.items()
        if kind
    ]


def _with_models(
    photographs: Sequence[ImageMetadata], camera_model: CameraModel
) -> tuple[list[ImageMetadata], list[ExcludedImage]]:
    """The photographs with the lenses and the panoramas that a person asks for; without the panoramas of a flight that
    took photographs of one view."""
    if camera_model == "equirectangular":
        return [replace(photo, is_panorama=is_twice_as_wide(*photo.size)) for photo in photographs], []
    if camera_model != "auto":
        photographs = [replace(photo, camera_model=camera_model.replace("-", "_").upper()) for photo in photographs]
    panoramas = [photo for photo in photographs if photo.is_panorama]
    if 2 * len(panoramas) >= len(photographs):
        return list(photographs), []
    why = (
        "is a panorama (equirectangular) among photographs of one view; to use panoramas, give a folder of those alone"
    )
    return [photo for photo in photographs if not photo.is_panorama], [
        ExcludedImage(photo.name, why) for photo in panoramas
    ]


def _of_the_flight(photographs: Sequence[ImageMetadata]) -> tuple[list[ImageMetadata], list[ExcludedImage]]:
    """Without the pictures that are none of the flight, and with tags held against each other's."""
    reasons, lent = strays(photographs)
    kept = [lent.get(photo.name, photo) for photo in photographs if photo.name not in reasons]
    return cross_checked(kept), [ExcludedImage(name, why) for name, why in sorted(reasons.items())]


def _read(
    listed: Callable[[Path], Mapping[str, Path]], path: Path, name: str, mask: Path | None
) -> ImageMetadata | ExcludedImage:
    try:
        photo = with_sidecars(replace(read_image_metadata(path, name), mask=mask), listed)
    except UnusableImage as why:
        return ExcludedImage(name, str(why))
    check_mask(photo)
    return photo


def _drop_duplicates(photographs: list[ImageMetadata]) -> tuple[list[ImageMetadata], list[ExcludedImage]]:
    """Leave out copies of the same file, and the same photograph with another ending or in other letters (upper and
    lower case). Of copies that one stays whose name and folders do not say that it is one, else the shallower."""
    kept, left_out = list[ImageMetadata](), list[ExcludedImage]()
    groups = find_copies([photo.path for photo in photographs])
    group_of = {photographs[k].name: number for number, group in enumerate(groups) for k in group}
    firsts = {k: min((photographs[i].name for i in group), key=_by_originality) for k, group in enumerate(groups)}
    stems = dict[str, list[ImageMetadata]]()
    for photo in photographs:
        group = group_of.get(photo.name)
        alike = stems.setdefault(match_key(photo.name), [])
        if group is not None and firsts[group] != photo.name:
            why = f"is a copy of {firsts[group]}"
        else:
            why = next(filter(None, (_why_same(photo, other) for other in alike)), "")
        if why:
            left_out.append(ExcludedImage(photo.name, why))
            continue
        alike.append(photo)
        kept.append(photo)
    return kept, left_out


def _by_originality(name: str) -> tuple[bool, int, str]:
    """The order of names of one file, the likeliest original first."""
    path = PurePosixPath(name)
    return say_copy(path), len(path.parts), name


def _why_same(photo: ImageMetadata, other: ImageMetadata) -> str:
    """Why a photograph does not count beside another whose name differs in its ending and case alone; empty where both
    were taken, at other moments or places, and their masks can be told apart."""
    one_mask = photo.mask is not None and photo.mask == other.mask  # which of the two is it of?
    if taken_apart(photo, other) and not one_mask:
        return ""
    if photo.name.lower() == other.name.lower():
        return f"has the name of {other.name} but for upper and lower case: rename one of the two to use both"
    return f"has the name of {other.name} with another ending"
