"""A run that one command takes from stage to stage is neither changed nor lost by another."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from experiments.bench.worker import BenchJob, run_job
from support.captures import tiny_scene, write_colmap
from support.flights import write_photograph
from support.hand_made_models import model_at, quadrants
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.cli.main import main
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.presets import PRESETS
from vdgs.config.serialization import to_dict
from vdgs.config.sfm_options import SfmRequest
from vdgs.distributed.shard import Shard
from vdgs.distributed.sharded_job import REQUEST
from vdgs.errors import RunError
from vdgs.model.anchor_model import ModelMetadata
from vdgs.partition.blocks import save_blocks
from vdgs.pipeline.dry_run import estimate_run
from vdgs.pipeline.merge_blocks import merge_run_blocks
from vdgs.pipeline.run_pipeline import reconstruct_if_needed
from vdgs.pipeline.train_block import train_shard
from vdgs.runs.create_or_resume import create_or_resume_run, exclusive_run
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StatusRecord
from vdgs.sfm.discarding import discard_training
from vdgs.sfm.reconstruct import writing
from vdgs.system.atomic_files import write_json
from vdgs.system.file_locks import is_locked

pytestmark = pytest.mark.slow

#: Another process that drives a run: it holds the lock of which it is told until its input ends.
DRIVER = (
    "import fcntl, sys; lock = open(sys.argv[1], 'a'); fcntl.flock(lock, fcntl.LOCK_EX); print(flush=True); "
    "sys.stdin.read()"
)
#: As `--preset laptop --block.margin free` gives them: blocks may be merged by either rule.
METHOD = replace(PRESETS["laptop"], block=replace(PRESETS["laptop"].block, margin="free"))
OPTIONS = ("--preset", "laptop", "--block.margin", "free")
AT_WORK = "another vdgs process works on this run"


@contextmanager
def held_elsewhere(folder: Path) -> Iterator[Callable[[], None]]:
    """Another process holds the lock of a folder, until what is given is called."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-S", "-c", DRIVER, str(folder / ".lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdin is not None
        holder.stdout.readline()
        yield holder.stdin.close


@contextmanager
def driven_elsewhere(run: RunFolder) -> Iterator[None]:
    """Another process takes the run from stage to stage; at the moment it is between two of them."""
    with held_elsewhere(run.path / ".run"):
        yield


@pytest.fixture
def place(tmp_path: Path) -> Path:
    write_colmap(tmp_path / "place", tiny_scene())
    return tmp_path / "place"


@pytest.fixture
def run(place: Path, tmp_path: Path) -> RunFolder:
    """A run with a finished coarse model and a block, as far as its files say so."""
    context = create_or_resume_run(place, tmp_path / "run", CaptureOptions(), METHOD, overwrite=False)
    run, capture = context.run, context.capture
    write_json(run.capture_file, capture_metadata(capture))
    for stage in (run.coarse, run.block(0)):
        stage.reset_unless(run.keys().coarse if stage == run.coarse else run.keys().blocks)
        stage.model.write_bytes(b"a model")
        stage.set_status(StatusRecord(state="done", iteration=3000, model_id="7-any"))
    return run


def contents(run: RunFolder) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in run.path.rglob("*") if file.is_file()}


def command_line(*arguments: object) -> object:
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    return ended.value.code


