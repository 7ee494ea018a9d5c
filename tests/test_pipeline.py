"""`vdgs run` as people run it: real processes, stopped, killed, damaged, given other settings and continued."""

import json
import shutil
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from captures_support import tiny_scene, write_colmap
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.decoder import Decoder
from vdgs.model.visibility import visibility_of
from vdgs.partition.assignment.saving import load_scores
from vdgs.partition.blocks import load_blocks, places_of
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import open_run
from vdgs.stages.evaluate import BlocksAlone

SETTINGS = (
    "--preset", "laptop", "--iterations", "400", "--save-every", "40", "--anchors.offsets", "3",
    "--growth.start", "100", "--growth.statistics-from", "50", "--growth.gate", "0.05", "--blocks", "2",
    "--block.compensation.t-low-quantile", "0",
    "--assignment.min-cameras", "4", "--block.iterations", "250", "--block.growth.gate", "0.05",
    "--block.growth.start", "50", "--block.growth.statistics-from", "0", "--block.growth.interval", "50",
)  # fmt: skip
#: What a block's model is compared by: the whole file.
MERGED = "merged/model.safetensors"


def vdgs(*arguments: object, wait: float = 240) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "vdgs.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=wait)


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene())
    origin = {"frame": "ENU", "origin_lat_deg": 47.0, "origin_lon_deg": 8.5, "origin_alt_m": 400.0}
    (folder / "georef.json").write_text(json.dumps(origin))
    return folder


