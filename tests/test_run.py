"""The run folder refuses what would lose or mix results, and says why."""

import json

import pytest

from vdgs.config import PRESETS, TrainConfig, differences, to_dict, validate, with_iterations
from vdgs.errors import RunError
from vdgs.run import RunFolder, StageFolder


def settings(**changes) -> dict:
    return {"capture": {"path": "/data/a"}, "training": to_dict(PRESETS["laptop"]) | changes}


def test_the_same_settings_continue(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.begin(settings())
    run.begin(settings())
    assert run.settings() == settings()


def test_changed_settings_are_refused_with_the_difference(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.begin(settings())
    with pytest.raises(RunError, match="seed: 0 -> 5"):
        run.begin(settings(seed=5))


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(RunError, match=r"holiday\.jpg"):
        RunFolder(tmp_path).begin(settings())


def test_one_process_at_a_time(tmp_path):
    run = RunFolder(tmp_path / "run")
    with run.locked(), pytest.raises(RunError, match="another vdgs process"), run.locked():
        pass


@pytest.mark.parametrize("text", ["", "capture: [", "- 1\n- 2", "\x00\x01"])
def test_a_damaged_config_is_named(tmp_path, text):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(RunError, match=r"config\.yaml"):
        RunFolder(tmp_path).settings()


def test_not_a_run(tmp_path):
    with pytest.raises(RunError, match="not a run folder"):
        RunFolder(tmp_path).settings()


def test_the_log_is_cut_at_the_state_that_training_continues_from(tmp_path):
    folder = StageFolder(tmp_path)
    lines = [json.dumps({"iteration": i}) for i in (50, 100, 150)]
    folder.log.write_text("\n".join(lines) + '\n{"iterat')
    folder.cut_log(100)
    assert folder.log.read_text() == lines[0] + "\n" + lines[1] + "\n"


def test_differences_name_nested_settings():
    assert differences({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}) == ["a.c: 2 -> 3"]


def test_presets_are_valid():
    assert all(validate(preset) == [] for preset in PRESETS.values())


def test_validation_names_each_problem():
    bad = TrainConfig(iterations=-1, resolutions=((0.5, 2),))
    assert len(validate(bad)) == 2


def test_automatic_iterations_follow_the_number_of_photographs():
    automatic = TrainConfig(iterations=0)
    assert [with_iterations(automatic, views).iterations for views in (5, 145, 9000)] == [3000, 8700, 30_000]
    assert with_iterations(TrainConfig(iterations=7), 9000).iterations == 7
