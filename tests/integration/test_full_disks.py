"""Stages whose disk is full in their middle: a file system in memory that has little room, then more."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from rich.console import Console

from support.commands import vdgs
from support.flights import Flight, copy_folder
from support.small_pipeline import BLOCK, CUT, SETTINGS
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import VdgsError

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("sfm"), pytest.mark.usefixtures("unestimated")]

SIZE_MB = 64
#: Colors that are not fitted again: quicker, and files alike.
FITTED = ("--color-iterations", "0", "--no-evaluate")


@dataclass(frozen=True)
class SmallDisk:
    """A file system that a file of no use fills up."""

    folder: Path

    def leave(self, free_bytes: int) -> None:
        """Let so much room be left."""
        state = os.statvfs(self.folder)
        with (self.folder / "ballast").open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, state.f_bavail * state.f_frsize - free_bytes)

    def empty(self) -> None:
        (self.folder / "ballast").unlink()

    def results(self) -> dict[str, bytes]:
        """All files but those that say how work goes on, and folders of work."""
        return {
            str(path.relative_to(self.folder)): path.read_bytes()
            for path in self.folder.rglob("*")
            if path.is_file() and path.suffix in (".safetensors", ".npz", ".bin", ".geojson", ".png", ".JPG", ".db")
        }

    def leftovers(self) -> list[str]:
        ends = (".tmp", ".part", ".scratch", ".partial.mp4")
        return [path.name for path in self.folder.rglob("*") if path.name.endswith(ends) or ".maps-" in path.name]


@pytest.fixture
def disk(tmp_path) -> Iterator[SmallDisk]:
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_MB}m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("a file system in memory cannot be mounted here: that needs root")
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def assert_fails_then_works(
    disk: SmallDisk, free_bytes: int, *command: object, prepare: Callable[[], None] | None = None
) -> None:
    """The law: words instead of traces, exit code 1, what was there stays whole, no leftovers, then the same command
    works."""
    kept = assert_fails(disk, free_bytes, *command, prepare=prepare)
    assert_works(disk, kept, *command)


def assert_fails(
    disk: SmallDisk, free_bytes: int, *command: object, prepare: Callable[[], None] | None = None
) -> dict[str, bytes]:
    """Fill the disk for a command and empty it again. Returns what the command left there."""
    before = disk.results()
    disk.leave(free_bytes)
    failed = vdgs(*command, prepare=prepare)
    assert failed.returncode == 1, f"{command}: {failed.stdout}{failed.stderr}"
    assert str(disk.folder) in failed.stderr
    assert "Free some space" in failed.stderr
    assert not [each for each in ("Traceback", "***", "terminate called") if each in failed.stderr], failed.stderr
    after = disk.results()
    assert {name: after.get(name) for name in before} == before, command
    assert disk.leftovers() == []
    disk.empty()
    return {name: content for name, content in after.items() if name not in before}


def assert_works(disk: SmallDisk, kept: dict[str, bytes], *command: object) -> None:
    done = vdgs(*command)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    found = disk.results()
    assert kept == {name: found.get(name) for name in kept}, "a half file stood under its final name"


def test_every_stage_of_a_run_says_that_the_disk_is_full_and_continues_to_the_same_bits(disk, native_small):
    run, free = disk.folder / "run", 24 << 10
    for command in (
        ("train-coarse", native_small.capture, "--output", run, "--up", "z", *SETTINGS, "--save-every", "10"),
        ("visibility", run),
        ("partition", run, *CUT),
        ("train-blocks", run, *BLOCK, "--jobs", "1"),
        ("merge", run),
        ("eval", run),
        ("report", run),
    ):
        assert_fails_then_works(disk, free, *command)
    for model in ("coarse/model.safetensors", "merged/model.safetensors"):
        assert (run / model).read_bytes() == (native_small.whole / model).read_bytes()


def test_exported_files_are_whole_or_absent(disk, native_small):
    """A command each that fails, and one for all when there is room again."""
    names = (
        "a.ply", "a.compressed.ply", "a.points.ply", "a.spz", "a.splat", "a.sog", "a.las", "a.laz", "a.glb", "a.html",
        "a.rad", "tiles/tileset.json", "lod/lod-meta.json", "place/scene.json",
    )  # fmt: skip
    command, kept = ("export", native_small.whole, *FITTED), dict[str, bytes]()
    for name in names:
        kept |= assert_fails(disk, 4 << 10, *command, "--output", disk.folder / name)
    assert_works(disk, kept, *command, *(word for name in names for word in ("--output", disk.folder / name)))
    assert all((disk.folder / name).stat().st_size > 0 for name in names)


@pytest.mark.parametrize(
    "command",
    [
        ("view", "RUN", "--static", "DISK/site"),
        ("render", "RUN", "--output", "DISK/views"),
        ("render", "RUN", "--mode", "depth", "--raw", "--output", "DISK/numbers"),
        ("render", "RUN", "--views", "flyover", "--seconds", "4", "--output", "DISK/film.mp4"),
        ("inspect", "CAPTURE", "--output", "DISK/looks"),
        (
            *("synth", "--size", "toy", "--extent-m", "40", "--num-points", "200"),
            *("--num-images", "3", "--width", "48", "--height", "36", "DISK/town"),
        ),
    ],
    ids=lambda command: f"{command[0]} {Path(command[-1]).name}",
)
def test_files_for_others_are_whole_or_absent(disk, native_small, command):
    places = {"RUN": native_small.whole, "CAPTURE": native_small.capture, "DISK": disk.folder}

    def place(word: str) -> str:
        for name, path in places.items():
            word = word.replace(name, str(path))
        return word

    assert_fails_then_works(disk, 4 << 10, *map(place, command))


def expect_room() -> None:
    """Let a map begin whatever is free: others fill the disk later."""
    from vdgs.rendering.ortho import render_ortho

    render_ortho._print_plan = lambda *_, **__: None  # type: ignore[assignment]


def test_maps_are_whole_or_absent(disk, native_small):
    """Before they begin, while tiles are written, and after; then the same command draws them."""
    pytest.importorskip("rasterio")
    command = ("ortho", native_small.whole, "--output", disk.folder / "maps", "--gsd", "0.1")
    kept = dict[str, bytes]()
    for free_bytes, prepare in ((4096, None), (4096, expect_room), (60 << 10, expect_room)):
        kept |= assert_fails(disk, free_bytes, *command, prepare=prepare)
    assert_works(disk, kept, *command)


def goes_on(nine: Flight, folder: Path) -> None:
    from vdgs.sfm.reconstruct import reconstruct

    reconstruct(SfmRequest(image_folders=(nine.folder,), output=folder, threads=1), Console(file=io.StringIO()))


@pytest.mark.usefixtures("few_features")
@pytest.mark.parametrize(
    ("step", "rooms"),
    [("features", (0, 64 << 10, 400 << 10)), ("matching", (24 << 10,)), ("mapping", (100 << 10,))],
)
def test_a_reconstruction_continues_to_the_same_model(disk, nine, nine_begun, monkeypatch, step, rooms):
    """COLMAP's own files among them: its database, and models, which it writes without a look whether they fit. A disk
    that was full may be full again soon."""
    output = disk.folder / "capture"
    if step in nine_begun:
        copy_folder(nine_begun[step], output)
    for free_bytes in rooms:
        disk.leave(free_bytes)
        with monkeypatch.context() as patch:
            patch.setattr("vdgs.sfm.reconstruct.check_disk_space", lambda _: None)  # others fill it later
            with pytest.raises(VdgsError, match=f"{re.escape(str(disk.folder))}.*Free some space"):
                goes_on(nine, output)
        disk.empty()
    goes_on(nine, output)
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        file = f"sparse/0/{name}.bin"
        assert (output / file).read_bytes() == (nine_begun["done"] / file).read_bytes()
