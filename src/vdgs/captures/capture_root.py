"""The folder of a capture. Imports nothing: commands about runs ask for it."""

from __future__ import annotations

from pathlib import Path

#: Folders of ODM and Bundler whose files are about the photographs beside these folders.
_INNER = {"opensfm", "odm_report", "bundle"}
_PIX4D_INNER = ("1_initial", "params")


def capture_root(path: Path) -> Path:
    """The folder of a capture that is given by its folder, or by the file of its project: the one that has images in
    it, where programs put the file into a folder beside images."""
    if not path.is_file():
        return path
    if path.parts[-3:-1] == _PIX4D_INNER:
        return path.parents[2]
    inner = path.parent.name in _INNER and not (path.parent / "images").is_dir()
    above = path.parent.parent
    listed = (above / "list.txt").is_file() and not (path.parent / "list.txt").is_file()  # as Bundler itself leaves it
    return above if inner and ((above / "images").is_dir() or listed) else path.parent
