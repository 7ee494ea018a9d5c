"""Keys: a setting that came later leaves runs of before as they are, and counts where it changes a run."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vdgs.runs.keys import counted, stage_keys
from vdgs.settings.method import MethodConfig
from vdgs.settings.plain import to_dict
from vdgs.settings.presets import PRESETS

CAPTURE = {"capture": {"path": "/somewhere", "images": None}}
PLAIN = MethodConfig()
#: Settings that came with exposure, dense Adam and the readings of compensation.
CHANGED = {
    "adam": replace(PLAIN, training=replace(PLAIN.training, adam="dense")),
    "stereo": replace(PLAIN, training=replace(PLAIN.training, anchors=replace(PLAIN.training.anchors, stereo=True))),
    "exposure": replace(PLAIN, training=replace(PLAIN.training, exposure=True)),
    "spread": replace(PLAIN, training=replace(PLAIN.training, exposure=True, exposure_spread=0.1)),
    "drop": replace(PLAIN, training=replace(PLAIN.training, seldom=replace(PLAIN.training.seldom, drop=0.1))),
    "bound": replace(
        PLAIN, training=replace(PLAIN.training, anchors=replace(PLAIN.training.anchors, bound_sizes=False))
    ),
}


def keys(method: MethodConfig):
    return stage_keys(to_dict(method) | CAPTURE)


@pytest.mark.parametrize("preset", ["paper", "laptop"])
def test_runs_of_before_have_their_keys(preset):
    """As settings were recorded before these came."""
    training = PRESETS[preset].training
    without = replace(training, exposure=False, exposure_spread=0.0, anchors=replace(training.anchors, stereo=False))
    now = to_dict(replace(PRESETS[preset], training=without)) | CAPTURE
    before = to_dict(replace(PRESETS[preset], training=without)) | CAPTURE
    for name in ("adam", "exposure", "exposure_spread", "seldom"):
        del before["training"][name]
    del before["training"]["anchors"]["bound_sizes"]
    del before["training"]["anchors"]["stereo"]
    del before["training"]["rates"]["exposure"]
    del before["training"]["compensation"]["added_to"]
    del before["block"]["compensation"]["added_to"]
    del before["assignment"]["best_block"]
    assert stage_keys(now) == stage_keys(before)
    assert "seldom" not in counted("training", now["training"])
    assert "voxel" in counted("training", now["training"])["anchors"]


@pytest.mark.parametrize("name", CHANGED)
def test_a_setting_that_changes_training_changes_all_keys_after_it(name):
    changed, plain = keys(CHANGED[name]), keys(PLAIN)
    assert changed.coarse != plain.coarse
    assert changed.blocks != plain.blocks


def test_settings_of_blocks_and_assignment_leave_what_is_before_them():
    block = replace(PLAIN.block, compensation=replace(PLAIN.block.compensation, added_to="sum"))
    changed, plain = keys(replace(PLAIN, block=block)), keys(PLAIN)
    assert (changed.coarse, changed.assignment) == (plain.coarse, plain.assignment)
    assert changed.blocks != plain.blocks
    changed = keys(replace(PLAIN, assignment=replace(PLAIN.assignment, best_block=False)))
    assert changed.partition == plain.partition
    assert changed.assignment != plain.assignment


def test_a_setting_counts_only_beside_the_one_that_it_needs():
    alone = replace(PLAIN, training=replace(PLAIN.training, exposure_spread=0.1))
    assert keys(alone) == keys(PLAIN)
    assert keys(CHANGED["spread"]).coarse != keys(CHANGED["exposure"]).coarse
