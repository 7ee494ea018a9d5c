"""Renders for people: colors that mean the same in every frame and say so, numbers on request, folders replaced with
care."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from support.hand_made_models import camera_above, opaque_plane
from vdgs.config.commands import RenderRequest
from vdgs.errors import VdgsError
from vdgs.model.renderer import render
from vdgs.rendering import render_folder
from vdgs.rendering.render_run import _check
from vdgs.rendering.scalar_maps import (
    NO_DATA_COLOR,
    add_colorbar,
    alpha_scale,
    depth_range,
    depth_scale,
    render_depth,
    visibility_scale,
)
from vdgs.system.figure_style import VISIBILITY_CMAP

SCALES = {
    "depth": depth_scale((31.7, 48.2), "m"),
    "visibility": visibility_scale(np.arange(14)),
    "many views": visibility_scale(np.arange(1200)),
    "alpha": alpha_scale(),
}


def picture(names: list[str], place: Path, text: bytes = b"picture") -> None:
    for name in names:
        (place / name).write_bytes(text)


def rendered(place: Path, names: list[str]) -> None:
    earlier = render_folder.begin_render(place, names)
    picture(names, place)
    render_folder.finish_render(place, earlier, names, {"kind": "image"})


def names_in(place: Path) -> list[str]:
    return sorted(path.name for path in place.iterdir() if not path.name.startswith("."))


def test_a_second_render_takes_the_place_of_the_first(tmp_path: Path) -> None:
    rendered(tmp_path / "r", ["a.png", "b.png", "c.png"])
    (tmp_path / "r" / ".DS_Store").write_bytes(b"hidden")
    rendered(tmp_path / "r", ["b.png", "d.png"])
    assert names_in(tmp_path / "r") == ["b.png", "d.png", "render.json"]
    assert json.loads((tmp_path / "r" / "render.json").read_text())["files"] == ["b.png", "d.png"]
    assert (tmp_path / "r" / ".DS_Store").is_file()


def test_what_systems_and_programs_leave_is_no_reason_to_refuse(tmp_path: Path) -> None:
    rendered(tmp_path, ["00000.png", "00001.png"])
    picture(systems := ["Thumbs.db", "desktop.ini", "._00000.png"], tmp_path)
    (tmp_path / "@eaDir").mkdir()
    picture(["00000.png.aux.xml", "00001.png.aux.xml"], tmp_path)
    rendered(tmp_path, ["00000.png"])
    assert {path.name for path in tmp_path.iterdir()} == {*systems, "@eaDir", "00000.png", "render.json"}
    picture(["theirs.png.aux.xml", "thumb_1.png"], tmp_path)
    with pytest.raises(VdgsError, match=r"no render wrote \(theirs\.png\.aux\.xml, thumb_1\.png\)"):
        render_folder.begin_render(tmp_path, ["thumb_1.png"])


def test_what_no_render_wrote_is_never_touched(tmp_path: Path) -> None:
    rendered(tmp_path, ["a.png"])
    picture(["mine.png"], tmp_path, b"mine")
    with pytest.raises(VdgsError, match=r"1 files or folders that no render wrote \(mine\.png\)"):
        render_folder.begin_render(tmp_path, ["mine.png"])
    assert (tmp_path / "mine.png").read_bytes() == b"mine"
    assert json.loads((tmp_path / "render.json").read_text())["files"] == ["a.png"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"written_by": "me", "files": ["a.png"]}', "\x00"])
def test_a_list_that_is_not_ours_claims_nothing(tmp_path: Path, text: str) -> None:
    picture(["a.png"], tmp_path)
    (tmp_path / "render.json").write_text(text)
    with pytest.raises(VdgsError, match=r"2 files or folders that no render wrote \(a\.png, render\.json\)"):
        render_folder.begin_render(tmp_path, ["a.png"])


def test_a_list_that_was_edited_reaches_nothing_else(tmp_path: Path) -> None:
    rendered(tmp_path / "r", ["a.png"])
    picture(["precious.png"], tmp_path)
    record = json.loads((tmp_path / "r" / "render.json").read_text())
    record["files"] += ["../precious.png", str(tmp_path / "precious.png"), 5, "..", ""]
    (tmp_path / "r" / "render.json").write_text(json.dumps(record))
    rendered(tmp_path / "r", ["b.png"])
    assert names_in(tmp_path / "r") == ["b.png", "render.json"]
    assert names_in(tmp_path) == ["precious.png", "r"]


def test_a_render_that_was_cut_off_is_known_again(tmp_path: Path) -> None:
    rendered(tmp_path, ["a.png", "b.png"])
    render_folder.begin_render(tmp_path, ["c.png", "d.png"])
    picture(["c.png"], tmp_path)  # and here the power fails
    assert render_folder.begin_render(tmp_path, ["e.png"]) == ["a.png", "b.png", "c.png"]
    render_folder.finish_render(tmp_path, ["a.png", "b.png", "c.png"], [], {})
    assert names_in(tmp_path) == ["render.json"]


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "film").write_bytes(b"")
    with pytest.raises(VdgsError, match="is a file"):
        render_folder.begin_render(tmp_path / "film", ["a.png"])


def test_a_pixel_has_a_depth_where_it_is_more_than_half_opaque() -> None:
    """At the edge of a sheet, where splats thin out."""
    model, camera = opaque_plane(), camera_above(3.0, 0.0)
    alpha, depth = render(model, camera).alpha.numpy(), render_depth(model, camera)
    assert ((alpha > 0.05) & (alpha <= 0.5)).sum() > 10
    np.testing.assert_array_equal(np.isfinite(depth), alpha > 0.5)
    np.testing.assert_allclose(depth[alpha > 0.5], 4.0, atol=0.05)


def test_the_range_of_depths_holds_every_view() -> None:
    near, far = np.full((4, 5), 10.0), np.full((4, 5), 90.0)
    far[0, 0] = np.nan
    low, high = depth_range([near, far, np.full((4, 5), np.nan)], 7.0)
    assert (low, high) == (10.0, 90.0)
    assert depth_range([np.full((2, 2), np.nan)], 7.0) == (0.0, 14.0)
    scale = depth_scale((low, high), "m")
    assert scale.low <= low < high <= scale.high
    ground = scale.colorize(np.array([[10.0, 90.0, np.nan]]))
    assert len(np.unique(ground.reshape(-1, 3), axis=0)) == 3
    assert tuple(ground[0, 2]) == NO_DATA_COLOR


@pytest.mark.parametrize("span", [(0.0, 20.0), (30.0, 30.0), (1e-4, 2e-4), (0.0, 0.0), (12.0, 4000.0)])
def test_depths_of_any_range_have_round_numbers(span: tuple[float, float]) -> None:
    scale = depth_scale(span, "m")
    assert scale.low < scale.high
    assert 2 <= len(scale.ticks) <= 8
    assert len({words for _, words in scale.ticks}) == len(scale.ticks)
    assert all(len(words) <= 9 for _, words in scale.ticks)


def test_v_has_the_colors_of_all_other_figures_and_whole_steps() -> None:
    scale = visibility_scale(np.array([0, 1, 4, 10]))
    drawn = scale.colorize(np.array([[0.0, 0.4, 0.6, 9.8, 10.0, 10.4]])) / 255
    np.testing.assert_allclose(drawn[0, 0], VISIBILITY_CMAP(0.0)[:3], atol=0.01)
    np.testing.assert_allclose(drawn[0, -1], VISIBILITY_CMAP(1.0)[:3], atol=0.01)
    assert (drawn[0, 0] == drawn[0, 1]).all()
    assert (drawn[0, 3] == drawn[0, 5]).all()
    assert (drawn[0, 1] != drawn[0, 2]).any()
    assert [words for _, words in scale.ticks] == [str(number) for number in range(11)]
    assert SCALES["many views"].ticks[-1][1].startswith("≥")


@pytest.mark.parametrize("name", SCALES)
@pytest.mark.parametrize("size", [(48, 64), (49, 65), (7, 9), (720, 1280), (300, 4000)])
def test_legends_fit_below_every_picture(name: str, size: tuple[int, int]) -> None:
    scale, (height, width) = SCALES[name], size
    picture = np.full((height, width, 3), 7, np.uint8)
    whole = add_colorbar(picture, scale)
    assert whole.shape[1] == width
    assert whole.shape[0] % 2 == 0
    np.testing.assert_array_equal(whole[:height], picture)
    strip = whole[height:]
    assert (strip[1:-1, [0, -1]] == 255).all() or width < 30, "something is cut off at the edge"
    assert (strip[-1] == 255).all()
    if width >= 64:
        ink = np.round(np.array(to_rgb("#1c1e22")) * 255)
        assert (strip == ink).all(axis=-1).sum() > 10
        for value in (scale.low, scale.high):  # the bar shows both ends
            color = scale.colorize(np.full((1, 1), value))[0, 0].astype(int)
            assert (np.abs(strip - color).max(axis=-1) < 8).any()


def test_numbers_are_of_maps_in_folders(tmp_path: Path) -> None:
    with pytest.raises(VdgsError, match="--raw"):
        _check(RenderRequest(run=tmp_path, output=tmp_path / "out", raw=True))
    with pytest.raises(VdgsError, match="a film holds no numbers"):
        _check(RenderRequest(run=tmp_path, output=tmp_path / "film.mp4", mode="depth", raw=True))
