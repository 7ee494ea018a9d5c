"""No verb writes among photographs, whichever of its options names the place: laws over all verbs and options."""

from __future__ import annotations

import typing
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments.bench.cli import BenchArguments
from vdgs.cli.main import COMMANDS, main, verb_arguments
from vdgs.config.options import Option, options_of
from vdgs.config.output_paths import Output, is_output
from vdgs.config.ranges import FlagName

#: Options that name what is only read.
READ = {
    "capture", "run", "images", "gps", "gcp", "scale_bar", "test_list", "georef", "lpips_weights", "path", "data",
    "reuse_results", "config", "image_folders", "extra_image_folders",
}  # fmt: skip


def path_options(verb: str) -> list[Option]:
    """Every option of a verb that holds a path."""
    return [each for each in options_of(verb_arguments()[verb] or BenchArguments) if "Path" in str(each.hint)]


WRITTEN = [(verb, option) for verb in COMMANDS for option in path_options(verb) if is_output(option.hint)]


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """A memory card: DCIM/100MEDIA with photographs."""
    folder = tmp_path / "card" / "DCIM" / "100MEDIA"
    folder.mkdir(parents=True)
    exif = Image.Exif()
    exif[0x010F] = "DJI"
    for k in range(4):
        Image.fromarray(np.full((48, 64, 3), 50 * k, np.uint8)).save(folder / f"DJI_000{k}.JPG", exif=exif)
    return folder


def contents(folder: Path) -> dict[Path, bytes | None]:
    return {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.mark.parametrize("verb", COMMANDS)
def test_every_path_is_known_as_read_or_written(verb: str) -> None:
    for option in path_options(verb):
        read = option.path[-1] in READ
        assert read != is_output(option.hint), f"vdgs {verb} {option.flag}: mark it with Output(), or list it as read"


def test_the_known_outputs_are_found() -> None:
    verbs = {verb for verb, _ in WRITTEN}
    assert verbs >= {"run", "sfm", "train-coarse", "inspect", "render", "ortho", "export", "synth", "bench"}
    assert ("inspect", "--undistorted-folder") in {(verb, option.flag) for verb, option in WRITTEN}
    assert is_output(typing.Annotated[Path | None, FlagName("x"), Output()])
    assert not is_output(Path)


@pytest.mark.parametrize("inside", ["", "new", "new/deep", "film.mp4", "scene.ply", "../ortho.tif", ".."])
@pytest.mark.parametrize(("verb", "option"), WRITTEN, ids=[f"{verb} {option.flag}" for verb, option in WRITTEN])
def test_no_verb_writes_among_photographs(verb: str, option: Option, inside: str, card: Path, capsys) -> None:
    before, root = contents(card.parents[1]), card.parents[1].parent
    write_to(card / inside, verb, option, root)
    said = capsys.readouterr().err
    assert "lies among the photographs" in said
    assert str(card.parents[1] / "") in said.split("such as")[1]
    assert contents(card.parents[1]) == before
    assert sorted(root.iterdir()) == [root / "card", root / "empty"]


def write_to(place: Path, verb: str, option: Option, root: Path) -> None:
    """Let a verb write to a place, which it must refuse before it looks at its run or capture."""
    (root / "empty").mkdir()
    (root / "empty" / "config.yaml").touch()  # neither a capture nor a run, which is not looked at yet
    arguments = (
        [str(root / "empty")] if verb not in ("synth", "bench", "config") else ["toy"] if verb == "bench" else []
    )
    if option.flag != "--output":
        arguments += [] if verb in ("render", "ortho", "export", "view") else ["--output", str(root / "free")]
    with pytest.raises(SystemExit) as ended:
        main([verb, *arguments, *([str(place)] if option.is_positional else [option.flag, str(place)])])
    assert ended.value.code == 1


@pytest.mark.parametrize("target", ["there.ply", "gone.ply"])
@pytest.mark.parametrize(("verb", "option"), WRITTEN, ids=[f"{verb} {option.flag}" for verb, option in WRITTEN])
def test_no_verb_writes_over_a_link_to_a_file(verb: str, option: Option, target: str, tmp_path: Path, capsys) -> None:
    (tmp_path / "there.ply").write_text("of another program")
    (tmp_path / "link.ply").symlink_to(target)
    write_to(tmp_path / "link.ply", verb, option, tmp_path)
    assert f"link.ply: is a link to {target}, which the output would replace" in capsys.readouterr().err
    assert (tmp_path / "link.ply").is_symlink()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["empty", "link.ply", "there.ply"]


@pytest.mark.parametrize("verb", sorted({*COMMANDS} - {verb for verb, _ in WRITTEN} - {"doctor"}))
def test_photographs_are_no_run(verb: str, card: Path, capsys) -> None:
    before = contents(card.parents[1])
    with pytest.raises(SystemExit) as ended:
        main([verb, str(card)])
    assert ended.value.code == 1
    assert str(card) in capsys.readouterr().err
    assert contents(card.parents[1]) == before
