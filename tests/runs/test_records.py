"""What stages note of themselves comes back as it was written."""

import json

import pytest

from vdgs.errors import RunError, VdgsError
from vdgs.partition.block_records import BlockCamerasRecord, BlockRecord, MergedBlockRecord, PartitionRecord
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.records import record_from_dict, record_to_compact_dict, record_to_dict

MERGED = StatusRecord(
    state="done",
    anchors=3,
    blocks_trained=1,
    blocks=(
        MergedBlockRecord(block=0, trained=3, kept=2, dropped=1, coarse_fallback=0, unseen=1),
        MergedBlockRecord(block=1, trained=0, kept=0, dropped=0, coarse_fallback=1, unseen=0),
    ),
    block_models=("a-1", None),
    seconds=1.0,
    merge_seconds=0.25,
    model_id="b-2",
)
CUT = PartitionRecord(
    key="k",
    assignment_key="a",
    strategy="visibility",
    lambda_vis=1.0,
    warnings=("a warning",),
    assignment_warnings=(),
    blocks=(
        BlockCamerasRecord(
            block=0,
            cameras=2,
            above_threshold=1,
            best_block=1,
            topped_up=0,
            anchors_core=5,
            anchors_expanded=7,
            mean_v=None,
            std_v=None,
            area=2.5,
        ),
    ),
    spatial_only_blocks=(BlockRecord(0, 5, 2.5, 1.5, 0.5),),
    seconds=3.0,
    peak_memory_bytes=4,
)


@pytest.mark.parametrize(
    "record", [StatusRecord(), StatusRecord(state="running", iteration=3, seconds_left=7), MERGED, CUT]
)
@pytest.mark.parametrize("written", [record_to_dict, record_to_compact_dict])
def test_what_is_read_is_what_was_written(record, written):
    assert record_from_dict(type(record), json.loads(json.dumps(written(record)))) == record


def test_what_is_missing_or_foreign_in_a_status_is_left_out(tmp_path):
    folder = StageFolder(tmp_path)
    folder.status_file.write_text('{"state": "done", "seconds": 3, "psnr_training": null, "of_the_future": [1]}')
    assert folder.status() == StatusRecord(state="done", seconds=3.0)


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