#: Commands that would give the run other settings, or remove what was trained for those that it has.
CHANGES: dict[str, Callable[[Path, Path], list[object]]] = {
    "other blocks": lambda place, run: ["run", place, "--output", run, *OPTIONS, "--blocks", "4"],
    "another coarse model": lambda place, run: [
        "run", place, "--output", run, *OPTIONS, "--iterations", "50", "--overwrite",
    ],
    "read otherwise": lambda place, run: [
        "run", place, "--output", run, *OPTIONS, "--downscale", "2", "--overwrite",
    ],
    "the coarse stage": lambda place, run: ["train-coarse", place, "--output", run, "--preset", "laptop"],
    "another cut": lambda _, run: ["partition", run, "--blocks", "4", "--overwrite"],
    "other training": lambda _, run: ["train-blocks", run, "--block.iterations", "7", "--overwrite"],
    "another block": lambda _, run: ["train-blocks", run, "--block", "0", "--block.iterations", "7", "--overwrite"],
    "another merge": lambda _, run: ["merge", run, "--rule", "max-visibility"],
    "moved, for visibility": lambda place, run: ["visibility", run, "--capture", moved(place)],
    "moved, for figures": lambda place, run: ["eval", run, "--capture", moved(place)],
    "moved, for maps": lambda place, run: ["ortho", run, "--capture", moved(place)],
    "moved, for other programs": lambda place, run: ["export", run, "--capture", moved(place), "--output", "x.ply"],
    "moved, for a run": lambda place, run: ["run", moved(place), "--output", run, *OPTIONS],
}  # fmt: skip


def moved(place: Path) -> Path:
    return Path(shutil.move(place, place.with_name("moved")))


@pytest.mark.parametrize("change", CHANGES)
def test_what_another_process_drives_is_not_touched(run, place, capsys, change):
    arguments = [*CHANGES[change](place, run.path), "--quiet"]
    with driven_elsewhere(run):
        before = contents(run)
        assert command_line(*arguments) == 1
        assert contents(run) == before
    assert AT_WORK in capsys.readouterr().err


def test_a_block_is_trained_beside_who_drives_the_run(run, capsys):
    """Commands that change nothing are those that executors begin, on whatever machine."""
    with driven_elsewhere(run):
        assert command_line("train-blocks", run.path, "--block", "0") == 1
    assert "vdgs partition" in capsys.readouterr().err  # it is not refused for its driver


class Listener(io.StringIO):
    """A stream that does something once it is written to."""

    def __init__(self, then: Callable[[], None]) -> None:
        super().__init__()
        self.then = then

    def write(self, text: str) -> int:
        self.then()
        return super().write(text)


def test_who_drives_a_run_waits_for_another_command_that_trains_its_blocks(run):
    """`vdgs train-blocks RUN` on another machine is no failure of the run."""
    context = RunContext(run)
    with held_elsewhere(run.path) as release:
        with pytest.raises(RunError, match=AT_WORK):  # of `vdgs merge`
            merge_run_blocks(context, False, Console(file=io.StringIO()))
        listener = Listener(release)
        with run.drive_lock(), pytest.raises(RunError, match="vdgs partition"):  # which comes once it has the lock
            merge_run_blocks(context, False, Console(file=listener))
    assert "waiting for it" in listener.getvalue()


def test_a_block_that_another_command_trains_is_waited_for(run):
    with held_elsewhere(run.block(0).path) as release:
        with pytest.raises(RunError, match=AT_WORK), run.block(0).locked():
            pass
        listener = Listener(release)
        with run.block(0).locked(on_wait=lambda: listener.write("waits")):
            assert is_locked(run.block(0).path)
    assert listener.getvalue() == "waits"


def test_a_worker_of_a_run_waits_for_another_command_that_trains_its_block(run):
    """`vdgs train-blocks RUN` beside `vdgs run`: the block is no failure of the run."""
    keys, block = run.keys(), run.block(0)
    write_json(run.partition / "partition.json", {"key": keys.partition, "assignment_key": keys.assignment})
    save_blocks(run.partition / "blocks.geojson", quadrants(), [{}] * 4)
    replace(model_at([[0.0, 0.0, 0.0]], seed=0), metadata=ModelMetadata(key=keys.blocks, block=0)).save(block.model)
    write_json(run.block(0).path.parent / REQUEST, {"worker": "block", "request": to_dict(CheckpointOptions())})
    with held_elsewhere(block.path) as release:
        listener = Listener(release)
        train_shard(Shard(run.block(0).path.parent, 0, "cpu", 1.0, Console(file=listener, width=1000)))
    said = listener.getvalue()
    assert f"{block.path}: another vdgs process trains this block; waiting for it" in said
    assert "already trained; nothing to do" in said


