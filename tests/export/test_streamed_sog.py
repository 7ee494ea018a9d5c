"""Streamed SOG: all of the scene in each level, each node where the document says, and nothing of others touched."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("gaussforge", reason="gaussforge is not installed (pip install 'vdgs[dev]')")


from support.gaussians import overhead, picture, psnr, random_gaussians, turned
from support.splat_readers import independent
from vdgs.errors import VdgsError
from vdgs.export.formats import registry, streamed_sog
from vdgs.export.formats.axes import Y_DOWN
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene
from vdgs.export.formats.streamed_sog import level_count, write_streamed_sog
from vdgs.model.gaussians import Gaussians


def level(path: Path, number: int) -> tuple[Gaussians, list[dict]]:
    """All of a level in the ground frame, read by another program, and its nodes: box, and rows of what was read."""
    document = json.loads(path.read_text())
    found, nodes = None, []
    for node in document["tree"]["children"]:
        place = node["lods"][str(number)]
        file = path.parent / document["filenames"][place["file"]]
        bundle = path.parent / f"{file.parent.name}.sog"
        with zipfile.ZipFile(bundle, "w") as archive:
            for each in file.parent.iterdir():
                archive.write(each, each.name)
        part = independent(bundle).select(torch.arange(place["offset"], place["offset"] + place["count"]))
        bundle.unlink()
        nodes.append(node["bound"] | {"means": part.means})
        found = part if found is None else found.concat(part)
    return turned(found, Y_DOWN.turn.T), nodes


@pytest.fixture(scope="module")
def flat() -> Gaussians:
    some = random_gaussians(1200, 1, reach=6.0)
    return replace(some, means=some.means * torch.tensor([1, 1, 0.1]), opacity_logits=some.opacity_logits + 2)


def test_each_level_is_the_scene(tmp_path, flat, monkeypatch):
    monkeypatch.setattr(streamed_sog, "COARSEST_SIZE", 100)
    monkeypatch.setattr(streamed_sog, "FILE_SIZE", 400)
    path = tmp_path / "lod-meta.json"
    notes = write_streamed_sog(path, ExportScene.of(flat), node_size=150)
    assert notes[0].startswith("3 levels")
    document = json.loads(path.read_text())
    assert document["lodLevels"] == 3
    assert document["counts"][0] == 1200
    assert document["count"] == sum(document["counts"])
    assert len(document["filenames"]) > 3
    camera = replace(overhead(height=40.0, aside=3.0, size=48), fx=90.0, fy=90.0)
    for number, near in ((0, 36), (1, 24), (2, 19)):
        read, nodes = level(path, number)
        assert len(read) == document["counts"][number] == pytest.approx(1200 / 4**number, rel=0.1)
        assert psnr(picture(read, camera), picture(flat, camera)) > near
        for node in nodes:
            assert (node["means"].numpy() >= np.array(node["min"]) - 1e-3).all()
            assert (node["means"].numpy() <= np.array(node["max"]) + 1e-3).all()
    assert json.loads((tmp_path / "lod-meta.json.json").read_text())["axes"].startswith("-x, -z, -y of the ground")


def test_an_earlier_one_goes_and_what_others_put_there_stays(tmp_path, flat):
    path, scene = tmp_path / "lod-meta.json", ExportScene.of(flat.select(torch.arange(50)))
    (tmp_path / "lod-photos").mkdir()
    for number in (1, 2):
        registry.write_scene(path, scene)
        assert sorted(each.name for each in tmp_path.glob("lod-[0-9]*")) == [f"lod-{number}"]
        if number == 1:
            (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "lod-2" / "0_0" / "notes.txt").write_text("mine")
    registry.write_scene(path, scene)
    assert [each.name for each in (tmp_path / "lod-2" / "0_0").iterdir()] == ["notes.txt"]
    listed = registry.format_from_path(path).files(path)
    assert sum(each.name == "meta.json" for each in listed) == 1
    assert len(listed) == 1 + len(list((tmp_path / "lod-3" / "0_0").iterdir()))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "lod-meta.json").mkdir()
    with pytest.raises(VdgsError, match=r"FOLDER/lod-meta\.json"):
        registry.write_scene(tmp_path / "other" / "lod-meta.json", scene)


def test_scenes_have_as_many_levels_as_they_need():
    assert [level_count(each) for each in (1, 131_072, 131_073, 1_400_000, 10_000_000, 10**9)] == [1, 1, 2, 3, 5, 6]
    assert ExportMetadata().program.startswith("vdgs ")  # by which documents of ours are known
