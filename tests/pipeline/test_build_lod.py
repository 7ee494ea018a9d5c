"""Levels of detail: what a tree holds, what a view of it shows, and what becomes of one that is cut off or foreign."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice, product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console

from support.captures import camera_at
from support.hand_made_models import camera_above, model_at, opaque_plane
from vdgs.config.commands import LodRequest
from vdgs.errors import RunError, Stopped, VdgsError
from vdgs.export.lod_bake import CameraTable, merge_cells
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import SPLAT_TENSORS
from vdgs.kernels.torch_ref.merged_splats import shown_members
from vdgs.model import lod_tree
from vdgs.model.anchor_model import AnchorModel, DecoderSpan
from vdgs.model.decode_world import gaussian_means
from vdgs.model.decoder import Decoder
from vdgs.model.gaussian_merging import gaussian_weights, merge_by_moments, single_members
from vdgs.model.gaussians import Gaussians, NodeGaussians
from vdgs.model.lod_format import LOD_FORMAT, TREE_FILE
from vdgs.model.lod_quadtree import build_quadtree
from vdgs.model.lod_scene import LodScene
from vdgs.model.lod_splats import FadedNode, merged_splats
from vdgs.model.lod_tree import LodCut, LodTree
from vdgs.model.renderer import render, render_scalar_map, without_aliasing
from vdgs.pipeline import build_lod
from vdgs.pipeline.build_lod import build_tree
from vdgs.runs.lod_folder import find_tree, has_lod, open_tree
from vdgs.runs.lod_status import lod_folder, lod_status
from vdgs.runs.open_run import ModelLocation, open_mapped
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.quoting import shell_word
from vdgs.system.tensors import file_id, read_tensors, write_tensors

pytestmark = pytest.mark.slow

CAMERAS = [
    camera_at(x, y, 5.0, 15.0, 90.0 * number) for number, (x, y) in enumerate([(-2, -2), (2, -2), (2, 2), (-2, 2)])
]
VIEWS = [camera_at(0.3, 0.2, 3.0), camera_at(-1.0, 2.0, 5.0, 40.0, 30.0), camera_at(0.0, 0.0, 0.6, 80.0)]


@pytest.fixture(scope="module", autouse=True)
def small_leaves() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_lod, "MAX_LEAF_ANCHORS", 150)
        yield


@pytest.fixture(scope="module")
def model() -> AnchorModel:
    """A plane of 900 anchors in no order, of two decoders."""
    plane = opaque_plane()
    order = torch.randperm(len(plane.anchors), generator=torch.Generator().manual_seed(0))
    other = Decoder.from_tensors({n: t + 0.3 * (n == "color_b2") for n, t in plane.decoder.tensors().items()})
    spans = (DecoderSpan(300, plane.decoder), DecoderSpan(len(order) - 300, other))
    return replace(plane, anchors=plane.anchors.select(order), decoder_spans=spans, photograph_pixel=0.1)


@pytest.fixture(scope="module")
def scene(model, tmp_path_factory) -> LodScene:
    folder = tmp_path_factory.mktemp("lod")
    build_tree(folder, model, "1-a", CameraTable(CAMERAS, 5.0))
    return LodScene(LodTree(folder), model.without_anchors())


def test_every_anchor_lies_in_one_leaf_within_its_square():
    positions = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32) ** 3
    tree = build_quadtree(positions, 100)
    leaves = np.flatnonzero(tree.is_leaf).tolist()
    rows = np.concatenate([tree.rows(leaf) for leaf in leaves])
    assert np.array_equal(np.sort(rows), np.arange(5000))
    assert tree.count[leaves].max() <= 100
    for node in range(len(tree.parent)):
        mine = positions[tree.rows(node), :2]
        assert np.ptp(mine, axis=0).max() <= tree.edge[node] * (1 + 1e-6)
        assert node in leaves or (np.diff(tree.rows(node)) != 0).all()
        assert tree.parent[node] < node
    assert all(np.array_equal(tree.rows(leaf), np.sort(tree.rows(leaf))) for leaf in leaves)
    same = build_quadtree(np.zeros((300, 3), np.float32), 100)
    assert same.count.tolist() == [300]


@pytest.mark.parametrize("camera", VIEWS)
def test_without_any_error_the_picture_is_that_of_the_model_to_the_last_bit(scene, model, camera):
    for part in (camera, camera.cropped(10, 5, 40, 30)):
        whole, drawn = (render(each, part, depth=True) for each in (model, scene.at_error(0.0)))
        assert all(torch.equal(a, b) for a, b in zip(whole, drawn, strict=True))
    values = torch.arange(len(model.anchors)).float()
    rows = {tuple(place): value for place, value in zip(model.anchors.positions.tolist(), values, strict=True)}
    known = scene.at_error(0.0).values(
        camera, lambda _, places: torch.stack([rows[tuple(p)] for p in places().tolist()])
    )
    drawn = render_scalar_map(scene.at_error(0.0), known * 1.0, camera)
    expected = render_scalar_map(model, values, camera)
    torch.testing.assert_close(drawn, expected, rtol=1e-4, atol=1e-2, equal_nan=True)


def test_places_that_have_faded_out_are_not_drawn(scene, model):
    """As the viewer leaves out what few cameras see: of Gaussians of anchors and of merged ones alike."""
    camera, half = camera_at(0.0, 0.0, 6.0), scene.with_fade(lambda places: (places[:, 0] > 0).float(), "half")
    factors = (gaussian_means(model.anchors)[..., 0] > 0).float()
    faded = replace(model, anchors=replace(model.anchors, opacity_factors=factors))
    exact = render(half.at_error(0.0), camera).image
    assert torch.equal(exact, render(faded, camera).image)
    left = model.anchors.positions[factors.any(1), 0]
    for error in (0.0, 2.0, 50.0):
        drawn = half.at_error(error)
        rows, splats = drawn.view_splats(camera)
        x = drawn.values(camera, lambda _, places: places()[:, 0])[rows[splats.opacities > 0]]
        assert len(x)
        assert bool(((x > 0) | torch.isin(x, left)).all())
    half = scene.with_fade(lambda places: torch.full((len(places),), 0.5), "by half")
    for error in (0.0, 2.0, 50.0):
        whole, drawn = (each.at_error(error).view_splats(camera)[1].opacities for each in (scene, half))
        torch.testing.assert_close(drawn, whole / 2, atol=1e-6, rtol=1e-5)


def mixed_cut(scene: LodScene) -> LodCut:
    """Some children of the root by their merged Gaussians, and the leaves below the others."""
    table = scene.tree.table
    children = np.flatnonzero(table.parent == 0).tolist()
    above = np.arange(len(table))
    for node in range(1, len(table)):
        above[node] = node if table.parent[node] == 0 else above[table.parent[node]]
    leaves = np.flatnonzero((table.anchors > 0) & np.isin(above, children[2:])).tolist()
    assert len(children) >= 3
    assert leaves
    return LodCut(tuple(children[:2]), tuple(leaves))


def test_a_node_that_has_wholly_faded_out_is_left_out_and_the_others_keep_their_values(scene, monkeypatch):
    camera, cut = camera_at(0.0, 0.0, 6.0), mixed_cut(scene)
    monkeypatch.setattr(LodTree, "cut", lambda *_: cut)
    gone = scene.tree.gaussians(cut.nodes[0]).means
    low, high = gone.amin(0), gone.amax(0)
    fade = lambda places: (~((places >= low) & (places <= high)).all(1)).float()  # noqa: E731
    whole, faded = (each.at_error(1.0) for each in (scene, scene.with_fade(fade, "one node")))
    for drawn in (whole, faded):
        rows, splats = drawn.view_splats(camera)
        places = drawn.values(camera, lambda _, places: places())
        merged = rows >= len(places) - sum(len(scene.tree.gaussians(node)) for node in cut.nodes[drawn is faded :])
        shown = merged & (splats.opacities > 0)
        pixels, _ = camera.project(places[rows[shown]].numpy())
        torch.testing.assert_close(splats.means_px[shown], torch.from_numpy(pixels).float(), atol=1e-3, rtol=1e-4)
        assert int(rows.max()) == len(places) - 1
    assert len(whole.values(camera, lambda _, places: places())) - len(places) >= len(gone)


def test_parts_of_a_faded_picture_read_each_node_once_on_any_number_of_threads(scene, monkeypatch):
    camera, read, cut = camera_at(0.0, 0.0, 6.0), list[Path](), mixed_cut(scene)
    monkeypatch.setattr(LodTree, "cut", lambda *_: cut)
    for name in ("load_node", "load_anchors"):
        load = getattr(lod_tree, name)
        monkeypatch.setattr(lod_tree, name, lambda path, load=load: (read.append(path), load(path))[1])
    pictures = []
    for threads in (1, 3):
        monkeypatch.setattr(lod_tree, "get_num_threads", lambda threads=threads: threads)
        anew = replace(scene, tree=scene.tree.with_own_cache(1 << 28))
        half = anew.with_fade(lambda places: places[:, 0].clamp(0, 1), f"{threads}").at_error(2.0).for_view(camera)
        top = camera.height // 2
        for part in (camera.cropped(0, 0, camera.width, top), camera.cropped(0, top, camera.width, camera.height)):
            pictures.append(render(half, part).image)
        assert len(read) == len(cut.nodes) + len(cut.leaves)
        assert len(set(read)) == len(read)
        read.clear()
    assert all(torch.equal(a, b) for a, b in zip(pictures[:2], pictures[2:], strict=True))


def test_a_cut_shows_each_place_once_and_is_coarser_the_larger_the_error(scene):
    table, tree = scene.tree.table, scene.tree
    under = [{leaf} if table.anchors[leaf] else set() for leaf in range(len(table))]
    for node in range(len(table) - 1, 0, -1):
        under[table.parent[node]] |= under[node]
    everywhere = Camera(
        camera_from_world=VIEWS[0].camera_from_world, fx=5.0, fy=5.0, cx=32.0, cy=24.0, width=64, height=48
    )
    costs = []
    for error in (0.0, 0.001, 0.01, 0.1, 1.0, 100.0):
        cut = tree.cut(everywhere, error)
        shown = [*cut.leaves, *(leaf for node in cut.nodes for leaf in under[node])]
        assert sorted(shown) == np.flatnonzero(table.anchors).tolist()
        costs.append(tree.cost(cut))
        assert tree.error_within(everywhere, 0.0, costs[-1]) <= error
    assert costs == sorted(costs, reverse=True)
    assert costs[0] > costs[-1]
    within = tree.error_within(everywhere, 0.0, costs[0] // 3)
    assert tree.cost(tree.cut(everywhere, within)) <= costs[0] // 3


def test_merged_levels_stay_opaque_and_keep_their_colors(scene, model):
    """As nearly as a random decoder allows, whose colors differ from side to side."""
    high = camera_at(0.0, 0.0, 9.0)
    inner = slice(16, 32), slice(24, 40)
    whole = render(model, high)
    for error in (0.2, 1.0, 100.0):
        drawn = render(scene.at_error(error), high, depth=True)
        assert drawn.alpha[inner].min() > 0.9
        assert (drawn.image[inner] - whole.image[inner]).mean((0, 1)).abs().max() < 0.05
        assert (drawn.median_depth[inner] - 9.0).abs().max() < 0.1
    assert not scene.tree.cut(high, 100.0).leaves


def test_without_aliasing_a_picture_from_afar_is_that_of_many_samples_and_that_of_merged_levels(scene):
    high, pixel = camera_at(0.0, 0.0, 60.0), 6.0 / 60.0  # as of photographs from a height of 6
    tiny = model_at(np.random.default_rng(3).uniform((-3, -3, 0), (3, 3, 2), (400, 3)))
    many = render(tiny, high.resized(8 * high.width, 8 * high.height)).image
    many = many.reshape(high.height, 8, high.width, 8, 3).mean((1, 3))
    errors = [
        float((render(each, high).image - many).square().mean()) for each in (without_aliasing(tiny, pixel), tiny)
    ]
    assert errors[0] < errors[1] / 4
    near = camera_at(0.3, 0.2, 3.0)
    assert torch.equal(render(without_aliasing(tiny, pixel), near).image, render(tiny, near).image)
    fine, merged = (render(without_aliasing(scene.at_error(error), pixel), high).image for error in (0.0, 1.0))
    assert (fine - merged).square().mean() < (render(scene.at_error(0.0), high).image - merged).square().mean()


def test_levels_show_the_sky_with_aliasing_and_without(scene):
    sky = replace(scene.model, decoder=replace(scene.model.decoder, envmap=torch.full((4, 8, 3), 0.53)))
    up, lit = camera_above(0.0, 0.0, 6.0, 150.0), replace(scene, model=sky)
    for shown in (lit, lit.at_error(1.0), without_aliasing(lit, 0.1), without_aliasing(sky, 0.1)):
        assert (render(shown, up).image - 0.53).abs().max() < 1e-6


def test_nodes_are_kept_as_they_were_saved_and_drawn_in_float32(scene):
    kept = scene.tree.gaussians(0)
    assert {name for name, tensor in kept.tensors().items() if tensor.dtype == torch.float32} == {"means"}
    _, drawn = scene.at_error(1e6).view_splats(VIEWS[0])
    wanted = merged_splats([FadedNode(kept.float())], VIEWS[0])
    for name in SPLAT_TENSORS:
        assert torch.equal(getattr(drawn, name), getattr(wanted, name))


def test_merging_cells_keeps_what_it_merges(scene):
    gaussians = scene.tree.gaussians(0).float()
    merged, error = merge_cells(gaussians, 1.5, np.zeros(len(gaussians)))
    assert 1 < len(merged) < len(gaussians)
    assert 0 < error < 1.5
    alone, same = merge_cells(gaussians, 1e-4, np.full(len(gaussians), 0.5))
    assert len(alone) == len(gaussians)
    assert same == pytest.approx(0.5)
    one, _ = merge_cells(gaussians, 100.0, np.zeros(len(gaussians)))
    weights = torch.from_numpy(gaussian_weights(gaussians))[:, None]
    assert len(one) == 1
    torch.testing.assert_close(
        one.means[0].double(), (weights * gaussians.means).sum(0) / weights.sum(), atol=1e-5, rtol=0
    )


def test_cells_merge_what_lies_nearest_to_their_means():
    """Seen on a line: a Gaussian beside the border of a cell joins those of the next cell that are nearer."""
    x = torch.tensor([0.0, 0.1, 0.95, 1.05, 1.1, 1.15])
    place = torch.stack([x, x * 0, x * 0], 1)
    some = single_members(Gaussians(
        means=place, log_scales=torch.full((6, 3), -3.0), quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(6, 1),
        opacity_logits=torch.zeros(6), sh0=torch.zeros(6, 3), shN=torch.zeros(6, 3, 3),
    ))  # fmt: skip
    merged, _ = merge_cells(some, 1.0, np.zeros(6))
    torch.testing.assert_close(merged.means[:, 0], torch.tensor([0.05, 1.0625]), atol=1e-5, rtol=0)


def test_from_afar_one_gaussian_dims_as_much_as_the_many_that_it_stands_for_and_near_by_no_more_than_an_opaque_one():
    """A stack of Gaussians smaller than a pixel, each drawn as transparent as its blur makes it."""
    places = np.random.default_rng(5).uniform(-0.02, 0.02, (100, 3)).astype(np.float32)
    many = single_members(Gaussians(
        means=torch.from_numpy(places), log_scales=torch.full((100, 3), -4.0), opacity_logits=torch.zeros(100),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(100, 1), sh0=torch.zeros(100, 3), shN=torch.zeros(100, 3, 3),
    ))  # fmt: skip
    one = merge_by_moments(many, np.zeros(100, np.int64), enlarge=1.0)
    assert one.covers[0] > 10
    near = merged_splats([FadedNode(one)], camera_at(0.0, 0.0, 0.1)).opacities
    assert 0.99 < float(near[0]) <= 0.999 + 1e-6
    # The many saturate where they are dense, which makes their disk wider than a Gaussian.
    for height, least, most, tolerance in ((10.0, 0.7, 0.9, 0.25), (15.0, 0.5, 0.7, 0.1), (30.0, 0.0, 0.0, 0.0)):
        camera = camera_at(0.0, 0.0, height)
        members = one.log_weight_mean, one.log_weight_std
        assert least <= float(shown_members(*members, torch.tensor([height]), camera)[0]) <= most
        shown, wanted = (mean_alpha_sum(gaussians, camera) for gaussians in (one, many))
        assert shown == pytest.approx(wanted, rel=tolerance)


def mean_alpha_sum(gaussians: NodeGaussians, camera: Camera) -> float:
    """How much a picture shows of merged Gaussians, the mean over places of its pixels."""
    kernels, sums = get_backend(torch.device("cpu")), list[float]()
    for x, y in product(np.arange(4) / 4, repeat=2):
        moved = replace(camera, cx=camera.cx + x, cy=camera.cy + y)
        splats = merged_splats([FadedNode(gaussians)], moved)
        raster = kernels.rasterize(splats, torch.zeros(3), camera.width, camera.height)
        sums.append(float(raster.alpha.sum()))
    return float(np.mean(sums))


def test_memory_is_bounded_by_what_was_asked_for(scene):
    tree = LodTree(scene.tree.folder, cache_bytes=200_000)
    bounded = LodScene(tree, scene.model)
    for camera in VIEWS * 2:
        for error in (0.0, 0.5, 5.0):
            assert torch.equal(
                render(bounded.at_error(error), camera).image, render(scene.at_error(error), camera).image
            )
            assert 0 < tree.cached_bytes <= 200_000


def test_a_build_that_was_cut_off_continues_to_the_same_bytes(model, scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cut_off")

    def stop(records, total):
        yield from islice(records, total // 2)
        raise Stopped("stopped")

    with pytest.raises(Stopped):
        build_tree(folder, model, "1-a", CameraTable(CAMERAS, 5.0), stop)
    with pytest.raises(VdgsError, match="no finished level-of-detail tree"):
        LodTree(folder)
    kept = {file: file.stat().st_mtime_ns for file in folder.rglob("nodes/*.safetensors")}
    assert kept
    build_tree(folder, model, "1-a", CameraTable(CAMERAS, 5.0))
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    names = sorted(file.relative_to(folder) for file in folder.rglob("*.safetensors"))
    assert names == sorted(file.relative_to(scene.tree.folder) for file in scene.tree.folder.rglob("*.safetensors"))
    assert all(file_id(folder / name) == file_id(scene.tree.folder / name) for name in names)


def test_a_damaged_node_is_named(scene, tmp_path):
    folder = Path(shutil.copytree(scene.tree.folder, tmp_path / "lod"))
    file = folder / "nodes" / "000000.safetensors"
    content = bytearray(file.read_bytes())
    content[-5] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(VdgsError, match=r"000000\.safetensors: is missing or damaged.*vdgs lod"):
        render(LodScene(LodTree(folder), scene.model, 1000.0), VIEWS[0])


def test_a_tree_of_another_version_is_made_again(scene, tmp_path):
    folder = Path(shutil.copytree(scene.tree.folder, tmp_path / "lod"))
    tensors, header = read_tensors(folder / TREE_FILE)
    copied = {name: tensor.clone() for name, tensor in tensors.items()}  # from the file that is written anew
    write_tensors(folder / TREE_FILE, copied, {"vdgs-lod-2": header[LOD_FORMAT]})
    with pytest.raises(VdgsError, match=r"is of another version of vdgs\. Make it again: vdgs lod RUN"):
        LodTree(folder)


def test_a_scene_that_no_camera_shows_has_a_tree(tmp_path):
    model = model_at(np.random.default_rng(1).normal(size=(400, 3)))
    away = [camera_at(50.0, 50.0, 5.0)]
    build_tree(tmp_path, model, "1-b", CameraTable(away, 5.0))
    scene = LodScene(LodTree(tmp_path), model.without_anchors(), 0.0)
    assert torch.equal(render(scene, VIEWS[1]).image, render(model, VIEWS[1]).image)


@pytest.fixture
def coarse(model, tmp_path, monkeypatch) -> SimpleNamespace:
    """A run whose coarse model is done, as a stage knows it."""
    run = RunFolder(tmp_path / "run")
    keyed = replace(model, metadata=replace(model.metadata, key="key"))
    keyed.save(run.coarse.model)
    status = StatusRecord(state="done", anchors=len(model.anchors), model_id=file_id(run.coarse.model))
    run.coarse.set_status(status)
    location = ModelLocation(run.coarse, "coarse", "key", "")
    monkeypatch.setattr(build_lod, "locate_model", lambda *_: location)
    monkeypatch.setattr(build_lod, "camera_height", lambda _: 5.0)
    capture = SimpleNamespace(train_views=[SimpleNamespace(camera=camera) for camera in CAMERAS])
    return SimpleNamespace(run=run, capture=capture, location=location)


def test_a_model_that_stands_in_for_the_merged_one_is_said(coarse, monkeypatch):
    location = replace(coarse.location, warning="this is the coarse model, not the merged one: there is none yet")
    monkeypatch.setattr(build_lod, "locate_model", lambda *_: location)
    console = Console(record=True, width=200)
    build_lod.build_lod(coarse, LodRequest(run=coarse.run.path), console)
    assert f"warning {location.warning}" in console.export_text()


def test_a_tree_belongs_to_its_model_and_no_other(coarse, model):
    console = Console(record=True)
    request = LodRequest(run=coarse.run.path)
    folder = build_lod.build_lod(coarse, request, console)
    build_lod.build_lod(coarse, request, console)
    assert console.export_text(clear=False).count("nothing to do") == 1
    at = lod_folder(coarse.run)
    at.set_status(replace(at.status(), state="running"))  # as a process leaves it that ended before its last step
    assert not has_lod(coarse.run, coarse.location)
    build_lod.build_lod(coarse, request, console)
    assert has_lod(coarse.run, coarse.location)
    assert console.export_text().count("nothing to do") == 1
    opened = open_mapped(coarse.run, coarse.location)
    drawn = open_tree(opened).at_error(0.0)
    assert torch.equal(render(drawn, VIEWS[0]).image, render(model, VIEWS[0]).image)
    assert find_tree(opened) is not None
    other = replace(opened, status=replace(opened.status, model_id="1-b"))
    assert find_tree(other) is None
    with pytest.raises(RunError, match=r"tree of another model than the coarse one.*vdgs lod .*--model coarse"):
        open_tree(other)
    tensors, header = read_tensors(folder / TREE_FILE)
    older = {name: tensor.clone() for name, tensor in tensors.items()}
    write_tensors(folder / TREE_FILE, older, {"vdgs-lod-3": header[LOD_FORMAT]})
    assert find_tree(opened) is None
    assert not has_lod(coarse.run, coarse.location)
    with pytest.raises(RunError, match=r"tree is of another version of vdgs\. Make it: vdgs lod .*--model coarse"):
        open_tree(opened)
    for merged, end in (("1-c", " --model coarse"), ("", "")):
        models = {
            "coarse": SimpleNamespace(output_id=opened.status.model_id),
            "merge": SimpleNamespace(output_id=merged),
        }
        (stage,) = lod_status(coarse.run, SimpleNamespace(of=models.__getitem__))
        assert (stage.state, stage.reason) == ("stale", "made by another version of vdgs")
        assert stage.command == f"vdgs lod {shell_word(coarse.run.path)}{end}"
    (folder / TREE_FILE).unlink()
    with pytest.raises(RunError, match="no finished level-of-detail tree"):
        open_tree(opened)


def test_no_tree_is_made_of_a_damaged_model(coarse):
    file = coarse.run.coarse.model
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(VdgsError, match=r"damaged or incomplete"):
        build_lod.build_lod(coarse, LodRequest(run=coarse.run.path), Console())
    assert not list(coarse.run.path.rglob("lod/**/*.safetensors"))


def test_a_disk_without_room_is_said_before_anything_is_written(coarse, monkeypatch):
    monkeypatch.setattr(build_lod.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(VdgsError, match=r"takes up to .* and .* are free"):
        build_lod.build_lod(coarse, LodRequest(run=coarse.run.path), Console())
    assert not list(coarse.run.path.rglob("lod/**/*.safetensors"))