@pytest.mark.parametrize("shared", [True, False])
def test_what_blocks_at_work_need_is_not_discarded_for_another_capture(run, shared):
    """Blocks that a driver began which died share the run; `vdgs run PHOTOGRAPHS --overwrite` is another process."""
    run.own_capture.mkdir()
    (run.own_capture / ".lock").touch()
    request = SfmRequest(image_folders=(run.path / "DCIM",), output=run.own_capture, overwrite=True)
    with run.drive_lock(), run.locked():
        before = contents(run)
    with run.locked(shared), pytest.raises(RunError, match=AT_WORK), writing(request, run):
        pytest.fail("photographs are reconstructed")
    assert contents(run) == before
    with writing(request, run):
        discard_training(request.output, run)
        assert not run.block(0).has_output()


def test_who_takes_a_run_up_drives_it(place, tmp_path):
    method = PRESETS["laptop"]
    with exclusive_run(place, tmp_path / "run", CaptureOptions(), method, overwrite=False) as context:
        run = context.run
        assert run.is_running()
        with pytest.raises(RunError, match=AT_WORK):
            create_or_resume_run(place, run.path, CaptureOptions(), method, overwrite=True)
    assert not run.is_running()
    create_or_resume_run(place, run.path, CaptureOptions(), method, overwrite=False)


def test_a_bench_does_not_begin_what_another_process_drives(run, place):
    job = BenchJob(
        place, to_dict(CaptureOptions()), to_dict(PRESETS["laptop"]), ("coarse",), run.path, None, "key", None, 4, 1,
        overwrite=True,
    )  # fmt: skip
    with driven_elsewhere(run):
        before = contents(run)
        with pytest.raises(RunError, match=AT_WORK):
            run_job(job)
        assert contents(run) == before


def take_photographs(folder: Path) -> Path:
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    for k in range(6):
        place = np.array([10.0 * (k % 3), 12.0 * (k // 3), 40.0 + k % 2])
        write_photograph(folder / f"p{k}.jpg", np.roll(noise, k, axis=0), k, place)
    return folder


def test_photographs_are_not_made_a_capture_under_a_run_that_is_driven(tmp_path):
    photographs, run = take_photographs(tmp_path / "card"), RunFolder(tmp_path / "run")
    request = RunRequest(
        capture=photographs,
        output=run.path,
        preset="laptop",
        threads=1,
        device="cpu",
        training=PRESETS["laptop"].training,
    )
    with driven_elsewhere(run), pytest.raises(RunError, match=AT_WORK):
        reconstruct_if_needed(request, Console(file=io.StringIO()))
    assert not run.own_capture.exists()


def test_a_look_refuses_photographs_for_a_run_that_was_trained_on_a_capture(run, tmp_path):
    request = RunRequest(capture=take_photographs(tmp_path / "card"), output=run.path, threads=1, device="cpu")
    before = contents(run)
    for act in (estimate_run, reconstruct_if_needed):
        with pytest.raises(RunError, match=r"is a run of the capture .*, not of these photographs"):
            act(request, Console(file=io.StringIO()))
    assert contents(run) == before


def test_a_run_among_other_files_leaves_nothing_there(place, tmp_path):
    thesis = tmp_path / "work" / "thesis.txt"
    thesis.parent.mkdir()
    thesis.write_text("three years")
    with pytest.raises(RunError, match="holds other files"):
        create_or_resume_run(place, thesis.parent, CaptureOptions(), PRESETS["laptop"])
    assert list(thesis.parent.iterdir()) == [thesis]


@pytest.mark.parametrize("options", [("--iterations", "50"), ("--downscale", "2"), ("--block.iterations", "7")])
def test_what_was_trained_stays_where_the_new_command_is_refused(run, place, capsys, options):
    """A photograph is damaged, which is known once all are read: by then nothing of the run is changed."""
    photograph = sorted((place / "images").iterdir())[0]
    photograph.write_bytes(bytes(photograph.stat().st_size))
    before = contents(run)
    assert command_line("run", place, "--output", run.path, *OPTIONS, *options, "--overwrite", "--quiet") == 1
    assert photograph.name in capsys.readouterr().err
    assert contents(run) == before
