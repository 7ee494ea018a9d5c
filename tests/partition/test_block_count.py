"""How many blocks a scene is cut into: by the photographs, and by the memory that training a block takes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from vdgs.config.method import BlockConfig, MethodConfig, PartitionConfig
from vdgs.config.presets import PRESETS
from vdgs.geometry.camera import Camera
from vdgs.partition.partition_scene import choose_block_count
from vdgs.pipeline.train_blocks import _block_bytes
from vdgs.runs.run_folder import RunFolder
from vdgs.system.memory.memory_estimate import train_bytes_per_pixel


def test_the_number_of_blocks() -> None:
    def count(anchors: int, cameras: int, **settings: Any) -> int:
        method = replace(PRESETS["laptop"], partition=PartitionConfig(**settings))
        return choose_block_count(anchors, cameras, 10**6, method)

    assert count(10**6, 500, blocks=3) == 3
    assert [count(10**5, cameras, blocks="auto") for cameras in (33, 145, 400, 5000)] == [1, 1, 1, 1]
    # Memory asks for 20 blocks or so, photographs allow fewer.
    few = [count(2 * 10**6, cameras, blocks="auto", block_memory_gb=3.0) for cameras in (33, 145, 400)]
    assert few == [1, 2, 8]
    by_memory = [count(2 * 10**6, 5000, blocks="auto", block_memory_gb=gb) for gb in (2.5, 3, 4, 8, 64)]
    assert by_memory == sorted(by_memory, reverse=True)
    assert by_memory[0] > by_memory[-1] == 1


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(("offsets", "pixels"), [(10, 10**6), (32, 10**6), (10, 2 * 10**7)])
@pytest.mark.parametrize("limits", [{}, {"max_anchors": 15 * 10**5}, {"max_anchors_total": 2 * 10**6}])
def test_a_block_by_memory_takes_at_most_that_in_training(
    preset: str, offsets: int, pixels: int, limits: dict[str, int]
) -> None:
    """By the estimate of the stage that trains it: its growth, its limits of anchors, its mean, its picture."""
    anchors, gb = 10**6, 1 + train_bytes_per_pixel(PRESETS[preset].training) / 1e9 * pixels + 1.3 * offsets / 10
    method = PRESETS[preset]
    growth = replace(method.block.densify, max_anchors=limits.get("max_anchors", 0))
    block = replace(method.block, densify=growth, max_anchors_total=limits.get("max_anchors_total", 0))
    training = replace(method.training, model=replace(method.training.model, num_offsets=offsets))
    partition = PartitionConfig(blocks="auto", block_memory_gb=gb)
    method = MethodConfig(training, partition, method.assignment, block)
    count = choose_block_count(anchors, 50_000, pixels, method)
    assert 1 < count < 1000

    def taken(blocks: int) -> int:
        own = [SimpleNamespace(anchors_core=anchors // blocks)] * blocks
        run = SimpleNamespace(method=lambda: method, partition_record=lambda: SimpleNamespace(blocks=own))
        return _block_bytes(
            cast(RunFolder, run),
            [Camera(camera_from_world=np.eye(4), fx=1, fy=1, cx=0, cy=0, width=pixels // 1000, height=1000)],
        )

    assert taken(count) <= 1e9 * gb < 1.001 * taken(count - 1)


def test_more_growth_asks_for_more_blocks_and_limits_of_anchors_for_fewer() -> None:
    auto, paper = PartitionConfig(blocks="auto"), PRESETS["default"]

    def count(block: BlockConfig) -> int:
        return choose_block_count(2 * 10**6, 50_000, 10**6, MethodConfig(partition=auto, block=block))

    plain = replace(paper.block, compensation=replace(paper.block.compensation, enabled=False))
    limited = replace(paper.block, max_anchors_total=2 * 10**6)
    assert count(paper.block) > count(plain) > count(limited)
    assert count(replace(plain, swa_fraction=0.5)) > count(plain)
