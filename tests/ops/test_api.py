"""The functions of `vdgs`: what the command line makes of the same things, bit for bit; said when it fails."""

from __future__ import annotations

import json
import shutil
import signal
import warnings
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation

import vdgs
from support.captures import tiny_scene
from support.commands import CommandsHere, small_figures
from support.dataset_layouts import write_transforms
from support.fake_device import CARD, pretended_card
from support.small_pipeline import vdgs as verb
from vdgs.config.presets import PRESETS
from vdgs.config.validation_rules import checked_settings
from vdgs.errors import CaptureError, RunError, Stopped, VdgsError
from vdgs.model.anchor_model import AnchorModel
from vdgs.system.stop_signals import catch_stop_signals

pytestmark = [pytest.mark.xdist_group("api"), pytest.mark.slow]


@pytest.fixture(scope="module")
def run(native_small):
    return vdgs.open_run(native_small.whole)


@pytest.fixture(scope="module")
def coarse(native_small):
    return vdgs.open_run(native_small.whole, model="coarse").scene


@pytest.fixture(scope="module")
def capture(native_small):
    return vdgs.load_capture(native_small.capture, up="z")


def test_a_run_is_opened_and_drawn(run, native_small):
    assert len(run.scene) == len(run.scene.positions)
    assert (len(run.blocks), run.assignment.cameras.shape) == (2, (5, 2))
    camera = run.scene.cameras[0]
    out = vdgs.render(run.scene, camera, mode="rgb+depth")
    assert out.rgb.shape == (camera.height, camera.width, 3)
    assert bool((out.alpha >= 0).all())
    assert float(out.depth.nanmean()) == pytest.approx(10, abs=1.5)  # so high is the flight
    assert float(out.expected_depth.nanmean()) == pytest.approx(10, abs=1.5)
    assert vdgs.render(run.scene, camera).depth is None
    loaded = vdgs.Scene.load(native_small.whole / "merged" / "model.safetensors")
    assert torch.equal(vdgs.render(loaded, camera).rgb, out.rgb)
    with pytest.raises(VdgsError, match="choose rgb"):
        vdgs.render(run.scene, camera, mode="depths")


def test_a_background_is_three_numbers_in_any_form(run):
    camera = run.scene.cameras[0]
    wanted = vdgs.render(run.scene, camera, background=(1.0, 0.5, 0.0)).rgb
    for color in ([1, 0.5, 0], np.array([1, 0.5, 0]), torch.tensor([1, 0.5, 0])):
        assert torch.equal(vdgs.render(run.scene, camera, background=color).rgb, wanted)
    for color in ((255, 255, 255), "white", (1, 1, 1, 1), 1.0, np.ones((3, 1)), (0.0, 0.0, np.nan)):
        with pytest.raises(VdgsError, match=r"^background is .*it must be"):
            vdgs.render(run.scene, camera, background=color)


def test_an_appearance_that_is_not_there_is_named(run):
    camera = run.scene.cameras[0]
    for wrong in (10**9, -1, "a", 0.5, len(run.scene.cameras)):
        with pytest.raises(VdgsError, match=f"^image_index is '?{wrong}'?; it must be"):
            vdgs.render(run.scene, camera, image_index=wrong)
    assert torch.equal(*(vdgs.render(run.scene, camera, image_index=each).rgb for each in (1, np.int64(1))))


