"""Files of Gaussians: what other programs' readers and our own find in them is the scene that was written."""

import json
import re
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch

from support.gaussians import overhead, picture, psnr, random_gaussians, turned
from support.splat_readers import independent
from vdgs.errors import VdgsError
from vdgs.export.formats import export_scene, registry, sog, spz
from vdgs.export.formats.axes import Y_DOWN, Y_UP
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene, metadata_path
from vdgs.export.formats.gaussian_ply import read_ply_chunks
from vdgs.export.formats.parallel_gzip import gzip_blocks
from vdgs.export.formats.quaternion_canonical import canonicalize_quaternions
from vdgs.kernels import get_backend
from vdgs.model.gaussian_transform import gaussian_covariances
from vdgs.model.gaussians import Gaussians

PLACED = ExportMetadata(
    origin=(690_000.0, 5_334_000.25, 512.0), crs="EPSG:32632", geodetic=(48.13, 11.57, 512.0), has_compass=True
)
#: PSNR of what is read back, drawn, against the scene as it was: at least.
CLOSE = {".ply": 100, ".spz": 38, ".splat": 38}


def flat(gaussians: Gaussians) -> Gaussians:
    """Without the colors that change with the direction."""
    return replace(gaussians, shN=gaussians.shN[:, :0])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_keeps_every_bit(tmp_path, degree):
    written = random_gaussians(300, degree)
    assert registry.write_scene(tmp_path / "a.ply", ExportScene.of(written, PLACED)) == ()
    for read in (registry.read_gaussians(tmp_path / "a.ply"), independent(tmp_path / "a.ply")):
        for name in ("means", "log_scales", "opacity_logits", "sh0", "shN"):
            assert torch.equal(getattr(read, name), getattr(written, name)), name
        torch.testing.assert_close(gaussian_covariances(read), gaussian_covariances(written))


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
def test_splats_of_other_programs_are_read_in_every_form_of_a_ply(tmp_path, form):
    written = random_gaussians(300, 1)
    registry.write_scene(tmp_path / "a.ply", ExportScene.of(written, PLACED))
    data = (tmp_path / "a.ply").read_bytes()
    header, mark, body = data.partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(300, -1)
    text = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows).encode()
    body = text if form == "ascii" else rows.astype(">f4").tobytes()
    header = header.replace(b"binary_little_endian", form.encode()) + mark
    (tmp_path / "b.ply").write_bytes(header + body)
    read = registry.read_gaussians(tmp_path / "b.ply")
    for name in ("means", "log_scales", "opacity_logits", "sh0", "shN"):
        assert torch.equal(getattr(read, name), getattr(written, name)), name
    (tmp_path / "b.ply").write_bytes(header + body[: len(body) // 2])
    with pytest.raises(VdgsError, match="truncated"):
        registry.read_gaussians(tmp_path / "b.ply")


def test_a_ply_says_where_it_stands_and_has_the_layout_that_all_read(tmp_path):
    registry.write_scene(tmp_path / "a.ply", ExportScene.of(random_gaussians(3, 3), PLACED))
    data = (tmp_path / "a.ply").read_bytes()
    header = data[: data.index(b"end_header\n") + 11].decode("ascii").splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "comment origin [690000.0, 5334000.25, 512.0]" in header
    assert "comment crs EPSG:32632" in header
    names = [line.removeprefix("property float ") for line in header if line.startswith("property")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert names[54:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def test_wkt_of_several_lines_stays_one_comment(tmp_path):
    facts = ExportMetadata(crs='PROJCRS["Straße",\n  BASEGEOGCRS["x"],\nend_header\n]')
    written = random_gaussians(5, 1)
    registry.write_scene(tmp_path / "a.ply", ExportScene.of(written, facts))
    assert torch.equal(registry.read_gaussians(tmp_path / "a.ply").means, written.means)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_an_spz_is_what_niantics_code_reads(tmp_path, version, degree):
    written = random_gaussians(400, degree)
    spz.write_spz(tmp_path / "a.spz", replace(ExportScene.of(written), spz_version=version))
    theirs, ours = independent(tmp_path / "a.spz"), turned(registry.read_gaussians(tmp_path / "a.spz"), Y_UP.turn)
    wanted = turned(written, Y_UP.turn)
    for read in (theirs, ours):
        torch.testing.assert_close(read.means, wanted.means, atol=0.5 / 4096 + 1e-6, rtol=0)
        sizes = (each.log_scales.sort(1).values for each in (read, wanted))  # version 2 names the axes anew
        torch.testing.assert_close(*sizes, atol=1 / 32 + 1e-5, rtol=0)
        torch.testing.assert_close(
            read.opacity_logits.sigmoid(), wanted.opacity_logits.sigmoid(), atol=0.5 / 255 + 1e-5, rtol=0
        )
        torch.testing.assert_close(read.sh0, wanted.sh0, atol=0.5 / 255 / 0.15 + 1e-5, rtol=0)
        torch.testing.assert_close(read.shN, wanted.shN, atol=0.5 / 128 + 1e-4, rtol=0)
        assert shape_errors(read, wanted).max() < 0.08  # sizes are in steps of a sixteenth
    torch.testing.assert_close(gaussian_covariances(ours), gaussian_covariances(theirs), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(ours.shN, theirs.shN, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("version", "most"), [(2, 0.02), (3, 0.005)])
def test_needles_of_an_spz_keep_their_shapes(tmp_path, version, most):
    """Sizes that the file holds exactly: what differs is the rotation, in a shape by a fiftieth at most."""
    some = random_gaussians(3000, 0)
    needles = replace(some, log_scales=torch.tensor([0.0, -4.0, -4.0]).repeat(len(some), 1))
    spz.write_spz(tmp_path / "a.spz", replace(ExportScene.of(needles), spz_version=version))
    for read in (
        turned(independent(tmp_path / "a.spz"), Y_UP.turn.T),
        registry.read_gaussians(tmp_path / "a.spz"),
    ):
        assert most / 2 < shape_errors(read, needles).max() < most


def shape_errors(one: Gaussians, other: Gaussians) -> np.ndarray:
    """By how much each ellipsoid differs from another, as a share of it."""
    wanted = gaussian_covariances(other).double()
    return ((gaussian_covariances(one).double() - wanted).norm(dim=(1, 2)) / wanted.norm(dim=(1, 2))).numpy()


@pytest.mark.parametrize("name", ["a.splat", "a.spz", "a.sog", "a.compressed.ply"])
@pytest.mark.parametrize("part", [0, 1, 2, 3])
def test_rotations_that_are_nearly_all_of_one_part_stay_what_they_are(tmp_path, name, part):
    """Where that part, in a byte, would be 256: w, x, y or z, of either sign."""
    some = random_gaussians(40, 0)
    small = np.random.default_rng(part).uniform(-0.03, 0.03, (40, 4))
    small[:, part] = np.where(np.arange(40) % 2, 1.0, -1.0)
    turns = torch.nn.functional.normalize(torch.from_numpy(small.astype(np.float32)), dim=1)
    axes = Y_UP if name == "a.spz" else Y_DOWN
    # As the file holds them: turned into its axes, they would be others.
    some = turned(
        replace(some, quaternions=turns, log_scales=torch.tensor([0.0, -2.0, -1.0]).repeat(40, 1)), axes.turn.T
    )
    registry.write_scene(tmp_path / name, ExportScene.of(some))
    path = tmp_path / name
    read = turned(independent(path), Y_DOWN.turn.T) if name == "a.sog" else registry.read_gaussians(path)
    read = read.select(torch.cdist(some.means, read.means).argmin(1))  # some write in Morton order
    assert shape_errors(read, some).max() < 0.02


def test_an_spz_of_a_higher_degree_than_ours_is_not_called_damaged(tmp_path):
    data = spz.HEADER_STRUCT.pack(spz.MAGIC, 3, 0, 4, 12, 0, 0)
    with pytest.raises(VdgsError, match="degree 4, and vdgs reads those up to 3"):
        list(spz.decode_spz(data, tmp_path / "a.spz"))


def test_axes_named_anew_give_the_same_shapes_with_small_turns():
    some = random_gaussians(500, 0)
    some = replace(some, quaternions=torch.nn.functional.normalize(some.quaternions, dim=-1))
    small = canonicalize_quaternions(some)
    torch.testing.assert_close(gaussian_covariances(small), gaussian_covariances(some), rtol=1e-4, atol=1e-6)
    assert float(small.quaternions[:, 0].min()) > 0.85


def test_what_changes_with_no_direction_stays_so_in_an_spz(tmp_path):
    written = random_gaussians(50, 3)
    written = replace(written, shN=torch.zeros_like(written.shN))
    registry.write_scene(tmp_path / "a.spz", ExportScene.of(written))
    assert torch.equal(independent(tmp_path / "a.spz").shN, written.shN)


@pytest.mark.parametrize("ending", sorted(CLOSE))
def test_what_is_read_back_draws_the_same_picture(tmp_path, ending):
    written = random_gaussians(300, 0 if ending == ".splat" else 3)
    registry.write_scene(tmp_path / f"a{ending}", ExportScene.of(written))
    assert psnr(picture(registry.read_gaussians(tmp_path / f"a{ending}")), picture(written)) > CLOSE[ending]


def test_chunks_and_their_sizes_make_no_difference(tmp_path, monkeypatch):
    whole = random_gaussians(100, 2)
    parts = [whole.select(torch.arange(a, b)) for a, b in ((0, 1), (1, 40), (40, 40), (40, 100))]
    names = [f"a{each.suffix}" for each in registry.FORMATS if each.folder is None and each.suffix != ".sog"]
    for name in names:
        registry.write_scene(tmp_path / f"1{name}", ExportScene.of(whole, PLACED))
    monkeypatch.setattr(export_scene, "CHUNK_SIZE", 16)
    for name in names:
        registry.write_scene(
            tmp_path / f"2{name}", ExportScene(chunks=iter(parts), count=100, degree=2, metadata=PLACED)
        )
        one, other = (tmp_path / f"{i}{name}" for i in (1, 2))
        if name.endswith((".laz", ".las")):
            continue  # tested by their numbers: headers hold a date
        unpack = (lambda data: zlib.decompress(data, 31)) if name.endswith(".spz") else bytes
        assert unpack(one.read_bytes()) == unpack(other.read_bytes()), name


def test_a_splat_is_its_32_bytes(tmp_path):
    written = random_gaussians(200, 1)
    lost = registry.write_scene(tmp_path / "a.splat", ExportScene.of(written, PLACED))
    assert "colors no longer change with the viewing direction" in lost
    rows = np.frombuffer((tmp_path / "a.splat").read_bytes(), "<f4,<f4,<f4,<f4,<f4,<f4,u4,u4")
    assert len(rows) == 200
    wanted, theirs = turned(written, Y_DOWN.turn), independent(tmp_path / "a.splat")
    torch.testing.assert_close(theirs.means, wanted.means)
    assert shape_errors(theirs, wanted).max() < 0.05
    np.testing.assert_array_equal(np.stack([rows[f"f{i}"] for i in range(3)], 1), wanted.means.numpy())
    np.testing.assert_allclose(
        np.stack([rows[f"f{i}"] for i in range(3, 6)], 1), wanted.log_scales.exp().numpy(), rtol=1e-6
    )
    alpha = np.ascontiguousarray(rows["f6"]).view(np.uint8).reshape(-1, 4)[:, 3]
    np.testing.assert_allclose(alpha / 255, wanted.opacity_logits.sigmoid().numpy(), atol=0.5 / 255 + 1e-6)
    facts = json.loads(metadata_path(tmp_path / "a.splat").read_text())
    assert facts["origin"] == [690_000.0, 5_334_000.25, 512.0]
    assert facts["axes"].startswith("x west, y down")


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_sog_is_read_by_others(tmp_path, degree):
    written = random_gaussians(500, degree)
    notes = registry.write_scene(tmp_path / "a.sog", ExportScene.of(written))
    assert "positions are rounded" in notes[0]
    read, wanted = independent(tmp_path / "a.sog"), turned(written, Y_DOWN.turn)
    near = torch.cdist(wanted.means, read.means).argmin(1)  # in Morton order
    assert len(near.unique()) == 500
    read = read.select(near)
    # Half a step of 16 bits between the outermost, in the logarithm of the distance from the plane of the origin.
    logs = [(each.sign() * each.abs().log1p()).numpy() for each in (read.means.double(), wanted.means.double())]
    assert (np.abs(logs[0] - logs[1]) < 0.51 * np.ptp(logs[1], axis=0) / 65535).all()
    torch.testing.assert_close(read.log_scales, wanted.log_scales, atol=0.05, rtol=0)
    torch.testing.assert_close(read.sh0, wanted.sh0, atol=0.05, rtol=0)
    torch.testing.assert_close(read.shN, wanted.shN, atol=0.02, rtol=0)
    assert psnr(picture(turned(read, Y_DOWN.turn.T)), picture(written)) > 36
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        assert json.loads(bundle.read("meta.json"))["count"] == 500


def test_a_sog_keeps_the_few_that_are_larger_and_brighter_than_all_others(tmp_path, monkeypatch):
    """Backdrops and water: a sample of a large scene does not hold them."""
    monkeypatch.setattr(sog, "SAMPLE_ROWS", 100)
    written = random_gaussians(5000, 0)
    few = torch.arange(7, 5000, 500)
    written.log_scales[few, 0] = torch.linspace(2.0, 3.5, len(few))
    written.log_scales[few + 1, 1] = -9.0
    written.sh0[few, 2] = torch.linspace(4.0, 6.0, len(few))
    registry.write_scene(tmp_path / "a.sog", ExportScene.of(written))
    read, wanted = independent(tmp_path / "a.sog"), turned(written, Y_DOWN.turn)
    read = read.select(torch.cdist(wanted.means, read.means).argmin(1))
    torch.testing.assert_close(read.log_scales, wanted.log_scales, atol=0.1, rtol=0)
    torch.testing.assert_close(read.sh0, wanted.sh0, atol=0.1, rtol=0)


@pytest.mark.parametrize(("size", "color"), [(5.0, 5.0), (20.0, 80.0)])
def test_one_that_is_far_larger_and_brighter_makes_a_sog_no_coarser_for_the_others(tmp_path, size, color):
    """The entries of the codebooks go to what is there, not to the void before it."""
    written = random_gaussians(20_000, 0)
    errors = []
    for _ in range(2):
        registry.write_scene(tmp_path / "a.sog", ExportScene.of(written))
        read, wanted = independent(tmp_path / "a.sog"), turned(written, Y_DOWN.turn)
        order = get_backend(torch.device("cpu")).morton_order(wanted.means)
        off = [(read.log_scales - wanted.log_scales[order]), (read.sh0 - wanted.sh0[order])]
        errors.append([float(each.square().mean().sqrt()) for each in off])
        assert max(float(each.abs().max()) for each in off) < 0.1
        written.log_scales[77, 1], written.sh0[77, 2] = size, color
    np.testing.assert_array_less(errors[1], 1.02 * np.array(errors[0]))


def glb_arrays(path: Path) -> tuple[pygltflib.GLTF2, dict[str, np.ndarray]]:
    """A GLB as pygltflib reads it, and the numbers of every attribute."""
    gltf = pygltflib.GLTF2().load(str(path))
    (primitive,) = gltf.meshes[0].primitives
    blob, widths, found = gltf.binary_blob(), {"SCALAR": 1, "VEC3": 3, "VEC4": 4}, {}
    for name, index in vars(primitive.attributes).items():
        if index is None:
            continue
        accessor = gltf.accessors[index]
        view = gltf.bufferViews[accessor.bufferView]
        kind, width = {5126: np.float32, 5123: np.uint16}[accessor.componentType], widths[accessor.type]
        found[name] = np.frombuffer(blob, kind, accessor.count * width, view.byteOffset).reshape(-1, width)
    return gltf, found


@pytest.mark.parametrize("degree", [0, 3])
def test_a_glb_holds_the_turned_scene_with_all_its_bits(tmp_path, degree):
    written = random_gaussians(250, degree)
    assert registry.write_scene(tmp_path / "a.glb", ExportScene.of(written, PLACED)) == ()
    gltf, found = glb_arrays(tmp_path / "a.glb")
    wanted, prefix = turned(written, Y_UP.turn), "KHR_gaussian_splatting:"
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.mode == 0
    assert primitive.extensions["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    assert primitive.extensions["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display"
    assert gltf.extensionsUsed == ["KHR_gaussian_splatting"]
    assert gltf.asset.extras["origin"] == [690_000.0, 5_334_000.25, 512.0]
    np.testing.assert_array_equal(found["POSITION"], wanted.means.numpy())
    np.testing.assert_allclose(gltf.accessors[0].min, wanted.means.numpy().min(0))
    np.testing.assert_allclose(gltf.accessors[0].max, wanted.means.numpy().max(0))
    np.testing.assert_allclose(found[prefix + "SCALE"], wanted.log_scales.exp().numpy(), rtol=1e-6)
    np.testing.assert_allclose(found[prefix + "OPACITY"][:, 0], wanted.opacity_logits.sigmoid().numpy(), rtol=1e-6)
    wxyz = torch.from_numpy(found[prefix + "ROTATION"][:, [3, 0, 1, 2]].copy())
    torch.testing.assert_close(gaussian_covariances(replace(wanted, quaternions=wxyz)), gaussian_covariances(wanted))
    np.testing.assert_array_equal(found[prefix + "SH_DEGREE_0_COEF_0"], wanted.sh0.numpy())
    further = [
        found[f"{prefix}SH_DEGREE_{band}_COEF_{i}"] for band in range(1, degree + 1) for i in range(2 * band + 1)
    ]
    if degree:
        np.testing.assert_array_equal(np.stack(further, 1), wanted.shN.numpy())
    light = found["COLOR_0"].astype(np.float64) / 65535  # linear, as the base specification has it
    np.testing.assert_allclose(light[:, 3], wanted.opacity_logits.sigmoid().numpy(), atol=1e-5)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)[:, :3]
    np.testing.assert_allclose(srgb, np.clip(0.5 + 0.28209479 * wanted.sh0.numpy(), 0, 1), atol=1e-4)


def test_what_no_spz_can_hold_is_refused_before_work(tmp_path):
    asked = []

    def chunks():
        asked.append(True)
        yield far

    far = random_gaussians(4, 0)
    far.means[2, 1] = 2500.0
    known = ExportScene(chunks=chunks(), count=4, degree=0, bounds=((-3, -3, -1), (3, 2500, 1)))
    with pytest.raises(VdgsError, match=r"2500 m from the origin.*tileset\.json"):
        registry.write_scene(tmp_path / "a.spz", known)
    assert not asked
    with pytest.raises(VdgsError, match="2500 m from the origin"):
        registry.write_scene(tmp_path / "a.spz", replace(known, bounds=None))
    assert list(tmp_path.iterdir()) == []
    for edge in (2048.0, float(np.nextafter(np.float32(2048), 0)), -2048.0):  # one step, and a rounding before it
        far.means[2, 1] = edge
        with pytest.raises(VdgsError, match="2048 m from the origin"):
            registry.write_scene(tmp_path / "a.spz", ExportScene.of(far))
    far.means[2, 1] = -2047.9
    registry.write_scene(tmp_path / "a.spz", ExportScene.of(far))
    torch.testing.assert_close(registry.read_gaussians(tmp_path / "a.spz").means, far.means, atol=2e-4, rtol=0)


def test_wide_tiles_give_up_bits_after_the_point(tmp_path):
    wide = random_gaussians(50, 1, reach=9000.0)
    (tmp_path / "a.spz").write_bytes(spz.encode_spz(wide, 2))
    torch.testing.assert_close(independent(tmp_path / "a.spz").means, wide.means, atol=1 / 512 + 1e-3, rtol=0)


def test_what_bytes_cannot_hold_is_counted(tmp_path):
    bright = random_gaussians(10, 0)
    bright.sh0[0] = 9.0
    bright.sh0[1:3, 2] = 9.0
    bright.log_scales[4, 1] = 7.0
    bright.log_scales[5:7, 2] = -14.0
    *_, cut = registry.write_scene(tmp_path / "a.splat", ExportScene.of(bright))
    assert cut.startswith("3 of 10 colors lay outside of 0 .. 1")
    notes = registry.write_scene(tmp_path / "a.spz", ExportScene.of(bright))
    assert notes[1:] == (
        "1 of 10 Gaussians are larger than 377 units and were cut to that",
        "2 of 10 Gaussians are thinner than 0.00005 units and became as thick as that, which nobody sees",
        "3 of 10 colors lay far outside of 0 .. 1 and were cut off",
    )


@pytest.mark.parametrize("name", [each.suffix if each.folder else f"a{each.suffix}" for each in registry.FORMATS])
def test_a_file_that_loses_digits_says_so(name, tmp_path):
    """Of any scene; those that hold float32 alone have nothing to say. What is coded alike is said alike."""
    lost = registry.write_scene(tmp_path / name, ExportScene.of(random_gaussians(20, 0), PLACED))
    if name in ("a.ply", "a.glb", "a.points.ply"):
        assert not any("rounded" in note for note in lost)
    else:
        assert any("rounded" in note for note in lost)
    if name in ("a.spz", "tileset.json"):
        assert lost[0] == "positions are rounded to 0.24 mm, colors and shapes to bytes"


@pytest.mark.parametrize("name", [each.suffix if each.folder else f"a{each.suffix}" for each in registry.FORMATS])
def test_numbers_that_are_none_leave_no_file(tmp_path, name):
    (tmp_path / name).write_text("before")
    broken = random_gaussians(20, 1)
    broken.opacity_logits[13] = float("nan")
    with pytest.raises(VdgsError, match="Gaussian 13: its opacity logits are not finite"):
        registry.write_scene(tmp_path / name, ExportScene(chunks=iter([broken]), count=20, degree=1))
    assert [each.name for each in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "before"


@pytest.mark.parametrize("name", [each.suffix if each.folder else f"a{each.suffix}" for each in registry.FORMATS])
def test_only_files_of_ours_may_be_written_over(tmp_path, name):
    """Those of an earlier export are known by what they say, or what lies beside them."""
    path = tmp_path / name
    for free in (None, b""):
        if free is not None:
            path.write_bytes(free)
        registry.check_not_foreign(path)
    path.write_bytes(b"ply\nformat ascii 1.0\ncomment of somebody else\n")
    with pytest.raises(VdgsError, match="is there already and was not written by vdgs"):
        registry.check_not_foreign(path)
    path.unlink()
    registry.write_scene(path, ExportScene.of(random_gaussians(20, 1)))
    registry.check_not_foreign(path)


@pytest.mark.parametrize("name", ["a.spz", "a.splat", "a.sog", "a.rad", "a.laz", "a.las", "lod-meta.json"])
def test_facts_of_others_beside_a_file_stay(tmp_path, name):
    beside = metadata_path(tmp_path / name)
    beside.write_text('{"mine": 1}')
    with pytest.raises(VdgsError, match=rf"{re.escape(beside.name)}: is there already and was not written by vdgs"):
        registry.check_not_foreign(tmp_path / name)


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.points.ply"])
def test_a_coordinate_system_beside_a_ply_is_ours_where_the_ply_is(tmp_path, name):
    path, beside = tmp_path / name, tmp_path / f"{name}.prj"
    beside.write_text("PROJCS[mine]")
    with pytest.raises(VdgsError, match=r"\.prj: is there already and was not written by vdgs"):
        registry.check_not_foreign(path)
    beside.unlink()
    registry.write_scene(path, ExportScene.of(random_gaussians(20, 1), PLACED))
    assert beside.is_file()
    registry.check_not_foreign(path)


@pytest.mark.parametrize("code", ["EPSG:32611", "EPSG:32633+5773"])
def test_a_coordinate_system_of_a_ply_that_was_deleted_is_still_ours(tmp_path, code):
    pyproj = pytest.importorskip("pyproj")
    crs, path, beside = pyproj.CRS.from_user_input(code), tmp_path / "a.ply", tmp_path / "a.ply.prj"
    registry.write_scene(path, ExportScene.of(random_gaussians(20, 1), replace(PLACED, crs=crs.to_wkt())))
    path.unlink()
    registry.check_not_foreign(path)
    for theirs in ("WKT1_ESRI", "WKT1_GDAL"):
        beside.write_text(crs.to_wkt(theirs) + "\n")
        with pytest.raises(VdgsError, match=r"\.prj: is there already and was not written by vdgs"):
            registry.check_not_foreign(path)


def test_scenes_that_are_not_what_they_announce_are_refused(tmp_path):
    some = random_gaussians(20, 1)
    with pytest.raises(ValueError, match="21 Gaussians were announced, 20 came"):
        registry.write_scene(tmp_path / "a.ply", ExportScene(chunks=[some], count=21, degree=1))
    with pytest.raises(ValueError, match="degree 1, announced was 3"):
        registry.write_scene(tmp_path / "a.ply", ExportScene(chunks=[some], count=20, degree=3))
    with pytest.raises(VdgsError, match="no Gaussians"):
        registry.write_scene(tmp_path / "a.ply", ExportScene(chunks=[], count=0, degree=3))
    assert list(tmp_path.iterdir()) == []


def test_endings_choose_formats(tmp_path):
    endings = [
        registry.format_from_path(Path(name)).suffix for name in ("a.ply", "B.PLY", "a.points.ply", "x/tileset.json")
    ]
    assert endings == [".ply", ".ply", ".points.ply", "tileset.json"]
    for name in ("a.obj", "a", "mytileset.json", ".ply"):
        with pytest.raises(VdgsError, match=r"no format is known.*\.ply \(3DGS PLY.*tileset\.json"):
            registry.format_from_path(Path(name))
    with pytest.raises(VdgsError, match=r"written but not read.*\.ply, \.spz, \.splat"):
        registry.read_gaussians(tmp_path / "a.glb")
    (tmp_path / "a.ply").mkdir()
    with pytest.raises(VdgsError, match="is a folder"):
        registry.check_export(tmp_path / "a.ply", ExportScene(chunks=[], count=1, degree=0))


@pytest.mark.parametrize("ending", [".ply", ".spz", ".splat"])
@pytest.mark.parametrize("what", ["missing", "cut", "other"])
def test_damaged_files_are_named(tmp_path, ending, what):
    path = tmp_path / f"a{ending}"
    if what != "missing":
        registry.write_scene(path, ExportScene.of(random_gaussians(30, 1)))
        path.write_bytes(path.read_bytes()[:-5] if what == "cut" else b"something else")
    with pytest.raises(VdgsError, match=re.escape(str(path))):
        registry.read_gaussians(path)


def test_point_clouds_and_text_are_no_scenes(tmp_path):
    registry.write_scene(tmp_path / "a.points.ply", ExportScene.of(random_gaussians(3, 0)))
    with pytest.raises(VdgsError, match="no PLY of 3DGS"):
        list(read_ply_chunks(tmp_path / "a.points.ply"))


def test_a_stream_that_is_packed_in_parallel_is_one_gzip_member():
    rng = np.random.default_rng(0)
    parts = [rng.integers(0, 9, size, dtype=np.uint8).tobytes() for size in (0, 5, 3 << 20, 1, 1 << 20)]
    unpacker = zlib.decompressobj(31)
    assert unpacker.decompress(b"".join(gzip_blocks(parts))) == b"".join(parts)
    assert unpacker.eof
    assert unpacker.unused_data == b""


def test_a_glb_beyond_4_gib_is_refused_before_work(tmp_path):
    with pytest.raises(VdgsError, match=r"GiB as glTF, and a GLB holds 4 GiB.*tileset\.json"):
        registry.check_export(tmp_path / "a.glb", ExportScene(chunks=[], count=20_000_000, degree=3))


def test_more_than_every_reader_of_spz_opens_is_said(tmp_path, monkeypatch):
    some = random_gaussians(50, 0)
    monkeypatch.setattr(spz, "MAX_READABLE_POINTS", 50)
    assert registry.write_scene(tmp_path / "a.spz", ExportScene.of(some)) == (spz.ROUNDING_NOTE,)
    monkeypatch.setattr(spz, "MAX_READABLE_POINTS", 49)
    *_, note = registry.write_scene(tmp_path / "a.spz", ExportScene.of(some))
    assert "--max-gaussians 49" in note
    assert "tileset.json" in note


def test_pictures_would_tell_a_wrong_turn(tmp_path):
    """So the tests above can fail."""
    some = random_gaussians(300, 3)
    assert psnr(picture(turned(some, Y_UP.turn), overhead()), picture(some)) < 25
    assert psnr(picture(flat(some)), picture(some)) < 30
