"""Pictures that are drawn while a visitor moves."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from support.captures import camera_at
from support.hand_made_models import two_floors
from vdgs.model.anchor_model import DecoderSpan
from vdgs.model.decode_world import gaussian_means
from vdgs.model.renderer import render
from vdgs.viewer.lod import LodPyramid


def test_levels_of_a_model_that_fades_out_fade_out():
    model, camera = two_floors(), camera_at(0.0, 0.0, 6.0)
    west = (gaussian_means(model.anchors)[..., 0] < 0).float()
    levels = LodPyramid(replace(model, anchors=replace(model.anchors, opacity_factors=west)))
    for most in (None, 100):
        level, _ = levels.of(camera, most)
        assert torch.equal(level.of(model.anchors.positions), level.model.anchors.positions)
        assert torch.equal(level.model.anchors.opacity_factors, level.of(west))
        alpha = render(level.model, camera).alpha
        assert alpha[:, -8:].max() < 0.1 < alpha[:, :8].mean()


@pytest.mark.parametrize("parts", [False, True])
def test_quick_pictures_of_much_are_drawn_with_fewer_larger_gaussians(parts):
    model = two_floors()
    if parts:
        counts = (300, len(model.anchors) - 300)
        model = replace(model, decoder_spans=tuple(DecoderSpan(count, model.decoder) for count in counts))
    camera = camera_at(0.0, 0.0, 6.0)
    levels = LodPyramid(model)
    assert levels.of(camera)[0].model is model
    assert levels.of(camera, 10_000)[0].model is model
    few, count = levels.of(camera, 400)
    assert 0 < count <= 400
    assert few.mask is not None
    assert len(few.model.anchors) == int(few.mask.sum()) < len(model.anchors) / 3
    assert sum(part.count for part in few.model.decoder_spans) == (len(few.model.anchors) if parts else 0)
    assert torch.equal(few.of(model.anchors.positions), few.model.anchors.positions)
    thin, whole = render(few.model, camera), render(model, camera)
    inner = slice(14, 34), slice(20, 44)
    assert thin.alpha[inner].mean() > 0.95
    assert (thin.image[inner].mean((0, 1)) - whole.image[inner].mean((0, 1))).abs().max() < 0.05
