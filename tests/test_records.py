"""What stages note of themselves comes back as it was written."""

import json

import pytest

from vdgs.errors import RunError, VdgsError
from vdgs.partition.records import AssignedBlock, CutBlock, MergedBlock, PartitionRecord
from vdgs.runs.folder import RunFolder
from vdgs.runs.stage_folder import StageFolder
from vdgs.runs.status import Status
from vdgs.storage.records import known, plain, record_of

MERGED = Status(
    "done", anchors=3, blocks_trained=1, blocks=(MergedBlock(0, 3, 2, 1, 0, 1), MergedBlock(1, 0, 0, 0, 1, 0)),
    block_models=("a-1", None), seconds=1.0, merge_seconds=0.25, model="b-2",
)  # fmt: skip
CUT = PartitionRecord(
    "k", "a", "visibility", 1.0, ("a warning",), (),
    (AssignedBlock(0, 2, 1, 1, 0, 5, 7, None, None, 2.5),), (CutBlock(0, 5, 2.5, 1.5, 0.5),), 3.0, 4,
)  # fmt: skip


@pytest.mark.parametrize("record", [Status(), Status("running", iteration=3, seconds_left=7), MERGED, CUT])
@pytest.mark.parametrize("written", [plain, known])
def test_what_is_read_is_what_was_written(record, written):
    assert record_of(type(record), json.loads(json.dumps(written(record)))) == record


def test_what_is_missing_or_foreign_in_a_status_is_left_out(tmp_path):
    folder = StageFolder(tmp_path)
    folder.status_file.write_text('{"state": "done", "seconds": 3, "psnr_training": null, "of_the_future": [1]}')
    assert folder.status() == Status("done", seconds=3.0)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("[1, 2]", "not an object"), ("3", "not an object"), ("{}", "says no state"), ('{"state": 3}', "state is 3"),
        ('{"state": "done", "iteration": "many"}', "iteration is 'many'"),
        ('{"state": "done", "anchors": true}', "anchors is True"),
        ('{"state": "done", "seconds": 1' + "0" * 400 + "}", "seconds is 1000"),
        ('{"state": "done", "blocks": [{"block": 0}]}', "trained"), ('{"state": "done", "blocks": 4}', "not a list"),
        ('{"sta', "not valid JSON"),
    ],
)  # fmt: skip
def test_a_damaged_status_is_named(tmp_path, content, why):
    folder = StageFolder(tmp_path)
    folder.status_file.write_text(content)
    with pytest.raises(VdgsError, match=rf"status\.json: is damaged.*{why}"):
        folder.status()


@pytest.mark.parametrize("content", ["[1]", "{", '{"blocks": [{"block": 0}]}', '{"key": 3}'])
def test_a_damaged_partition_is_named(tmp_path, content):
    run = RunFolder(tmp_path)
    assert run.partition_record() == PartitionRecord()
    run.partition.mkdir()
    (run.partition / "partition.json").write_text(content)
    with pytest.raises(RunError, match=r"partition\.json: is damaged.*vdgs partition"):
        run.partition_record()
