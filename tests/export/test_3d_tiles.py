"""3D Tiles: the scene in the leaves of a tree, closed surfaces above them, boxes around all, on the right spot."""

import json
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from support.gaussians import overhead, random_gaussians
from vdgs.errors import VdgsError
from vdgs.export.formats import registry, spz
from vdgs.export.formats.axes import Y_UP
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene, concatenate
from vdgs.export.formats.tiles_3d import write_tiles
from vdgs.geometry.geodesy import geodetic_from_ecef
from vdgs.model.gaussian_merging import merge_to
from vdgs.model.gaussian_transform import gaussian_covariances, transform_gaussians
from vdgs.model.gaussians import Gaussians, render_gaussians

pytestmark = pytest.mark.xdist_group("export_tiles")

PLACE = ExportMetadata(geodetic=(48.13, 11.57, 512.0))


def tiles_of(tileset: Path) -> list[tuple[dict, int, Gaussians]]:
    """Every tile: what the tileset says of it, its depth in the tree, its Gaussians in the ground frame."""
    found, waiting = [], [(json.loads(tileset.read_text())["root"], 0)]
    while waiting:
        entry, depth = waiting.pop(0)
        found.append((entry, depth, tile(tileset.parent / entry["content"]["uri"])))
        waiting += [(child, depth + 1) for child in entry.get("children", [])]
    return found


