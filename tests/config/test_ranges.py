"""Every number that a person may give has a range, and what lies outside is said before any work."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from experiments.bench.cli import BenchArguments
from vdgs.cli.capture_cmds import InspectArguments, SfmArguments, SynthArguments
from vdgs.cli.export_cmd import ExportArguments
from vdgs.cli.main import main
from vdgs.cli.result_cmds import EvalArguments, OrthoArguments, RenderArguments, ViewArguments
from vdgs.cli.run_cmd import RunArguments, TrainCoarseArguments
from vdgs.cli.stage_cmds import MergeArguments, PartitionArguments, TrainBlocksArguments
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig, PartitionConfig
from vdgs.config.options import options_of
from vdgs.config.presets import PRESETS
from vdgs.config.ranges import NumericSetting, Range, check_ranges, find_range_errors, iter_numbers
from vdgs.config.serialization import from_dict, to_dict
from vdgs.config.validation_rules import validate_config
from vdgs.errors import VdgsError
from vdgs.synth.synth_options import SynthOptions

HERE = Path("here")
ARGUMENTS: tuple[Any, ...] = (
    BenchArguments(table="toy", output=HERE),
    InspectArguments(HERE, HERE),
    SynthArguments(HERE),
    EvalArguments(run=HERE),
    RenderArguments(run=HERE, output=HERE),
    PartitionArguments(run=HERE),
    TrainBlocksArguments(run=HERE),
    MergeArguments(run=HERE),
    OrthoArguments(run=HERE),
    ExportArguments(run=HERE),
    SfmArguments(images=(HERE,), output=HERE),
    ViewArguments(run=HERE),
    TrainCoarseArguments(capture=HERE, output=HERE),
    RunArguments(capture=HERE, output=HERE),
    MethodConfig(),
    *PRESETS.values(),
)


@pytest.mark.parametrize("asked", ARGUMENTS, ids=lambda asked: type(asked).__name__)
def test_every_number_has_a_range_that_holds_its_default(asked):
    assert [each.flag for each in iter_numbers(asked) if each.range is None] == []
    assert find_range_errors(asked) == []
    assert all(math.isfinite(each.range.max) for each in iter_numbers(asked) if each.range is not None)


def test_numbers_are_found_wherever_they_stand():
    """So the test above can fail."""
    found = {each.flag: each for each in iter_numbers(MethodConfig())}
    assert found["--blocks"].value == 8
    assert {"--lr.offsets", "--resolution-schedule", "--block.densify.stop-fraction"} <= found.keys()
    assert [each.value for each in iter_numbers(MethodConfig().training.lr)][:2] == [0.01, 1e-4]
    auto = PartitionConfig(blocks="auto")
    assert next(each for each in iter_numbers(auto) if each.path == ("blocks",)) == NumericSetting(
        ("blocks",), None, Range(1, 10_000)
    )


@pytest.mark.parametrize(
    ("kind", "flag", "word", "value"),
    [
        (RunArguments, "--iterations", "1e3", 1000),
        (RunArguments, "--iterations", "30_000", 30_000),
        (RunArguments, "--iterations", "30,000", 30_000),
        (RunArguments, "--iterations", "2.5k", 2500),
        (RunArguments, "--iterations", "30.000", None),  # thirty thousand to half of the world
        (RunArguments, "--iterations", "1e400", None),
        (RunArguments, "--seed", "9007199254740993", 9007199254740993),  # no number of floating point
        (RunArguments, "--blocks", "auto", "auto"),
        (RunArguments, "--downscale", "1,5", 1.5),
        (RunArguments, "--downscale", "1,500", None),
        (RunArguments, "--downscale", "50%", None),
        (SynthArguments, "--overlap", "70%", 0.7),
        (SynthArguments, "--extent-m", "12000cm", 120.0),
        (OrthoArguments, "--bbox", "832300,619770,832400.5,619850", (832300.0, 619770.0, 832400.5, 619850.0)),
        (OrthoArguments, "--gsd", "5cm", None),  # the map may count in feet
    ],
)
def test_numbers_are_read_as_people_write_them_where_they_are_clear(kind, flag, word, value):
    option = next(each for each in options_of(kind) if each.flag == flag)
    if value is None:
        with pytest.raises(ValueError, match=f"^{word}: must be a .*number; write such as"):
            option.read([word])
    else:
        assert option.read([word]) == value
        assert type(option.read([word])) is type(value)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, -1e300])
def test_no_range_holds_what_is_no_sensible_number(value):
    ranges = {each.range for asked in ARGUMENTS for each in iter_numbers(asked)}
    assert not any(each.contains(value) for each in ranges if each is not None)


def test_ends_belong_to_a_range_unless_it_says_otherwise():
    assert [Range(0, 1).contains(end) for end in (0, 1)] == [True, True]
    assert [Range(0, 1, exclusive_min=True).contains(end) for end in (0, 1)] == [False, True]
    assert [Range(0, 1, exclusive_max=True).contains(end) for end in (0, 1)] == [True, False]
    assert [Range(2, 3, allow_zero=True).contains(value) for value in (0, 1, 2)] == [True, False, True]
    assert str(Range(0, 1, exclusive_min=True, allow_zero=True)) == "0, or above 0 and at most 1"


def test_each_number_out_of_range_is_named_as_the_command_line_names_it():
    method = MethodConfig()
    wrong = replace(
        method,
        partition=replace(method.partition, lambda_vis=math.nan),
        block=replace(method.block, densify=replace(method.block.densify, stop_fraction=2.0)),
    )
    assert validate_config(wrong) == [
        "--lambda-vis nan: must be at least 0 and at most 1000",
        "--block.densify.stop-fraction 2.0: must be at least 0 and at most 1",
    ]
    with pytest.raises(VdgsError, match=r"--downscale 0\.5: must be at least 1"):
        check_ranges(CaptureOptions(downscale=0.5))
    with pytest.raises(VdgsError, match=r"(?s)--num-images 1: .*--overlap nan: "):
        SynthOptions(num_images=1, overlap=math.nan).resolved()


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "C", "--output", "R", "--expansion", "nan"],
        ["run", "C", "--output", "R", "--threads", "-3"],
        ["train-coarse", "C", "--output", "R", "--downscale", "1e9"],
        ["inspect", "C", "--output", "R", "--test-every", "0"],
        ["render", "R", "--output", "O", "--seconds", "nan"],
        ["render", "R", "--output", "O", "--width", "10000000"],
        ["eval", "R", "--visibility-bins", "100000"],
        ["synth", "O", "--noise-px", "inf"],
        ["bench", "toy", "--output", "O", "--seeds", "0"],
    ],
)
def test_the_command_line_says_so_at_once(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 1
    assert re.search(rf"{arguments[-2]} .*: must be ", capsys.readouterr().err)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"training": {"iterations": "many"}}, r"training\.iterations is 'many'; it must be a whole number"),
        ({"training": {"iterations": 1.5}}, "must be a whole number"),
        ({"training": {"lr": {"offsets": [1]}}}, "must be a list of 2: a number, a number"),
        ({"training": {"model": 3}}, "not a group of settings"),
        ({"partition": {"blocks": "most"}}, "must be a whole number or auto"),
        ({"partition": {"balanced": 1}}, "must be true or false"),
        ({"block": {"margin": "frozn"}}, "must be frozen or ramp or free"),
        ({"block": {"view_sampeling": "uniform"}}, "block has no 'view_sampeling'; did you mean 'view_sampling'"),
    ],
)
def test_a_value_of_another_kind_is_named(settings, says):
    with pytest.raises(ValueError, match=says):
        from_dict(MethodConfig, settings)


def test_a_number_that_yaml_takes_for_text_is_still_one():
    densify = from_dict(MethodConfig, {"block": {"densify": {"grad_threshold": "1e-4"}}}).block.densify
    assert densify.grad_threshold == 1e-4
    for said, number in (("1e3", 1000), (1e3, 1000), ("9007199254740993", 9007199254740993)):
        assert from_dict(MethodConfig, {"training": {"seed": said}}).training.seed == number
    for said, iterations in (("30k", 30_000), ("30,000", 30_000), ("2.5k", 2500)):
        assert from_dict(MethodConfig, {"training": {"iterations": said}}).training.iterations == iterations
    words = {"training": {"densify": {"stop_fraction": "70%"}, "lr": {"offsets": ["1,5", "1e-4"]}}}
    training = from_dict(MethodConfig, words).training
    assert (training.densify.stop_fraction, training.lr.offsets) == (0.7, (1.5, 1e-4))
    with pytest.raises(ValueError, match=r"'30\.000'; it must be a whole number; write such as 30000, 30k"):
        from_dict(MethodConfig, {"training": {"iterations": "30.000"}})
    for said, word in ((True, "on"), (False, "off"), ("auto", "auto")):  # YAML takes on and off for truth
        assert from_dict(MethodConfig, {"block": {"mask_moving": said}}).block.mask_moving == word
    assert to_dict(from_dict(CaptureOptions, {"gps": "/a.csv"}))["gps"] == "/a.csv"