def test_cameras_that_nothing_can_be_drawn_with_are_named(run):
    camera = run.scene.cameras[0]
    pose = camera.camera_from_world
    for said, changes in (
        ("camera_from_world must be a rotation", {"camera_from_world": np.diag([2.0, 2, 2, 1]) @ pose}),
        ("camera_from_world must be a rotation", {"camera_from_world": np.diag([-1.0, 1, 1, 1]) @ pose}),
        ("camera_from_world must be a rotation", {"camera_from_world": pose * np.nan}),
        ("camera_from_world must be a rotation", {"camera_from_world": pose[:3]}),
        ("camera_from_world must be a rotation", {"camera_from_world": pose.tolist()}),
        ("width and height must be whole", {"width": 96.0}),
        ("width and height must be whole", {"height": 0}),
        ("fx and fy must be above 0", {"fx": 0.0}),
        ("fx and fy must be above 0", {"fy": -80.0}),
        ("fx and fy must be above 0", {"fx": "80"}),
        ("fx and fy must be above 0", {"cx": np.nan}),
        ("model must be pinhole or orthographic, not 'ortho'", {"model": "ortho"}),
        ("model must be pinhole or orthographic, not 'fisheye'", {"model": "fisheye"}),
        ("model must be pinhole or orthographic, not None", {"model": None}),
        ("photograph_pixel must be a finite number", {"photograph_pixel": np.nan}),
    ):
        wrong = replace(camera, **changes)
        with pytest.raises(VdgsError, match=f"^camera: {said}"):
            vdgs.render(run.scene, wrong)
        with pytest.raises(VdgsError, match=f"^each of cameras: {said}"):
            vdgs.count_visibility(run.scene.positions, [camera, wrong])
        with pytest.raises(VdgsError, match=f"^camera: {said}"):
            vdgs.ops.cull(run.scene.positions, run.scene.model.anchors.log_scales, wrong)
    of_numpy = replace(camera, fx=np.float32(camera.fx))
    assert torch.equal(vdgs.render(run.scene, of_numpy).rgb, vdgs.render(run.scene, camera).rgb)


def test_owners_are_told_in_the_kind_that_is_given(run):
    points = run.scene.positions[:, :2]
    owners = run.blocks.owner(points)
    assert owners.dtype == torch.int64
    assert set(owners.tolist()) == {0, 1}
    assert run.blocks.owner(points.numpy()).tolist() == owners.tolist()
    assert run.blocks.owner(points.double().numpy()).tolist() == owners.tolist()
    for wrong in (run.scene.positions, points[0], points.numpy()[0]):
        with pytest.raises(ValueError, match=r"points must be \[n, 2\], x and y, not"):
            run.blocks.owner(wrong)


def test_cameras_are_made_of_matrices(run):
    camera = run.scene.cameras[1]
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    made = vdgs.cameras_from(camera.camera_from_world[None], K, camera.width, camera.height)
    torch.testing.assert_close(vdgs.render(run.scene, made[0]).rgb, vdgs.render(run.scene, camera).rgb)
    far = camera.camera_from_world.copy()
    far[0, 3] += 1e6 + 0.123  # in float32 the translation would be off by centimetres
    assert np.array_equal(vdgs.cameras_from(far[None], torch.tensor(K), 4, 3)[0].camera_from_world, far)
    for poses, intrinsics in ((camera.camera_from_world, K), (far[None], K[0]), (far[None], np.stack([K, K])), (1, 2)):
        with pytest.raises(ValueError, match="viewmats must be"):
            vdgs.cameras_from(poses, intrinsics, 4, 3)


def test_doubts_about_a_capture_are_warnings_and_what_cannot_become_a_scene_is_refused(tmp_path):
    scene = tiny_scene()
    content = write_transforms(tmp_path, scene)
    content["frames"][1]["transform_matrix"][0][3] = float("nan")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        capture = vdgs.load_capture(tmp_path)
    texts = [str(each.message) for each in said]
    assert any("left out, for the pose cannot be used" in text for text in texts)
    assert set(capture.warnings) <= set(texts)
    assert len(set(texts)) == len(texts)
    assert {(each.filename, each.category) for each in said} == {(__file__, UserWarning)}
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(CaptureError, match=r"are not where the cameras look.*or the poses are of another convention"):
        vdgs.load_capture(tmp_path)


