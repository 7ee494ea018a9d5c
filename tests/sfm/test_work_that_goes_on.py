"""Work that was stopped goes on with what it has, but for what the command that goes on makes another."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("embreex")

from support.flights import ORIGIN, copy_folder, write_photograph
from vdgs.captures.reconstruction import read_digests
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.sfm import feature_matching, reconstruct
from vdgs.sfm.feature_extraction import count_features
from vdgs.sfm.focal_decision import should_fix_focal
from vdgs.sfm.gcp_list import GcpList
from vdgs.sfm.reconstruction_plan import plan_reconstruction
from vdgs.sfm.step_keys import step_keys
from vdgs.sfm.workspace import Workspace

pytestmark = pytest.mark.xdist_group("sfm")


def strips(card: Path, table: Path) -> Path:
    """Twelve photographs that say nothing of how they were flown, and a table that says: in level strips."""
    card.mkdir()
    lines = ["name,lat,lon,alt"]
    for k in range(12):
        pixels = np.random.default_rng(k).integers(0, 255, (120, 160, 3), np.uint8)
        write_photograph(card / f"{k:02d}.jpg", pixels, k, None)
        place = np.array([[30.0 * (k % 4), 30.0 * (k // 4), 60.0]])
        lines.append(f"{k:02d}.jpg,{','.join(f'{value:.8f}' for value in geodetic_from_enu(place, ORIGIN)[0])}")
    table.write_text("\n".join(lines))
    return card


def test_models_are_made_anew_where_positions_that_come_later_hold_the_focal_length(tmp_path):
    """A model whose focal length was fitted is none of one that was held. What was matched stays, and a finished
    capture is placed anew."""
    card = strips(tmp_path / "card", tmp_path / "gps.csv")
    held, keys = [], []
    for gps in (None, tmp_path / "gps.csv"):
        request = SfmRequest(image_folders=(card,), output=tmp_path / "capture", gps=gps)
        plan = plan_reconstruction(request)
        held.append(should_fix_focal(plan.image_list.images, plan.gps_priors, SfmOptions())[0])
        keys.append(step_keys(plan, read_digests(request.output)))
    assert held == [False, True]
    assert {step for step in keys[0] if keys[0][step] == keys[1][step]} == {"features", "matches", "capture"}


def test_captures_are_placed_anew_where_a_list_or_positions_are_said_to_be_of_another_system(tmp_path):
    """A list of the same numbers, whose heights are said to be the metres that they were only taken for."""
    card = strips(tmp_path / "card", tmp_path / "gps.csv")
    request = SfmRequest(image_folders=(card,), output=tmp_path / "capture", gps=tmp_path / "gps.csv")
    plan = plan_reconstruction(request)
    guessed = GcpList((), "NAD83 / Ohio North (ftUS)", "gcp.txt", (), unsaid_height_unit_m=0.3048)
    told = replace(guessed, unsaid_height_unit_m=None)
    positions = plan.gps_priors
    plans = [
        plan,
        replace(plan, gcps=guessed),
        replace(plan, gcps=told),
        replace(plan, gcps=replace(told, crs="NAD83(2011) / Ohio North (ftUS)")),
        replace(plan, gcps=replace(told, datum_error_m=2.0)),
        replace(plan, gps_priors=replace(positions, datum_errors_m=np.full(len(positions), 2.0))),
        replace(plan, gps_priors=replace(positions, altitude_reference="over the ellipsoid")),
        replace(plan, gps_priors=replace(positions, are_stated=~positions.are_stated)),
    ]
    keys = [step_keys(each, read_digests(request.output)) for each in plans]
    assert len({each["placed"] for each in keys}) == len(plans)
    assert len({each["capture"] for each in keys}) == 1


@pytest.mark.slow
def test_pairs_that_were_matched_are_counted_and_not_chosen_again(nine, nine_begun, tmp_path, monkeypatch):
    """To choose them without positions takes all descriptors."""
    copy_folder(nine_begun["mapping"], tmp_path / "capture")
    request = SfmRequest(image_folders=(nine.folder,), output=tmp_path / "capture", threads=1)
    plan, work = plan_reconstruction(request), Workspace(request.output / "work")
    key = step_keys(plan, read_digests(request.output))["matches"]
    chosen = feature_matching.select_pairs(work, plan.image_list.images, plan.gps_priors, request.options)
    there = count_features(work)
    monkeypatch.setattr(feature_matching, "select_pairs", lambda *_: pytest.fail("was done already"))
    console = Console(file=io.StringIO())
    assert reconstruct._matches(plan, work, key, console) == sum(all(map(there.get, pair)) for pair in chosen) > 0
