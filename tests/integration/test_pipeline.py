"""`vdgs run` by real processes: what it leaves, what the same command does again, and what other settings change."""

import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from support.captures import tiny_scene, write_colmap
from support.commands import do_tasks_here, vdgs
from support.pipeline_run import BLOCK_ITERATIONS, ITERATIONS, MERGED, SETTINGS, changed_files, model, moments
from vdgs.evaluation.evaluate_run import IsolatedBlocks
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.decoder import Decoder
from vdgs.partition.assignment.score_file import load_scores
from vdgs.partition.blocks import Blocks, load_blocks, xy_positions
from vdgs.pipeline.dense_points import PIXELS_PER_POINT
from vdgs.runs.open_run import open_run
from vdgs.runs.run_folder import RunFolder
from vdgs.visibility.visibility_counts import count_visibility

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("pipeline")]


def train_each(run: Path, *settings: str) -> None:
    """Train every block again, one command each."""
    for index in range(2):
        done = vdgs("train-blocks", run, "--block", index, *settings, "--overwrite")
        assert done.returncode == 0, done.stderr


def test_a_run_ends_with_maps_and_its_report_shows_them(copied, capture):
    asked = ("run", capture, "--output", copied, *[each for each in SETTINGS if each != "--no-ortho"])
    done = vdgs(*asked)
    assert done.returncode == 0, done.stderr
    assert {"orthophoto.tif", "dsm.tif", "visibility.tif"} <= {file.name for file in (copied / "maps").iterdir()}
    assert "The scene as maps." in (copied / "report.html").read_text()
    assert vdgs(*asked).stdout.startswith("nothing to do")
    (copied / "report.html").unlink()
    assert "already drawn" in vdgs(*asked).stdout


def test_a_scene_goes_out_and_says_what_it_loses(copied, tmp_path):
    scene = tmp_path / "out" / "scene.ply"
    done = vdgs("export", copied, "--output", scene, "--output", tmp_path / "out" / "scene.splat")
    assert done.returncode == 0, done.stderr
    assert "scene.ply, read back, on" in done.stdout
    assert "scene.splat, read back, on" in done.stdout
    loss = json.loads((copied / "export.json").read_text())["losses"][0]
    measured = json.loads((copied / "evaluation" / "metrics.json").read_text())
    assert loss["psnr"] == pytest.approx(measured["psnr_reference_exposure"], abs=1e-6)
    assert loss["ssim"] == pytest.approx(measured["ssim_reference_exposure"], abs=1e-6)
    assert abs(loss["psnr_baked"] - loss["psnr"]) < 0.5
    assert {"psnr", "psnr_baked", "ssim_baked", "lower"} <= loss["by_visibility"][0].keys()


def test_blocks_draw_parts_of_photographs_and_the_pixels_that_were_asked_for(unbroken, copied):
    """So many photographs' worth of pixels in more steps, or so many steps with fewer pixels: by the setting."""
    for index, folder in enumerate(RunFolder(unbroken).block_folders()):
        status, cameras = folder.status(), load_scores(unbroken / "partition" / "scores.npz")[2].cameras
        assert status.iteration > 1.04 * BLOCK_ITERATIONS
        assert status.images_drawn == pytest.approx(BLOCK_ITERATIONS, abs=1)
        assert len(json.loads((folder.path / "crops.json").read_text())["crops"]) == cameras[:, index].sum()
    train_each(copied, "--block.crop", "fixed-steps", "--block.decoder", "frozen", "--block.view-sampling", "uniform")
    for folder in RunFolder(copied).block_folders():
        assert folder.status().iteration == BLOCK_ITERATIONS
        assert folder.status().images_drawn < 0.96 * BLOCK_ITERATIONS
        assert model(copied, folder.model) != model(unbroken, folder.model.relative_to(copied))
    assert vdgs("merge", copied).returncode == 0
    assert_one_decoder(copied, unbroken)


def assert_one_decoder(run: Path, unbroken: Path) -> None:
    """Blocks whose decoder is frozen, as printed, leave that of the coarse model, and others do not."""
    coarse, merged = AnchorModel.load(run / "coarse/model.safetensors"), AnchorModel.load(run / MERGED)
    assert merged.decoder_spans == ()
    assert bits(merged.decoder) == bits(coarse.decoder)
    for index in range(2):
        block = AnchorModel.load(run / f"blocks/{index:02d}/model.safetensors")
        assert bits(block.decoder) == bits(coarse.decoder)
        other = AnchorModel.load(unbroken / f"blocks/{index:02d}/model.safetensors")
        assert bits(other.decoder) != bits(block.decoder)


