"""Plans of the bench: what tables, methods and scenes are made of, and which runs they need."""

import typing
from dataclasses import replace

import pytest

from experiments.bench.baseline_stages import BASELINES
from experiments.bench.cli import BenchArguments
from experiments.bench.definitions import (
    CITYGAUSSIAN_STAGES,
    BenchMethod,
    BenchScene,
    Budget,
    growth_decisions,
    has_block_folders,
    has_gaussian_blocks,
)
from experiments.bench.methods import METHODS
from experiments.bench.paper_numbers import PAPER_NUMBERS
from experiments.bench.plan import PlanOptions, make_plan
from experiments.bench.scenes import PUBLISHED, SCENES
from experiments.bench.tables import TABLES
from experiments.bench.worker import STAGES
from vdgs.config.method import block_train_config
from vdgs.config.presets import PRESETS
from vdgs.config.serialization import diff_settings, to_dict
from vdgs.config.validation_rules import validate_config
from vdgs.errors import VdgsError


def total_iterations(method: BenchMethod, scene: BenchScene) -> int:
    config = method.settings(scene.base(scene.budget, 0), scene.budget)
    of_blocks = config.partition.blocks * config.block.iterations
    if has_gaussian_blocks(method.stages):
        return of_blocks + (config.training.iterations if method.stages == CITYGAUSSIAN_STAGES else 0)
    return config.training.iterations + (of_blocks if has_block_folders(method.stages) else 0)


@pytest.mark.parametrize("scene", SCENES.values(), ids=lambda scene: scene.name)
def test_every_method_works_on_every_scene_and_gets_the_same_iterations(scene):
    for method in METHODS.values():
        config = method.settings(scene.base(scene.budget, 7), scene.budget)
        assert validate_config(config) == []
        assert config.training.seed == 7
        assert set(method.stages) <= STAGES.keys() | BASELINES.keys()
        if method.less:
            assert total_iterations(method, scene) < scene.budget.total
            continue
        if method.more:
            assert total_iterations(method, scene) > scene.budget.total
            continue
        assert total_iterations(method, scene) == pytest.approx(scene.budget.total, abs=16), method.name


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_tables_name_what_exists(table):
    assert set(table.methods) <= METHODS.keys()
    assert set(table.scenes) <= SCENES.keys()
    assert table.ours in table.methods
    assert not table.groups or [name for group in table.groups for name in group.methods] == list(table.methods)
    plan = make_plan(table.name, PlanOptions())
    assert plan.run_of.keys() == {
        (scene, method, seed)
        for scene in table.scenes
        for method in table.methods
        for seed in (table.seeds[:1] if scene in table.single_seed else table.seeds)
    }
    trained = {run.folder for run in plan.coarse}
    assert all(run.coarse_from in trained for run in plan.runs if "blocks" in run.stages)
    assert len({run.folder for run in plan.runs + plan.coarse}) == len(plan.runs + plan.coarse)


def test_the_command_line_offers_every_table():
    assert set(typing.get_args(typing.get_type_hints(BenchArguments)["table"])) == TABLES.keys()


def test_the_ablations_change_what_they_are_named_after():
    scene = SCENES["residence"]
    base = scene.base(scene.budget, 0)
    settings = {name: method.settings(base, scene.budget) for name, method in METHODS.items()}
    assert settings["full"] == base
    assert (base.training.iterations, base.partition.blocks, base.block.iterations) == (100_000, 8, 50_000)
    assert settings["baseline"].training.iterations == 500_000
    assert settings["no-blocking"].partition.blocks == 1
    assert settings["no-blocking"].block.compensation.enabled
    off = replace(base.block.compensation, enabled=False)
    assert settings["no-anchor-generation"] == replace(base, block=replace(base.block, compensation=off))
    for name in ("no-blocking", "no-blocking-as-long"):
        crossed = replace(settings[name], block=replace(settings[name].block, compensation=off))
        assert settings[f"{name}-plain"] == crossed
    assert settings["lambda-vis-0"].partition.lambda_vis == 0
    assert settings["t-low-0.3"].block.compensation.t_low == 0.3
    assert settings["beta-g-0.5"].block.compensation.beta_g == 0.5
    assert settings["gamma-0.95"].block.compensation.gamma == 0.95
    assert settings["blocks-16"].block.iterations == 25_000
    # The paper's defaults are the middle of each sweep.
    assert {name for name in TABLES["table4"].methods if settings[name] == base} == {
        "lambda-vis-1", "t-low-0.2", "beta-g-2", "gamma-0.9"
    }  # fmt: skip


