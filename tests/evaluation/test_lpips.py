"""LPIPS with random weights against an independent network; files that are missing or wrong."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from support.photographs import noisy, photograph
from vdgs.errors import VdgsError
from vdgs.evaluation import lpips
from vdgs.evaluation.lpips import Lpips, load_lpips

pytestmark = [pytest.mark.xdist_group("lpips"), pytest.mark.slow]

#: VGG16 as published: channels of each convolution, M a 2 x 2 maximum.
LAYOUT = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512]


def build_features(generator: torch.Generator) -> nn.Sequential:
    """VGG16's features in torchvision's order, with random weights that keep activations alive."""
    layers: list[nn.Module] = []
    channels = 3
    for step in LAYOUT:
        if step == "M":
            layers.append(nn.MaxPool2d(2, 2))
            continue
        convolution = nn.utils.skip_init(nn.Conv2d, channels, int(step), 3, padding=1)
        with torch.no_grad():
            convolution.weight.normal_(0, (2 / (9 * channels)) ** 0.5, generator=generator)
            convolution.bias.normal_(0, 0.05, generator=generator)
        layers += [convolution, nn.ReLU()]
        channels = int(step)
    return nn.Sequential(*layers).eval()


@pytest.fixture(scope="module")
def features() -> nn.Sequential:
    return build_features(torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def backbone(features: nn.Sequential) -> dict[str, torch.Tensor]:
    return {f"features.{name}": value for name, value in features.state_dict().items()}


@pytest.fixture(scope="module")
def heads() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    channels = (64, 128, 256, 512, 512)
    return {f"lin{i}.model.1.weight": torch.rand((1, c, 1, 1), generator=generator) for i, c in enumerate(channels)}


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine where nothing of LPIPS is installed or cached."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(lpips, "HEAD_FILES", {})
    return tmp_path


@torch.inference_mode()
def independent(features: nn.Sequential, heads: dict, x: torch.Tensor, y: torch.Tensor) -> float:
    """LPIPS of two images [1, 3, h, w] as the network sees them, from its definition."""
    shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
    x, y, total, tap = (x - shift) / scale, (y - shift) / scale, 0.0, 0
    for index, layer in enumerate(features):
        x, y = layer(x), layer(y)
        if index in (3, 8, 15, 22, 29):
            unit = [each / (torch.linalg.vector_norm(each, dim=1, keepdim=True) + 1e-10) for each in (x, y)]
            total += float(((unit[0] - unit[1]) ** 2 * heads[f"lin{tap}.model.1.weight"]).sum(1).mean())
            tap += 1
    return total


def test_equals_an_independent_network(features, backbone, heads):
    rng = np.random.default_rng(0)
    reference = photograph(rng, 37, 50)
    image = noisy(reference, rng)
    scores = Lpips(backbone, heads)(image, reference)
    x, y = (torch.from_numpy(each / 255.0).float().permute(2, 0, 1)[None] for each in (image, reference))
    assert scores.lpips_vgg == pytest.approx(independent(features, heads, 2 * x - 1, 2 * y - 1), rel=1e-4)
    assert scores.lpips_vgg_01 == pytest.approx(independent(features, heads, x, y), rel=1e-4)


def test_a_distance(backbone, heads):
    rng = np.random.default_rng(1)
    reference = photograph(rng, 32, 32)
    slightly, strongly = noisy(reference, rng, 0.02), noisy(reference, rng, 0.2)
    metric = Lpips(backbone, heads)
    same, near, far = (metric(image, reference) for image in (reference, slightly, strongly))
    assert same.lpips_vgg == same.lpips_vgg_01 == 0.0
    assert 0 < near.lpips_vgg < far.lpips_vgg
    assert 0 < near.lpips_vgg_01 < far.lpips_vgg_01
    assert near.lpips_vgg != near.lpips_vgg_01
    assert metric(reference, strongly).lpips_vgg == pytest.approx(far.lpips_vgg, rel=1e-5)


def test_images_that_do_not_fit_are_refused(backbone, heads):
    metric = Lpips(backbone, heads)
    image = np.zeros((32, 32, 3), np.uint8)
    with pytest.raises((ValueError, TypeError)):
        metric(image, image[:20])
    with pytest.raises(ValueError, match="16 pixels"):
        metric(image[:15], image[:15])


def test_weights_from_either_kind_of_file(backbone, heads, nowhere: Path):
    torch.save(heads, nowhere / "heads.pth")
    torch.save({**backbone, "classifier.0.bias": torch.zeros(4)}, nowhere / "vgg.pth")
    save_file(backbone, nowhere / "vgg.safetensors")
    rng = np.random.default_rng(2)
    image, reference = photograph(rng, 16, 16), photograph(rng, 16, 16)
    expected = Lpips(backbone, heads)(image, reference)
    for name in ("vgg.pth", "vgg.safetensors"):
        metric, note = load_lpips(nowhere / name, nowhere / "heads.pth")
        assert metric is not None
        assert metric(image, reference) == expected
        assert "not torchvision's file" in note


def test_what_is_missing_is_said_in_one_line(backbone, nowhere: Path):
    metric, why = load_lpips()
    assert metric is None
    assert "--lpips-weights" in why
    assert lpips.VGG16_URL in why
    assert "\n" not in why
    torch.save(backbone, nowhere / "vgg.pth")
    with pytest.raises(VdgsError, match=r"--lpips-weights .*vgg.pth: no linear heads.*vdgs\[lpips\]"):
        load_lpips(nowhere / "vgg.pth")  # was asked for by name
    lpips.default_weights_path().parent.mkdir(parents=True)
    torch.save(backbone, lpips.default_weights_path())
    metric, why = load_lpips()  # was only found
    assert metric is None
    assert "vdgs[lpips]" in why


def test_the_download_of_torch_is_found(backbone, heads, nowhere: Path):
    cached = lpips.default_weights_path()
    assert nowhere in cached.parents
    cached.parent.mkdir(parents=True)
    torch.save(backbone, cached)
    torch.save(heads, nowhere / "heads.pth")
    assert load_lpips(heads=nowhere / "heads.pth")[0] is not None


def test_heads_are_found_inside_a_package_that_is_not_imported(nowhere: Path, monkeypatch: pytest.MonkeyPatch):
    package = nowhere / "someheads"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "weights" / "vgg.pth").write_bytes(b"")
    monkeypatch.syspath_prepend(str(nowhere))
    monkeypatch.setattr(lpips, "HEAD_FILES", {"no_such_package": "x.pth", "someheads": "weights/vgg.pth"})
    assert lpips.find_heads() == package / "weights" / "vgg.pth"


@pytest.mark.parametrize("spoil", ["absent", "garbage", "cut", "object", "other", "bad.safetensors"])
def test_wrong_files_are_named(spoil: str, backbone, heads, nowhere: Path):
    torch.save(heads, nowhere / "heads.pth")
    file = nowhere / (spoil if spoil.endswith(".safetensors") else f"{spoil}.pth")
    if spoil == "garbage" or file.suffix == ".safetensors":
        file.write_bytes(b"<html>not found</html>" * 20)
    elif spoil == "cut":
        torch.save(heads, file)
        os.truncate(file, file.stat().st_size // 2)
    elif spoil == "object":
        torch.save({"features.0.weight": Path("x")}, file)
    elif spoil == "other":
        torch.save({**backbone, "features.10.weight": torch.zeros(256, 64, 3, 3)}, file)
    with pytest.raises(VdgsError, match=file.name) as caught:
        load_lpips(file, nowhere / "heads.pth")
    assert ("features.10.weight" in str(caught.value)) == (spoil == "other")


@pytest.mark.skipif(lpips.find_heads() is None, reason="needs torchmetrics or lpips")
def test_the_real_heads_fit(backbone):
    found = lpips.find_heads()
    assert found is not None
    real = lpips._read(found, "LPIPS heads")  # saved from a GPU, read without one
    assert all(bool((value >= 0).all()) for value in real.values())
    image = photograph(np.random.default_rng(3), 32, 32)
    assert Lpips(backbone, real)(noisy(image, np.random.default_rng(4)), image).lpips_vgg > 0
