"""Files of settings: every setting with its comment, read back alike; each source of settings wins over those below."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from vdgs.cli.argument_parser import parse_words
from vdgs.cli.main import main
from vdgs.cli.run_cmd import RunArguments
from vdgs.cli.start_settings import start_settings
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig
from vdgs.config.options import options_of, with_values
from vdgs.config.presets import PRESETS
from vdgs.errors import VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.runs.settings_file import read_settings_file, settings_text
from vdgs.system.atomic_files import write_json
from vdgs.system.quoting import shell_word


def read(file: Path) -> tuple[CaptureOptions, MethodConfig]:
    options, method = read_settings_file(file)
    return with_values(CaptureOptions(), options), with_values(MethodConfig(), method)


def asked(*words: object) -> RunArguments:
    """The arguments of `vdgs run` over their defaults."""
    given = parse_words(RunArguments, ["C", "--output", "R", "--device", "cpu", *map(str, words)])
    arguments: RunArguments = given.over(start_settings(given).layer())
    return arguments


@pytest.mark.parametrize("preset", PRESETS)
def test_a_written_file_holds_every_setting_and_its_comment(preset, tmp_path, capsys):
    file = tmp_path / "settings.yaml"
    with pytest.raises(SystemExit) as ended:
        main(["config", "--preset", preset, "-o", str(file), "--images", "images_4"])
    assert ended.value.code == 0
    assert f"--config {shell_word(file)}" in capsys.readouterr().out
    assert read(file) == (CaptureOptions(images="images_4"), PRESETS[preset])
    text = file.read_text()
    said = " ".join(line.strip().removeprefix("# ") for line in text.splitlines() if line.strip().startswith("#"))
    for option in (*options_of(MethodConfig), *options_of(CaptureOptions)):
        assert option.help
        assert option.help in said
    assert max(map(len, text.splitlines())) <= 120


def test_a_file_that_is_there_is_kept(tmp_path, capsys):
    (tmp_path / "settings.yaml").write_text("mine")
    with pytest.raises(SystemExit) as ended:
        main(["config", "-o", str(tmp_path / "settings.yaml")])
    assert ended.value.code == 1
    assert "is there already. Choose another name, or add --overwrite" in capsys.readouterr().err
    assert (tmp_path / "settings.yaml").read_text() == "mine"


def test_the_file_wins_over_the_preset_and_the_command_over_the_file(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("capture: {downscale: 2}\ntraining: {seed: 7, densify: {every: 50}}\nblock: {iterations: 30}\n")
    laptop = PRESETS["laptop"]
    assert asked().training == laptop.training  # what suits a CPU
    assert asked("--preset", "default").training == PRESETS["default"].training
    arguments = asked("--preset", "laptop", "--config", file, "--block.iterations", 40, "--densify.start", 3)
    densify = replace(laptop.training.densify, every=50, start=3)
    assert arguments.training == replace(laptop.training, seed=7, densify=densify)
    assert arguments.block == replace(laptop.block, iterations=40)
    assert arguments.options == CaptureOptions(downscale=2)


def test_what_a_run_stores_is_such_a_file(tmp_path):
    options = CaptureOptions(images="images_2", gps=tmp_path / "gps.csv")
    run = RunFolder(tmp_path / "run")
    run.create_or_check(RunSettings.create(tmp_path, options, PRESETS["paper"]), command="vdgs run C --output R")
    assert read(run.config_file) == (options, PRESETS["paper"])
    arguments = asked("--config", run.config_file)
    assert (arguments.options, arguments.method()) == (options, PRESETS["paper"])


def test_a_run_that_is_there_keeps_its_settings(tmp_path):
    own = replace(PRESETS["paper"], training=replace(PRESETS["paper"].training, iterations=5))
    options = CaptureOptions(images="images_2")
    RunFolder(tmp_path / "R").create_or_check(RunSettings.create(tmp_path, options, own))
    kept = asked("--output", tmp_path / "R")
    assert (kept.options, kept.method()) == (options, own)
    other = asked("--output", tmp_path / "R", "--preset", "laptop", "--downscale", 2)
    assert (other.options, other.method()) == (replace(options, downscale=2), PRESETS["laptop"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("trainign: {seed: 1}", "there is no setting 'trainign'; did you mean 'training'?"),
        ("iterations: 60", "there is no setting 'iterations'; it stands in training and in block"),
        ("training: {densify: {evry: 1}}", "training.densify has no 'evry'; did you mean 'every'?"),
        ("capture: {image: images_4}", "capture has no 'image'; did you mean 'images'?"),
        ("partition: {lambda_vis: .nan}", "settings.yaml: --lambda-vis nan"),
        ("training: {iterations: many}", "training.iterations is 'many'; it must be a whole number"),
        ("training: 5", "training is 5, not a group of settings"),
        ("- 1", "holds no settings"),
        ("vdgs: {iterations: 5}", "vdgs has no 'iterations'"),
        ("training: [", "cannot be read as YAML"),
        ("training:\n\titerations: 5", "cannot be read as YAML (line 2, column 1: found character"),
        ("training: {iterations: 5, seed: 1, iterations: 6}", "iterations is given twice"),
        ("training: {iterations: 30.000}", "write such as 30000, 30k"),
    ],
)
def test_a_file_that_does_not_work_is_explained(text, says, tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text(text)
    with pytest.raises(VdgsError, match=r"settings\.yaml: ") as raised:
        read_settings_file(file)
    assert says in str(raised.value)


@pytest.mark.parametrize("text", ["training:", "capture:", "training:\n  densify:\nblock: {}", "training: ~", "vdgs:"])
def test_a_section_whose_settings_are_all_commented_out_sets_nothing(text, tmp_path):
    (tmp_path / "settings.yaml").write_text(f"{text}\n# seed: 1\n")
    assert read_settings_file(tmp_path / "settings.yaml") == ({}, {})


def test_a_path_in_a_file_may_begin_in_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    (tmp_path / "settings.yaml").write_text("capture: {images: ~/small, gps: ~/gps.csv, georef: ./~g.json}")
    options = read(tmp_path / "settings.yaml")[0]
    assert (options.images, options.gps) == ("/home/me/small", Path("/home/me/gps.csv"))
    assert options.georef == Path("~g.json")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_files_are_read_as_programs_on_windows_save_them(encoding, tmp_path):
    (tmp_path / "settings.yaml").write_text("# der Größe nach\ntraining: {seed: 7}\n", encoding=encoding)
    assert read(tmp_path / "settings.yaml")[1].training.seed == 7


def test_a_file_without_settings_changes_none(tmp_path):
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    assert read(tmp_path / "empty.yaml") == (CaptureOptions(), MethodConfig())
    text = settings_text(CaptureOptions(), MethodConfig())
    assert list(yaml.safe_load(text)) == ["capture", "training", "partition", "assignment", "block", "merge"]


@pytest.mark.parametrize(("steps", "asked_for"), [(3000, 0), (7200, 0), (4000, 4000)])
def test_steps_that_follow_from_photographs_follow_from_others_again(tmp_path, steps, asked_for):
    """Of the run that is there, and of its settings as a file for another."""
    views, run = [f"{k}.jpg" for k in range(120 if steps == 7200 else 29)], RunFolder(tmp_path / "run")
    method = PRESETS["laptop"]
    method = replace(method, training=replace(method.training, iterations=steps))
    (tmp_path / "capture").mkdir()
    run.create_or_check(RunSettings.create(tmp_path / "capture", CaptureOptions(), method))
    write_json(run.capture_file, {"training_views": views})
    words = [str(tmp_path / "capture"), "--output", str(run.path), "--device", "cpu"]
    of_run = start_settings(parse_words(RunArguments, words))
    assert of_run.method.training.iterations == asked_for
    assert replace(of_run.method, training=method.training) == method
    assert asked("--config", run.path / "config.yaml").method().training.iterations == asked_for
