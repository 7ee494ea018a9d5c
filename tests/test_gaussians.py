"""3DGS as a comparator: its colours, its control of density, its training, its files."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from captures_support import tiny_scene, write_colmap
from checkerboard import Photographs
from vdgs.cameras import Camera
from vdgs.captures.loading import load_capture
from vdgs.captures.options import CaptureOptions
from vdgs.checkpoints import load_newest, save_state
from vdgs.comparators import gaussian_watching
from vdgs.comparators import gaussians as comparator
from vdgs.comparators.gaussian_density import DensityConfig, control_density, reset_logits, split
from vdgs.comparators.gaussian_model import (
    Gaussians,
    GaussiansModel,
    draw_gaussians,
    initial_gaussians,
    visible_rows,
)
from vdgs.comparators.gaussian_training import (
    GaussianRates,
    GaussiansConfig,
    GaussiansStage,
    degree_at,
    downscale_at,
    from_saved,
    rates_at,
    scene_extent,
    start_state,
    to_saved,
    train,
    train_step,
)
from vdgs.comparators.spherical_harmonics import basis, dc_of_colours, function_count, view_colours
from vdgs.errors import RunError, TrainingDiverged, VdgsError
from vdgs.evaluation.evaluate import EvaluationSettings
from vdgs.kernels.native.module import set_threads, threads
from vdgs.run import RunFolder, StageFolder
from vdgs.run_options import WatchOptions
from vdgs.stages.watching import Stopped

CONFIG = GaussiansConfig(
    iterations=80,
    resolutions=((0, 2), (20, 1)),
    degree_interval=25,
    density=DensityConfig(start=15, interval=10, until=0.75, dense=0.08, reset_interval=40),
)


# ------------------------------------------------------------------------------------- spherical harmonics


def quadrature() -> tuple[torch.Tensor, torch.Tensor]:
    """Unit directions and weights that integrate polynomials up to degree 6 over the sphere exactly."""
    z, weights = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    ring = np.sqrt(1 - z**2)
    directions = np.stack(
        [ring[:, None] * np.cos(angle), ring[:, None] * np.sin(angle), np.repeat(z[:, None], 16, 1)], -1
    )
    return torch.from_numpy(directions.reshape(-1, 3)), torch.from_numpy(np.repeat(weights * 2 * np.pi / 16, 16))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_functions_are_orthonormal(degree):
    directions, weights = quadrature()
    values = basis(directions, degree)
    torch.testing.assert_close((values * weights[:, None]).T @ values, torch.eye(function_count(degree)).double())


def test_the_functions_have_their_known_values():
    x, y, z = torch.eye(3, dtype=torch.float64)
    diagonal = (x + y) / math.sqrt(2)
    values = basis(torch.stack([x, y, z, diagonal]), 3)
    torch.testing.assert_close(values[:, 0], torch.full((4,), 0.28209479177387814).double())
    # (1,-1), (1,0), (1,1) look along -y, z, -x.
    torch.testing.assert_close(values[0, 1:4], -0.4886025119029199 * x.flip(0))
    torch.testing.assert_close(values[1, 1:4], torch.tensor([-0.4886025119029199, 0, 0]).double())
    torch.testing.assert_close(values[2, 1:4], torch.tensor([0, 0.4886025119029199, 0]).double())
    assert float(values[3, 4]) == pytest.approx(1.0925484305920792 / 2)  # xy
    assert float(values[2, 6]) == pytest.approx(0.31539156525252005 * 2)  # 3 z² - 1
    assert float(values[0, 9]) == pytest.approx(0)
    assert float(values[1, 9]) == pytest.approx(0.5900435899266435)  # y³, from -y (3 x² - y²)
    assert float(values[2, 12]) == pytest.approx(0.3731763325901154 * 2)  # z (5 z² - 3)
    assert float(values[0, 15]) == pytest.approx(-0.5900435899266435)  # -x³


def test_a_parity_belongs_to_each_band():
    directions, _ = quadrature()
    there, back = basis(directions, 3), basis(-directions, 3)
    for band in range(4):
        part = slice(band**2, (band + 1) ** 2)
        torch.testing.assert_close(back[:, part], (-1) ** band * there[:, part])


def test_colours_follow_the_viewing_direction():
    dc = dc_of_colours(torch.tensor([[0.2, 0.5, 0.9]]))
    rest = torch.zeros(1, 15, 3)
    right = torch.tensor([[1.0, 0, 0]])
    torch.testing.assert_close(view_colours(dc, rest, right, 3), torch.tensor([[0.2, 0.5, 0.9]]))
    rest[0, 2, 0] = -1.0  # grows with x
    assert view_colours(dc, rest, right, 1)[0, 0] > 0.5 > view_colours(dc, rest, -right, 1)[0, 0]
    assert float(view_colours(dc, rest, -right, 1)[0, 0]) == 0.0  # not below black
    torch.testing.assert_close(view_colours(dc, rest, -right, 0), torch.tensor([[0.2, 0.5, 0.9]]))
    with pytest.raises(ValueError, match="further coefficients"):
        view_colours(dc, rest[:, :3], right, 2)
    with pytest.raises(ValueError, match="degree"):
        basis(right, 4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_have_the_gradients_of_finite_differences(degree):
    generator = torch.Generator().manual_seed(degree)

    def draw(*shape: int) -> torch.Tensor:
        return (0.1 * torch.randn(*shape, generator=generator, dtype=torch.float64)).requires_grad_()

    dc, rest, towards = draw(5, 3), draw(5, function_count(degree) - 1, 3), draw(5, 3)

    def colours(dc, rest, towards):
        return view_colours(dc, rest, torch.nn.functional.normalize(towards, dim=-1), degree)

    assert torch.autograd.gradcheck(colours, (dc, rest, towards))


# ------------------------------------------------------------------------------------------ drawing


def some_gaussians(count: int = 40, seed: int = 0, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-4, 4, (count, 2)), rng.uniform(-0.2, 0.2, (count, 1))], axis=1)
    start = initial_gaussians(points, rng.integers(0, 255, (count, 3), dtype=np.uint8), 0.3, degree)
    noise = torch.from_numpy(rng.normal(0, 0.3, start.rest.shape).astype(np.float32))
    return replace(start, rest=noise, quaternions=torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32)))


@given(seed=st.integers(0, 10_000), size=st.floats(-3, 1.5))
@settings(max_examples=25, deadline=None)
def test_what_is_left_out_of_a_view_would_not_change_it(seed, size):
    everything = some_gaussians(seed=seed)
    everything = replace(
        everything, log_scales=everything.log_scales + size, logits=torch.full_like(everything.logits, 6.0)
    )
    camera = Photographs().camera(seed % 8)
    rows = visible_rows(everything, camera)
    whole, _ = draw_gaussians(everything, camera, torch.zeros(3), 1)
    part, _ = draw_gaussians(everything.select(rows), camera, torch.zeros(3), 1)
    torch.testing.assert_close(part.image, whole.image, rtol=0, atol=0)


def test_what_lies_behind_or_beside_the_camera_is_not_visible():
    camera = Photographs().camera(0)
    x, y, _ = camera.position
    points = np.array([[x, y, 0.0], [x, y, 9.0], [x + 50, y, 0.0]])
    placed = initial_gaussians(points, np.zeros((3, 3), np.uint8), 0.1, 0)
    placed = replace(placed, log_scales=torch.full((3, 3), -3.0))
    assert visible_rows(placed, camera).tolist() == [0]


def test_a_gaussian_shows_another_colour_from_another_side():
    rest = torch.zeros(1, 3, 3)
    rest[0, 2, 0] = -0.6
    shown = Gaussians(
        torch.zeros(1, 3), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1,), 5.0),
        torch.zeros(1, 3), rest,
    )  # fmt: skip
    reds = []
    for x in (-3.0, 3.0):
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = -pose[:3, :3] @ np.array([x, 0, 5.0])
        camera = Camera(pose, 20.0, 20.0, 16.0, 16.0, 32, 32)
        reds.append(float(GaussiansModel(shown, (0.0, 0.0, 0.0), {}).render(camera).image[..., 0].max()))
    assert reds[0] > reds[1] + 0.1  # seen from -x the viewing direction has a positive x


def test_gaussians_start_as_the_sparse_points_say():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    colours = np.array([[255, 0, 51]] * 4, np.uint8)
    start = initial_gaussians(points, colours, 0.1, 3)
    assert float(start.log_scales[0].exp().mean()) == pytest.approx((1 + 2 + 3) / 3)
    torch.testing.assert_close(start.logits.sigmoid(), torch.full((4,), 0.1))
    towards = torch.tensor([[0.0, 0, 1]]).expand(4, 3)
    shown = view_colours(start.dc, start.rest, towards, start.degree)
    torch.testing.assert_close(shown[0], torch.tensor([1.0, 0, 0.2]), atol=1e-6, rtol=0)
    twice = initial_gaussians(np.zeros((5, 3)), np.zeros((5, 3), np.uint8), 0.1, 0)
    assert torch.isfinite(twice.log_scales).all()
    with pytest.raises(VdgsError, match="at least 2"):
        initial_gaussians(points[:1], colours[:1], 0.1, 0)


# ------------------------------------------------------------------------------------- control of density


def four(logits: float = 2.0) -> Gaussians:
    """Two small and two large Gaussians; the extent of their scene is 10, so 0.1 divides small from large."""
    start = some_gaussians(4)
    sizes = torch.tensor([0.02, 0.05, 0.5, 0.8]).log()
    return replace(start, log_scales=sizes[:, None].repeat(1, 3), logits=torch.full((4,), logits))


def decide(gaussians: Gaussians, gradient: list[float], *, prune_large: bool = False, **changes):
    generator = torch.Generator().manual_seed(0)
    config = DensityConfig(**changes)
    return control_density(gaussians, torch.tensor(gradient), 10.0, config, generator, prune_large=prune_large)


def test_small_gaussians_are_cloned_and_large_ones_split():
    before = four()
    change = decide(before, [1e-3, 0.0, 2e-4, 1e-4])
    assert (change.cloned, change.split, change.pruned) == (1, 1, 0)
    assert change.kept.tolist() == [True, True, False, True, True, True, True]
    after = before.extended(change.added).select(change.kept)
    assert len(after) == 4 + 1 + 1
    for name, tensor in change.added.tensors().items():
        assert torch.equal(tensor[0], before.tensors()[name][0])  # the clone
    torch.testing.assert_close(change.added.log_scales[1:].exp(), torch.full((2, 3), 0.5 / 1.6))
    assert torch.equal(change.added.rest[1], before.rest[2])


def test_where_nothing_asks_nothing_changes():
    change = decide(four(), [1e-4] * 4)
    assert len(change.added) == 0
    assert bool(change.kept.all())


def test_faint_and_oversized_gaussians_go():
    faint = four()
    faint.logits[1] = math.log(0.004 / 0.996)
    change = decide(faint, [0.0] * 4)
    assert change.kept.tolist() == [True, False, True, True]
    assert change.pruned == 1
    huge = four()
    huge.log_scales[3, 1] = math.log(1.5)
    assert bool(decide(huge, [0.0] * 4).kept.all())
    assert decide(huge, [0.0] * 4, prune_large=True).kept.tolist() == [True, True, True, False]


def test_the_limit_serves_the_largest_gradients_first():
    change = decide(four(), [3e-4, 5e-4, 4e-4, 2e-4], max_gaussians=6)
    assert (change.cloned, change.split) == (1, 1)
    assert torch.equal(change.added.means[0], four().means[1])
    assert len(change.kept) == 7
    assert len(decide(four(), [1.0] * 4, max_gaussians=3).added) == 0


def test_the_parts_of_a_split_gaussian_are_spread_as_it_is():
    parent = replace(some_gaussians(1 + 1).select(torch.tensor([0])), log_scales=torch.tensor([[2.0, 0.5, 0.1]]).log())
    many = parent.select(torch.zeros(20_000, dtype=torch.int64))
    parts = split(many, 1.6, torch.Generator().manual_seed(3))
    first, second = (parts.means - parent.means).double().chunk(2)
    for offsets in (first, second):
        spread = torch.linalg.eigvalsh(offsets.T @ offsets / len(offsets))
        torch.testing.assert_close(spread.sqrt(), torch.tensor([0.1, 0.5, 2.0]).double(), rtol=0.03, atol=0)
        assert float(offsets.mean(0).norm()) < 0.05
    # A pair straddles its parent: drawn independently of each other, on average halfway between the two.
    assert abs(float((first * second).sum(1).mean())) < 0.1
    beyond = ((first * second).sum(1) < 0).double().mean()
    assert 0.45 < float(beyond) < 0.55


def test_a_reset_lowers_opacities_and_raises_none():
    logits = torch.tensor([5.0, 0.0, -4.0, -8.0])
    after = reset_logits(logits, 0.01).sigmoid()
    torch.testing.assert_close(after[:2], torch.full((2,), 0.01))
    torch.testing.assert_close(after[3], logits[3].sigmoid())
    assert bool((after <= 0.01 + 1e-6).all() | (after <= logits.sigmoid()).all())


# ---------------------------------------------------------------------------------------------- training


def stage(config: GaussiansConfig = CONFIG) -> GaussiansStage:
    return GaussiansStage(config, Photographs(), 8, scene_extent(Photographs().cameras))


def start(config: GaussiansConfig = CONFIG):
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-4, 4, (300, 2)), np.zeros((300, 1))], axis=1)
    grey = np.full((300, 3), 128, np.uint8)
    return start_state(initial_gaussians(points, grey, config.initial_opacity, config.degree))


def run(state, stage_, until: int | None = None):
    train(
        state, stage_,
        stop=lambda: until is not None and state.iteration >= until, after_step=lambda *_: None,
    )  # fmt: skip
    return state


def bits(state) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in to_saved(state).tensors.items()}


@pytest.fixture(scope="module")
def unbroken():
    return run(start(), stage())


def test_training_learns_the_place():
    longer = replace(
        CONFIG, iterations=400, density=replace(CONFIG.density, interval=50, until=0.5, reset_interval=1000)
    )
    state = run(start(longer), stage(longer))
    photographs, model = Photographs(), GaussiansModel(state.gaussians, (0.0, 0.0, 0.0), {})
    errors = []
    for index in range(8):
        picture = model.render(photographs.camera(index)).image
        errors.append(float(((picture - photographs.get(index)[0].float() / 255) ** 2).mean()))
    assert np.mean(errors) < 0.2 * float(torch.var(photographs.get(0)[0].float() / 255))
    assert len(state.gaussians) > 300


def test_a_stopped_and_continued_run_has_the_same_bits(unbroken, tmp_path):
    state = start()
    for stop_at in (1, 19, 20, 27, 40, 79):
        run(state, stage(), until=stop_at)
        assert state.iteration == stop_at
        save_state(tmp_path, to_saved(state))
        saved, _ = load_newest(tmp_path)
        assert saved is not None
        state = from_saved(saved)
    assert bits(run(state, stage())) == bits(unbroken)


def test_the_number_of_threads_changes_no_bit(unbroken):
    before = threads()
    try:
        set_threads(1 if before > 1 else 3)
        assert bits(run(start(), stage())) == bits(unbroken)
    finally:
        set_threads(before)


def test_another_seed_is_another_run():
    short = replace(CONFIG, iterations=10)
    other = replace(short, seed=1)
    assert bits(run(start(other), stage(other))) != bits(run(start(), stage(short)))


def test_growth_keeps_everything_aligned_and_resets_opacities(unbroken):
    assert len({tensor.shape[0] for tensor in to_saved(unbroken).tensors.values()}) == 1
    state, counts = start(), {}
    train(
        state, stage(), stop=lambda: False, after_step=lambda s, r: counts.update({s.iteration: (r, len(s.gaussians))})
    )
    decided = [iteration for iteration, (report, _) in counts.items() if report.cloned is not None]
    assert decided == [20, 30, 40, 50, 60]
    for iteration in decided:
        report, after = counts[iteration]
        assert after == counts[iteration - 1][1] + report.cloned + report.split - report.pruned
    assert counts[80][1] == counts[60][1]
    assert sum(report.cloned for report, _ in counts.values() if report.cloned) > 0
    assert sum(report.split for report, _ in counts.values() if report.split) > 0


def test_opacities_are_reset_with_their_moments():
    state = run(start(), stage(), until=39)
    assert float(state.gaussians.logits.sigmoid().max()) > 0.05
    train_step(state, stage())
    assert float(state.gaussians.logits.sigmoid().max()) <= 0.01 + 1e-6
    assert not state.moments.first["logits"].any()
    assert state.moments.first["means"].any()


def test_bands_of_colour_are_released_one_after_the_other():
    assert [degree_at(i, CONFIG) for i in (0, 24, 25, 50, 75, 79)] == [0, 0, 1, 2, 3, 3]
    state = run(start(), stage(), until=25)
    assert not state.gaussians.rest.any()
    run(state, stage(), until=50)
    assert state.gaussians.rest[:, :3].any()
    assert not state.gaussians.rest[:, 3:].any()


def test_the_schedules():
    assert [downscale_at(i, GaussiansConfig()) for i in (0, 249, 250, 499, 500, 9999)] == [4, 4, 2, 2, 1, 1]
    config = GaussiansConfig(iterations=100, rates=GaussianRates())
    assert rates_at(config, 3.0, 0)["means"] == pytest.approx(3 * 1.6e-4)
    assert rates_at(config, 3.0, 50)["means"] == pytest.approx(3 * 1.6e-5)
    assert rates_at(config, 3.0, 100)["means"] == pytest.approx(3 * 1.6e-6)
    assert rates_at(config, 3.0, 100)["dc"] == pytest.approx(20 * rates_at(config, 9.0, 0)["rest"])


def test_a_loss_that_is_not_a_number_stops_training():
    with pytest.raises(TrainingDiverged, match="iteration 1"):
        train_step(start(), replace(stage(), background=(float("nan"), 0.0, 0.0)))


# --------------------------------------------------------------------------------------- as people use it

SHORT = GaussiansConfig(iterations=60, resolutions=((0, 2), (30, 1)), density=replace(CONFIG.density, until=0.5))
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene())
    return load_capture(folder, CaptureOptions(up="z"))


@pytest.fixture(scope="module")
def trained(capture, tmp_path_factory):
    run_ = RunFolder(tmp_path_factory.mktemp("run"))
    result = comparator.run_gaussians(
        run_, capture, SHORT, QUIET, visibility_map=lambda camera: np.full((camera.height, camera.width), 3.0)
    )
    return SimpleNamespace(run=run_, result=result, folder=StageFolder(run_.path / "gaussians"))


def test_a_run_leaves_model_log_and_figures(trained):
    written = json.loads((trained.run.evaluation / "metrics.json").read_text())
    assert written == trained.result
    assert written["model"] == "3dgs"
    assert written["psnr"] > 12
    assert written["by_visibility"][0]["lower"] == written["by_visibility"][-1]["upper"] == 3.0
    model = GaussiansModel.load(trained.folder.model)
    assert written["n_gaussians"] == len(model.gaussians) == trained.folder.status()["gaussians"]
    lines = [json.loads(line) for line in trained.folder.log.read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [20, 30, 50]
    assert lines[-1]["loss"] < 0.7 * lines[0]["loss"]
    assert (trained.run.evaluation / "contact_sheet.png").exists()
    assert written["train_seconds"] > 0


def test_a_finished_run_is_only_read(trained, capture):
    before = trained.folder.model.stat().st_mtime_ns
    comparator.train_gaussians(capture, SHORT, trained.folder.path, QUIET)
    assert trained.folder.model.stat().st_mtime_ns == before


def test_a_stopped_run_continues_from_its_last_state(trained, capture, tmp_path, monkeypatch):
    def stopped(state, stage_, *, stop, after_step):
        return train(state, stage_, stop=lambda: state.iteration >= 37, after_step=after_step)

    monkeypatch.setattr(gaussian_watching, "train", stopped)
    with pytest.raises(Stopped, match="37"):
        comparator.train_gaussians(capture, SHORT, tmp_path, QUIET, options=WatchOptions(save_every=10))
    assert StageFolder(tmp_path).status()["state"] == "stopped"
    monkeypatch.undo()
    comparator.train_gaussians(capture, SHORT, tmp_path, QUIET)
    assert StageFolder(tmp_path).model.read_bytes() == trained.folder.model.read_bytes()


def test_other_settings_and_other_captures_are_refused(trained, capture, tmp_path):
    with pytest.raises(RunError, match="iterations: 60 -> 61"):
        comparator.train_gaussians(capture, replace(SHORT, iterations=61), trained.folder.path, QUIET)
    write_colmap(tmp_path, tiny_scene(seed=1))
    other = load_capture(tmp_path, CaptureOptions(up="z"))
    with pytest.raises(RunError, match="is not the capture"):
        comparator.train_gaussians(other, SHORT, trained.folder.path, QUIET)
    with pytest.raises(RunError, match="is not the capture"):
        comparator.evaluate_gaussians(GaussiansModel.load(trained.folder.model), other, tmp_path / "evaluation")


def test_the_background_is_black_or_that_of_the_photographs(trained, capture, tmp_path):
    assert GaussiansModel.load(trained.folder.model).background == (0.0, 0.0, 0.0)
    mean = replace(SHORT, iterations=1, background="mean")
    model = comparator.train_gaussians(capture, mean, tmp_path, QUIET)
    assert all(0.3 < value < 0.7 for value in model.background)
    away = Camera(np.diag([1.0, 1, 1, 1]), 20.0, 20.0, 4.0, 4.0, 8, 8)  # looks up from the ground
    moved = replace(model.gaussians, means=model.gaussians.means - torch.tensor([0.0, 0.0, 100.0]))
    nothing = replace(model, gaussians=moved).render(away).image
    torch.testing.assert_close(nothing, torch.tensor(model.background).expand(8, 8, 3))


def test_settings_that_do_not_work_are_named(capture, tmp_path):
    wrong = replace(SHORT, iterations=0, resolutions=((5, 1),), degree=4)
    with pytest.raises(VdgsError, match=r"(?s)iterations.*degree.*resolutions"):
        comparator.train_gaussians(capture, wrong, tmp_path / "run", QUIET)
    assert not (tmp_path / "run").exists()


def test_a_model_is_measured_without_its_folder(trained, capture, tmp_path):
    model = GaussiansModel.load(trained.folder.model)
    result = comparator.evaluate_gaussians(
        model, capture, tmp_path, settings=EvaluationSettings(comparisons=False, colour_correction=False)
    )
    assert result["psnr"] == pytest.approx(trained.result["psnr"])
    assert result["by_visibility"] is None


@pytest.mark.parametrize("damage", ["truncate", "text", "nan", "missing", "bits"])
def test_a_damaged_model_is_refused(trained, tmp_path, damage):
    path, model = tmp_path / "model.safetensors", GaussiansModel.load(trained.folder.model)
    if damage == "nan":
        model = replace(model, gaussians=replace(model.gaussians, means=model.gaussians.means * float("nan")))
    model.save(path)
    if damage == "truncate":
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "text":
        path.write_text("not a model")
    elif damage == "missing":
        path.unlink()
    elif damage == "bits":
        path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    with pytest.raises(VdgsError, match=r"model\.safetensors"):
        GaussiansModel.load(path)
