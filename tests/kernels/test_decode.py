"""Laws of decoding: the twin against calculus, the native kernel against the twin."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from support.decode_scenes import CAMERAS, Scene, looking_down
from vdgs.kernels.constants import ALPHA_MIN
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.decode import decode as native_decode
from vdgs.kernels.kernel_types import AnchorSplats, DecoderWeights
from vdgs.kernels.torch_ref.decode import decode as twin_decode

EVERY_ISA = pytest.mark.parametrize("isa", extension.supported_isas())
BOTH = pytest.mark.parametrize("decode", [twin_decode, native_decode])
NUMBERS = ("means_px", "conics", "depths", "colors", "opacities", "volumes")


def weighted_sum(splats: AnchorSplats, seed: int = 0) -> torch.Tensor:
    """A scalar that depends on every number of every splat, the same in either precision."""
    total = splats.depths.new_zeros(())
    for name in NUMBERS:
        numbers = getattr(splats, name)
        columns = numbers[:, None] if numbers.dim() == 1 else numbers
        generator = torch.Generator().manual_seed(seed)
        weight = torch.randn(40_000, columns.shape[1], generator=generator)[splats.source.long()]
        total = total + (columns * weight.to(columns)).sum()
    return total


@pytest.mark.parametrize(
    ("camera", "with_distance"), [*((camera, False) for camera in CAMERAS), *((camera, True) for camera in CAMERAS[:2])]
)
def test_gradients_of_the_twin_are_those_of_finite_differences(camera, with_distance):
    scene = Scene.random(6, k=4, with_distance=with_distance, spread=0.5, seed=1).to(torch.float64)

    def f(*trainable):
        splats = twin_decode(*scene.with_trainable(trainable).arguments, camera)
        assert len(splats.source) > 4
        return tuple(getattr(splats, name) for name in NUMBERS)

    assert torch.autograd.gradcheck(f, scene.trainable, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


@BOTH
def test_splats_follow_the_definition(decode):
    camera, scene = looking_down(), Scene.random(50, k=4, seed=3)
    splats = decode(*scene.arguments, camera)
    index = len(splats.source) // 2
    anchor, offset = divmod(int(splats.source[index]), 4)
    x, s = scene.positions[anchor], scene.log_scales[anchor]
    ray = x - torch.as_tensor(camera.position).float()
    inputs = torch.cat([scene.features[anchor], ray / ray.norm()])
    opacity, covariance, color = (
        head.w2 @ torch.relu(head.w1 @ inputs + head.b1) + head.b2
        for head in (scene.weights.opacity, scene.weights.covariance, scene.weights.color)
    )
    mean = x + scene.offsets[anchor, offset] * s[:3].exp()
    scale = s[3:].exp() * torch.sigmoid(covariance.reshape(4, 7)[offset, :3])
    close = {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close(splats.opacities[index], torch.tanh(opacity[offset]), **close)
    torch.testing.assert_close(splats.colors[index], torch.sigmoid(color.reshape(4, 3)[offset]), **close)
    torch.testing.assert_close(splats.volumes[index], scale.prod(), **close)
    pixels, depths = camera.project(mean[None].double().numpy())
    torch.testing.assert_close(splats.means_px[index].double(), torch.from_numpy(pixels[0]), rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(splats.depths[index].double(), torch.from_numpy(depths)[0], **close)


@BOTH
@pytest.mark.parametrize("camera", CAMERAS)
def test_what_is_kept_is_opaque_and_on_the_image(decode, camera):
    scene = Scene.random(300, spread=6.0, seed=4)
    splats = decode(*scene.arguments, camera)
    assert (splats.opacities >= ALPHA_MIN).all()
    assert (torch.diff(splats.source) > 0).all()
    assert splats.source.dtype == torch.int32
    # On a canvas ten times as large there are more; those that both hold are the same.
    wide = replace(camera, width=640, height=480, cx=camera.cx + 288, cy=camera.cy + 216)
    wider = decode(*scene.arguments, wide)
    assert len(wider.source) > len(splats.source)
    assert set(splats.source.tolist()) <= set(wider.source.tolist())


def assert_same(scene: Scene, camera, frozen: bool = False, tolerance: float = 1e-3) -> None:
    """Native float32 against the twin in float64: values, and gradients of everything trainable."""
    exact, single = scene.to(torch.float64, frozen), scene.to(torch.float32, frozen)
    twin, ours = twin_decode(*exact.arguments, camera), native_decode(*single.arguments, camera)
    # Splats at the very edge of the image or of opacity may be kept by one and not by the other.
    common = sorted(set(twin.source.tolist()) & set(ours.source.tolist()))
    assert max(len(twin.source), len(ours.source)) - len(common) <= len(common) // 500
    ours, twin = restricted(ours, common), restricted(twin, common)
    for name in NUMBERS:
        torch.testing.assert_close(
            getattr(ours, name).double(),
            getattr(twin, name),
            rtol=2e-4,
            atol=2e-4,
            msg=lambda m, n=name: f"{n}: {m}",
        )
    leaves = [(a, b) for a, b in zip(single.trainable, exact.trainable, strict=True) if b.requires_grad]
    gradients = torch.autograd.grad(weighted_sum(ours), [a for a, _ in leaves])
    expected = torch.autograd.grad(weighted_sum(twin), [b for _, b in leaves])
    for index, (g, e) in enumerate(zip(gradients, expected, strict=True)):
        assert g.shape == e.shape
        error = (g.double() - e).abs().max() if e.numel() else torch.zeros(())
        scale = e.abs().max() if e.numel() else torch.ones(())
        assert error <= tolerance * scale, f"gradient {index}: {error:.3g} of {scale:.3g}"


def restricted(splats: AnchorSplats, sources: list[int]) -> AnchorSplats:
    position = {s: i for i, s in enumerate(splats.source.tolist())}
    index = torch.tensor([position[s] for s in sources], dtype=torch.long)
    return AnchorSplats(**{name: getattr(splats, name)[index] for name in (*NUMBERS, "source")})


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(("v", "k"), [(700, 10), (33, 1), (18, 32), (16, 7), (1, 10)])
def test_native_equals_the_twin(camera, v, k):
    assert_same(Scene.random(v, k, seed=v), camera)


def test_native_equals_the_twin_with_distance_and_with_a_frozen_decoder():
    assert_same(Scene.random(300, with_distance=True), CAMERAS[0])
    assert_same(Scene.random(300), CAMERAS[2], frozen=True)


@pytest.mark.parametrize("log_scale", [-9.0, 2.0])
def test_native_equals_the_twin_for_tiny_and_for_huge_splats(log_scale):
    assert_same(Scene.random(200, log_scale=log_scale, spread=2.0), CAMERAS[0])


def test_native_gives_no_gradient_where_none_is_wanted():
    scene = Scene.random(40).to(torch.float32, frozen=True)
    fixed = replace(scene, offsets=scene.offsets.detach())
    weighted_sum(native_decode(*fixed.arguments, CAMERAS[0])).backward()
    assert fixed.features.grad is not None
    assert fixed.offsets.grad is None
    assert all(t.grad is None for t in fixed.weights.tensors())


def test_native_refuses_second_derivatives():
    """Rather than to take them for zero, as by a penalty on gradients."""
    scene = Scene.random(5)
    features = scene.features.requires_grad_(True)
    colors = native_decode(*replace(scene, features=features).arguments, CAMERAS[0]).colors
    for loss in (colors.square().sum(), colors.sum()):
        with pytest.raises(RuntimeError, match="differentiate twice"):
            torch.autograd.grad(loss, features, create_graph=True)


def test_native_takes_any_layout_of_memory_and_a_loss_of_one_output():
    scene = Scene.random(40)
    spread_out = replace(scene, features=scene.features.T.contiguous().T)
    a, b = (s.to(torch.float32) for s in (scene, scene))
    b = replace(b, features=spread_out.features.detach().requires_grad_())
    for s in (a, b):
        native_decode(*s.arguments, CAMERAS[0]).opacities.sum().backward()
    torch.testing.assert_close(a.features.grad, b.features.grad, rtol=0, atol=0)
    assert a.features.grad.any()
    assert a.offsets.grad is None or not a.offsets.grad.any()


@BOTH
@pytest.mark.parametrize(("v", "opaque"), [(0, True), (5, False)])
def test_nothing_visible_and_nothing_opaque(decode, v, opaque):
    scene = Scene.random(v)
    if not opaque:
        bias = torch.full_like(scene.weights.opacity.b2, -100.0)
        weights = replace(scene.weights, opacity=replace(scene.weights.opacity, b2=bias))
        scene = replace(scene, weights=weights)
    scene = scene.to(torch.float32)
    splats = decode(*scene.arguments, CAMERAS[0])
    assert [getattr(splats, name).shape[0] for name in (*NUMBERS, "source")] == [0] * 7
    weighted_sum(splats).backward()
    for tensor in scene.trainable:
        assert tensor.grad is None or not tensor.grad.any()


@pytest.mark.parametrize("isa", ["twin", *extension.supported_isas()])
def test_what_is_not_a_number_is_dropped_and_spoils_nothing(isa, monkeypatch):
    decode = twin_decode if isa == "twin" else native_decode
    if isa != "twin":
        monkeypatch.setattr(extension, "get_extension", lambda: extension.load_extension(isa))
    camera, nan = CAMERAS[0], float("nan")
    scene = Scene.random(60, spread=1.0)
    spoilt, offset = divmod(int(decode(*scene.arguments, camera).source[60]), 10)
    others = [a for a in range(60) if a != spoilt][:7]
    scene.offsets[spoilt, offset, 1] = nan
    scene.features[others[0], 5] = scene.log_scales[others[1], 0] = scene.positions[others[2], 0] = nan
    scene.log_scales[others[3], 4] = 200.0
    scene.features[others[4]] = float("inf")
    scene.positions[others[5]] = torch.as_tensor(camera.position)
    scene.log_scales[others[6], 1] = -float("inf")  # a scale of zero is a number
    scene = scene.to(torch.float32)
    splats = decode(*scene.arguments, camera)
    assert spoilt * 10 + offset not in splats.source.tolist()
    anchors = set((splats.source // 10).tolist())
    assert spoilt in anchors
    assert not anchors & set(others[:6])
    weighted_sum(splats).backward()
    for tensor in scene.trainable:
        assert torch.isfinite(tensor.grad).all()


def test_weights_survive_a_walk_through_their_tensors():
    weights = DecoderWeights.random(5, True, torch.Generator().manual_seed(0))
    again = DecoderWeights.from_tensors(weights.tensors())
    assert all(a is b for a, b in zip(weights.tensors(), again.tensors(), strict=True))
    assert weights.covariance.w2.shape == (35, 32)
    assert weights.map(lambda t: 2 * t).color.w1.shape == (32, 36)


def results(scene: Scene, camera) -> list[torch.Tensor]:
    """Splats and gradients of the native decoder, to be compared bit by bit."""
    scene = scene.to(torch.float32)
    splats = native_decode(*scene.arguments, camera)
    numbers = [getattr(splats, name) for name in (*NUMBERS, "source")]
    return [*(t.detach() for t in numbers), *torch.autograd.grad(weighted_sum(splats), scene.trainable)]


@EVERY_ISA
def test_any_number_of_threads_gives_the_same_bits(isa, monkeypatch):
    chosen = extension.load_extension(isa)
    monkeypatch.setattr(extension, "get_extension", lambda: chosen)
    scene, threads = Scene.random(1500, seed=5), chosen.threads()
    try:
        runs = []
        for count in (1, 2, 3):
            chosen.set_threads(count)
            runs.append(results(scene, CAMERAS[2]))
    finally:
        chosen.set_threads(threads)
    for run in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(run, runs[0], strict=True))


@EVERY_ISA
def test_every_instruction_set_equals_the_twin(isa, monkeypatch):
    monkeypatch.setattr(extension, "get_extension", lambda: extension.load_extension(isa))
    assert_same(Scene.random(330, seed=6), CAMERAS[2])
    assert_same(Scene.random(37, k=3, with_distance=True, seed=6), CAMERAS[1])


def test_shapes_that_do_not_belong_together_are_refused():
    scene = Scene.random(4)
    for wrong in (
        replace(scene, features=scene.features[:3]),
        replace(scene, log_scales=scene.log_scales[:, :5]),
        replace(scene, weights=Scene.random(1, k=9).weights),
        Scene.random(1, k=33),
    ):
        with pytest.raises((ValueError, TypeError)):
            native_decode(*wrong.arguments, CAMERAS[0])


def test_more_offsets_than_can_be_numbered_are_refused():
    scene = Scene.random(1, k=32)
    many = [each.expand(2**26, *each.shape[1:]) for each in scene.arguments[:4]]
    with pytest.raises(ValueError, match=r"at most 2.31 - 1 offsets"), torch.no_grad():
        native_decode(*many, scene.weights, CAMERAS[0])


@EVERY_ISA
def test_activations_are_exact_to_a_few_units_in_the_last_place(isa, monkeypatch):
    monkeypatch.setattr(extension, "get_extension", lambda: extension.load_extension(isa))
    scene = Scene.random(16, k=32, spread=0.2)
    raw_opacities, raw_colors = torch.linspace(0.005, 4, 32), torch.linspace(-10, 10, 96)
    opacity, color = scene.weights.opacity, scene.weights.color
    opacity = replace(opacity, w2=torch.zeros_like(opacity.w2), b2=raw_opacities)
    color = replace(color, w2=torch.zeros_like(color.w2), b2=raw_colors)
    scene = replace(scene, weights=replace(scene.weights, opacity=opacity, color=color))
    splats = native_decode(*scene.arguments, CAMERAS[0])
    offset = splats.source.long() % 32
    assert len(offset.unique()) > 25
    expected = torch.tanh(raw_opacities.double())[offset]
    torch.testing.assert_close(splats.opacities.double(), expected, rtol=1e-6, atol=0)
    expected = torch.sigmoid(raw_colors.double()).reshape(32, 3)[offset]
    torch.testing.assert_close(splats.colors.double(), expected, rtol=1e-6, atol=0)