def tile(path: Path) -> Gaussians:
    """The Gaussians of a GLB around an SPZ, by the letters of both formats."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    gltf = json.loads(data[20 : 20 + length])
    assert length % 4 == 0
    assert data[24 + length : 28 + length] == b"BIN\0"
    (primitive,) = gltf["meshes"][0]["primitives"]
    packed = primitive["extensions"]["KHR_gaussian_splatting"]["extensions"]["KHR_gaussian_splatting_compression_spz_2"]
    view = gltf["bufferViews"][packed["bufferView"]]
    content = zlib.decompress(data[28 + length : 28 + length + view["byteLength"]], 31)
    gaussians = concatenate(spz.decode_spz(content, path))
    assert gltf["accessors"][primitive["attributes"]["POSITION"]]["count"] == len(gaussians)
    # CesiumJS tells the degree of spherical harmonics by how many attributes are named so.
    assert sum("SH_DEGREE" in name for name in primitive["attributes"]) == gaussians.shN.shape[1]
    placement = np.array(gltf["nodes"][0]["matrix"], np.float64).reshape(4, 4).T
    assert "translation" not in gltf["nodes"][0]  # CesiumJS reads nothing but the matrix (CesiumGS/cesium#12682)
    np.testing.assert_array_equal(placement[:3, :3], np.eye(3))
    moved = transform_gaussians(gaussians, 1.0, np.eye(3), placement[:3, 3])
    return transform_gaussians(moved, 1.0, Y_UP.turn.T, np.zeros(3))


@pytest.fixture(scope="module")
def town() -> Gaussians:
    """Wider than SPZ could hold from its origin."""
    some = random_gaussians(1500, 1, reach=2500.0)
    return replace(some, log_scales=some.log_scales + 3)


@pytest.fixture(scope="module")
def written(town, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("tiles") / "tileset.json"
    write_tiles(path, ExportScene.of(town, PLACE), max_gaussians=120)
    return path


def test_the_leaves_hold_the_scene(written, town):
    leaves = [gaussians for entry, _, gaussians in tiles_of(written) if "children" not in entry]
    assert all(len(each) <= 120 for each in leaves)
    assert sum(map(len, leaves)) == len(town)
    means = torch.cat([each.means for each in leaves])
    near = torch.cdist(town.means.double(), means.double()).argmin(1)
    assert len(near.unique()) == len(town)
    torch.testing.assert_close(means[near], town.means, atol=4e-4, rtol=0)
    shapes = torch.cat([gaussian_covariances(each) for each in leaves])[near]
    error = (shapes - gaussian_covariances(town)).norm(dim=(1, 2)) / gaussian_covariances(town).norm(dim=(1, 2))
    assert float(error.median()) < 0.05


def test_errors_shrink_and_boxes_lie_within_each_other(written):
    tileset = json.loads(written.read_text())
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["geometricError"] > tileset["root"]["geometricError"]

    def check(entry: dict) -> None:
        box = np.array(entry["boundingVolume"]["box"])
        for child in entry.get("children", []):
            inner = np.array(child["boundingVolume"]["box"])
            half, inner_half = (np.abs(each[3:].reshape(3, 3)).sum(0) for each in (box, inner))
            assert (np.abs(inner[:3] - box[:3]) + inner_half <= half + 1e-6).all()
            assert child["geometricError"] < entry["geometricError"]
            check(child)
        assert bool(entry.get("children")) == (entry["geometricError"] > 0)

    check(tileset["root"])
    for entry, _, gaussians in tiles_of(written):
        middle, half = np.split(np.array(entry["boundingVolume"]["box"]), [3])
        assert (np.abs(gaussians.means.numpy() - middle) <= half.reshape(3, 3).diagonal() + 1e-3).all()


def test_the_root_stands_on_its_place_on_earth(written):
    matrix = np.array(json.loads(written.read_text())["root"]["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(geodetic_from_ecef(matrix[None, :3, 3])[0], PLACE.geodetic, atol=1e-6)
    above = geodetic_from_ecef((matrix @ [0, 0, 100, 1])[None, :3])[0]
    np.testing.assert_allclose(above, [48.13, 11.57, 612.0], atol=1e-6)
    north = geodetic_from_ecef((matrix @ [0, 100, 0, 1])[None, :3])[0]
    assert north[0] > 48.1308
    assert north[1] == pytest.approx(11.57, abs=1e-9)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)


def test_viewers_are_told_what_they_need(written):
    needed = {"KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"}
    tileset = json.loads(written.read_text())
    assert set(tileset["extensions"]["3DTILES_content_gltf"]["extensionsRequired"]) == needed


def test_older_tiles_go_when_new_ones_are_there(tmp_path, town):
    some = town.select(torch.arange(50))
    path = tmp_path / "tileset.json"
    (tmp_path / "mine.txt").write_text("stays")
    for _ in range(2):
        notes = registry.write_scene(path, ExportScene.of(some))
    assert any("center of the Earth" in note for note in notes)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["mine.txt", "tiles-2", "tileset.json"]
    broken = replace(some, sh0=some.sh0 * float("inf"))
    with pytest.raises(VdgsError, match="not finite"):
        registry.write_scene(path, ExportScene(chunks=[broken], count=50, degree=1))
    assert sorted(each.name for each in tmp_path.iterdir()) == ["mine.txt", "tiles-2", "tileset.json"]
    assert len(tiles_of(path)[0][2]) == 50


def listed(folder: Path) -> list[str]:
    """All that lies in a folder, at any depth."""
    return sorted(each.relative_to(folder).as_posix() for each in folder.rglob("*"))


def test_only_tiles_of_ours_ever_go(tmp_path, town):
    path, some = tmp_path / "tileset.json", ExportScene.of(town.select(torch.arange(50)))
    for mine in ("tiles-photos/a.jpg", "tiles-1/a.jpg", "tiles-2/0.glb", "tiles-/0.glb"):
        (tmp_path / mine).parent.mkdir()
        (tmp_path / mine).write_text("mine")
    before = listed(tmp_path)
    registry.write_scene(path, some)
    assert listed(tmp_path) == sorted([*before, "tiles-3", "tiles-3/0.glb", "tileset.json"])
    (tmp_path / "tiles-3" / "notes.txt").write_text("mine")
    registry.write_scene(path, some)
    assert listed(tmp_path) == sorted(
        [*before, "tiles-3", "tiles-3/notes.txt", "tiles-4", "tiles-4/0.glb", "tileset.json"]
    )


@pytest.mark.parametrize(
    ("generator", "uri"),
    [
        ("another", "tiles-2/0.glb"), ("vdgs 1", "../tiles-2/0.glb"), ("vdgs 1", "tiles-2/../mine/0.glb"),
        ("vdgs 1", "mine/0.glb"), ("vdgs 1", "/tiles-2/0.glb"), ("vdgs 1", "tiles-2"), ("vdgs 1", 5), (None, None),
    ],
)  # fmt: skip
def test_what_a_strange_tileset_names_stays(tmp_path, town, generator, uri):
    folder = tmp_path / "at"
    for mine in ("tiles-2/0.glb", "at/tiles-2/0.glb", "at/mine/0.glb"):
        (tmp_path / mine).parent.mkdir(parents=True)
        (tmp_path / mine).write_text("mine")
    root = {"content": {"uri": str(tmp_path) + uri if str(uri).startswith("/") else uri}}
    strange = {"asset": {"version": "1.1", "generator": generator}, "root": root}
    (folder / "tileset.json").write_text(json.dumps(strange) if generator else "{")
    registry.write_scene(folder / "tileset.json", ExportScene.of(town.select(torch.arange(50))))
    for mine in ("tiles-2/0.glb", "at/tiles-2/0.glb", "at/mine/0.glb"):
        assert (tmp_path / mine).read_text() == "mine"


def test_a_crowd_on_one_spot_ends_in_one_tile(tmp_path):
    crowd = random_gaussians(300, 0)
    crowd = replace(crowd, means=torch.zeros(300, 3))
    write_tiles(tmp_path / "tileset.json", ExportScene.of(crowd), max_gaussians=50)
    leaves = [gaussians for entry, _, gaussians in tiles_of(tmp_path / "tileset.json") if "children" not in entry]
    assert [len(each) for each in leaves] == [300]


# Coarser levels


def surface(side: int = 60, step: float = 0.1, opacity: float = 0.98) -> Gaussians:
    """A closed, flat, jittered surface in two colors, each Gaussian as wide as their distance."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(side) * step, np.arange(side) * step)
    means = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) - side * step / 2
    means[:, :2] += rng.uniform(-0.3, 0.3, (len(means), 2)) * step
    n = len(means)
    return Gaussians(
        means=torch.from_numpy(means * [1, 1, 0]).float(),
        log_scales=torch.log(torch.tensor([step, step, step / 20])).repeat(n, 1) - 0.3,
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        opacity_logits=torch.full((n,), float(torch.logit(torch.tensor(opacity)))),
        sh0=torch.from_numpy(np.where(means[:, :1] < 0, [1.0, 0.0, -1.0], [-1.0, 1.0, 0.5])).float(),
        shN=torch.zeros(n, 0, 3),
    )