def test_a_run_leaves_what_the_documents_say(unbroken):
    expected = [
        "config.yaml", "capture.json", "coarse/model.safetensors", "coarse/evaluation/metrics.json",
        "visibility/visibility.json", "visibility/map.png", "partition/blocks.geojson", "partition/scores.npz",
        "partition/blocks_wgs84.geojson", "partition/partition.json", "partition/blocks.png",
        "partition/block_facts.png", "partition/scores.png", "blocks/00/model.safetensors", "blocks/01/log.jsonl",
        "blocks/01/output.log", MERGED, "evaluation/metrics.json", "evaluation/by_block.json",
        "evaluation/contact_sheet.png", "report.html",
    ]  # fmt: skip
    assert [name for name in expected if not (unbroken / name).is_file()] == []
    assert not list(unbroken.rglob("*.tmp"))
    metrics = {folder: json.loads((unbroken / folder / "metrics.json").read_text())
               for folder in ("coarse/evaluation", "evaluation")}  # fmt: skip
    assert (metrics["coarse/evaluation"]["model"], metrics["evaluation"]["model"]) == ("coarse", "merged")
    bins = [[each["pixels"] for each in each["by_visibility"]] for each in metrics.values()]
    assert bins[0] == bins[1]  # both models are measured on the same pixels


def test_the_merged_scene_is_the_cores_of_the_blocks(unbroken):
    blocks, merged = load_blocks(unbroken / "partition/blocks.geojson"), AnchorModel.load(unbroken / MERGED)
    assert len(blocks) == 2
    owner = blocks.owner(xy_positions(merged.anchors.positions))
    for index in range(2):
        own = AnchorModel.load(unbroken / f"blocks/{index:02d}/model.safetensors").anchors
        part = merged.anchors.select(torch.from_numpy(owner == index))
        assert all(torch.equal(own.tensors()[name], tensor) for name, tensor in part.tensors().items())
    coarse = AnchorModel.load(unbroken / "coarse/model.safetensors")
    assert len(merged.anchors) > len(coarse.anchors)
    assert bits(merged.decoder) == bits(coarse.decoder)
    blocks_own = [AnchorModel.load(unbroken / f"blocks/{index:02d}/model.safetensors").decoder for index in range(2)]
    assert [bits(part.decoder) for part in merged.decoder_spans] == [bits(own) for own in blocks_own]
    assert len({tuple(bits(each).values()) for each in (coarse.decoder, *blocks_own)}) == 3


def bits(decoder: Decoder) -> dict[str, bytes]:
    return {name: tensor.detach().numpy().tobytes() for name, tensor in decoder.tensors().items()}


def test_a_block_alone_stands_among_coarse_anchors_with_the_coarse_decoder(unbroken, monkeypatch):
    run, coarse = RunFolder(unbroken), AnchorModel.load(unbroken / "coarse/model.safetensors")
    asked, owner = list[int](), Blocks.owner
    monkeypatch.setattr(Blocks, "owner", lambda self, points: asked.append(len(points)) or owner(self, points))
    blocks = IsolatedBlocks(run, coarse)
    other, alone = blocks.assemble(0), blocks.assemble(1)
    assert asked == [len(coarse.anchors)]  # for both: of millions it takes seconds
    assert len(other.anchors) != len(alone.anchors)
    own = AnchorModel.load(unbroken / "blocks/01/model.safetensors")
    assert [part.count for part in alone.decoder_spans] == [len(own.anchors), len(alone.anchors) - len(own.anchors)]
    assert [bits(part.decoder) for part in alone.decoder_spans] == [bits(own.decoder), bits(coarse.decoder)]
    assert len(alone.anchors) > len(own.anchors)


def test_cycles_of_compensated_growth_are_logged(unbroken):
    lines = [json.loads(line) for line in (unbroken / "blocks/00/log.jsonl").read_text().splitlines()]
    cycles = [line for line in lines if line.get("low_share") is not None]
    until = lines[-1]["iteration"] // 2  # blocks draw parts of photographs: how many steps they make follows from those
    assert until >= 50
    assert [line["iteration"] for line in cycles] == list(range(25, until + 1, 25))
    assert all(0 <= line["low_share"] <= 1 and line["t_low"] == 0.2 for line in cycles)
    assert all(line["grown_low"] + line["grown_other"] == line["grown"] for line in cycles)


def test_every_camera_serves_a_block_and_v_is_brute_force(unbroken):
    _, _, assignment = load_scores(unbroken / "partition/scores.npz")
    assert assignment.cameras.any(axis=1).all()
    assert (assignment.cameras.sum(axis=0) >= 4).all()
    opened = open_run(unbroken, "coarse")
    cameras = [view.camera for view in opened.capture.train_views]
    brute = sum(camera.in_frustum(opened.model.anchors.positions.double().numpy()).astype(int) for camera in cameras)
    assert np.array_equal(count_visibility(opened.model.anchors.positions, cameras).numpy(), brute)


