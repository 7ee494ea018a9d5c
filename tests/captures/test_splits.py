"""Which photographs train and which test: every n-th, and the lists that a person or a capture brings."""

from __future__ import annotations

import json

import pytest

from support.captures import UP, TinyScene, up, write_colmap, write_images
from vdgs.captures.loading import load_capture
from vdgs.captures.splits import held_out_by_capture
from vdgs.errors import CaptureError


def test_validation_leaves_the_test_photographs_out(folder, scene):
    names = sorted(scene.cameras)
    tested = {view.name for view in load_capture(folder, up(test_every=4)).test_views}
    validation = load_capture(folder, up(test_every=4, validation=True))
    assert tested.isdisjoint(view.name for view in validation.views)
    kept = [name for name in names if name not in tested]
    assert [view.name for view in validation.test_views] == kept[::4]
    assert len(validation.views) == len(kept)


def test_test_lists_and_every_nth(folder, scene, tmp_path):
    listed = tmp_path / "test.txt"
    listed.write_text("# held out\nframe_002.jpg\n\nframe_007\n")
    names = {view.name for view in load_capture(folder, up(test_list=listed)).test_views}
    assert names == {"frame_002.png", "frame_007.png"}
    every = load_capture(folder, up(test_list=listed, split="every", test_every=3))
    assert [view.name for view in every.test_views] == sorted(scene.cameras)[::3]
    listed.write_text("nobody.png\n")
    with pytest.raises(CaptureError, match=r"1 of its 1 names .* such as frame_000\.png(?s:.)*\n  nobody\.png"):
        load_capture(folder, up(test_list=listed))


def test_a_list_may_name_photographs_without_a_camera_and_those_that_are_gone(folder, scene):
    """As benchmarks do: the whole list is of a set that COLMAP did not register whole."""
    names = sorted(scene.cameras)
    (folder / "images" / names[5]).unlink()
    (folder / "test.txt").write_text("\n".join([names[2], names[5], "unregistered.png"]))
    (folder / "validation.txt").write_text(f"{names[7]}\nunregistered.png\n")
    capture = load_capture(folder, UP)
    assert [view.name for view in capture.test_views] == [names[2]]
    assert names[7] not in {view.name for view in capture.views}
    test, validation = (note for note in capture.warnings if "that has a camera and is there" in note)
    assert "test.txt: 2 of its 3 names are of no photograph" in test
    assert test.endswith(f"({names[5]}, unregistered.png).")
    assert "validation.txt: 1 of its 2 names" in validation
    write_images(folder / "images", scene)
    with pytest.raises(CaptureError, match=r"test\.txt: 1 of its 3 names .*\n  unregistered\.png"):
        load_capture(folder, up(strict=True))


@pytest.mark.parametrize("line", ["{1}", "{0}\\{1}", "images/{0}/{1}", "./{0}/{1}", "D:\\card\\{0}\\{1}"])
def test_lists_name_photographs_in_all_ways_that_mean_one(tmp_path, scene, line):
    cards = {f"{100 + k // 6}MEDIA/{name}": camera for k, (name, camera) in enumerate(scene.cameras.items())}
    write_colmap(tmp_path, TinyScene(cards, scene.points, scene.colors))
    chosen = [sorted(cards)[k] for k in (2, 9)]
    (tmp_path / "test.txt").write_text("\r\n".join(line.format(*name.split("/")) for name in chosen))
    assert [view.name for view in load_capture(tmp_path, UP).test_views] == chosen


def test_a_line_of_a_list_that_may_mean_several_photographs_is_refused(tmp_path, scene):
    cards = {f"{100 + k % 6}MEDIA/{k // 6}.png": camera for k, camera in enumerate(scene.cameras.values())}
    write_colmap(tmp_path, TinyScene(cards, scene.points, scene.colors))
    (tmp_path / "test.txt").write_text("100MEDIA/1.png\n1.png\n")
    with pytest.raises(CaptureError, match=r"'1\.png' may be 10\dMEDIA/1\.png or .*: write the folder too"):
        load_capture(tmp_path, UP)


