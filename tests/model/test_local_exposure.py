"""Laws of the exposure that photographs of a place have in the mean, and what draws with it."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from support.hand_made_models import camera_above, model_at, opaque_plane, quadrants
from vdgs.config.method import MergeConfig
from vdgs.errors import VdgsError
from vdgs.export.bake import bake, collect_contributions
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.model.exposure import apply_exposure, exposure_matrix
from vdgs.model.local_exposure import LocalExposure, apply_departures, fit_local_exposure
from vdgs.model.renderer import render
from vdgs.partition.merging import merge_blocks
from vdgs.pipeline.train_block import keep_coarse_block
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.stage_folder import StageFolder

GRID = LocalExposure(torch.arange(2 * 3 * 12).float().view(2, 3, 3, 4), x=-1.0, y=2.0, spacing=0.5)
ONE = torch.tensor([[0.1, -0.05, 0.02, 0.03], [0.0, -0.2, 0.04, -0.01], [0.05, 0.0, 0.3, 0.02]])


def colors_of(images: int) -> torch.Tensor:
    """The mean of x xᵀ over the pixels of each of some photographs."""
    colors = torch.rand(images, 500, 3, generator=torch.Generator().manual_seed(images))
    pixels = torch.cat([colors, torch.ones(images, 500, 1)], dim=2)
    return pixels.transpose(1, 2) @ pixels / 500


def each_of(planes: torch.Tensor) -> torch.Tensor:
    """D of each place, [n, 3, 4]."""
    return planes.T.unflatten(1, (3, 4))


def everywhere(departure: torch.Tensor) -> LocalExposure:
    return LocalExposure(departure.view(1, 1, 3, 4), 0.0, 0.0, 1.0)


def test_between_nodes_it_is_bilinear_and_beyond_the_grid_that_of_the_border():
    nodes = GRID.departures
    places = torch.tensor([[-1.0, 2, 7], [-0.5, 2.5, 0], [-0.25, 2.25, 0], [9, 2.25, 0], [-9, -9, 0]])
    expected = [
        nodes[0, 0], nodes[1, 1], nodes[:, 1:].mean((0, 1)), nodes[:, 2].mean(0), nodes[0, 0]
    ]  # fmt: skip
    assert torch.allclose(each_of(GRID.at(places)), torch.stack(expected))
    assert GRID.at(places[:0]).shape == (12, 0)


def test_the_bits_of_a_place_depend_neither_on_the_places_beside_it_nor_on_threads():
    g, threads = torch.Generator().manual_seed(0), torch.get_num_threads()
    places, colors = 3 * torch.rand(100_003, 3, generator=g), torch.rand(100_003, 3, generator=g)
    some = torch.randperm(100_003, generator=g)[:77]
    drawn = []
    try:
        for count in (1, 4):  # torch parts so many values among threads
            torch.set_num_threads(count)
            drawn.append(apply_departures(colors, GRID.at(places), torch.arange(100_003)))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*drawn)
    assert torch.equal(drawn[0][some], apply_departures(colors[some], GRID.at(places[some]), torch.arange(77)))


def test_what_all_photographs_depart_by_holds_everywhere_as_their_exposure():
    cameras = [camera_above(x, 0.0) for x in (-2.0, 0.0, 2.0)]
    positions = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([6.0, 4.0, 0.1])
    positions -= torch.tensor([3.0, 2.0, 0.0])
    found = fit_local_exposure(ONE.expand(3, 3, 4), colors_of(3), cameras, positions)
    assert torch.allclose(each_of(found.at(positions)), ONE.expand(300, 3, 4), atol=1e-3)
    picture = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(1))
    exposed = apply_exposure(picture, exposure_matrix(ONE[None], 0))
    drawn = apply_departures(picture.flatten(0, 1), ONE.view(12, 1), torch.zeros(20, dtype=torch.long))
    assert torch.allclose(drawn.view(4, 5, 3), exposed, atol=1e-6)


def test_a_place_follows_the_photographs_that_show_it():
    """Two photographs side by side: halfway it is their mean, and under each that one counts most."""
    cameras = [camera_above(-2.0, 0.0), camera_above(2.0, 0.0)]
    line = torch.linspace(-4, 4, 801)
    positions = torch.stack([line, torch.linspace(-1, 1, 801), torch.zeros(801)], 1)
    found = fit_local_exposure(torch.stack([ONE, -ONE]), colors_of(1).expand(2, 4, 4), cameras, positions)
    places = torch.tensor([[-2.0, 0, 0], [0, 0, 0], [2, 0, 0]])
    shares = (each_of(found.at(places)) * ONE).sum((1, 2)) / ONE.square().sum()
    assert shares[1] == pytest.approx(0.0, abs=0.02)
    assert shares[0] > 0.4
    assert shares[2] < -0.4


def test_photographs_far_away_change_nothing():
    """A place is as bright as its own photographs, in a capture of 361 of them and in one of 1369."""
    found = []
    for side in (9, 18):
        steps = np.arange(-side, side + 1) * 0.4 * 4 * 32 / 60  # four tenths of what a photograph shows to each side
        cameras = [camera_above(x, y) for x in steps for y in steps]
        near = torch.tensor([abs(c.position[0]) < 4 and abs(c.position[1]) < 4 for c in cameras])
        departures = torch.where(near[:, None, None], ONE, torch.zeros(3, 4))
        positions = torch.tensor([[x, y, 0.0] for x in steps[::2] for y in steps[::2]], dtype=torch.float32)
        moments = colors_of(1).expand(len(cameras), 4, 4)
        found.append(each_of(fit_local_exposure(departures, moments, cameras, positions).at(torch.zeros(1, 3)))[0])
    assert torch.allclose(found[0], found[1], atol=0.02 * float(ONE.abs().max()))
    assert (found[1] * ONE).sum() > 0.8 * ONE.square().sum()


def test_photographs_that_look_away_do_not_count():
    away = camera_above(0.0, 0.0, altitude=-4.0)  # below the ground, looking down
    positions = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    found = fit_local_exposure(torch.stack([ONE, 5 * ONE]), colors_of(2), [camera_above(0.0, 0.0), away], positions)
    assert torch.allclose(each_of(found.at(positions)), ONE.expand(50, 3, 4), atol=1e-3)
    assert not fit_local_exposure(ONE[None], colors_of(1), [away], positions).departures.any()


@pytest.mark.parametrize(
    "positions",
    [
        np.zeros((1, 3)),
        np.array([[0.0, 0, 0], [3, 1, 0]]),
        np.full((4, 3), 0.4),
        np.c_[np.arange(9.0), np.zeros((9, 2))],
    ],
)
def test_scenes_without_extent_have_one_too(positions: np.ndarray):
    found = fit_local_exposure(ONE[None], colors_of(1), [camera_above(2.0, 0.5)], torch.from_numpy(positions).float())
    found.check()
    assert torch.allclose(each_of(found.at(torch.zeros(1, 3))), ONE[None], atol=1e-3)


def test_pictures_and_files_have_its_colors_and_nothing_else_changes():
    plain, camera = opaque_plane(), camera_above(0.0, 0.0)
    model = replace(plain, local_exposure=everywhere(ONE), background=(0.0, 0.0, 0.0))
    plain = replace(plain, background=(0.0, 0.0, 0.0))
    drawn, before = render(model, camera, depth=True), render(plain, camera, depth=True)
    assert torch.equal(drawn.alpha, before.alpha)
    assert torch.equal(drawn.depth, before.depth)
    expected = before.image + before.image @ ONE[:, :3].T + before.alpha[..., None] * ONE[:, 3]
    assert torch.allclose(drawn.image, expected, atol=1e-5)
    assert torch.equal(render(model.without_local_exposure(), camera).image, before.image)

    def baked(of: AnchorModel) -> tuple[torch.Tensor, torch.Tensor]:
        seen = collect_contributions(of, [camera, camera_above(0.5, 0.0, tilt_deg=20.0)])
        parts = list(bake(seen, np.flatnonzero(seen.pixels > 1), degree=1))
        return torch.cat([part.sh0 for part in parts]), torch.cat([part.means for part in parts])

    (colors, means), (base, places) = baked(model), baked(plain)
    assert torch.equal(means, places)
    y0 = 0.28209479177387814
    color, was = 0.5 + y0 * colors.view(-1, 3), 0.5 + y0 * base.view(-1, 3)
    assert torch.allclose(color, was + was @ ONE[:, :3].T + ONE[:, 3], atol=2e-3)


def test_a_model_keeps_it_in_its_file_which_is_checked(tmp_path: Path):
    model, file = replace(model_at(np.eye(3)), local_exposure=GRID), tmp_path / "model.safetensors"
    model.save(file)
    found = AnchorModel.load(file).local_exposure
    assert found is not None
    assert torch.equal(found.departures, GRID.departures)
    assert (found.x, found.y, found.spacing) == (GRID.x, GRID.y, GRID.spacing)
    replace(model, local_exposure=None).save(file)
    assert AnchorModel.load(file).local_exposure is None
    for bad in (replace(GRID, departures=GRID.departures / 0), replace(GRID, spacing=0.0)):
        replace(model, local_exposure=bad).save(file)
        with pytest.raises(VdgsError, match="local exposure"):
            AnchorModel.load(file)
    model.save(file)
    file.write_bytes(without_place(file.read_bytes()))
    with pytest.raises(VdgsError, match="damaged or incomplete"):
        AnchorModel.load(file)


def without_place(content: bytes) -> bytes:
    """The same file whose header does not say where the grid lies."""
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    (name,) = header["__metadata__"]
    said = json.loads(header["__metadata__"][name])
    del said["local_exposure"]
    header["__metadata__"][name] = json.dumps(said)
    new = json.dumps(header).encode()
    return struct.pack("<Q", len(new)) + new + content[8 + length :]


def test_the_merge_keeps_it_unless_one_exposure_is_asked_for():
    g = np.random.default_rng(0)
    coarse = replace(model_at(g.uniform(-3, 3, (40, 3))), local_exposure=GRID)
    blocks, cameras = quadrants(), [[camera_above(0.0, 0.0)]] * 4
    for asked, kept in (("local", GRID), ("global", None)):
        merged, _ = merge_blocks(
            coarse, [None] * 4, blocks, cameras, MergeConfig(reference_exposure=asked), allow_missing=True
        )
        assert merged.local_exposure is kept


def test_a_block_that_stays_as_it_is_is_kept_in_one_exposure_as_all_blocks_are(tmp_path):
    """Else its pictures would be measured in the exposure of their place and in that of the view."""
    folder, model = StageFolder(tmp_path), replace(opaque_plane(), local_exposure=everywhere(ONE))
    keep_coarse_block(folder, replace(model, metadata=ModelMetadata(block=0, key="k")), 0, Console(quiet=True))
    kept = load_verified(folder, "k", 0)
    assert kept.local_exposure is None
    assert torch.equal(kept.anchors.positions, model.anchors.positions)