def test_more_anchors_by_plain_growth_differ_from_it_in_the_threshold_alone():
    scene = SCENES["regime-uneven"]
    base = scene.base(scene.budget, 0)
    settings = {name: to_dict(METHODS[name].settings(base, scene.budget)) for name in TABLES["more-anchors"].methods}
    threshold = base.training.densify.grad_threshold
    assert base.block.densify.grad_threshold == threshold
    for factor in (0.5, 0.25):
        line = f"densify.grad_threshold: {threshold} -> {factor * threshold}"
        eager = f"threshold-{factor:g}"
        assert diff_settings(settings["cell-1-off"], settings[f"cell-1-{eager}"]) == [f"block.{line}"]
        assert diff_settings(settings["coarse"], settings[f"coarse-{eager}"]) == [f"training.{line}"]
    assert not settings["cell-1-off"]["block"]["compensation"]["enabled"]


def test_crossed_cells_differ_from_the_preset_paper_in_the_two_factors_alone():
    scene = SCENES["regime-small"]
    base = scene.base(scene.budget, 0)
    settings = {name: METHODS[name].settings(base, scene.budget) for name in ("vdgs-paper", *TABLES["crossed"].methods)}
    assert settings["paper-1-on"] == settings["vdgs-paper"]
    by_place, plain = "partition.lambda_vis: 1.0 -> 0.0", "block.compensation.enabled: True -> False"
    whole = to_dict(settings["vdgs-paper"])
    for name, lines in (("0-on", [by_place]), ("1-off", [plain]), ("0-off", [by_place, plain])):
        assert sorted(diff_settings(whole, to_dict(settings[f"paper-{name}"]))) == sorted(lines)
    for count in (1, 2, 8):  # each block as long as one of four
        blocks = METHODS[f"paper-blocks-{count}"].settings(base, scene.budget)
        assert diff_settings(whole, to_dict(blocks)) == [f"partition.blocks: 4 -> {count}"]


def test_short_training_decides_about_growth_and_long_training_as_often_as_its_preset():
    for scene, iterations in (("seneca", 900), ("seneca", 1000), ("regime-small", 1600)):
        plan = make_plan("table1", PlanOptions(scenes=(scene,), seeds=1, total_iterations=iterations))
        for method in ("full", "vdgs-paper", "vdgs-default"):
            config = plan.run_of[scene, method, 0].config
            assert growth_decisions(config.training) >= 2
            assert growth_decisions(block_train_config(config, 100)) >= 2
    for scene in ("residence", "regime-uneven", "copr"):
        for method in ("full", "vdgs-paper", "vdgs-default"):
            config = METHODS[method].settings(SCENES[scene].base(SCENES[scene].budget, 0), SCENES[scene].budget)
            assert (config.training.densify.every, config.block.densify.every) == (100, 100)


def test_blocks_as_printed_take_back_what_the_laptop_changes():
    scene = SCENES["lab-uneven"]
    base = scene.base(scene.budget, 0)
    printed, default = METHODS["printed"].settings(base, scene.budget), PRESETS["default"]
    assert printed != base
    assert (printed.block.decoder, printed.block.view_sampling) == ("frozen", "uniform")
    assert (printed.block.decoder, printed.block.view_sampling) == (default.block.decoder, default.block.view_sampling)
    assert printed.assignment.threshold == default.assignment.threshold == 0.45
    # But for what belongs to the scene.
    block = replace(default.block, iterations=base.block.iterations, densify=base.block.densify)
    assert printed.block == block
    alike = {"loss": default.training.loss, "oblique_sampling": 1.0}
    assert printed.training == replace(base.training, **alike) != base.training
    alone = {
        name: METHODS[name].settings(base, scene.budget)
        for name in (
            "frozen-decoder", "even-sampling", "by-votes", "share-0.45", "printed-rates", "half-size", "last-model",
            "printed-compensation",
        )
    }  # fmt: skip
    assert alone["frozen-decoder"] == replace(base, block=replace(base.block, decoder="frozen"))
    assert alone["even-sampling"] == replace(base, block=replace(base.block, view_sampling="uniform"))
    again = {
        name: getattr(default.block, name) for name in ("lr_scale_offsets", "lr_scale_log_scales", "lr_scale_features")
    }
    assert set(again.values()) == {1.0}  # the paper prints no rates for blocks
    assert alone["printed-rates"] == replace(base, block=replace(base.block, **again))
    assert alone["half-size"] == replace(base, block=replace(base.block, resolution_schedule=((0.0, 2), (0.3, 1))))
    assert alone["last-model"] == replace(base, block=replace(base.block, swa_fraction=default.block.swa_fraction))
    compensation = default.block.compensation
    assert alone["printed-compensation"] == replace(base, block=replace(base.block, compensation=compensation))
    assert all(each != base for each in alone.values())
    assert alone["share-0.45"] == replace(base, assignment=replace(base.assignment, threshold=0.45))