def test_matrices_that_make_no_camera_are_refused(run):
    camera = run.scene.cameras[1]
    pose = camera.camera_from_world
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    scaled, skewed, turned = pose.copy(), K.copy(), K.copy()
    scaled[:3, :3] *= 2
    skewed[0, 1], turned[1, 1] = 5, -camera.fy
    mirrored = np.diag([1.0, 1.0, -1.0, 1.0]) @ pose
    for why, wrong in (
        ("it holds numbers that are not finite", np.full((4, 4), np.nan)),
        ("it holds numbers that are not finite", np.full((4, 4), np.inf)),
        ("R times its transpose is off 1 by 3,", scaled),
        ("R times its transpose is off 1 by 0.0", np.diag([1.01, 1.01, 1.01, 1]) @ pose),
        ("it mirrors the world", mirrored),
        ("its last row is not 0 0 0 1: transpose", pose.T),
    ):
        with pytest.raises(VdgsError, match=rf"viewmats\[1\] is no rotation and translation \({why}"):
            vdgs.cameras_from(np.stack([pose, wrong]), K, 4, 3)
    for wrong in (skewed, K.T, 2 * K, turned, 0 * K, K * np.nan):
        for intrinsics in (wrong, np.stack([K, wrong])):
            with pytest.raises(VdgsError, match=r"Ks holds .*with fx and fy above 0\. Transpose"):
                vdgs.cameras_from(np.stack([pose, pose]), intrinsics, 4, 3)
    for size in ((160.5, 3), (0, 3), (4, -3), ("4", 3), (4, None)):
        with pytest.raises(VdgsError, match=r"(width|height) is .*it must be (a whole number|at least 1)"):
            vdgs.cameras_from(pose[None], K, *size)
    with pytest.raises(VdgsError, match="model is 'fisheye'; it must be pinhole or orthographic"):
        vdgs.cameras_from(pose[None], K, 4, 3, model="fisheye")
    assert vdgs.cameras_from(pose[None], K, 4, 3, model="ortho")[0].model == "orthographic"
    with pytest.raises(ValueError, match=r"not \(4, 4\) and \(3, 3\): give viewmats\[None\]"):
        vdgs.cameras_from(pose, K, 4, 3)
    made = vdgs.cameras_from(pose[None].astype(np.float32), K, np.int64(4), torch.tensor(3))[0]
    assert (made.width, made.height, type(made.width)) == (4, 3, int)


