"""A model whose parts have decoders of their own: drawing, file, merge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.hand_made_models import camera_above, model_at, quadrant_of, quadrants
from vdgs.config.method import MergeConfig
from vdgs.errors import VdgsError
from vdgs.evaluation.splat_artifacts import needle_share
from vdgs.model.anchor_model import AnchorModel, DecoderSpan, ModelMetadata, has_envmap
from vdgs.model.anchors import Anchors
from vdgs.model.renderer import decode_view, render, render_scalar_map, without_aliasing
from vdgs.partition.merging import merge_blocks

VIEWS = [camera_above(0.3, -0.2), camera_above(-2.0, 1.0, tilt_deg=30.0), camera_above(40.0, 40.0)]


def scattered(n: int = 300, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-3, -3, 0), (3, 3, 0.5), (n, 3))


def in_parts(model: AnchorModel, counts: tuple[int, ...], seeds: tuple[int, ...]) -> AnchorModel:
    decoders = [model_at(np.zeros((1, 3)), decoder_seed=seed).decoder for seed in seeds]
    return replace(model, decoder_spans=tuple(map(DecoderSpan, counts, decoders)))


@pytest.mark.parametrize("counts", [(300,), (100, 200), (0, 120, 0, 180), (299, 1, 0)])
def test_parts_with_the_same_decoder_are_one_model(counts):
    model = model_at(scattered())
    parted = replace(model, decoder_spans=tuple(DecoderSpan(count, model.decoder) for count in counts))
    values = torch.arange(300.0)
    for view in VIEWS:
        assert torch.equal(render(model, view).image, render(parted, view).image)
        whole, pieces = decode_view(model, view), decode_view(parted, view)
        assert torch.equal(whole[0], pieces[0])
        assert torch.equal(whole[1].source, pieces[1].source)
        assert torch.equal(
            render_scalar_map(model, values, view).nan_to_num(-1),
            render_scalar_map(parted, values, view).nan_to_num(-1),
        )


def test_every_part_is_decoded_by_its_own_decoder():
    model = in_parts(model_at(scattered()), (120, 180), (1, 2))
    for view in VIEWS[:2]:
        _, splats = decode_view(model, view)
        k = model.anchors.offsets.shape[1]
        alone = []
        for first, last, decoder in model.decoder_ranges():
            rows = torch.arange(first, last)
            alone.append(
                decode_view(
                    AnchorModel(
                        anchors=model.anchors.select(rows), decoder=decoder, voxel_size=0.1, background=(0, 0, 0)
                    ),
                    view,
                )[1]
            )
        assert torch.equal(splats.colors, torch.cat([each.colors for each in alone]))
        assert torch.equal(splats.means_px, torch.cat([each.means_px for each in alone]))
        assert bool((splats.source.diff() > 0).all())
        assert int(splats.source[-1]) // k < 300
    other = in_parts(model, (120, 180), (1, 3))
    assert not torch.equal(render(model, VIEWS[0]).image, render(other, VIEWS[0]).image)


def test_a_file_keeps_parts(tmp_path):
    model = in_parts(model_at(scattered()), (120, 0, 180), (1, 2, 3))
    model.save(tmp_path / "model.safetensors")
    back = AnchorModel.load(tmp_path / "model.safetensors")
    assert [part.count for part in back.decoder_spans] == [120, 0, 180]
    assert torch.equal(render(back, VIEWS[0]).image, render(model, VIEWS[0]).image)
    for ours, theirs in zip(back.decoder_spans, model.decoder_spans, strict=True):
        assert all(torch.equal(t, theirs.decoder.tensors()[name]) for name, t in ours.decoder.tensors().items())
    plain = model_at(scattered())
    plain.save(tmp_path / "plain.safetensors")
    faded = replace(plain.anchors, opacity_factors=torch.zeros(plain.anchors.offsets.shape[:2]))
    replace(plain, anchors=faded).save(tmp_path / "faded.safetensors")
    assert (tmp_path / "faded.safetensors").read_bytes() == (tmp_path / "plain.safetensors").read_bytes()
    assert AnchorModel.load(tmp_path / "plain.safetensors").decoder_spans == ()


def test_views_from_nearer_than_the_photographs_keep_their_blur(tmp_path):
    scene, near, far = model_at(scattered()), VIEWS[0], camera_above(0.3, -0.2, altitude=30.0)
    thin = scene.anchors.log_scales - torch.tensor([0.0, 0.0, 0.0, 6.0, 6.0, 0.0])
    plain = replace(scene, anchors=replace(scene.anchors, log_scales=thin))
    depths = decode_view(plain, near)[1].depths
    pixel = 3 * float(depths.max()) / near.fx
    replace(plain, photograph_pixel=pixel).save(tmp_path / "model")
    blurred = AnchorModel.load(tmp_path / "model")
    assert blurred.photograph_pixel == pixel
    assert needle_share(decode_view(plain, near)[1], near) > 0.01
    assert needle_share(decode_view(blurred, near)[1], near) < 0.001
    assert torch.equal(render(blurred, far).image, render(plain, far).image)
    # Its own pixels are learnt, whatever the height of the cameras: nothing becomes more transparent.
    assert torch.equal(render(without_aliasing(blurred, pixel / 100), near).image, render(blurred, near).image)
    replace(plain, photograph_pixel=-1.0).save(tmp_path / "model")
    with pytest.raises(VdgsError, match=r"its pixels are of size -1\.0"):
        AnchorModel.load(tmp_path / "model")


def test_parts_that_do_not_add_up_are_refused(tmp_path):
    model = in_parts(model_at(scattered()), (120, 181), (1, 2))
    model.save(tmp_path / "model.safetensors")
    with pytest.raises(VdgsError, match="parts hold 301 anchors, not 300"):
        AnchorModel.load(tmp_path / "model.safetensors")


def trained_apart(coarse: AnchorModel, own: bool) -> list[AnchorModel | None]:
    """The blocks of `quadrants`, each with other features and perhaps another decoder."""
    owner = quadrant_of(coarse.anchors.positions[:, :2].numpy())
    models: list[AnchorModel | None] = []
    for index in range(4):
        anchors = coarse.anchors.select(torch.from_numpy(owner == index))
        anchors = Anchors(**(anchors.tensors() | {"features": anchors.features + 0.1 * index}))
        decoder = model_at(np.zeros((1, 3)), decoder_seed=10 + index).decoder if own else coarse.decoder
        metadata = ModelMetadata(decoder="own" if own else "frozen")
        models.append(replace(coarse, anchors=anchors, decoder=decoder, metadata=metadata))
    return models


def test_the_merged_scene_decodes_each_block_as_it_was_trained():
    coarse = model_at(scattered())
    blocks, cameras = quadrants(), [VIEWS[:2]] * 4
    trained = trained_apart(coarse, own=True)
    merged, _ = merge_blocks(coarse, trained, blocks, cameras, MergeConfig())
    assert [part.count for part in merged.decoder_spans] == [
        len(model.anchors) for model in trained if model is not None
    ]
    for part, model in zip(merged.decoder_spans, trained, strict=True):
        assert model is not None
        given, own = part.decoder.tensors(), model.decoder.tensors()
        assert given.keys() == own.keys()
        assert all(torch.equal(given[name], own[name]) for name in own)
    frozen, _ = merge_blocks(coarse, trained_apart(coarse, own=False), blocks, cameras, MergeConfig())
    assert frozen.decoder_spans == ()


def test_the_coarse_decoder_stands_in_with_its_anchors():
    coarse = model_at(scattered())
    trained = trained_apart(coarse, own=True)
    trained[2] = None
    merged, _ = merge_blocks(coarse, trained, quadrants(), [VIEWS[:2]] * 4, MergeConfig(), allow_missing=True)
    assert merged.decoder_spans[2].decoder is coarse.decoder
    owner = quadrant_of(coarse.anchors.positions[:, :2].numpy())
    assert merged.decoder_spans[2].count == int((owner == 2).sum())


def test_a_file_says_whether_a_sky_is_drawn_behind(tmp_path):
    plain, file = model_at(scattered(10)), tmp_path / "model.safetensors"
    before_sky = replace(plain, decoder=replace(plain.decoder, envmap=torch.rand(4, 8, 3)))
    for model, known in ((plain, False), (before_sky, True)):
        model.save(file)
        assert has_envmap(file) == known
    file.write_bytes(file.read_bytes()[:40])
    assert not has_envmap(file)
    assert not has_envmap(tmp_path / "none")
