"""Keys: a setting counts where it changes a run."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig
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


def test_a_setting_counts_only_beside_the_one_that_it_needs():
    alone = replace(PLAIN, training=replace(PLAIN.training, exposure_min_spread=0.1))
    assert keys(alone) == keys(PLAIN)
    assert keys(CHANGED["spread"]).coarse != keys(CHANGED["exposure"]).coarse
