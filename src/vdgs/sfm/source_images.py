"""Which photographs a capture is made of, and what changed in their folders since: OUTPUT/photographs.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from vdgs.captures.reconstruction import SOURCE_IMAGES_FILE, read_digests
from vdgs.captures.strays import is_mask_folder, masked_stem
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.system.content_digests import ContentDigests
from vdgs.system.quoting import shell_line
from vdgs.system.records import record_from_dict, record_to_dict
from vdgs.system.units import first_names


@dataclass(frozen=True)
class SourceFile:
    """A photograph: its name in the capture, and the digest of its file; empty where it is not known."""

    name: str
    digest: str = ""
    mask: str | None = None
    """The digest of its mask where that lies beside the folders, empty where there is none; None: not known."""


@dataclass(frozen=True, kw_only=True)
class SourceImages:
    """The photographs of a capture, used or not, and the command that makes it of them."""

    folders: tuple[str, ...]
    files: tuple[SourceFile, ...]
    command: str | None = None

    @staticmethod
    def of(folders: Sequence[Path], digests: ContentDigests, command: str | None = None) -> SourceImages:
        """Those that lie in the folders now. Raises VdgsError where they cannot be told."""
        from vdgs.sfm.find_images import find_files  # these read pictures, which most runs do not need
        from vdgs.sfm.mask_files import find_masks

        named = find_files(folders).named
        within = {path.resolve() for path in named.values()}  # masks among these are files of their own
        masks = {
            path: mask
            for path, mask in find_masks(folders, named.values())[0].items()
            if mask is not None and mask.resolve() not in within
        }
        found = digests.of_all([*named.values(), *masks.values()])
        files = tuple(
            SourceFile(name, found[path], (found[masks[path]] or None) if path in masks else "")
            for name, path in named.items()
        )
        return SourceImages(folders=tuple(str(each.resolve()) for each in folders), files=files, command=command)

    @staticmethod
    def read(output: Path) -> SourceImages | None:
        """Those that a capture was begun with; None where it does not say it."""
        try:
            return record_from_dict(SourceImages, read_json_or_empty(output / SOURCE_IMAGES_FILE))
        except ValueError:
            return None

    def write(self, output: Path) -> None:
        write_json(output / SOURCE_IMAGES_FILE, record_to_dict(self))

    def changes_since(self, before: SourceImages) -> str:
        """photographs: 1 added (a.jpg), 2 masks removed (masks/b.png, masks/c.png), 1 with another mask (d.jpg); empty
        where nothing changed."""
        old, new = ({each.name: each for each in files} for files in (before.files, self.files))
        both = [(old[name], new[name]) for name in old.keys() & new.keys()]
        changed = [now.name for was, now in both if was.digest and now.digest and was.digest != now.digest]
        masked = [now.name for was, now in both if None not in (was.mask, now.mask) and was.mask != now.mask]
        kinds = {"added": new.keys() - old.keys(), "removed": old.keys() - new.keys(), "changed": set(changed)}
        parts = list[str]()
        for kind, names in kinds.items():
            masks = {name for name in names if _is_mask(name)}
            parts += _told(names - masks, kind) + _told(masks, f"mask{'s' if len(masks) > 1 else ''} {kind}")
        parts += _told(set(masked), "with another mask, or without")
        return f"photographs: {', '.join(parts)}" if parts else ""


def _told(names: set[str], kind: str) -> list[str]:
    return [f"{len(names)} {kind} ({first_names(sorted(names))})"] if names else []


def _is_mask(name: str) -> bool:
    """Whether a file of a folder of photographs is a mask, by its name."""
    path = PurePosixPath(name)
    return any(is_mask_folder(folder.name) for folder in path.parents) or masked_stem(path.stem) is not None


def source_changes(output: Path) -> str:
    """What changed in the folders of photographs since a capture was begun with them; empty where nothing did, and
    where they are not there any more (a card that was taken out)."""
    from vdgs.sfm.films.take_frames import film_changes  # imports much that most runs do not need

    before = SourceImages.read(output)
    if before is None or not all(Path(folder).is_dir() for folder in before.folders):
        return ""
    if films := film_changes(output):
        return films
    try:
        folders = [Path(folder) for folder in before.folders]
        return SourceImages.of(folders, read_digests(output)).changes_since(before)
    except (VdgsError, OSError) as error:
        return f"photographs: cannot be compared ({error})"


def check_unchanged(output: Path, now: SourceImages, overwrite: bool) -> None:
    """Raise VdgsError, naming them, where photographs are others than those a capture was begun with."""
    before = SourceImages.read(output)
    if before is None or overwrite:
        return
    if changes := now.changes_since(before):
        if now.folders != before.folders and sorted(now.folders) == sorted(before.folders):
            raise VdgsError(
                f"{output}: was begun with these folders in another order, by which their photographs are named. Give "
                f"them as before ({shell_line(before.folders)}), or add --overwrite to make it anew, with all that was "
                "trained on it."
            )
        raise VdgsError(
            f"{output}: was begun with other photographs than there are now. {changes[0].upper()}{changes[1:]}. Add "
            "--overwrite to make it anew of those that are there, with all that was trained on it; or restore them."
        )
