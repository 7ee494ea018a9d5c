"""The fused way from splats to moved anchors: the bits of autograd and Adam one after the other."""

from dataclasses import replace

import pytest
import torch

from support.decode_scenes import Scene, looking_down, turned
from support.instruction_sets import every_instruction_set, on_threads, using
from vdgs.kernels import cpu, torch_ref
from vdgs.kernels.kernel_types import AdamState, SplatGradients

CAMERA = turned(96, 64)
#: A few of the anchors, some of them neighbors.
ROWS = torch.tensor([row for row in range(700) if row % 7 in (0, 3, 4)])
RATES = (0.01, 0.02, 0.005)
#: How often each anchor has moved: some never, some so often that it no longer matters.
UPDATES = torch.tensor([(row * row * 7) % 997 * (1 if row % 5 else 30) for row in range(700)], dtype=torch.int32)


#: How much faster anchors move that have moved seldom.
EARLY = 4.0


def states_of(scene: Scene) -> list[AdamState]:
    """The scene's parameters after some steps of Adam; copies."""
    g = torch.Generator().manual_seed(9)
    return [
        AdamState(t.clone(), 0.1 * torch.randn(t.shape, generator=g), torch.rand(t.shape, generator=g), rate, EARLY)
        for t, rate in zip((scene.features, scene.offsets, scene.log_scales), RATES, strict=True)
    ]


def gradients_of(scene: Scene, rows: torch.Tensor = ROWS, depths: bool = False) -> SplatGradients:
    with torch.no_grad():
        splats = cpu.decode(*scene.arguments, CAMERA, rows)
    g = torch.Generator().manual_seed(8)
    parts = {name: torch.randn(getattr(splats, name).shape, generator=g)
             for name in ("means_px", "conics", "colors", "opacities")}  # fmt: skip
    of_depth = torch.randn(splats.depths.shape, generator=g) if depths else None
    return SplatGradients(
        **parts, volume=0.3, source=splats.source, color_values=splats.colors, opacity_values=splats.opacities,
        depths=of_depth,
    )  # fmt: skip


def fused(kernels, scene: Scene, gradients: SplatGradients, rows: torch.Tensor = ROWS):
    states, updates = states_of(scene), UPDATES[: len(scene.positions)].clone()
    weights = scene.weights.map(lambda t: t.clone().requires_grad_(True))
    finite, found = kernels.decode_backward_adam(scene.positions, states, weights, CAMERA, rows, gradients, updates)
    assert found is not None
    assert torch.equal(updates, counted(rows, len(updates))) or not finite
    return finite, [*(t for state in states for t in state[:3]), *found]


def counted(rows: torch.Tensor, n: int = 700) -> torch.Tensor:
    """`UPDATES` after one more of these rows."""
    updates = UPDATES[:n].clone()
    updates[rows] += 1
    return updates


def apart(scene: Scene, gradients: SplatGradients) -> list[torch.Tensor]:
    """The same with autograd through gathered anchors, then Adam parameter by parameter."""
    states = states_of(scene)
    leaves = [state.parameter[ROWS].requires_grad_(True) for state in states]
    weights = scene.weights.map(lambda t: t.clone().requires_grad_(True))
    splats = cpu.decode(scene.positions[ROWS], *leaves, weights, CAMERA)
    outputs = [splats.means_px, splats.conics, splats.colors, splats.opacities, splats.volumes]
    received = [gradients.means_px, gradients.conics, gradients.colors, gradients.opacities,
                torch.full_like(splats.volumes, gradients.volume)]  # fmt: skip
    if gradients.depths is not None:
        outputs, received = [*outputs, splats.depths], [*received, gradients.depths]
    found = torch.autograd.grad(outputs, [*leaves, *weights.tensors()], received)
    for state, gradient in zip(states, found, strict=False):
        assert cpu.adam_rows(state, ROWS, gradient, counted(ROWS)[ROWS])
    return [*(t for state in states for t in state[:3]), *found[3:]]


@pytest.mark.parametrize("depths", [False, True])
@every_instruction_set
def test_the_bits_are_those_of_autograd_and_adam_for_any_number_of_threads(instructions, depths):
    scene = Scene.random(700, seed=2)
    with using(instructions):
        gradients = gradients_of(scene, depths=depths)
        assert len(gradients.source) > 300
        expected = apart(scene, gradients)
        for count in (1, 3):
            with on_threads(count):
                finite, ours = fused(cpu, scene, gradients)
            assert finite
            assert all(torch.equal(a, b) for a, b in zip(ours, expected, strict=True))


@pytest.mark.parametrize(("with_distance", "depths"), [(False, False), (True, False), (False, True)])
def test_native_equals_the_twin(with_distance, depths):
    scene = Scene.random(700, k=3, with_distance=with_distance, seed=3)
    gradients = gradients_of(scene, depths=depths)
    for ours, twins in zip(fused(cpu, scene, gradients)[1], fused(torch_ref, scene, gradients)[1], strict=True):
        torch.testing.assert_close(ours, twins, rtol=2e-3, atol=2e-4 * float(twins.abs().max()))


