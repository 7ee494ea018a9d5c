"""The run folder refuses what would lose or mix results, and says why."""

import json
from dataclasses import replace

import pytest
import yaml

from support.captures import tiny_scene, write_colmap
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import BlockConfig, DensifyConfig, MethodConfig, TrainConfig, resolve_iterations
from vdgs.config.presets import PRESETS
from vdgs.config.serialization import diff_settings, from_dict, to_dict
from vdgs.config.validation_rules import validate_config
from vdgs.errors import RunError
from vdgs.runs.config_file import load_yaml
from vdgs.runs.create_or_resume import create_or_resume_run
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import SECTIONS, RunSettings
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.runs.stage_keys import REQUIRED_SETTINGS, hashable_settings, stage_keys
from vdgs.system.atomic_files import write_json, write_text


def settings(**changes) -> RunSettings:
    laptop = PRESETS["laptop"]
    return RunSettings.create(
        "/data/a", CaptureOptions(), replace(laptop, training=replace(laptop.training, **changes))
    )


def test_the_same_settings_continue(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.create_or_check(settings())
    run.create_or_check(settings())
    assert run.settings() == settings()


def test_changed_settings_are_refused_with_the_difference(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.create_or_check(settings())
    with pytest.raises(RunError, match="seed: 0 -> 5"):
        run.create_or_check(settings(seed=5))


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(RunError, match=r"holiday\.jpg"):
        RunFolder(tmp_path).create_or_check(settings())


def test_one_process_at_a_time(tmp_path):
    run = RunFolder(tmp_path / "run")
    with run.locked(), pytest.raises(RunError, match="another vdgs process"), run.locked():
        pass


@pytest.mark.parametrize(
    "text",
    ["", "capture: [", "- 1\n- 2", "\x00\x01", "capture: 2026-13-45", pytest.param("[" * 100_000, id="nested deeply")],
)
def test_a_damaged_config_is_named(tmp_path, text):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(RunError, match=r"config\.yaml"):
        RunFolder(tmp_path).settings()


def test_a_config_that_was_cut_off_is_not_filled_up_with_defaults(tmp_path):
    run = RunFolder(tmp_path)
    run.create_or_check(settings())
    text = run.config_file.read_text()
    for section in SECTIONS[1:]:
        run.config_file.write_text(text[: text.index(f"\n{section}:\n") + 1])
        with pytest.raises(RunError, match=f"damaged .*no `{section}`"):
            run.settings()


def test_numbers_of_settings_are_decimal():
    text = "{a: 010, b: 1:30, c: 12, d: 0x10, e: -3, f: 1:30.5}"
    assert load_yaml(text) == {"a": "010", "b": "1:30", "c": 12, "d": 16, "e": -3, "f": "1:30.5"}


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"capture": {"path": "/data/a", "imagse": "x"}}, r"capture has no 'imagse'; did you mean 'images'\?"),
        ({"capture": {"path": "/data/a", "images": 5}}, r"capture\.images is 5; it must be text"),
        ({"capture": {"images": None}}, "`capture` must be a group of settings with a path"),
        ({"merge": {"rule": "mine"}}, r"merge\.rule is 'mine'; it must be owner or max-visibility"),
        ({"blocks": 4}, "there is no setting 'blocks'"),
        ({"training": {"average": 0.3}}, r"config\.yaml: training has no 'average'.* begun anew: vdgs run"),
        ({"block": {"ring": "ramp"}}, r"config\.yaml: block has no 'ring'; did you mean .* begun anew: vdgs run"),
    ],
)
def test_a_setting_that_is_none_is_named(tmp_path, change, complaint):
    run = RunFolder(tmp_path)
    write_text(run.config_file, yaml.safe_dump(settings().to_dict() | change))
    with pytest.raises(RunError, match=complaint):
        run.settings()