def test_default_and_paper_restart_the_coarse_stage_and_paper_leaves_our_choices_out():
    default, paper = PRESETS["default"], PRESETS["paper"]
    for each in (default, paper):
        loop = block_train_config(each, 100)
        assert (loop.lr, loop.densify) == (each.training.lr, each.training.densify)
        assert (loop.iterations, loop.lr_warm_boost, loop.swa_fraction) == (50_000, 1.0, 0.0)
        assert (each.partition.blocks, each.partition.expansion, each.assignment.threshold) == (8, 0.4, 0.45)
    ours = {
        line.split(":")[0] for line in diff_settings(to_dict(default), to_dict(paper))
    }  # fmt: skip
    assert ours == {
        "partition.cluster_axes", "partition.cluster_clip", "partition.cluster_smoothing", "partition.min_block_share",
        "assignment.always_best", "assignment.min_cameras", "assignment.mode", "block.random_background",
        "block.margin", "block.mask_moving", "merge.rule", "training.optimizer", "training.model.bound_scales",
        "training.model.photograph_blur", "training.init.fill_gaps", "training.loss.background",
        "training.loss.random_background", "training.model.background_model", "training.densify.start",
        "training.densify.stop_fraction", "block.densify.start", "block.densify.stop_fraction",
    }  # fmt: skip
    for growth, iterations in ((paper.training.densify, 100_000), (paper.block.densify, 50_000)):
        steps = range(growth.every, int(growth.stop_fraction * iterations) + 1, growth.every)
        decided = [step for step in steps if step >= growth.start]
        assert (decided[0], decided[-1]) == (1_600, iterations // 2 - 100)  # as Scaffold-GS's program compares
    assert not validate_config(paper)


def test_comparators_that_published_dense_adam_have_it():
    scene = SCENES["lab-uneven"]
    base = scene.base(scene.budget, 0)
    scaffold, baseline = (METHODS[name].settings(base, scene.budget) for name in ("scaffold-gs-ours", "baseline"))
    assert scaffold == replace(baseline, training=replace(baseline.training, optimizer="adam"))
    assert block_train_config(METHODS["dense-adam"].settings(base, scene.budget), 100).optimizer == "adam"
    assert baseline.training.optimizer == "sparse-adam"
    merged = {name: METHODS[name].settings(base, scene.budget).merge.rule for name in METHODS}
    assert {name for name, rule in merged.items() if rule == "max-visibility"} == {
        "free-best-seen", "ramp-best-seen", "vdgs-paper", *TABLES["crossed"].methods, *TABLES["paper-blocks"].methods
    }  # fmt: skip


def test_a_sweep_of_t_low_is_not_overruled_by_the_quantile_of_the_laptop():
    scene = SCENES["lab-uneven"]
    assert scene.base(scene.budget, 0).block.compensation.t_low_quantile > 0
    config = METHODS["t-low-0.05"].settings(scene.base(scene.budget, 0), scene.budget)
    assert (config.block.compensation.t_low, config.block.compensation.t_low_quantile) == (0.05, 0.0)


def test_runs_with_the_same_settings_are_one_run():
    plan = make_plan("table4", PlanOptions(scenes=("residence",)))
    defaults = [plan.run_of["residence", name, 0] for name in ("lambda-vis-1", "t-low-0.2", "beta-g-2", "gamma-0.9")]
    assert len({run.folder for run in defaults}) == 1
    assert len(plan.runs) == 17 - 3
    assert len(plan.coarse) == 1


def test_the_coarse_row_trains_nothing_of_its_own():
    plan = make_plan("table2", PlanOptions(scenes=("tiny",), seeds=1))
    shared, of_printed = sorted(plan.coarse, key=lambda run: run.folder != plan.run_of["tiny", "coarse", 0].coarse_from)
    assert plan.run_of["tiny", "full", 0].coarse_from == shared.folder
    assert plan.run_of["tiny", "printed", 0].coarse_from == of_printed.folder
    assert plan.run_of["tiny", "coarse-as-long", 0].coarse_from is None
    assert plan.run_of["tiny", "baseline", 0].coarse_from is None
    # Whatever stands beside it: a table with blocks, later in the same folder, finds what blocks begin with.
    assert make_plan("table2", PlanOptions(scenes=("tiny",), seeds=1, methods=("coarse",))).coarse == (shared,)


def test_a_shared_coarse_stage_does_not_depend_on_the_methods_asked_for():
    some, others = (
        make_plan("table1", PlanOptions(scenes=("tiny",), seeds=1, methods=methods)).coarse
        for methods in (("no-blocking", "full"), ("dogs", "blocks-4", "3dgs"))
    )
    assert some == others
    assert len(some) == 1


def test_pixels_are_grouped_by_the_same_model_whichever_methods_stand_beside_the_own_one():
    plans = [
        make_plan("table1", PlanOptions(scenes=("seneca",), seeds=1, methods=methods))
        for methods in (("full", "vdgs-paper"), ("3dgs-black", "vdgs-paper", "momentum-gs", "full"), ("full",))
    ]
    references = {plan.reference("seneca").folder for plan in plans}
    assert references == {plans[0].run_of["seneca", "full", 0].coarse_from}
    without = make_plan("table1", PlanOptions(scenes=("seneca",), seeds=1, methods=("3dgs-black", "baseline-mean")))
    assert without.reference("seneca").method == "baseline-mean"
    assert make_plan("table1", PlanOptions(scenes=("seneca",), methods=("3dgs-black",))).reference("seneca") is None


def test_a_method_that_is_named_twice_is_refused():
    with pytest.raises(VdgsError, match="--methods names full 2 times"):
        make_plan("table1", PlanOptions(methods=("full", "coarse", "full")))


def test_choices_change_the_budget_for_all_alike():
    plan = make_plan("table2", PlanOptions(scenes=("tiny",), seeds=2, total_iterations=1200, max_anchors=1000))
    assert plan.budgets["tiny"] == Budget(600, 2, 300)
    assert plan.seeds == (0, 1)
    assert make_plan("table2", PlanOptions(scenes=("tiny",), seeds=2, first_seed=1)).seeds == (1, 2)
    full = plan.run_of["tiny", "full", 1].config
    # Growth starts later in proportion, as block.steps_scaler does it.
    assert (full.training.densify.start, full.block.densify.start) == (200, 100)
    for method in ("full", "no-blocking", "printed"):  # whatever the number of blocks
        config = plan.run_of["tiny", method, 1].config
        assert (config.training.densify.max_anchors, config.block.max_anchors_total) == (1000, 1000)
    for wrong in (PlanOptions(scenes=("nowhere",)), PlanOptions(methods=("magic",)), PlanOptions(seeds=0),
                  PlanOptions(steps_scaler=0.0)):  # fmt: skip
        with pytest.raises(VdgsError):
            make_plan("table2", wrong)


def test_the_paper_is_quoted_as_printed():
    table = PAPER_NUMBERS["table1"]
    assert table["VDGS"]["residence"] == (24.03, 0.845, 0.188)
    assert table["Momentum-GS"]["block-all"] == (29.11, 0.881, 0.180)
    assert PAPER_NUMBERS["table2"]["(d) Full"]["residence"] == PAPER_NUMBERS["table3"]["4 blocks"]["residence"]
    assert {scene for row in table.values() for scene in row} == set(PUBLISHED)
    titles = {METHODS[name].title for name in TABLES["table4"].methods}
    assert PAPER_NUMBERS["table4"].keys() == titles - {"β_g = 0.1", "no compensation"}  # ours, not in the paper
