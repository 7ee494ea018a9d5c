"""The limit of anchors of all blocks together: their shares, and what comes of them in a real run."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from experiments.bench.plan import PlanOptions, make_plan
from support.captures import tiny_scene, write_colmap
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import BlockConfig, DensifyConfig, MethodConfig, max_block_anchors
from vdgs.config.validation_rules import validate_config
from vdgs.pipeline.count_visibility import count_run_visibility
from vdgs.pipeline.find_motion import find_run_motion
from vdgs.pipeline.merge_blocks import merge_run_blocks
from vdgs.pipeline.partition_stage import partition_run
from vdgs.pipeline.train_block import train_block
from vdgs.pipeline.train_coarse import train_coarse
from vdgs.runs.create_or_resume import create_or_resume_run
from vdgs.runs.run_folder import RunFolder

pytestmark = pytest.mark.slow

counts = st.lists(st.integers(0, 10**6), min_size=1, max_size=16).filter(any)


@given(owned=counts, total=st.integers(1, 10**8))
def test_shares_hold_the_total_whatever_the_blocks(owned, total):
    limits = [max_block_anchors(BlockConfig(max_anchors_total=total), each, sum(owned)) for each in owned]
    # Growth stops at the limit and removes nothing.
    held = [max(each, limit) for each, limit in zip(owned, limits, strict=True) if each]
    assert sum(held) <= max(total, sum(owned))
    assert min(limits) >= 1  # 0 would be no limit at all
    assert all(limit >= each for each, limit in zip(owned, limits, strict=True)) or total < sum(owned)


def test_no_total_is_no_limit_and_a_block_may_have_one_of_its_own():
    assert max_block_anchors(BlockConfig(), 10, 30) == 0
    alone = BlockConfig(densify=DensifyConfig(max_anchors=50))
    assert max_block_anchors(alone, 10, 30) == 50
    assert max_block_anchors(replace(alone, max_anchors_total=90), 10, 30) == 30
    assert max_block_anchors(replace(alone, max_anchors_total=900), 10, 30) == 50
    assert validate_config(MethodConfig(block=BlockConfig(max_anchors_total=-1)))


def eager(max_anchors: int) -> MethodConfig:
    """The full method of a table with that limit, in four blocks that grow wherever they may from the first step on."""
    choices = PlanOptions(seeds=1, scenes=("copr",), methods=("full",), max_anchors=max_anchors)
    (planned,) = make_plan("table1", choices).runs
    config, growth = planned.config, planned.config.block.densify
    growth = replace(
        growth,
        every=4,
        stats_start=0,
        start=1,
        stop_fraction=1.0,
        grad_threshold=1e-12,
        min_draw_fraction=0.0,
        coarsest_voxels=2.0,
        prune_view_fraction=1e9,
    )
    return replace(
        config,
        training=replace(config.training, iterations=1, resolution_schedule=((0.0, 1),)),
        assignment=replace(config.assignment, min_cameras=4, image_size=32),
        block=replace(
            config.block, iterations=16, densify=growth, swa_fraction=0.0, crop="off", view_sampling="uniform",
            resolution_schedule=((0.0, 1),),
        ),
    )  # fmt: skip


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene(points=150))
    return folder


def merged(capture: Path, output: Path, max_anchors: int) -> tuple[RunFolder, int, int]:
    """A run, and how many anchors its coarse model and its merged scene have."""
    console = Console(file=io.StringIO())
    context = create_or_resume_run(capture, output, CaptureOptions(), eager(max_anchors))
    run = context.run
    train_coarse(context, CheckpointOptions(), console)
    find_run_motion(context, console)
    count_run_visibility(context, console)
    partition_run(context, console)
    assert context.figure_seconds > 0
    for index in range(len(run.partition_record().blocks)):
        train_block(context, index, CheckpointOptions(), console)
    merge_run_blocks(context, False, console)
    return run, run.coarse.status().anchors, run.merged.status().anchors


def test_a_merged_scene_keeps_to_the_limit_of_all_its_blocks(place, tmp_path):
    limit = 160  # a little more than the coarse model has
    run, coarse, grown = merged(place, tmp_path / "run", limit)
    owned = [each.anchors_core for each in run.partition_record().blocks]
    trained = [run.block(index).status().anchors for index in range(len(owned))]
    shares = [limit * each // coarse for each in owned]
    assert max(owned) > -(-limit // len(owned))  # equal shares would leave the largest above its own
    assert trained == shares  # all of them wanted more
    assert coarse < grown == sum(shares) <= limit