def test_a_finished_run_does_nothing_again(capture, copied):
    before = moments(copied)
    again = vdgs("run", capture, "--output", copied, *SETTINGS)
    assert again.returncode == 0, again.stderr
    assert again.stdout.startswith(f"nothing to do: {copied} is whole")
    assert changed_files(copied, before) == set()
    (copied / "report.html").unlink()  # so that every stage looks
    again = vdgs("run", capture, "--output", copied, *SETTINGS)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("nothing to do") == 8
    assert changed_files(copied, before) <= {"report.html", ".run/progress.json"}


def test_damaged_counts_of_cameras_are_counted_again(copied):
    file = copied / "visibility" / "visibility.safetensors"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    done = vdgs("visibility", copied)
    assert done.returncode == 0, done.stderr
    assert file.read_bytes() == whole


def test_models_that_were_cut_off_are_made_again_with_the_same_bits(capture, copied):
    models = {copied / stage / "model.safetensors" for stage in ("coarse", "blocks/00", "merged")}
    before = {file: file.read_bytes() for file in models}
    for file, content in before.items():
        file.write_bytes(content[: len(content) * 2 // 3])
    assert vdgs("status", copied).returncode != 0
    again = vdgs("run", capture, "--output", copied, *SETTINGS)
    assert again.returncode == 0, again.stderr
    assert {file: file.read_bytes() for file in models} == before
    assert vdgs("status", copied).returncode == 0


def test_other_settings_are_refused_where_they_cost_training(capture, copied):
    before = moments(copied)
    refused = vdgs("run", capture, "--output", copied, *SETTINGS, "--lambda-vis", "0")
    assert refused.returncode == 1
    assert "--lambda-vis: 1.0 -> 0.0" in refused.stderr
    assert "--overwrite" in refused.stderr
    assert changed_files(copied, before) == set()


def test_a_changed_setting_redoes_exactly_what_depends_on_it(capture, copied):
    before = moments(copied)
    redone = vdgs(
        "run",
        capture,
        "--output",
        copied,
        *SETTINGS,
        "--block.compensation.beta-g",
        "0",
        "--overwrite",
        prepare=do_tasks_here,
    )
    assert redone.returncode == 0, redone.stderr
    changed = {name.split("/")[0] for name in changed_files(copied, before)}
    assert changed - {".run"} == {"config.yaml", "blocks", "merged", "evaluation", "report.html"}


def test_a_dry_run_says_what_it_takes_and_writes_nothing(capture, copied, tmp_path):
    whole = vdgs("run", capture, "--output", copied, *SETTINGS, "--dry-run")
    assert whole.stdout.startswith("nothing to do"), whole.stderr
    shutil.rmtree(copied / "merged")
    before = moments(copied)
    for output, done in ((copied, True), (tmp_path / "new", False)):
        planned = vdgs("run", capture, "--output", output, *SETTINGS, "--dry-run", "--sfm.focal", "refine")
        assert planned.returncode == 0, planned.stderr
        assert "--sfm.focal: without effect" in planned.stdout
        assert ("what is left of the job: " in planned.stdout) is done
        assert f"{ITERATIONS} iterations" in planned.stdout
        assert f"2 blocks: about {BLOCK_ITERATIONS} iterations each, 2 at once" in planned.stdout
        assert planned.stdout.count("done already") == 2 * done
        assert "stereo" not in planned.stdout  # sparse points suffice
    changed = vdgs("run", capture, "--output", copied, *SETTINGS, "--lambda-vis", "0", "--dry-run")
    assert "changed --lambda-vis: 1.0 -> 0.0" in changed.stdout
    assert "these make 2 blocks useless, so that the run is refused without --overwrite" in changed.stdout
    assert changed.stdout.count("done already") == 1
    shrunk = vdgs("run", capture, "--output", copied, *SETTINGS, "--downscale", "2", "--dry-run")
    assert "changed --downscale: 1.0 -> 2.0" in shrunk.stdout, shrunk.stderr
    assert "done already" not in shrunk.stdout
    assert changed_files(copied, before) == set()
    assert not (tmp_path / "new").exists()


def test_a_dry_run_counts_what_stereo_may_add(tmp_path):
    write_colmap(tmp_path / "capture", tiny_scene(points=80))
    planned = vdgs("run", tmp_path / "capture", "--output", tmp_path / "run", *SETTINGS, "--dry-run")
    assert f"and at most {10 * 64 * 48 // PIXELS_PER_POINT - 80} where stereo finds ground" in planned.stdout
    assert "training steps at each size, stereo." in " ".join(planned.stdout.split())


def test_another_cut_leaves_no_old_result_standing(copied):
    """What was trained and measured for the cut of before is neither merged nor drawn nor reported as this one's."""
    assert vdgs("partition", copied, "--lambda-vis", "0.5", "--overwrite").returncode == 0
    refused = vdgs("merge", copied)
    assert refused.returncode == 1
    assert "block 0: trained for another cut" in refused.stderr
    drawn = vdgs("render", copied, "--output", copied / "views", "--width", "32")
    assert drawn.returncode == 0, drawn.stderr
    assert "this is the coarse model, not the merged one" in drawn.stdout
    assert "coarse model (" in drawn.stdout
    assert "of 32x" in drawn.stdout
    assert vdgs("report", copied).returncode == 0
    assert "Coarse model: PSNR" in (copied / "report.html").read_text()
    again = vdgs("train-blocks", copied, prepare=do_tasks_here)
    assert again.returncode == 0, again.stderr
    assert "trained again: blocks 0, 1" in again.stdout


def test_one_block_alone_is_the_same_block(unbroken, copied):
    shutil.rmtree(copied / "blocks/00")
    done = vdgs("train-blocks", copied, "--block", "0", "--threads", "2")
    assert done.returncode == 0, done.stderr
    assert model(copied, "blocks/00/model.safetensors") == model(unbroken, "blocks/00/model.safetensors")
    absent = vdgs("train-blocks", copied, "--block", "7")
    assert absent.returncode == 1
    assert "has blocks 0 to 1; there is no block 7" in absent.stderr


def test_a_missing_block_stops_the_merge_unless_the_coarse_model_may_stand_in(copied):
    for name in ("blocks/01", "merged"):
        shutil.rmtree(copied / name)
    refused = vdgs("merge", copied)
    assert refused.returncode == 1
    assert "block 1: not trained yet" in refused.stderr
    assert "--allow-missing-blocks" in refused.stderr
    assert not (copied / MERGED).exists()
    done = vdgs("merge", copied, "--allow-missing-blocks")
    assert done.returncode == 0, done.stderr
    blocks, merged = load_blocks(copied / "partition/blocks.geojson"), AnchorModel.load(copied / MERGED)
    coarse = AnchorModel.load(copied / "coarse/model.safetensors").anchors
    stood_in = coarse.positions[torch.from_numpy(blocks.owner(xy_positions(coarse.positions)) == 1)]
    held = merged.anchors.positions[torch.from_numpy(blocks.owner(xy_positions(merged.anchors.positions)) == 1)]
    assert torch.equal(stood_in, held)


def test_one_block_is_the_whole_scene_and_merging_it_the_identity(copied):
    for command in (("partition", copied, "--blocks", "1", "--overwrite"), ("train-blocks", copied), ("merge", copied)):
        done = vdgs(*command, prepare=do_tasks_here)
        assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (copied / "blocks").iterdir()) == ["00", "request.json"]
    merged, block = (AnchorModel.load(copied / name) for name in (MERGED, "blocks/00/model.safetensors"))
    assert all(torch.equal(t, block.anchors.tensors()[name]) for name, t in merged.anchors.tensors().items())


def test_stages_need_those_before_them(copied):
    for name in ("partition", "blocks", "merged", "evaluation"):
        shutil.rmtree(copied / name)
    for verb in ("train-blocks", "merge"):
        refused = vdgs(verb, copied)
        assert refused.returncode == 1
        assert "vdgs partition" in refused.stderr
        assert "Traceback" not in refused.stderr


def test_figures_of_another_model_are_not_taken_for_this_ones(capture, copied):
    again = vdgs("eval", copied, "--visibility-bins", "2")
    assert again.returncode == 0, again.stderr
    assert json.loads((copied / "evaluation/metrics.json").read_text())["model"] == "merged"  # where there is one
    done = vdgs("run", capture, "--output", copied, *SETTINGS)
    assert done.returncode == 0, done.stderr
    assert len(json.loads((copied / "evaluation/metrics.json").read_text())["views_by_visibility"]) > 0
    assert done.stdout.count("already measured") == 1  # the coarse one


def test_why_a_view_was_assigned(copied):
    told = vdgs("partition", copied, "--explain", "frame_001.png")
    assert told.returncode == 0, told.stderr
    assert "frame_001.png" in told.stdout
    assert "threshold" in told.stdout or "best block" in told.stdout or "topped up" in told.stdout
    unknown = vdgs("partition", copied, "--explain", "nobody.png")
    assert unknown.returncode == 1
    assert "no training view 'nobody.png'" in unknown.stderr


def test_the_report_is_one_file_without_links_out(unbroken):
    text = (unbroken / "report.html").read_text()

    links: list[str] = []

    class Links(HTMLParser):
        def handle_starttag(self, tag, attrs):
            links.extend(value for name, value in attrs if name in ("src", "href") and value)

    Links().feed(text)
    assert len(links) > 5
    assert all(link.startswith(("data:", "#")) for link in links)