@pytest.mark.parametrize("sparse", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_lists_beside_the_model_are_read(tmp_path, scene, sparse):
    """3DGS and its hierarchical version have test.txt there."""
    names, model = sorted(scene.cameras), write_colmap(tmp_path, scene, sparse=sparse)
    (model / "test.txt").write_text(f"{names[3]}\n{names[7]}\n")
    (model / "validation.txt").write_text(names[5])
    capture = load_capture(tmp_path, UP)
    assert [view.name for view in capture.test_views] == [names[3], names[7]]
    assert names[5] not in {view.name for view in capture.views}
    (tmp_path / "test.txt").write_text(names[4])
    assert [view.name for view in load_capture(tmp_path, UP).test_views] == [names[4]]


@pytest.mark.parametrize("place", [".", "sparse/0"])
def test_the_lists_of_scannet_are_read(tmp_path, scene, place):
    names = sorted(scene.cameras)
    write_colmap(tmp_path, scene)
    lists = tmp_path / place / "train_test_lists.json"
    lists.write_text(json.dumps({"train": names[2:], "test": names[:2], "has_masks": False}))
    assert [view.name for view in load_capture(tmp_path, UP).test_views] == names[:2]
    for wrong in ("[]", '{"train": []}', '{"test": "a"}', "{"):
        lists.write_text(wrong)
        with pytest.raises(CaptureError, match=r"train_test_lists\.json: must hold"):
            load_capture(tmp_path, UP)
    (tmp_path / "test.txt").write_text(names[5])
    assert [view.name for view in load_capture(tmp_path, UP).test_views] == [names[5]]


def test_photographs_that_the_lists_of_scannet_leave_out_are_counted(tmp_path, scene):
    names = sorted(scene.cameras)
    write_colmap(tmp_path, scene)
    lists = tmp_path / "train_test_lists.json"
    for training, unlisted in ((names[2:], 0), (names[4:], 2), ([], 0), (7, 0)):
        lists.write_text(json.dumps({"train": training, "test": names[:2]}))
        capture = load_capture(tmp_path, UP)
        assert len(capture.train_views) == len(names) - 2
        said = [warning for warning in capture.warnings if "neither under train nor under test" in warning]
        assert len(said) == bool(unlisted)
        assert all(f"{lists}: 2 of {len(names)} photographs" in each and names[2] in each for each in said)


@pytest.mark.parametrize("name", ["test.txt", "train_test_lists.json"])
@pytest.mark.parametrize("inside", [True, False])
def test_lists_beside_the_photographs_are_read_and_said(tmp_path, scene, name, inside):
    """As ScanNet++ has them: SCENE/dslr/colmap, and beside it the photographs with their lists."""
    root, names = tmp_path / "dslr/colmap", sorted(scene.cameras)
    write_colmap(root, scene, sparse=".")
    place = root / "photos" if inside else tmp_path / "dslr"
    place.mkdir(exist_ok=True)
    (root / "images").rename(place / "resized_images")
    for list_name in (name, "validation.txt"):
        wanted = names[3:5] if list_name == name else names[5:6]
        text = json.dumps({"test": wanted}) if list_name.endswith(".json") else "\n".join(wanted)
        (place / list_name).write_text(text)
    where = str((place / "resized_images").relative_to(root) if inside else place / "resized_images")
    options = up(images=where)
    capture = load_capture(root, options)
    assert [view.name for view in capture.test_views] == names[3:5]
    assert names[5] not in {view.name for view in capture.views}
    assert f"{place / name} says which photographs are for the test." in capture.warnings
    assert f"{place / 'validation.txt'} says which photographs are for validation." in capture.warnings
    notes = list[str]()
    held_out = held_out_by_capture(root, where, names, options, notes)  # as `vdgs sfm` asks, which writes them down
    assert held_out == {"test.txt": set(names[3:5]), "validation.txt": {names[5]}}


def test_a_file_beside_photographs_elsewhere_that_names_none_of_them_is_not_theirs(tmp_path, scene):
    """A test.txt of somebody's home, say."""
    root = tmp_path / "capture"
    write_colmap(root, scene)
    (root / "images").rename(tmp_path / "photographs")
    expected = load_capture(root, up(images=str(tmp_path / "photographs"))).test_views
    for text in ("buy milk\n", "", "\x00\x01"):
        (tmp_path / "test.txt").write_text(text)
        capture = load_capture(root, up(images=str(tmp_path / "photographs")))
        assert [view.name for view in capture.test_views] == [view.name for view in expected]
        assert (
            f"{tmp_path / 'test.txt'} names other photographs than this capture has, and is not used."
            in capture.warnings
        )


def test_of_a_list_beside_photographs_elsewhere_half_must_fit_and_what_cannot_be_read_is_said(tmp_path, scene):
    root, names, options = tmp_path / "capture", sorted(scene.cameras), up(images=str(tmp_path / "photographs"))
    write_colmap(root, scene)
    (root / "images").rename(tmp_path / "photographs")
    file = tmp_path / "test.txt"
    file.write_text("\n".join([names[2], "a.jpg", "b.jpg"]))
    assert [view.name for view in load_capture(root, options).test_views] != [names[2]]
    file.write_text("\n".join([names[2], "a.jpg"]))
    assert [view.name for view in load_capture(root, options).test_views] == [names[2]]
    file.write_text(names[2], encoding="utf-16")
    with pytest.raises(CaptureError, match=r"test\.txt: is not UTF-8 text .* --split every"):
        load_capture(root, options)


def test_lists_that_contradict_each_other_are_said(folder, scene):
    names = sorted(scene.cameras)
    (folder / "test.txt").write_text(f"{names[3]}\n{names[7]}\n")
    other = folder / "sparse/0/test.txt"
    for text, contradicts in ((f"{names[7]}\n{names[3]}", False), (names[4], True), ("nothing of this", True)):
        other.write_text(text)
        capture = load_capture(folder, UP)
        assert [view.name for view in capture.test_views] == [names[3], names[7]]
        assert any(f"{other} names other photographs" in note for note in capture.warnings) == contradicts


def test_a_capture_may_bring_its_own_lists(folder, scene):
    names = sorted(scene.cameras)
    (folder / "test.txt").write_text(f"{names[2]}\n{names[9]}\n")
    (folder / "validation.txt").write_text(f"{names[4]}\n{names[5]}\n")
    tested, validated = load_capture(folder, UP), load_capture(folder, up(validation=True))
    assert [view.name for view in tested.test_views] == [names[2], names[9]]
    assert [view.name for view in validated.test_views] == names[4:6]
    training = [view.name for view in tested.train_views]
    assert training == [view.name for view in validated.train_views]
    assert training == [name for name in names if name not in {names[k] for k in (2, 4, 5, 9)}]
    # a list of one's own replaces the capture's; every n-th ignores both lists
    (folder / "mine.txt").write_text(names[4])
    mine = load_capture(folder, up(test_list=folder / "mine.txt"))
    assert [view.name for view in mine.test_views] == [names[4]]
    assert names[5] not in {view.name for view in mine.views}
    every = load_capture(folder, up(split="every", test_every=4))
    assert [view.name for view in every.test_views] == names[::4]
    assert len(every.views) == len(names)


def test_lists_may_name_photographs_that_max_images_leaves_out(folder, scene):
    (folder / "test.txt").write_text("\n".join(sorted(scene.cameras)[::2]))
    whole, part = load_capture(folder, UP), load_capture(folder, up(max_images=8))
    assert {view.name for view in part.test_views} < {view.name for view in whole.test_views}


def test_no_view_left_to_test_on(folder, tmp_path):
    (tmp_path / "none.txt").write_text("")
    with pytest.raises(CaptureError, match=r"none\.txt: names no photograph"):
        load_capture(folder, up(test_list=tmp_path / "none.txt"))
    (folder / "test.txt").write_text("# to come\n\n")
    with pytest.raises(CaptureError, match=r"/test\.txt: names no photograph"):
        load_capture(folder, UP)
    (tmp_path / "all.txt").write_text("\n".join(path.name for path in (folder / "images").iterdir()))
    with pytest.raises(CaptureError, match="no photograph is left to train on"):
        load_capture(folder, up(test_list=tmp_path / "all.txt"))


def test_a_list_saved_with_a_byte_order_mark_is_the_same_list(folder, scene):
    name = sorted(scene.cameras)[3]
    (folder / "test.txt").write_text(name + "\n", encoding="utf-8-sig")
    assert [view.name for view in load_capture(folder, UP).test_views] == [name]