@pytest.mark.parametrize("kernels", [cpu, torch_ref])
def test_a_gradient_by_depth_moves_anchors_and_one_of_nothing_does_not(kernels):
    scene = Scene.random(700, seed=2)
    gradients = gradients_of(scene)
    none, zero, some = (
        fused(kernels, scene, replace(gradients, depths=depths))[1]
        for depths in (None, torch.zeros(len(gradients.source)), torch.ones(len(gradients.source)))
    )
    assert all(torch.equal(a, b) for a, b in zip(none, zero, strict=True))
    assert not torch.equal(none[3], some[3])  # offsets


def test_rows_that_are_not_given_keep_their_bits():
    scene = Scene.random(700, seed=2)
    before = [t for state in states_of(scene) for t in state[:3]]
    _, after = fused(cpu, scene, gradients_of(scene))
    others = torch.ones(700, dtype=torch.bool)
    others[ROWS] = False
    for a, b in zip(before, after[:9], strict=True):
        assert torch.equal(a[others], b[others])
        assert not torch.equal(a[ROWS], b[ROWS])


def test_a_gradient_that_is_not_a_number_is_reported_and_stays_out_of_its_anchor():
    scene = Scene.random(700, seed=2)
    gradients = gradients_of(scene)
    spoilt = gradients.colors.clone()
    spoilt[100, 1] = float("nan")
    finite, after = fused(cpu, scene, replace(gradients, colors=spoilt))
    assert not finite
    assert all(bool(torch.isfinite(t).all()) for t in after[:9])


def test_a_frozen_decoder_gets_no_gradients():
    scene = Scene.random(700, seed=2)
    gradients, states = gradients_of(scene), states_of(scene)
    answer = cpu.decode_backward_adam(scene.positions, states, scene.weights, CAMERA, ROWS, gradients, UPDATES.clone())
    assert answer == (True, None)
    _, expected = fused(cpu, scene, gradients)
    assert all(torch.equal(a, b) for a, b in zip([t for s in states for t in s[:3]], expected[:9], strict=True))


def test_nothing_visible_moves_nothing():
    scene, none = Scene.random(5, seed=1), torch.empty(0, dtype=torch.int64)
    finite, after = fused(cpu, scene, gradients_of(scene, none), none)
    before = [t for state in states_of(scene) for t in state[:3]]
    assert finite
    assert all(torch.equal(a, b) for a, b in zip(before, after[:9], strict=True))
    assert all(not t.any() for t in after[9:])


def test_rows_are_read_where_they_stand():
    scene = Scene.random(700, seed=4)
    gathered = replace(scene, **{name: getattr(scene, name)[ROWS]
                                 for name in ("positions", "features", "offsets", "log_scales")})  # fmt: skip
    camera = looking_down()
    ours, expected = cpu.decode(*scene.arguments, camera, ROWS), cpu.decode(*gathered.arguments, camera)
    twin = torch_ref.decode(*scene.arguments, camera, ROWS)
    assert len(ours.source) > 100
    assert torch.equal(ours.source, twin.source)
    for name in vars(ours):
        assert torch.equal(getattr(ours, name), getattr(expected, name))
    features = scene.features.clone().requires_grad_(True)
    cpu.decode(*replace(scene, features=features).arguments, camera, ROWS).opacities.sum().backward()
    assert features.grad is not None
    assert set(features.grad.abs().sum(1).nonzero()[:, 0].tolist()) <= set(ROWS.tolist())


@pytest.mark.parametrize(
    ("rows", "error"),
    [([3, 2], ValueError), ([2, 2], ValueError), ([-1, 2], IndexError), ([2, 700], IndexError)],
)
def test_rows_that_are_not_there_are_refused(rows, error):
    scene = Scene.random(700, seed=2)
    with pytest.raises(error):
        cpu.decode(*scene.arguments, CAMERA, torch.tensor(rows))
    gradients, states = gradients_of(scene), states_of(scene)
    with pytest.raises(error):
        cpu.decode_backward_adam(
            scene.positions, states, scene.weights, CAMERA, torch.tensor(rows), gradients, UPDATES.clone()
        )
    assert torch.equal(states[0].parameter, scene.features)


def test_a_state_that_does_not_fit_is_refused():
    scene = Scene.random(700, seed=2)
    gradients = gradients_of(scene)
    for damage in (
        {"first": torch.zeros(699, 32)},
        {"second": torch.zeros(32, 700).T},
        {"first": torch.zeros(700, 32).double()},
    ):
        states = states_of(scene)
        states[0] = states[0]._replace(**damage)
        with pytest.raises(ValueError, match="moments"):
            cpu.decode_backward_adam(scene.positions, states, scene.weights, CAMERA, ROWS, gradients, UPDATES.clone())


@pytest.mark.parametrize("kernels", [cpu, torch_ref])
@pytest.mark.parametrize("updates", [torch.zeros(699, dtype=torch.int32), torch.zeros(700), UPDATES - 1])
def test_counts_that_do_not_fit_are_refused(kernels, updates):
    scene = Scene.random(700, seed=2)
    gradients, states = gradients_of(scene), states_of(scene)
    with pytest.raises((ValueError, TypeError), match="updates"):
        kernels.decode_backward_adam(scene.positions, states, scene.weights, CAMERA, ROWS, gradients, updates)
    assert torch.equal(states[0].parameter, scene.features)