@pytest.fixture(scope="module")
def unbroken(capture, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("unbroken") / "run"
    done = vdgs("run", capture, "--output", run, *SETTINGS)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "→ merged" in done.stdout
    return run


@pytest.fixture
def copied(unbroken, tmp_path) -> Path:
    return Path(shutil.copytree(unbroken, tmp_path / "run", ignore=shutil.ignore_patterns(".lock")))


def model(run: Path, name: str = MERGED) -> bytes:
    return (run / name).read_bytes()


def changed_files(run: Path, before: dict[str, int]) -> set[str]:
    return {name for name, moment in moments(run).items() if before.get(name) != moment}


def moments(run: Path) -> dict[str, int]:
    return {
        str(path.relative_to(run)): path.stat().st_mtime_ns
        for path in run.rglob("*")
        if path.is_file() and path.name != ".lock"
    }


def test_blocks_draw_parts_of_photographs_and_the_pixels_that_were_asked_for(unbroken, capture, tmp_path):
    """250 photographs' worth of pixels in more steps, or 250 steps with fewer pixels: by the setting."""
    shutil.copytree(unbroken, tmp_path / "run", ignore=shutil.ignore_patterns(".lock"))
    for index, folder in enumerate(RunFolder(unbroken).block_folders()):
        status, cameras = folder.status(), load_scores(unbroken / "partition" / "scores.npz")[2].cameras
        assert status.iteration > 260
        assert status.photographs == pytest.approx(250, abs=1)
        assert len(json.loads((folder.path / "crops.json").read_text())["crops"]) == cameras[:, index].sum()
    done = vdgs("run", capture, "--output", tmp_path / "run", *SETTINGS, "--block.crop", "steps", "--redo")
    assert done.returncode == 0, done.stderr + done.stdout
    for folder in RunFolder(tmp_path / "run").block_folders():
        assert folder.status().iteration == 250
        assert folder.status().photographs < 240
    assert model(tmp_path / "run") != model(unbroken)


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
    owner = blocks.owner(places_of(merged.anchors.positions))
    for index in range(2):
        own = AnchorModel.load(unbroken / f"blocks/{index:02d}/model.safetensors").anchors
        part = merged.anchors.select(torch.from_numpy(owner == index))
        assert all(torch.equal(own.tensors()[name], tensor) for name, tensor in part.tensors().items())
    coarse = AnchorModel.load(unbroken / "coarse/model.safetensors")
    assert len(merged.anchors) > len(coarse.anchors)
    assert bits(merged.decoder) == bits(coarse.decoder)
    blocks_own = [AnchorModel.load(unbroken / f"blocks/{index:02d}/model.safetensors").decoder for index in range(2)]
    assert [bits(part.decoder) for part in merged.parts] == [bits(own) for own in blocks_own]
    assert len({tuple(bits(each).values()) for each in (coarse.decoder, *blocks_own)}) == 3


def bits(decoder: Decoder) -> dict[str, bytes]:
    return {name: tensor.detach().numpy().tobytes() for name, tensor in decoder.tensors().items()}


def test_blocks_as_printed_leave_one_decoder(unbroken, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(unbroken, run)
    trained = vdgs("train", run, "--block.decoder", "frozen", "--block.sampling", "even", "--redo", "--jobs", 1)
    assert trained.returncode == 0, trained.stderr
    assert vdgs("merge", run).returncode == 0
    coarse, merged = AnchorModel.load(run / "coarse/model.safetensors"), AnchorModel.load(run / MERGED)
    assert merged.parts == ()
    assert bits(merged.decoder) == bits(coarse.decoder)
    for index in range(2):
        block = AnchorModel.load(run / f"blocks/{index:02d}/model.safetensors")
        assert bits(block.decoder) == bits(coarse.decoder)
        other = AnchorModel.load(unbroken / f"blocks/{index:02d}/model.safetensors")
        assert bits(other.decoder) != bits(block.decoder)


def test_a_block_alone_stands_among_coarse_anchors_with_the_coarse_decoder(unbroken):
    run, coarse = RunFolder(unbroken), AnchorModel.load(unbroken / "coarse/model.safetensors")
    alone = BlocksAlone(run, coarse).assembled(1)
    own = AnchorModel.load(unbroken / "blocks/01/model.safetensors")
    assert [part.count for part in alone.parts] == [len(own.anchors), len(alone.anchors) - len(own.anchors)]
    assert [bits(part.decoder) for part in alone.parts] == [bits(own.decoder), bits(coarse.decoder)]
    assert len(alone.anchors) > len(own.anchors)


def test_cycles_of_compensated_growth_are_logged(unbroken):
    lines = [json.loads(line) for line in (unbroken / "blocks/00/log.jsonl").read_text().splitlines()]
    cycles = [line for line in lines if line.get("low_share") is not None]
    assert [line["iteration"] for line in cycles] == [50, 100]
    assert all(0 <= line["low_share"] <= 1 and line["t_low"] == 0.2 for line in cycles)
    assert all(line["grown_low"] + line["grown_other"] == line["grown"] for line in cycles)


def test_every_camera_serves_a_block_and_v_is_brute_force(unbroken):
    _, _, assignment = load_scores(unbroken / "partition/scores.npz")
    assert assignment.cameras.any(axis=1).all()
    assert (assignment.cameras.sum(axis=0) >= 4).all()
    opened = open_run(unbroken, "coarse")
    cameras = [view.camera for view in opened.capture.train_views]
    brute = sum(camera.sees(opened.model.anchors.positions.double().numpy()).astype(int) for camera in cameras)
    assert np.array_equal(visibility_of(opened.model.anchors.positions, cameras).numpy(), brute)


def test_a_finished_run_does_nothing_again(capture, copied):
    before = moments(copied)
    again = vdgs("run", capture, "--output", copied, *SETTINGS)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("nothing to do") == 7
    assert changed_files(copied, before) <= {"report.html"}


def test_other_settings_are_refused_where_they_cost_training(capture, copied):
    before = moments(copied)
    refused = vdgs("run", capture, "--output", copied, *SETTINGS, "--lambda-vis", "0")
    assert refused.returncode == 1
    assert "partition.lambda_vis: 1.0 -> 0.0" in refused.stderr
    assert "--redo" in refused.stderr
    assert changed_files(copied, before) == set()


def test_a_changed_setting_redoes_exactly_what_depends_on_it(capture, copied):
    before = moments(copied)
    redone = vdgs("run", capture, "--output", copied, *SETTINGS, "--block.compensation.beta-g", "0", "--redo")
    assert redone.returncode == 0, redone.stderr
    changed = {name.split("/")[0] for name in changed_files(copied, before)}
    assert changed == {"config.yaml", "blocks", "merged", "evaluation", "report.html"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_is_cut_off_while_blocks_train_continues_to_the_same_bits(capture, unbroken, copied, number):
    for name in ("blocks", "merged", "evaluation"):
        shutil.rmtree(copied / name)
    command = [sys.executable, "-m", "vdgs.cli", "run", str(capture), "--output", str(copied), *SETTINGS]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not list(copied.glob("blocks/*/checkpoints/*.json")):
        time.sleep(0.02)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    if number == signal.SIGINT:
        assert process.returncode == 130, errors
        assert "The same command continues" in errors
    done = vdgs("run", capture, "--output", copied, *SETTINGS)
    assert done.returncode == 0, done.stderr + done.stdout
    assert model(copied) == model(unbroken)


def test_a_block_that_is_killed_is_started_again(unbroken, copied):
    shutil.rmtree(copied / "blocks/01")
    command = [sys.executable, "-m", "vdgs.cli", "train", str(copied)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not list(copied.glob("blocks/01/checkpoints/*.json")):
        time.sleep(0.02)
    children = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout.split()
    for child in children:
        subprocess.run(["kill", "-9", child], check=False)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert "crashed by SIGKILL" in output
    assert model(copied, "blocks/01/model.safetensors") == model(unbroken, "blocks/01/model.safetensors")


def test_one_block_alone_is_the_same_block(unbroken, copied):
    shutil.rmtree(copied / "blocks/00")
    done = vdgs("train", copied, "--block", "0", "--threads", "2")
    assert done.returncode == 0, done.stderr
    assert model(copied, "blocks/00/model.safetensors") == model(unbroken, "blocks/00/model.safetensors")
    absent = vdgs("train", copied, "--block", "7")
    assert absent.returncode == 1
    assert "has blocks 0 to 1; there is no block 7" in absent.stderr


def test_a_missing_block_stops_the_merge_unless_the_coarse_model_may_stand_in(copied):
    for name in ("blocks/01", "merged"):
        shutil.rmtree(copied / name)
    refused = vdgs("merge", copied)
    assert refused.returncode == 1
    assert "block 1: not trained yet" in refused.stderr
    assert "--incomplete" in refused.stderr
    assert not (copied / MERGED).exists()
    done = vdgs("merge", copied, "--incomplete")
    assert done.returncode == 0, done.stderr
    blocks, merged = load_blocks(copied / "partition/blocks.geojson"), AnchorModel.load(copied / MERGED)
    coarse = AnchorModel.load(copied / "coarse/model.safetensors").anchors
    stood_in = coarse.positions[torch.from_numpy(blocks.owner(places_of(coarse.positions)) == 1)]
    held = merged.anchors.positions[torch.from_numpy(blocks.owner(places_of(merged.anchors.positions)) == 1)]
    assert torch.equal(stood_in, held)


def test_one_block_is_the_whole_scene_and_merging_it_the_identity(capture, copied):
    done = vdgs("run", capture, "--output", copied, *SETTINGS, "--no-blocking", "--redo")
    assert done.returncode == 0, done.stderr
    assert [path.name for path in (copied / "blocks").iterdir()] == ["00"]
    merged, block = (AnchorModel.load(copied / name) for name in (MERGED, "blocks/00/model.safetensors"))
    assert all(torch.equal(t, block.anchors.tensors()[name]) for name, t in merged.anchors.tensors().items())


def test_stages_need_those_before_them(capture, tmp_path):
    run = tmp_path / "run"
    done = vdgs("coarse", capture, "--output", run, *SETTINGS[:4], "--anchors.offsets", "3")
    assert done.returncode == 0, done.stderr
    for verb, needed in (("train", "vdgs partition"), ("merge", "vdgs partition")):
        refused = vdgs(verb, run)
        assert refused.returncode == 1
        assert needed in refused.stderr
        assert "Traceback" not in refused.stderr
    for verb in ("visibility", "partition", "train", "merge", "eval", "report"):
        more = ["--blocks", "2"] if verb == "partition" else ["--block.iterations", "30"] if verb == "train" else []
        done = vdgs(verb, run, *more)
        assert done.returncode == 0, done.stderr
    assert json.loads((run / "evaluation/metrics.json").read_text())["model"] == "merged"


@pytest.mark.parametrize("file", ["partition/blocks.geojson", "partition/scores.npz", "partition/partition.json"])
def test_damaged_files_of_a_partition_are_named(copied, file):
    shutil.rmtree(copied / "blocks/00")
    (copied / file).write_bytes((copied / file).read_bytes()[:50])
    done = vdgs("train", copied, "--block", "0")
    assert done.returncode == 1
    assert Path(file).name in done.stderr
    assert "Traceback" not in done.stderr
    assert "vdgs partition" in done.stderr
    mended = vdgs("partition", copied)  # what the message advises helps
    assert mended.returncode == 0, mended.stderr
    assert vdgs("train", copied, "--block", "0").returncode == 0


def test_nothing_is_built_on_a_model_of_other_settings(capture, copied):
    """A change of the coarse stage's settings counts at once, even if training it again never began."""
    settings = ["--seed", "7", *SETTINGS]
    command = [sys.executable, "-m", "vdgs.cli", "run", str(capture), "--output", str(copied), *settings, "--redo"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and "seed: 7" not in (copied / "config.yaml").read_text():
        time.sleep(0.001)
    process.kill()
    process.communicate()
    if "seed: 7" in (copied / "config.yaml").read_text():
        refused = vdgs("partition", copied)
        if refused.returncode:  # unless the kill came before the claim: then the old model still has the old key
            assert "no coarse model of its settings" in refused.stderr
    done = vdgs("run", capture, "--output", copied, *settings, "--redo")
    assert done.returncode == 0, done.stderr
    assert "already trained; nothing to do" not in done.stdout


def test_figures_of_another_model_are_not_taken_for_this_ones(capture, copied):
    again = vdgs("eval", copied, "--bins", "2")
    assert again.returncode == 0, again.stderr
    done = vdgs("run", capture, "--output", copied, *SETTINGS)
    assert done.returncode == 0, done.stderr
    assert len(json.loads((copied / "evaluation/metrics.json").read_text())["views_by_visibility"]) > 0
    assert done.stdout.count("already measured") == 1  # the coarse one


def test_a_block_trained_again_is_merged_again(unbroken, copied):
    shutil.rmtree(copied / "blocks/01")
    assert vdgs("merge", copied, "--incomplete").returncode == 0
    assert model(copied) != model(unbroken)
    assert vdgs("train", copied).returncode == 0
    assert vdgs("merge", copied).returncode == 0
    assert model(copied) == model(unbroken)


def test_why_a_view_was_assigned(copied):
    told = vdgs("partition", copied, "--why", "frame_001.png")
    assert told.returncode == 0, told.stderr
    assert "frame_001.png" in told.stdout
    assert "threshold" in told.stdout or "best block" in told.stdout or "topped up" in told.stdout
    unknown = vdgs("partition", copied, "--why", "nobody.png")
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