def test_rounded_poses_become_the_nearest_rotations():
    """Of texts with three decimals and of float16, as captures on disk are read."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, :3] = Rotation.random(200, random_state=0).as_matrix()
    poses[:, :3, 3] = rng.uniform(-4, 4, (200, 3))
    for rounded in (np.round(poses, 3), np.round(poses, 4), poses.astype(np.float16)):
        made = vdgs.cameras_from(rounded, np.diag([50.0, 50, 1]), 64, 48)
        found = np.stack([each.camera_from_world for each in made])
        assert np.abs(found - poses).max() < 3e-3
        assert np.array_equal(found[:, :3, 3], rounded[:, :3, 3].astype(float))
        vdgs.count_visibility(poses[:, :3, 3], made)
    assert np.array_equal(vdgs.cameras_from(poses, np.diag([50.0, 50, 1]), 64, 48)[7].camera_from_world, poses[7])


def test_presets_are_read_as_they_are():
    """What `train` checks it does not change."""
    for name in PRESETS:
        preset = vdgs.preset(name)
        assert checked_settings(type(preset), asdict(preset), "") == preset


def test_visibility_is_counted_in_the_kind_that_is_given(coarse, native_small):
    counts = vdgs.count_visibility(coarse.positions, coarse.cameras)
    ratios = vdgs.visibility_ratio(coarse.positions, coarse.cameras)
    torch.testing.assert_close(ratios, counts.float() / len(coarse.cameras))
    points = coarse.positions.numpy()
    for given in (points, points.astype(np.float64)):
        found = vdgs.count_visibility(given, coarse.cameras)
        assert isinstance(found, np.ndarray)
        assert found.dtype == np.int32
        assert found.tolist() == counts.tolist()
    assert isinstance(vdgs.visibility_ratio(points, coarse.cameras), np.ndarray)
    for none in (points[:0], coarse.positions[:0]):
        assert [len(f(none, coarse.cameras)) for f in (vdgs.count_visibility, vdgs.visibility_ratio)] == [0, 0]


def test_the_stages_are_those_of_the_run(run, coarse):
    settings = run.settings
    counts = vdgs.count_visibility(coarse.positions, coarse.cameras)
    blocks = vdgs.partition(coarse.positions.numpy(), counts.numpy(), num_blocks=2, seed=settings.training.seed)
    assert [each.core for each in blocks.items] == [each.core for each in run.blocks.items]
    assignment = vdgs.assign_cameras(coarse, blocks, coarse.cameras, settings.assignment)
    assert np.array_equal(assignment.reasons, run.assignment.reasons)
    merged = vdgs.merge(coarse, run.block_scenes, blocks, assignment)
    assert same(merged, run.scene)
    assert same(vdgs.merge(coarse, iter(run.block_scenes), blocks, assignment), run.scene)
    other = vdgs.partition(coarse.positions.flip(1), counts, num_blocks=2)
    with pytest.raises(VdgsError, match=r"trained for another cut of the scene.*Give the blocks and the assignment"):
        vdgs.merge(coarse, run.block_scenes, other, assignment)
    with pytest.raises(VdgsError, match="at place 0 is of block 1: give the models in the order of the blocks"):
        vdgs.merge(coarse, run.block_scenes[::-1], blocks, assignment)
    with pytest.raises(ValueError, match=r"not \[5 training cameras, 2 blocks\]"):
        vdgs.merge(coarse, run.block_scenes, blocks, vdgs.assign_cameras(coarse, blocks, coarse.cameras[:2]))


@pytest.mark.parametrize("decoders", ["frozen", "own"])
def test_a_scene_on_a_card_is_merged_there(decoders, run, coarse):
    blocks, cpu = run.block_scenes, torch.device("cpu")
    if decoders == "frozen":
        blocks = [vdgs.Scene(with_decoder_of(each.model, coarse.model)) for each in blocks]
    wanted = vdgs.merge(coarse, blocks, run.blocks, run.assignment)
    assert bool(wanted.model.decoder_spans) == (decoders == "own")
    with pretended_card():
        there, *blocks_there = (vdgs.Scene(each.model.to(CARD), each.capture) for each in (coarse, *blocks))
        merged = vdgs.merge(there, blocks_there, run.blocks, run.assignment).model
        parts = merged.anchors, merged.decoder, *(span.decoder for span in merged.decoder_spans)
        assert {tensor.device for part in parts for tensor in part.tensors().values()} == {CARD}
        back = vdgs.Scene(merged.to(cpu))
    assert same(back, wanted)


def with_decoder_of(model: AnchorModel, coarse: AnchorModel) -> AnchorModel:
    return replace(model, decoder=coarse.decoder, metadata=replace(model.metadata, decoder="frozen"))


def test_a_device_may_be_one_of_torch(run):
    for device in (torch.device("cpu"), torch.device("cpu", 0)):
        assert vdgs.open_run(run.path, device=device).device == "cpu"
    with pytest.raises(VdgsError, match="--device meta: choose auto, cpu, cuda"):
        vdgs.open_run(run.path, device=torch.device("meta"))


def test_a_block_that_is_not_trained_is_named_with_its_command(run, tmp_path):
    shutil.copytree(run.path, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "blocks" / "01")
    opened = vdgs.open_run(tmp_path / "run")
    with pytest.raises(RunError, match=rf"block 1 is not trained(?s:.*)\n  vdgs train-blocks {opened.path} --block 1"):
        opened.block_scenes  # noqa: B018


def test_autocast_of_a_caller_changes_nothing(run, capture):
    camera = run.scene.cameras[0]
    config = replace(run.settings.training, iterations=2)
    drawn, trained = vdgs.render(run.scene, camera).rgb, vdgs.train(capture, config)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(vdgs.render(run.scene, camera).rgb, drawn)
        assert (
            vdgs.ops.decode_anchors(run.scene.model.anchors, run.scene.model.decoder, camera).colors.dtype
            == torch.float32
        )
        assert same(vdgs.train(capture, config), trained)


def test_blocks_are_opened_on_the_device_of_the_run(run):
    with pretended_card():
        opened = vdgs.open_run(run.path)
        opened.device = "cuda"
        assert {each.positions.device for each in (opened.scene, *opened.block_scenes)} == {CARD}


def same(one: vdgs.Scene, other: vdgs.Scene) -> bool:
    ours, theirs = one.model, other.model
    decoders = [(part.decoder.tensors(), of.decoder.tensors()) for part, of in zip(
        ours.decoder_spans, theirs.decoder_spans, strict=True)]  # fmt: skip
    return all(
        torch.equal(tensor, kept[name])
        for own, kept in [(ours.anchors.tensors(), theirs.anchors.tensors()), *decoders]
        for name, tensor in own.items()
    )


def test_training_in_memory_makes_the_scene_of_the_run(run, capture):
    events = []
    scene = vdgs.train(capture, run.settings, callbacks=[events.append])
    assert same(scene, run.scene)
    assert {event.stage for event in events} == {"coarse", "block 0", "block 1"}
    last = events[-1]
    assert (last.iteration, last.loss > 0, last.anchors > 0) == (last.iterations, True, True)


def test_a_callback_ends_a_stage(run, capture):
    seen = []

    def stop(event):
        seen.append(event.iteration)
        return np.float64(event.iteration) == 3  # numpy's True

    scene = vdgs.train(capture, run.settings.training, callbacks=[stop])
    assert seen == [1, 2, 3]
    assert scene.model.metadata.iterations == 3


@pytest.mark.slow
def test_training_in_a_folder_leaves_a_run(run, native_small, tmp_path, monkeypatch):
    monkeypatch.setattr("vdgs.distributed.backend_selection.LocalExecutor", CommandsHere)
    options = vdgs.CaptureOptions(up="z")
    with small_figures():
        scene = vdgs.train(native_small.capture, run.settings, run_dir=tmp_path / "run", capture_options=options)
    assert same(scene, run.scene)
    assert len(vdgs.open_run(tmp_path / "run").blocks) == 2
    again = vdgs.train(native_small.capture, run.settings, run_dir=tmp_path / "run", capture_options=options)
    assert same(again, scene)


@pytest.mark.parametrize("signals", [[signal.SIGINT], [signal.SIGINT] * 2])
def test_ctrl_c_while_a_run_trains_is_no_error_of_vdgs(signals, run, native_small, tmp_path, monkeypatch):
    """A loop over captures that goes on after a VdgsError ends."""

    def stages(*_args):
        with catch_stop_signals() as asked:
            for number in signals:
                signal.raise_signal(number)
            if asked:
                raise Stopped("Stopped; saved. The same command continues.")

    monkeypatch.setattr("vdgs.pipeline.train_in_memory.train_in_run_folder", stages)
    with pytest.raises(KeyboardInterrupt, match=r"^Stopped; saved\. The same call continues\.$"):
        vdgs.train(native_small.capture, run.settings, run_dir=tmp_path / "run")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_other_settings_of_a_run_folder_are_refused_with_what_python_has(run, native_small, tmp_path):
    shutil.copytree(run.path, tmp_path / "run")
    other = replace(run.settings, training=replace(run.settings.training, seed=7))
    options = vdgs.CaptureOptions(up="z")
    with pytest.raises(RunError, match="delete the folder to train anew, or name another run_dir") as refused:
        vdgs.train(native_small.capture, other, run_dir=tmp_path / "run", capture_options=options)
    assert "--overwrite" not in str(refused.value)


def test_the_file_is_that_of_the_command_line(run, coarse, native_small, tmp_path):
    verb("export", native_small.whole, "--output", tmp_path / "verb.ply", "--sh-degree", "1", "--no-evaluate")
    vdgs.export(run, tmp_path / "run.ply", sh_degree=1)
    vdgs.export(vdgs.merge(coarse, run.block_scenes, run.blocks, run.assignment), tmp_path / "m.ply", sh_degree=1)
    written = (tmp_path / "verb.ply").read_bytes()
    assert written.startswith(b"ply")
    assert (tmp_path / "run.ply").read_bytes() == written == (tmp_path / "m.ply").read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["m.ply", "run.ply", "verb.ply"]


def test_a_scene_is_saved_and_read(run, tmp_path):
    run.scene.save(tmp_path / "scene.safetensors")
    loaded = vdgs.Scene.load(tmp_path / "scene.safetensors")
    assert same(loaded, run.scene)
    with pytest.raises(VdgsError, match="needs the training cameras"):
        vdgs.export(loaded, tmp_path / "scene.ply")
    with pytest.raises(VdgsError, match="does not know its capture"):
        loaded.cameras  # noqa: B018


@pytest.mark.parametrize(
    "name", ["a.ply", "a.PLY", "a.points.ply", "a.spz", "a.splat", "a.sog", "a.glb", "a.las", "a.html", "tileset.json"]
)
def test_a_model_is_saved_under_no_name_of_another_format(run, tmp_path, name):
    with pytest.raises(VdgsError, match=rf"{name}: the name is that of .*vdgs\.export\(scene, path\) writes"):
        run.scene.save(tmp_path / name)
    assert not any(tmp_path.iterdir())


def test_what_is_no_model_is_told_and_kept(run, native_small, tmp_path):
    """Only of what a run wrote it is said to be deleted."""
    vdgs.export(run, tmp_path / "scene.ply", sh_degree=0)
    run.scene.save(tmp_path / "cut.safetensors")
    whole = (tmp_path / "cut.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(whole[:-8])
    (tmp_path / "flipped.safetensors").write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    for name in ("scene.ply", "cut.safetensors", "flipped.safetensors"):
        with pytest.raises(VdgsError, match=rf"{name}: .*Give the model that Scene\.save or a run wrote") as said:
            vdgs.Scene.load(tmp_path / name)
        assert "elete" not in str(said.value)
    save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(VdgsError, match=r"other\.safetensors: .*neither 'vdgs-anchors-1' nor 'vdgs-anchors-2'"):
        vdgs.Scene.load(tmp_path / "other.safetensors")
    for folder in (native_small.capture, native_small.whole):
        with pytest.raises(VdgsError, match=r"is a folder, not a model\. vdgs\.open_run\(RUN\)\.scene"):
            vdgs.Scene.load(folder)
    stage = tmp_path / "coarse"
    stage.mkdir()
    (stage / "status.json").write_text("{}")
    (stage / "model.safetensors").write_bytes(whole[:-8])
    with pytest.raises(VdgsError, match="Delete it and run `vdgs run`"):
        vdgs.Scene.load(stage / "model.safetensors")


def test_a_run_whose_capture_is_gone_is_still_drawn(run, native_small, tmp_path, monkeypatch):
    shutil.copytree(native_small.whole, tmp_path / "run")
    config = (tmp_path / "run" / "config.yaml").read_text()
    (tmp_path / "run" / "config.yaml").write_text(config.replace(str(native_small.capture), str(tmp_path / "gone")))
    moved = vdgs.open_run(tmp_path / "run")
    assert moved.scene.capture is None
    assert len(moved.scene) > 0
    with pytest.raises(CaptureError):
        moved.capture  # noqa: B018


def test_what_does_not_work_is_said_before_any_work(capture, tmp_path):
    with pytest.raises(RunError):
        vdgs.open_run(tmp_path)
    with pytest.raises(CaptureError, match="no such folder"):
        vdgs.train(tmp_path / "none")
    with pytest.raises(VdgsError, match="no preset 'fast'"):
        vdgs.train(capture, "fast")
    with pytest.raises(VdgsError, match="takes no Capture"):
        vdgs.train(capture, run_dir=tmp_path / "run")
    with pytest.raises(VdgsError, match=r"capture_options say how a folder is read.*vdgs\.load_capture"):
        vdgs.train(capture, capture_options=vdgs.CaptureOptions(downscale=4))
    with pytest.raises(VdgsError, match="takes no callbacks"):
        vdgs.train(capture.root, run_dir=tmp_path / "run", callbacks=[print])
    site = np.random.default_rng(8).uniform(0, 200, (500, 3))
    far_apart = np.concatenate([site, site + np.array([50_000.0, 0, 0])])
    with pytest.warns(UserWarning, match="instead of 8"):
        vdgs.partition(far_apart, np.full(1000, 5), num_blocks=8, lambda_vis=0.0)
    bad = replace(vdgs.preset(), training=replace(vdgs.preset().training, iterations=-1))
    with pytest.raises(VdgsError):
        vdgs.train(capture, bad)


def test_an_option_that_does_not_work_is_named(run, capture, native_small, tmp_path):
    points, counts = np.random.default_rng(0).uniform(0, 10, (300, 3)), np.full(300, 5)
    one_lost = np.array([[0.0, 0.0, 0.0], [1.0, np.nan, 0.0]])
    for words, call in {
        r"AssignmentConfig\.threshold is 7\.0; it must be at least 0 and at most 1": lambda: vdgs.assign_cameras(
            run.scene, run.blocks, run.scene.cameras, vdgs.AssignmentConfig(threshold=7.0)
        ),
        r"lambda_vis is -1\.0; it must be at least 0": lambda: vdgs.partition(points, counts, lambda_vis=-1.0),
        "lambda_vis is nan": lambda: vdgs.partition(points, counts, lambda_vis=float("nan")),
        "num_blocks is 0; it must be at least 1": lambda: vdgs.partition(points, counts, num_blocks=0),
        r"num_blocks is 2\.5; it must be a whole number": lambda: vdgs.partition(points, counts, num_blocks=2.5),
        "num_blocks is '2'; it must be a whole number": lambda: vdgs.partition(points, counts, num_blocks="2"),
        "seed is -1; it must be at least 0": lambda: vdgs.partition(points, counts, seed=-1),
        "balanced is 'yes'; it must be true or false": lambda: vdgs.partition(points, counts, balanced="yes"),
        "points must be finite, and 300 of 300 are not": lambda: vdgs.partition(points * np.nan, counts),
        "points must be finite, and 1 of 2 are not": lambda: vdgs.count_visibility(one_lost, run.scene.cameras),
        "^points must be finite, and 1 of 2 are": lambda: vdgs.visibility_ratio(
            torch.tensor(one_lost), run.scene.cameras
        ),
        "points is empty": lambda: vdgs.partition(points[:0], counts[:0]),
        "^400 blocks: the scene has only 300 distinct anchors": lambda: vdgs.partition(points, counts, num_blocks=400),
        "visibility must be whole numbers of cameras": lambda: vdgs.partition(points, counts * np.nan),
        "whole numbers of cameras, at least 0": lambda: vdgs.partition(points, -counts),
        "whole numbers of cameras, at least 0: ": lambda: vdgs.partition(points, counts / 10),  # ratios are no counts
        r"CaptureOptions\.downscale is '2'; it must be a number": lambda: vdgs.load_capture(
            capture.root, downscale="2"
        ),
        r"TrainConfig\.iterations is '3'; it must be a whole number": lambda: vdgs.train(
            capture, replace(vdgs.preset().training, iterations="3")
        ),
        r"count is 2\.5; it must be a whole number": lambda: vdgs.configure_threads(2.5),
        "count is -1; it must be at least 0": lambda: vdgs.configure_threads(-1),
        "sh_degree is 7; it must be 0 or 1": lambda: vdgs.export(run, tmp_path / "a.ply", sh_degree=7),
        r"export\.max_gaussians is -1; it must be": lambda: vdgs.export(run, tmp_path / "a.ply", max_gaussians=-1),
        "program is 'maya'": lambda: vdgs.export(run, tmp_path / "a.ply", program="maya"),
        "did you mean 'sh_degree'": lambda: vdgs.export(run, tmp_path / "a.ply", sh_degre=1),
        "export has no 'run': the scene is": lambda: vdgs.export(run, tmp_path / "a.ply", run="bogus"),
        "export has no 'output': `path`": lambda: vdgs.export(run, tmp_path / "a.ply", output=tmp_path / "b.ply"),
        "export has no 'model': it is": lambda: vdgs.export(run, tmp_path / "a.ply", model="coarse"),
        "export has no 'device': it is": lambda: vdgs.export(run, tmp_path / "a.ply", device="cpu"),
        "export has no 'threads': vdgs": lambda: vdgs.export(run, tmp_path / "a.ply", threads=2),
        "export has no 'evaluate': nothing": lambda: vdgs.export(run, tmp_path / "a.ply", evaluate=True),
        r"view\.port is 99999; it must be at least 1": lambda: vdgs.view(run, port=99999),
        "rule is 'best'": lambda: vdgs.merge(run.scene, run.block_scenes, run.blocks, run.assignment, rule="best"),
        "model='block'": lambda: vdgs.open_run(run.path, model="block"),
        "did you mean 'downscale'": lambda: vdgs.load_capture(capture.root, downscal=2),
        "x.csv": lambda: vdgs.load_capture(capture.root, gps="x.csv"),
        "tpu": lambda: vdgs.open_run(run.path, device="tpu"),
    }.items():
        with pytest.raises(VdgsError, match=words):
            call()
    assert not any(tmp_path.iterdir())
    (tmp_path / "link.ply").symlink_to(tmp_path / "gone.ply")
    with pytest.raises(VdgsError, match=r"link\.ply: is a link to .*gone\.ply"):
        vdgs.export(run, tmp_path / "link.ply")
    with pytest.raises(ValueError, match=r"visibility \[n\]"):
        vdgs.partition(points, counts[:9])
    with pytest.raises(TypeError, match="not list"):
        vdgs.count_visibility(points.tolist(), run.scene.cameras)


def test_a_run_is_shown_in_a_browser_as_the_verb_does(run, monkeypatch):
    from vdgs.viewer import server

    asked = []
    monkeypatch.setattr(server, "view_run", lambda request, console: asked.append(request))
    vdgs.view(run, port=8123)
    vdgs.view(str(run.path))
    assert [(each.run, each.port, each.model) for each in asked] == [(run.path, 8123, "best"), (run.path, None, "best")]


def test_a_capture_in_a_shell_is_a_line_and_its_views_have_no_arrays_of_observations(capture, coarse, run):
    assert "\n" not in repr(capture)
    assert f"{len(capture.train_views)} training" in repr(capture)
    assert "Observations" not in repr(capture.views[0])
    assert f"{len(coarse):,} anchors" in repr(coarse)
    assert str(run.path) in repr(run)


def test_wrong_kinds_of_arguments_are_named(capture, coarse):
    points, cameras = capture.points, coarse.cameras
    blocks = vdgs.partition(points, np.full(len(points), 5), num_blocks=2)
    for call, name in (
        (lambda: vdgs.count_visibility(points, capture), "cameras must be .*Sequence, not Capture: of a capture take"),
        (lambda: vdgs.visibility_ratio(points, capture.train_views), "cameras must be vdgs.Camera, not View"),
        (lambda: vdgs.count_visibility(points.tolist(), cameras), "points must be torch.Tensor or numpy.ndarray"),
        (lambda: vdgs.partition(points, [1] * len(points)), "visibility must be torch.Tensor or numpy.ndarray, not li"),
        (lambda: vdgs.render(points, cameras[0]), "scene must be vdgs.Scene, not ndarray"),
        (lambda: vdgs.render(coarse, capture.views[0]), "camera must be vdgs.Camera, not View"),
        (lambda: vdgs.assign_cameras(points, None, cameras), "scene must be vdgs.Scene"),
        (lambda: vdgs.export(points, "x.ply"), "scene must be vdgs.Scene"),
        (lambda: vdgs.assign_cameras(coarse, None, cameras), "blocks must be vdgs.Blocks, not NoneType"),
        (lambda: vdgs.merge(coarse, [points], None, None), "scene must be vdgs.Scene, not ndarray"),
        (lambda: vdgs.merge(coarse, [coarse], [], None), "blocks must be vdgs.Blocks, not list: vdgs.partition makes"),
        (lambda: vdgs.merge(coarse, [coarse], blocks, None), "assignment must be vdgs.Assignment, not NoneType"),
        (lambda: vdgs.assign_cameras(coarse, blocks, cameras, {}), "config must be vdgs.AssignmentConfig, not dict"),
        (lambda: vdgs.train(capture, {"iterations": 3}), "config must be vdgs.MethodConfig or vdgs.TrainConfig, not d"),
        (lambda: vdgs.train(capture, callbacks=print), "callbacks must be .*Iterable, not builtin.*: give a list of"),
        (lambda: vdgs.train(capture, callbacks=[3]), "each of callbacks must be .*Callable, not int"),
        (lambda: vdgs.count_visibility(np.full((2, 3), "a"), cameras), "points must hold numbers, not <U1"),
        (lambda: vdgs.Scene("scene.safetensors"), "model must be vdgs.AnchorModel, not str: vdgs.Scene.load"),
        (lambda: vdgs.Scene(coarse.model, capture.root), "capture must be vdgs.Capture or .*: vdgs.load_capture"),
        (lambda: vdgs.train(capture.root, capture_options={}), "capture_options must be vdgs.CaptureOptions, not dict"),
    ):
        with pytest.raises(TypeError, match=name):
            call()


def test_a_path_may_begin_with_the_home_folder(run, native_small, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for name, place in (("run", native_small.whole), ("capture", native_small.capture)):
        (tmp_path / name).symlink_to(place)
    (tmp_path / "tests.txt").write_text(vdgs.load_capture("~/capture").views[0].name)
    opened = vdgs.load_capture(Path("~/capture"), test_list="~/tests.txt")
    assert len(opened.test_views) == 1
    assert vdgs.open_run("~/run").path == tmp_path / "run"
    run.scene.save("~/scene.safetensors")
    assert len(vdgs.Scene.load("~/scene.safetensors")) == len(run.scene)
    vdgs.export(vdgs.Scene(run.scene.model, opened), "~/scene.points.ply")
    assert (tmp_path / "scene.points.ply").is_file()
    options = vdgs.CaptureOptions(test_list=Path("~/tests.txt"))
    with pytest.raises(VdgsError, match="other settings"):  # of the run in ~, not of one in ./~
        vdgs.train("~/capture", run_dir="~/run", capture_options=options)
    assert not (tmp_path / "~").exists()
