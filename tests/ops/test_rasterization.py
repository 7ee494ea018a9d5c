"""`vdgs.ops.rasterization`: gsplat's signature, its own strategies and its torch projection; the twin; differences."""

from __future__ import annotations

import inspect
import math

import numpy as np
import pytest
import torch

from support.fake_gsplat import needs_gsplat
from vdgs import ops
from vdgs.errors import UnsupportedOption, VdgsError

WIDTH, HEIGHT = 48, 32


@pytest.fixture
def twin(monkeypatch):
    """The readable implementation, which also computes in float64."""
    monkeypatch.setenv("VDGS_KERNELS", "torch_ref")


def scene(n: int = 60, cameras: int = 2, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    random = torch.Generator().manual_seed(n)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=random, dtype=torch.float64)

    viewmats = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    viewmats[:, 2, 3] = 4.0 + torch.arange(cameras)
    if cameras > 1:
        viewmats[1, :3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -0.2, 0.1], [0.2, 0, -0.3], [-0.1, 0.3, 0]]))
    K = torch.tensor([[40.0, 0, WIDTH / 2], [0, 44.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    found = {
        "means": 3 * draw(n, 3) - 1.5, "quats": 2 * draw(n, 4) - 1, "scales": 0.02 + 0.3 * draw(n, 3),
        "opacities": 0.05 + 0.9 * draw(n), "colors": draw(n, 3), "viewmats": viewmats,
        "Ks": K.repeat(cameras, 1, 1), "backgrounds": draw(cameras, 3),
    }  # fmt: skip
    return {name: tensor.to(dtype) for name, tensor in found.items()}


def draw(given, **options):
    return ops.rasterization(**given, width=WIDTH, height=HEIGHT, **options)


def with_gradients(given, skip=("Ks",)):
    return {name: each if name in skip else each.clone().requires_grad_(True) for name, each in given.items()}


@needs_gsplat
def test_it_has_the_signature_of_gsplat():
    import gsplat

    theirs, ours = (inspect.signature(each).parameters for each in (gsplat.rasterization, ops.rasterization))
    assert list(ours) == list(theirs)
    for name in set(theirs) - {"rolling_shutter"}:
        assert ours[name].default == theirs[name].default, name
    given = scene()
    assert torch.equal(draw(given, rolling_shutter=theirs["rolling_shutter"].default)[0], draw(given)[0])


@needs_gsplat
@pytest.mark.parametrize("model", ["pinhole", "ortho"])
@pytest.mark.parametrize("eps2d", [0.3, 0.1])
def test_it_projects_as_gsplat_does(model, eps2d):
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    given = scene(200)
    covars, _ = _quat_scale_to_covar_preci(given["quats"], given["scales"], compute_preci=False)
    radii, means2d, depths, conics, compensations = _fully_fused_projection(
        given["means"], covars, given["viewmats"], given["Ks"], WIDTH, HEIGHT, eps2d=eps2d, calc_compensations=True,
        camera_model=model,
    )  # fmt: skip
    given["opacities"] = torch.ones(200)  # their torch code has no bound by opacity
    options = {"camera_model": model, "eps2d": eps2d, "packed": False, "rasterize_mode": "antialiased"}
    _, _, meta = draw(given, **options)
    shown = (meta["radii"] > 0).all(-1)
    # Opaque Gaussians that antialiasing makes faint have smaller radii.
    assert bool(((radii > 0).all(-1) | ~shown).all())
    assert shown.float().mean() > 0.5
    for name, theirs in (("means2d", means2d), ("depths", depths), ("conics", conics), ("opacities", compensations)):
        torch.testing.assert_close(meta[name][shown], theirs[shown], rtol=2e-4, atol=2e-5, msg=name)
    _, _, classic = draw(given, camera_model=model, eps2d=eps2d, packed=False)
    both = (classic["radii"] > 0) & (radii > 0)  # one that reaches the edge by a rounding is drawn by either, or not
    assert float((both != (radii > 0)).float().mean()) < 0.01
    assert float((classic["radii"] - radii)[both].abs().max()) <= 1  # 3.33 sigma against the root of 2 ln 255
    _, _, by_covars = draw(given | {"covars": covars, "quats": None, "scales": None}, **options)
    for name in ("means2d", "conics", "opacities"):
        torch.testing.assert_close(by_covars[name][shown], meta[name][shown], rtol=2e-3, atol=2e-4)


@pytest.mark.usefixtures("twin")
@pytest.mark.parametrize(
    "options",
    [{}, {"packed": False, "render_mode": "RGB+ED"}, {"render_mode": "D"}, {"rasterize_mode": "antialiased"},
     {"eps2d": 0.7, "camera_model": "ortho"}],
    ids=str,
)  # fmt: skip
def test_gradients_equal_finite_differences(options):
    check_gradients(wide_scene(), **options)


@pytest.mark.usefixtures("twin")
def test_gradients_of_covariances_and_of_harmonics_equal_finite_differences():
    given = wide_scene()
    axes = given["scales"].diag_embed() + 0.1 * torch.tensor([[0.0, 1, 2], [1, 0, 1], [2, 1, 0]])
    covars = given | {"covars": axes @ axes.mT}
    del covars["quats"], covars["scales"]
    check_gradients(covars)
    coefficients = 0.2 * torch.randn(2, 9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    check_gradients(given | {"colors": coefficients}, sh_degree=2)


def wide_scene():
    """Two Gaussians that every pixel shows: no bound of the picture cuts through a difference."""
    given = scene(2, 1, torch.float64)
    given["scales"] = given["scales"] + 2.0
    given["opacities"] = 0.3 + 0.3 * given["opacities"]
    return given


def check_gradients(given, **options):
    names = [name for name in given if name != "Ks"]
    weights = torch.rand(1, 4, 5, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(*tensors):
        sized = given | dict(zip(names, tensors, strict=True))
        sized = {k: v for k, v in sized.items() if v is not None}
        K = sized["Ks"].clone()
        K[:, 0, 2], K[:, 1, 2] = 2.5, 2.0
        shown = {"quats": None, "scales": None} | sized | {"Ks": K}
        picture, alpha, _ = ops.rasterization(**shown, width=5, height=4, **options)
        return (torch.cat([picture, alpha], -1) * weights[..., : picture.shape[-1] + 1]).sum()

    leaves = tuple(given[name].clone().requires_grad_(True) for name in names)
    # Of the other options in one direction of everything at once.
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-6, rtol=1e-4, fast_mode=bool(options))


@pytest.mark.parametrize(
    "options",
    [{"packed": True, "render_mode": "RGB+D"}, {"packed": False, "rasterize_mode": "antialiased"},
     {"camera_model": "ortho"}],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("poses", [True, False], ids=["poses move", "poses stand"])
def test_native_equals_twin_with_gradients(options, poses, monkeypatch):
    found = []
    for name in ("cpu", "torch_ref"):
        monkeypatch.setenv("VDGS_KERNELS", name)
        given = with_gradients(scene(), skip=("Ks",) if poses else ("Ks", "viewmats"))
        picture, alpha, meta = draw(given, **options)
        meta["means2d"].retain_grad()
        (picture.square().mean() + (alpha * torch.linspace(0, 1, WIDTH)[:, None]).mean()).backward()
        moved = {name: each.grad for name, each in given.items() if each.requires_grad}
        found.append({"picture": picture.detach(), "alpha": alpha.detach(), "means2d": meta["means2d"].grad, **moved})
    native, readable = found
    assert len(native) == (10 if poses else 9)
    for name, value in native.items():
        scale = float(readable[name].abs().max())
        assert scale > 0, name
        torch.testing.assert_close(value, readable[name], rtol=1e-3, atol=1e-4 * scale, msg=name)


def test_a_pose_that_may_move_changes_no_picture():
    still = scene(200)
    moving = still | {"viewmats": still["viewmats"].clone().requires_grad_(True)}
    apart = (draw(moving)[0].detach() - draw(still)[0]).abs()
    # Two ways of rounding may fall on either side of 1/255, from which on a splat is drawn.
    assert float(apart.max()) < 1 / 255
    assert float(apart.mean()) < 1e-5


@pytest.mark.parametrize("change", ["scaled", "sheared", "mirrored"])
def test_poses_that_are_no_rigid_motions_are_drawn_as_they_say(change):
    """gsplat takes them, and so does the way for poses that move."""
    given = scene(200, cameras=1)
    pose = given["viewmats"]
    pose[0, :3, 3] += torch.tensor([0.3, -0.2, 0.5])
    if change == "scaled":
        pose[0, :3] *= 2
    elif change == "sheared":
        pose[0, 0, 1] += 0.01
    else:
        pose[0, 1] *= -1
    still, moving = draw(given), draw(given | {"viewmats": pose.clone().requires_grad_(True)})
    assert torch.equal(still[0], moving[0].detach())
    local = given["means"] @ pose[0, :3, :3].T + pose[0, :3, 3]
    wanted = (local @ given["Ks"][0].T)[:, :2] / local[:, 2:]
    torch.testing.assert_close(still[2]["means2d"], wanted[still[2]["gaussian_ids"]], rtol=1e-4, atol=1e-3)


def test_packed_rows_are_those_that_are_drawn():
    found = {}
    for packed in (True, False):
        given = with_gradients(scene(300) | {"means": 2 * scene(300)["means"]})
        picture, _, meta = draw(given, packed=packed)
        meta["means2d"].retain_grad()
        picture.square().mean().backward()
        found[packed] = picture, meta, given
    (picture, rows, given), (same, every, twice) = found[True], found[False]
    assert torch.equal(picture, same)
    at = rows["camera_ids"], rows["gaussian_ids"]
    assert set(rows["batch_ids"].tolist()) == {0}
    shown = torch.zeros(2, 300, dtype=torch.bool)
    shown[at] = True
    assert 0 < int(shown.sum()) < 600
    assert torch.equal(shown, (every["radii"] > 0).all(-1))
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        assert torch.equal(rows[name], every[name][at]), name
    assert torch.equal(rows["means2d"].grad, every["means2d"].grad[at])
    torch.testing.assert_close(given["means"].grad, twice["means"].grad)
    assert (every["width"], every["height"], every["n_cameras"], every["tile_width"]) == (WIDTH, HEIGHT, 2, 3)


def test_depths_and_features_are_drawn_with_the_colors():
    given = scene()
    both, alpha, _ = draw(given, render_mode="RGB+D")
    assert torch.equal(both[..., :3], draw(given)[0])
    depth = draw(given, render_mode="D")[0]
    assert torch.equal(both[..., 3:], depth)
    expected = depth / alpha.clamp(min=1e-10)
    assert torch.equal(draw(given, render_mode="ED")[0], expected)
    assert torch.equal(draw(given, render_mode="RGB+ED")[0][..., 3:], expected)
    features = torch.rand(2, 60, 8, generator=torch.Generator().manual_seed(0))  # of each camera
    many = given | {"colors": features, "backgrounds": torch.ones(2, 8)}
    drawn = draw(many)[0]
    assert drawn.shape == (2, HEIGHT, WIDTH, 8)
    for first in (0, 5):
        few = given | {"colors": features[..., first : first + 3], "backgrounds": torch.ones(2, 3)}
        torch.testing.assert_close(drawn[..., first : first + 3], draw(few)[0], rtol=0, atol=1e-6)
    # A color that is the depth makes the depth.
    _, _, meta = draw(given, packed=False)
    as_color = given | {"colors": meta["depths"][..., None].expand(2, 60, 3), "backgrounds": torch.zeros(2, 3)}
    torch.testing.assert_close(draw(as_color)[0][..., :1], depth, rtol=1e-5, atol=1e-5)


def test_batches_are_drawn_one_by_one():
    one, other = scene(40), scene(40)
    other["means"] = other["means"] + 0.2
    stacked = {name: torch.stack([one[name], other[name]])[None] for name in one}
    picture, alpha, meta = draw(stacked, packed=False)
    assert picture.shape == (1, 2, 2, HEIGHT, WIDTH, 3)
    assert alpha.shape == (1, 2, 2, HEIGHT, WIDTH, 1)
    assert meta["means2d"].shape == (1, 2, 2, 40, 2)
    assert meta["n_batches"] == 2
    for index, each in enumerate((one, other)):
        assert torch.equal(picture[0, index], draw(each)[0])


def test_harmonics_of_a_lower_degree_are_those_without_the_rest():
    given = scene(cameras=1)
    coefficients = torch.randn(60, 16, 3, generator=torch.Generator().manual_seed(2)) * 0.3
    lower = draw(given | {"colors": coefficients}, sh_degree=1)[0]
    assert torch.equal(lower, draw(given | {"colors": coefficients[:, :4]}, sh_degree=1)[0])
    flat = given | {"colors": (0.5 + coefficients[:, 0] / math.sqrt(4 * math.pi)).clamp(min=0)}
    torch.testing.assert_close(draw(given | {"colors": coefficients}, sh_degree=0)[0], draw(flat)[0])


def test_arrays_go_in_and_come_out():
    given = scene()
    arrays = {name: each.double().numpy() for name, each in given.items()}
    picture, alpha, meta = draw(arrays)
    assert all(isinstance(each, np.ndarray) for each in (picture, alpha, meta["means2d"], meta["gaussian_ids"]))
    np.testing.assert_array_equal(picture, draw(given)[0].numpy())


def test_what_is_far_small_or_beside_the_picture_is_left_out():
    given = scene(300)
    assert len(draw(given, near_plane=4.0)[2]["depths"]) < len(draw(given)[2]["depths"])
    assert float(draw(given, near_plane=4.0)[2]["depths"].min()) > 4
    assert float(draw(given, far_plane=4.0)[2]["depths"].max()) < 4
    small = draw(given, radius_clip=5.0)[2]["radii"]
    assert int(small.amax(-1).min()) > 5
    empty = given | {"means": given["means"] + 1000}
    picture, alpha, meta = draw(empty)
    assert len(meta["radii"]) == 0
    assert not alpha.any()
    assert torch.equal(picture, given["backgrounds"][:, None, None].expand_as(picture))


WRONG = {
    "quats must be [60, 4]": {"quats": torch.zeros(60, 3)},
    "opacities must be [60]": {"opacities": torch.zeros(60, 1)},
    "viewmats must be [2, 4, 4]": {"viewmats": torch.zeros(2, 3, 4)},
    "backgrounds must be [2, 3]": {"backgrounds": torch.zeros(3)},
    "give quats and scales, or covars": {"quats": None},
    "sh_degree=2 needs 9 bases, not 4": {"colors": torch.zeros(60, 4, 3), "sh_degree": 2},
}


@pytest.mark.parametrize("said", WRONG)
def test_other_shapes_are_refused(said):
    with pytest.raises(ValueError, match="^" + said.replace("[", r"\[").replace("]", r"\]")):
        draw(scene() | WRONG[said])


@pytest.mark.parametrize(
    "option",
    [{"absgrad": True}, {"sparse_grad": True}, {"distributed": True}, {"camera_model": "fisheye"}, {"with_ut": True},
     {"radial_coeffs": torch.zeros(2, 6)}, {"rolling_shutter": "ROLLING_TOP_TO_BOTTOM"}, {"render_mode": "rgb"},
     {"viewmats_rs": torch.eye(4)}, {"sh_degree": 4}],
    ids=lambda option: next(iter(option)),
)  # fmt: skip
def test_what_gsplat_has_and_this_has_not_is_said(option):
    given = scene() | ({"colors": torch.zeros(60, 25, 3)} if "sh_degree" in option else {})
    with pytest.raises(UnsupportedOption, match=next(iter(option))):
        draw(given, **option)


def test_double_precision_is_refused():
    with pytest.raises(TypeError, match=r"convert it with \.float"):
        draw(scene(dtype=torch.float64))
    with pytest.raises(TypeError, match=r"convert it with \.astype\(np\.float32\)"):
        draw(scene() | {"means": np.zeros((60, 3), np.float16)})


def test_what_is_no_tensor_is_named():
    given = scene()
    for name in ("means", "opacities", "colors", "viewmats", "Ks"):
        with pytest.raises(TypeError, match=rf"^{name} must be torch.Tensor or numpy.ndarray, not NoneType"):
            draw(given | {name: None})
    with pytest.raises(TypeError, match=r"^viewmats must be torch.Tensor or numpy.ndarray, not list"):
        draw(given | {"viewmats": given["viewmats"].tolist()})
    with pytest.raises(TypeError, match=r"^means must hold numbers"):
        draw(given | {"means": np.full((60, 3), None)})


def test_cameras_that_would_be_misread_are_named():
    given = scene()
    second = torch.arange(len(given["Ks"]))[:, None, None] == 1
    for name, wrong, message in (
        ("Ks", given["Ks"].masked_fill(second, torch.inf), "^Ks hold what is no finite number"),
        ("viewmats", given["viewmats"].masked_fill(second, torch.nan), "^viewmats hold what is no finite number"),
        ("Ks", given["Ks"].transpose(-1, -2), "^Ks have their translation in the last row: transpose them"),
        ("viewmats", given["viewmats"].transpose(-1, -2), "^viewmats have their translation in the last row"),
        ("Ks", given["Ks"] * torch.nan, "^Ks hold what is no finite number"),
        ("viewmats", given["viewmats"] / 0, "^viewmats hold what is no finite number"),
    ):
        with pytest.raises(ValueError, match=message):
            draw(given | {name: wrong.contiguous()})


@pytest.mark.parametrize("kernels", ["native", "twin"])
def test_gaussians_with_numbers_that_are_not_finite_are_left_out(kernels, request):
    if kernels == "twin":
        request.getfixturevalue("twin")
    given = {name: each for name, each in scene(cameras=1).items() if name != "backgrounds"}
    shown = draw(given)[2]["gaussian_ids"]
    rows = torch.arange(len(given["means"])) != shown[0]
    per_gaussian = ("means", "quats", "scales", "opacities", "colors")
    without = draw(given | {name: given[name][rows] for name in per_gaussian}, render_mode="RGB+ED")[0]
    assert not torch.equal(without, draw(given, render_mode="RGB+ED")[0])
    for name in per_gaussian:
        for value in (torch.nan, torch.inf):
            wrong = given[name].clone()
            wrong[shown[0]] = value
            assert torch.equal(draw(given | {name: wrong}, render_mode="RGB+ED")[0], without), (name, value)


@pytest.mark.parametrize("name", ["width", "height", "tile_size", "sh_degree"])
@pytest.mark.parametrize("value", ["44", 4.5, -1])
def test_numbers_that_are_not_whole_are_named(name, value):
    with pytest.raises(VdgsError, match=f"^{name} is '?{value}'?; it must be"):
        ops.rasterization(**scene(), **({"width": WIDTH, "height": HEIGHT} | {name: value}))


@pytest.mark.parametrize("name", ["near_plane", "far_plane", "radius_clip", "eps2d"])
def test_numbers_that_bound_nothing_are_named(name):
    for wrong in (float("nan"), "1", None, *([-1.0] if name in ("radius_clip", "eps2d") else [])):
        with pytest.raises(VdgsError, match=f"^{name} is '?{wrong}'?; it must be"):
            draw(scene(), **{name: wrong})
    assert torch.equal(draw(scene(), far_plane=float("inf"), radius_clip=torch.tensor(0))[0], draw(scene())[0])


def test_sizes_may_be_whole_numbers_of_any_kind():
    given = scene()
    for width in (float(WIDTH), np.int64(WIDTH), torch.tensor(WIDTH)):
        picture, _, meta = ops.rasterization(**given, width=width, height=HEIGHT)
        assert torch.equal(picture, draw(given)[0])
        assert type(meta["width"]) is int


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("mode", ["RGB", "ED", "RGB+D"])
def test_nothing_is_drawn_as_nothing(packed, mode):
    """A map before its first Gaussian, one whose Gaussians were all removed, no camera, no batch, no channel."""
    given, options = scene(), {"packed": packed, "render_mode": mode}
    channels = {"RGB": 3, "ED": 1, "RGB+D": 4}[mode]
    empty = {name: each if name in ("viewmats", "Ks", "backgrounds") else each[:0] for name, each in given.items()}
    moved = with_gradients(empty)
    picture, alpha, meta = draw(moved, **options)
    assert (picture.shape, alpha.shape) == ((2, HEIGHT, WIDTH, channels), (2, HEIGHT, WIDTH, 1))
    assert not alpha.any()
    if mode != "ED":
        assert torch.equal(picture[..., :3], given["backgrounds"][:, None, None].expand(2, HEIGHT, WIDTH, 3))
        picture.sum().backward()
        assert moved["backgrounds"].grad.tolist() == [[WIDTH * HEIGHT] * 3] * 2
        assert moved["means"].grad.shape == (0, 3)
    assert meta["means2d"].shape == ((0, 2) if packed else (2, 0, 2))
    views = {name: each[:0] if name in ("viewmats", "Ks", "backgrounds") else each for name, each in given.items()}
    for of, shape, of_meta in (
        (views, (0,), (0, 60, 3)),
        ({name: each[None][:0] for name, each in given.items()}, (0, 2), (0, 2, 60, 3)),
    ):
        picture, alpha, meta = draw(of, **options)
        assert picture.shape == (*shape, HEIGHT, WIDTH, channels)
        assert alpha.shape == (*shape, HEIGHT, WIDTH, 1)
        assert meta["conics"].shape == ((0, 3) if packed else of_meta)
        assert meta["radii"].dtype == torch.int32
    bare = given | {"colors": given["colors"][:, :0], "backgrounds": given["backgrounds"][:, :0]}
    picture, alpha, _ = draw(bare, **options)
    assert picture.shape == (2, HEIGHT, WIDTH, channels - 3 if mode != "ED" else 1)
    assert torch.equal(alpha, draw(given, **options)[1])


@pytest.mark.parametrize("options", [{}, {"rasterize_mode": "antialiased"}, {"eps2d": 0.1}, {"sh_degree": 1}])
def test_autocast_changes_nothing(options):
    given = scene()
    if "sh_degree" in options:
        given["colors"] = given["colors"][:, None].repeat(1, 4, 1)
    results = []
    for enabled in (False, True):
        moved = with_gradients(given)
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            picture = draw(moved, **options)[0]
        picture.square().sum().backward()
        results.append([picture, *(each.grad for each in moved.values() if each.grad is not None)])
    assert len(results[0]) == len(given)
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_depths_have_no_background_whatever_is_given(mode):
    given = scene()
    wanted = draw(given | {"backgrounds": None}, render_mode=mode)[0]
    for channels in (1, 3, 7):
        assert torch.equal(draw(given | {"backgrounds": torch.ones(2, channels)}, render_mode=mode)[0], wanted)


@needs_gsplat
@pytest.mark.parametrize("packed", [True, False])
def test_gsplats_own_strategy_densifies_by_it(packed):
    from gsplat import DefaultStrategy

    strategy = DefaultStrategy(refine_start_iter=0, refine_every=5, grow_grad2d=1e-6, refine_scale2d_stop_iter=100)
    given = scene()
    params = torch.nn.ParameterDict(
        {"means": given["means"], "quats": given["quats"], "scales": given["scales"].log(),
         "opacities": given["opacities"].logit(), "colors": given["colors"]}
    )  # fmt: skip
    optimizers = {name: torch.optim.Adam([each], 0.01) for name, each in params.items()}
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    for step in range(1, 8):
        shown = {"scales": params["scales"].exp(), "opacities": params["opacities"].sigmoid()}
        shown |= {name: params[name] for name in ("means", "quats", "colors")}
        picture, _, meta = draw(given | shown, packed=packed)
        strategy.step_pre_backward(params, optimizers, state, step, meta)
        picture.square().mean().backward()
        strategy.step_post_backward(params, optimizers, state, step, meta, packed=packed)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
    assert len(params["means"]) > 60


def test_an_image_is_fitted_by_the_loop_of_gsplats_example():
    """Random Gaussians before a camera, Adam, the squared error: as examples/image_fitting.py of gsplat does."""
    random = torch.Generator().manual_seed(0)
    side, count = 32, 300
    target = torch.ones(side, side, 3)
    target[: side // 2, : side // 2] = torch.tensor([1.0, 0.0, 0.0])
    target[side // 2 :, side // 2 :] = torch.tensor([0.0, 0.0, 1.0])
    means = 2 * (torch.rand(count, 3, generator=random) - 0.5) * 2
    scales = 0.3 * torch.rand(count, 3, generator=random)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=-1)
    rgbs, opacities = torch.rand(count, 3, generator=random), torch.ones(count)
    trained = [each.requires_grad_(True) for each in (rgbs, means, scales, opacities, quats)]
    viewmat = torch.eye(4)
    viewmat[2, 3] = 8.0
    focal = 0.5 * side / math.tan(0.25 * math.pi)
    K = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    optimizer, losses = torch.optim.Adam(trained, 0.03), []
    for _ in range(120):
        renders = ops.rasterization(
            means, quats / quats.norm(dim=-1, keepdim=True), scales, opacities.sigmoid(), rgbs.sigmoid(),
            viewmat[None], K[None], side, side, packed=False,
        )[0]  # fmt: skip
        loss = torch.nn.functional.mse_loss(renders[0], target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