def test_settings_are_read_anew_where_the_file_changes(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.create_or_check(settings())
    assert run.settings() == settings()
    run.config.write(settings(seed=7))
    assert run.settings() == settings(seed=7)


def test_not_a_run(tmp_path):
    with pytest.raises(RunError, match="not a run folder"):
        RunFolder(tmp_path).settings()


def test_the_log_is_cut_at_the_state_that_training_continues_from(tmp_path):
    folder = StageFolder(tmp_path)
    lines = [json.dumps({"iteration": i}) for i in (50, 100, 150)]
    folder.log.write_text("\n".join(lines) + '\n{"iterat')
    folder.truncate_log(100)
    assert folder.log.read_text() == lines[0] + "\n" + lines[1] + "\n"


def test_differences_name_nested_settings():
    assert diff_settings({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}) == ["a.c: 2 -> 3"]


def test_presets_are_valid():
    assert all(validate_config(preset) == [] for preset in PRESETS.values())


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_a_file(preset):
    method = PRESETS[preset]
    assert from_dict(MethodConfig, json.loads(json.dumps(to_dict(method)))) == method


def test_an_unknown_setting_is_named():
    with pytest.raises(ValueError, match=r"settings\.block has no 'rings'"):
        from_dict(MethodConfig, {"block": {"rings": "frozen"}})


def test_a_change_that_costs_trained_work_needs_redo(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.create_or_check(settings())
    other = replace(settings(), partition=replace(settings().partition, lambda_vis=0.7))
    run.change_settings(other, overwrite=False)  # nothing is trained yet
    run.block(0).reset_unless(run.keys().blocks)
    run.block(0).model.write_bytes(b"a trained block")
    with pytest.raises(RunError, match=r"--lambda-vis: 0\.7 -> 1\.0(?s:.*)a block useless. Add --overwrite"):
        run.change_settings(settings(), overwrite=False)
    assert run.settings() == other
    assert run.change_settings(settings(), overwrite=True) == ["--lambda-vis: 0.7 -> 1.0"]
    assert run.settings() == settings()


def test_a_stage_deletes_what_was_made_for_other_settings_and_nothing_else(tmp_path):
    folder = StageFolder(tmp_path / "stage")
    folder.reset_unless("a")
    folder.model.write_bytes(b"model")
    folder.set_status(StatusRecord(state="done", iteration=3))
    folder.reset_unless("a")
    assert folder.is_done("a")
    assert not folder.is_done("b")
    folder.reset_unless("b")
    assert not folder.model.exists()
    assert folder.status() == StatusRecord(state="new")
    assert folder.key() == "b"


def test_work_of_unknown_settings_is_not_taken_over(tmp_path):
    folder = StageFolder(tmp_path / "stage")
    folder.reset_unless("a")
    folder.model.write_bytes(b"model")
    folder.set_status(StatusRecord(state="done"))
    folder.status_file.unlink()  # as the message about a damaged one advises: the key stays known
    folder.reset_unless("a")
    assert folder.model.exists()
    folder.key_file.unlink()
    folder.reset_unless("a")
    assert not folder.model.exists()


def test_what_is_built_on_the_coarse_model_depends_on_the_very_model():
    ours, theirs = stage_keys(settings(), "1-a"), stage_keys(settings(), "1-b")
    assert ours.coarse == theirs.coarse
    assert ours.partition != theirs.partition
    assert ours.merge != theirs.merge


def test_each_setting_invalidates_the_stages_that_depend_on_it_and_no_others():
    order = ["coarse", "partition", "assignment", "blocks", "merge"]
    before = stage_keys(settings())
    changes: list[tuple[str, dict[str, object], int]] = [
        ("capture", {"images": "other"}, 0), ("training", {"seed": 5}, 0), ("partition", {"lambda_vis": 0.7}, 1),
        ("assignment", {"tau": 0.1}, 2), ("block", {"lr_scale_offsets": 0.5}, 3),
        ("merge", {"rule": "max-visibility"}, 4),
    ]  # fmt: skip
    for section, change, first in changes:
        section_changed = replace(getattr(settings(), section), **change)
        changed = stage_keys(replace(settings(), **{section: section_changed}))
        same = [getattr(before, stage) == getattr(changed, stage) for stage in order]
        assert same == [index < first for index in range(5)], section
    moved = stage_keys(replace(settings(), capture_path="/elsewhere"))
    assert moved == before


def test_blocks_share_the_run_and_one_process_works_on_each(tmp_path):
    run = RunFolder(tmp_path / "run")
    with run.locked(shared=True), run.locked(shared=True), run.block(1).locked():
        with pytest.raises(RunError, match="another vdgs process"), run.locked():
            pass
        with pytest.raises(RunError, match="another vdgs process"), run.block(1).locked():
            pass


def test_validation_names_each_problem():
    bad = MethodConfig(TrainConfig(iterations=-1, resolution_schedule=((0.5, 2),)))
    assert len(validate_config(bad)) == 2


def test_automatic_iterations_follow_the_number_of_photographs():
    automatic = TrainConfig(iterations=0)
    assert [resolve_iterations(automatic, views).iterations for views in (5, 145, 9000)] == [3000, 8700, 30_000]
    assert resolve_iterations(TrainConfig(iterations=7), 9000).iterations == 7


def test_every_setting_counts_beside_the_one_that_it_needs():
    settings = {"capture": {"images": None}} | to_dict(MethodConfig())
    for path in _leaves(settings):
        beside = _changed(settings, (path[0], REQUIRED_SETTINGS[path])) if path in REQUIRED_SETTINGS else settings
        assert _counted(_changed(beside, path)) != _counted(beside), path


def _counted(settings: dict) -> dict:
    return {section: hashable_settings(section, values) for section, values in settings.items()}


def _leaves(settings: dict, above: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Where the single settings are in a tree of them."""
    paths = []
    for name, value in settings.items():
        paths += _leaves(value, (*above, name)) if isinstance(value, dict) else [(*above, name)]
    return paths


def _changed(settings: dict, path: tuple[str, ...]) -> dict:
    """Settings with another value of one."""
    name, *below = path
    return {**settings, name: _changed(settings[name], tuple(below)) if below else "other"}


def test_a_ramp_needs_a_frozen_decoder():
    ramp = BlockConfig(margin="ramp", decoder="own")
    assert any("ramp needs --block.decoder frozen" in each for each in validate_config(MethodConfig(block=ramp)))
    assert validate_config(MethodConfig(block=replace(ramp, decoder="frozen"))) == []


@pytest.mark.parametrize(
    ("average", "until", "problems"), [(0.0, 1.0, 0), (0.3, 0.99, 0), (0.3, 1.0, 1), (1.0, 0.5, 1), (-0.1, 0.5, 1)]
)
def test_a_mean_needs_an_end_of_growth(average, until, problems):
    growth = DensifyConfig(stop_fraction=until)
    coarse = MethodConfig(training=TrainConfig(swa_fraction=average, densify=growth))
    block = MethodConfig(block=BlockConfig(swa_fraction=average, densify=growth))
    assert [len(validate_config(each)) for each in (coarse, block)] == [problems, problems]
    assert all(
        "densify.stop_fraction" in each or "swa-fraction" in each
        for each in validate_config(coarse) + validate_config(block)
    )


@pytest.mark.parametrize(("begins", "problems"), [(0.5, 0), (0.51, 1)])
def test_a_mean_is_of_models_of_one_image_size(begins, problems):
    settings = {
        "swa_fraction": 0.5,
        "densify": DensifyConfig(stop_fraction=0.4),
        "resolution_schedule": ((0.0, 2), (begins, 1)),
    }
    assert len(validate_config(MethodConfig(training=TrainConfig(**settings)))) == problems
    assert len(validate_config(MethodConfig(block=BlockConfig(**settings)))) == problems


def test_a_run_whose_blocks_are_at_work_is_taken_up_again_but_not_changed(tmp_path):
    """Blocks that a driver began which died since share the run with the next."""
    place, method = tmp_path / "capture", PRESETS["laptop"]
    other = replace(method, partition=replace(method.partition, lambda_vis=0.7))
    write_colmap(place, tiny_scene())
    context = create_or_resume_run(place, tmp_path / "run", CaptureOptions(), method, overwrite=False)
    run, capture = context.run, context.capture
    write_json(run.capture_file, capture_metadata(capture))
    with run.locked(shared=True):
        create_or_resume_run(place, run.path, CaptureOptions(), method, overwrite=False)
        with pytest.raises(RunError, match="another vdgs process"):
            create_or_resume_run(place, run.path, CaptureOptions(), other, overwrite=True)
