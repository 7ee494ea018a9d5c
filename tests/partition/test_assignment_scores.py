"""Scores of cameras for blocks: what they mean in each mode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.assignment import CONFIG, MODES, RENDERED, WIDTH, camera, flight, scene, skyward, strips
from support.instruction_sets import every_instruction_set, on_threads, using
from vdgs.config.method import AssignmentConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels import cpu as kernels
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import cull_anchors, decode_anchors, render
from vdgs.partition.assignment.score_matrix import compute_score_matrix, select_splats
from vdgs.partition.blocks import Blocks


@pytest.mark.parametrize("mode", RENDERED)
def test_one_block_is_the_whole_scene(mode):
    config = replace(CONFIG, mode=mode)
    scores = compute_score_matrix(scene(), strips(1), [*flight(), skyward()], config)
    assert np.array_equal(scores.coverage[:, 0], [1.0] * 9 + [0.0])
    assert np.array_equal(scores.visible_anchors[:, 0] > 0, [True] * 9 + [False])
    if mode == "leave-one-out":
        assert (scores.scores[:9, 0] > 0.5).all()
    else:
        assert np.array_equal(scores.scores[:, 0], [1.0] * 9 + [float(mode == "paper")])


@every_instruction_set
def test_the_splats_of_a_block_draw_what_the_block_alone_draws(instructions):
    model, blocks, view = scene(), strips(3), camera(8.0, tilt_deg=30.0)
    places = model.anchors.positions[:, :2].double().numpy()
    with using(instructions), torch.no_grad():
        rows = cull_anchors(model.anchors, view)
        splats = decode_anchors(model.anchors, rows, model.decoder.weights, view)
        anchor = rows[splats.source.long() // 4]
        for index in range(3):
            reached = torch.from_numpy(blocks.in_expanded(index, places))
            some = select_splats(splats, reached[anchor].nonzero().squeeze(1))
            ours = kernels.rasterize(some, torch.zeros(3), view.width, view.height)
            alone = render(replace(model, anchors=model.anchors.select(reached)), view, background=(0.0, 0.0, 0.0))
            assert torch.equal(ours.image, alone.image)
            assert torch.equal(ours.alpha, alone.alpha)


def expected_scores(mode: str, model: AnchorModel, blocks: Blocks, view: Camera) -> list[float]:
    """The definitions, block by block, from whole renders of parts of the model."""
    positions, black = model.anchors.positions, (0.0, 0.0, 0.0)
    places = positions[:, :2].double().numpy()
    part = lambda keep: replace(model, anchors=model.anchors.select(torch.from_numpy(keep)))  # noqa: E731
    small = view.limit_size(CONFIG.image_size)
    full, scores = render(model, small, background=black), []
    for index in range(len(blocks)):
        own = blocks.owner(places) == index
        block = render(part(blocks.in_expanded(index, places)), small, background=black)
        alike = (block.image - full.image).abs().mean(-1) < CONFIG.tau
        if mode == "coverage":
            drawn = full.alpha > 0.5
            scores.append(float((alike & drawn & (block.alpha > 0.5)).sum() / drawn.sum()))
        elif mode == "paper":
            scores.append(float(alike.float().mean()))
        elif mode == "frustum":
            scores.append(float(view.in_frustum(positions.double().numpy()[own]).mean()))
        else:
            rest = render(part(~own), small, background=black).image
            target = (full.image.clamp(0, 1) * 255).round().to(torch.uint8)
            scores.append(1 - float(kernels.photometric_loss(rest, target, None).ssim))
    return scores


@pytest.mark.parametrize("mode", MODES)
def test_scores_are_what_whole_renders_give(mode):
    blocks, views = strips(4), flight()[1:4]
    scores = compute_score_matrix(scene(), blocks, views, replace(CONFIG, mode=mode))
    expected = [expected_scores(mode, scene(), blocks, view) for view in views]
    assert scores.scores == pytest.approx(np.array(expected), abs=3e-3)
    assert np.count_nonzero(scores.scores > 0.1) >= 3
    everything = scene().anchors.positions.double().numpy()
    owner = blocks.owner(everything[:, :2])
    assert scores.visible_anchors.tolist() == [
        np.bincount(owner[view.in_frustum(everything)], minlength=4).tolist() for view in views
    ]
    assert scores.anchors.tolist() == np.bincount(owner, minlength=4).tolist()
    assert np.isnan(scores.coverage).all() == (mode == "frustum")


def test_empty_pixels_count_in_literal_mode_alone():
    """From high above, the scene fills a small part of the picture: the rest matches any block, however far."""
    views = [camera(WIDTH / 2, height=60.0)]
    literal, coverage = (compute_score_matrix(scene(), strips(4), views, replace(CONFIG, mode=m)) for m in MODES[1::-1])
    assert (literal.scores > 0.8).all()
    assert (coverage.scores < 0.5).all()
    assert np.array_equal(literal.coverage, coverage.scores)
    empty = compute_score_matrix(scene(), strips(4), [skyward()], replace(CONFIG, mode="paper"))
    assert (empty.scores == 1).all()


@pytest.mark.parametrize("mode", ["coverage", "leave-one-out", "frustum"])
def test_a_block_out_of_view_scores_nothing(mode):
    scores = compute_score_matrix(scene(), strips(4), [camera(2.0)], replace(CONFIG, mode=mode))
    assert scores.scores[0, 0] > 0.05
    assert scores.scores[0, 2:].tolist() == [0.0, 0.0]
    assert scores.visible_anchors[0, 2:].tolist() == [0, 0]


@pytest.mark.parametrize("mode", MODES)
def test_scores_depend_on_no_other_camera_and_on_no_number_of_threads(mode):
    config, views, blocks = replace(CONFIG, mode=mode), flight(), strips(3)
    order, told = np.random.default_rng(1).permutation(len(views)), []
    with on_threads(1):
        alone = compute_score_matrix(scene(), blocks, views, config)
    with on_threads(3):
        shuffled = compute_score_matrix(
            scene(), blocks, [views[i] for i in order], config, lambda *done: told.append(done)
        )
    for name in ("scores", "visible_anchors", "coverage", "nadir_block"):
        assert np.array_equal(getattr(alone, name)[order], getattr(shuffled, name), equal_nan=name == "coverage")
    assert told == [(i + 1, 9) for i in range(9)]


def test_pictures_are_made_smaller_and_never_larger():
    big = replace(camera(0.0), width=6400, height=4800)
    assert (big.limit_size(CONFIG.image_size).width, big.limit_size(CONFIG.image_size).height) == (48, 36)
    assert camera(0.0).limit_size(AssignmentConfig().image_size).width == 64
