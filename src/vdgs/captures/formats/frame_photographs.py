"""Photographs of sets whose JSON files name them by paths of other folders or machines (MatrixCity, Blender)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from urllib.parse import unquote

from vdgs.captures.capture import Split
from vdgs.captures.image_files import readable_images, readable_suffixes
from vdgs.captures.name_resolution import ImageNameIndex, without_uri
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject

#: Where a block keeps its images.
IMAGE_FOLDERS = ("", "rgb", "input", "images")


class FramePhotographs:
    """Finds the photographs of frames, in folders that are listed once: by name, else in another case or with another
    extension.

    Published file_paths climb ("../../train/block_1/0000.png"), or belong to another machine; the climbing and the
    drive are dropped, and ever shorter ends of the rest are looked for in `images` where it is given, else beside the
    pose file, in the capture, and up to three folders above a pose/ folder.
    """

    def __init__(self, root: Path, images: str | None) -> None:
        self._root, self._images = root, images
        self._listed = dict[Path, ImageNameIndex]()
        self._meant = dict[Path, tuple[str, ...]]()

    def find(self, frame: JsonObject, file: Path, split: Split) -> tuple[str, Path] | str:
        """Name (as from the dataset's root, or from the folder that was asked for) and file of a frame's photograph;
        what it is called where it is gone.

        Raises `CaptureError` for a frame that names none, and for one photograph of frames in different folders: the
        pose of one of them would be of another photograph.
        """
        parts = _parts(frame, file)
        decoded = _inside(PureWindowsPath(*map(unquote, parts)).parts)  # as in a URI: a%20b.png
        found = self._find(parts, file, split) or (self._find(decoded, file, split) if decoded else None)
        return found or "/".join(parts)

    def _find(self, parts: tuple[str, ...], file: Path, split: Split) -> tuple[str, Path] | None:
        tails = [parts, (split, *parts[-2:]), *(parts[k:] for k in range(1, len(parts)))]
        for tail in tails:
            for base in self._bases(file):
                image = self._find_below(base.joinpath(*tail[:-1]), tail[-1])
                if image is not None:
                    self._check_meant_once(image, parts, file)
                    return self._name(image, split), image
        return None

    def _bases(self, file: Path) -> list[Path]:
        if self._images is not None:
            return [self._root / self._images]
        above = self._root.parent
        return [file.parent, self._root, *((above.parent, above.parent.parent) if above.name == "pose" else ())]

    def _find_below(self, folder: Path, name: str) -> Path | None:
        # A name without extension may hold a dot, whose end is none: v1.2_0001.
        names = (name,) if PurePosixPath(name).suffix.lower() in readable_suffixes() else (f"{name}.png",)
        for sub in IMAGE_FOLDERS:
            listed = self._list(folder / sub)
            for each in names:
                found = listed.find(each)
                if found is not None:
                    return listed.images[found]
        return None

    def _list(self, folder: Path) -> ImageNameIndex:
        if folder not in self._listed:
            files = readable_images(folder.iterdir()) if folder.is_dir() else []
            self._listed[folder] = ImageNameIndex({file.name: file for file in files if file.is_file()})
        return self._listed[folder]

    def _check_meant_once(self, image: Path, parts: tuple[str, ...], file: Path) -> None:
        other = self._meant.setdefault(image, parts)
        if other[:-1] != parts[:-1]:
            raise CaptureError(
                f"{file}: {'/'.join(other)} and {'/'.join(parts)} would both be the photograph {image}. Keep the "
                "folders that the file names, or give the folder above them with --images."
            )

    def _name(self, image: Path, split: Split) -> str:
        """A name that is unique across blocks: the path below the folder, or split/block/file."""
        folder = self._root / (self._images or "")
        if image.is_relative_to(folder):
            return image.relative_to(folder).as_posix()
        parts = [part for part in image.parts[-3:] if part not in IMAGE_FOLDERS]
        return "/".join([split, *parts[-2:]])


def _parts(frame: JsonObject, file: Path) -> tuple[str, ...]:
    """The folders and the name of a frame's image, without what leads out of every folder."""
    path = frame.get("file_path")
    if isinstance(path, str):
        parts = _inside(PureWindowsPath(without_uri(path)).parts)  # parted by both kinds of slashes
    elif isinstance(frame.get("frame_index"), int):
        folder = _inside(PureWindowsPath(str(frame.get("path", ""))).parts)
        parts = (*folder, f"{frame['frame_index']:04d}.png")
    else:
        raise CaptureError(f"{file}: a frame has neither 'file_path' nor 'frame_index'. Export the file again.")
    if not parts or any("\0" in part for part in parts):
        raise CaptureError(f"{file}: a frame names no image ({path!r}). Export the file again.")
    return parts


def _inside(parts: Sequence[str]) -> tuple[str, ...]:
    return tuple(part for part in parts if part not in ("..", ".") and not PureWindowsPath(part).anchor)