@pytest.mark.parametrize("most", [900, 300, 100])
def test_a_merged_surface_has_no_holes_and_keeps_its_colors(most):
    fine = surface()
    coarse, width = merge_to(fine, most)
    assert len(coarse) == most
    assert 0.1 < width < 1.0
    camera = replace(overhead(height=7.0, aside=0.01, size=64), fx=90.0, fy=90.0)  # sees the middle of it

    def drawn(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
        raster, _ = render_gaussians(gaussians, camera, torch.zeros(3), 0)
        return raster.image.numpy(), raster.alpha.numpy()

    (image, alpha), (coarse_image, coarse_alpha) = drawn(fine), drawn(coarse)
    assert alpha.min() > 0.97
    assert coarse_alpha.min() > 0.9
    for half in (slice(0, 24), slice(40, 64)):  # away from the border between the colors
        np.testing.assert_allclose(coarse_image[:, half].mean((0, 1)), image[:, half].mean((0, 1)), atol=0.05)


def test_faint_things_stay_faint():
    fine = surface(opacity=0.1)
    coarse, _ = merge_to(fine, 200)
    camera = replace(overhead(height=7.0, aside=0.01, size=64), fx=90.0, fy=90.0)
    means = [render_gaussians(each, camera, torch.zeros(3), 0)[0].alpha.mean().item() for each in (fine, coarse)]
    assert means[1] == pytest.approx(means[0], abs=0.08)


def test_nothing_changes_where_nothing_must_be_merged():
    some = random_gaussians(100, 2)
    same, width = merge_to(some, 100)
    assert same is some
    assert width == 0
