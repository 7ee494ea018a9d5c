"""Keys: a setting counts where it changes a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import CompensationConfig, DensifyConfig, MethodConfig, PartitionConfig
from vdgs.config.presets import PRESETS
from vdgs.partition.partition_scene import choose_block_count
from vdgs.runs.run_settings import RunSettings
from vdgs.runs.stage_keys import stage_keys

PLAIN = MethodConfig()
CHANGED = {
    "adam": replace(PLAIN, training=replace(PLAIN.training, optimizer="adam")),
    "stereo": replace(PLAIN, training=replace(PLAIN.training, init=replace(PLAIN.training.init, mvs=True))),
    "exposure": replace(PLAIN, training=replace(PLAIN.training, exposure_compensation=True)),
    "spread": replace(PLAIN, training=replace(PLAIN.training, exposure_compensation=True, exposure_min_spread=0.1)),
    "bound": replace(PLAIN, training=replace(PLAIN.training, model=replace(PLAIN.training.model, bound_scales=False))),
}


def keys(method: MethodConfig):
    return stage_keys(RunSettings.create("/somewhere", CaptureOptions(), method))


@pytest.mark.parametrize("name", CHANGED)
def test_a_setting_that_changes_training_changes_all_keys_after_it(name):
    changed, plain = keys(CHANGED[name]), keys(PLAIN)
    assert changed.coarse != plain.coarse
    assert changed.blocks != plain.blocks


def test_settings_of_blocks_and_assignment_leave_what_is_before_them():
    block = replace(PLAIN.block, compensation=replace(PLAIN.block.compensation, target="sum"))
    changed, plain = keys(replace(PLAIN, block=block)), keys(PLAIN)
    assert (changed.coarse, changed.assignment) == (plain.coarse, plain.assignment)
    assert changed.blocks != plain.blocks
    changed = keys(replace(PLAIN, assignment=replace(PLAIN.assignment, always_best=False)))
    assert changed.partition == plain.partition
    assert changed.assignment != plain.assignment


def test_the_readings_of_eq_5_and_of_eq_10_count_where_they_act():
    compensation = replace(PLAIN.block.compensation, history="past")
    changed, plain = keys(replace(PLAIN, block=replace(PLAIN.block, compensation=compensation))), keys(PLAIN)
    assert (changed.assignment, changed.blocks == plain.blocks) == (plain.assignment, False)
    changed = keys(replace(PLAIN, partition=replace(PLAIN.partition, cluster_scale="common")))
    assert (changed.visibility, changed.partition == plain.partition) == (plain.visibility, False)


def test_a_setting_counts_only_beside_the_one_that_it_needs():
    alone = replace(PLAIN, training=replace(PLAIN.training, exposure_min_spread=0.1))
    assert keys(alone) == keys(PLAIN)
    assert keys(CHANGED["spread"]).coarse != keys(CHANGED["exposure"]).coarse


def automatic(**block: Any) -> MethodConfig:
    laptop = PRESETS["laptop"]
    return replace(laptop, partition=PartitionConfig(blocks="auto"), block=replace(laptop.block, **block))


@pytest.mark.parametrize(
    "block",
    [
        {"compensation": CompensationConfig(enabled=True)},
        {"swa_fraction": 0.0},
        {"margin": "ramp"},
        {"densify": DensifyConfig(max_anchors=100_000)},
        {"max_anchors_total": 400_000},
    ],
    ids=str,
)
def test_a_scene_is_cut_anew_where_an_automatic_number_of_blocks_is_another(block):
    plain, changed = automatic(), automatic(**block)
    counts = [choose_block_count(10**6, 50_000, 2 * 10**6, each) for each in (plain, changed)]
    assert counts[0] != counts[1]
    assert keys(plain).partition != keys(changed).partition
    fixed = [replace(each, partition=PartitionConfig(blocks=8)) for each in (plain, changed)]
    assert keys(fixed[0]).partition == keys(fixed[1]).partition


def test_what_does_not_change_an_automatic_number_of_blocks_leaves_the_cut():
    assert keys(automatic()).partition == keys(automatic(iterations=7, decoder="own")).partition
