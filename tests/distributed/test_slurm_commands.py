"""What SLURM's commands print, and what is read from it: sites add lines of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

from vdgs.distributed import slurm_commands
from vdgs.distributed.slurm_commands import ArrayTaskId, JobState, QueueEntry, SlurmError, UnreadableAnswerError

GREETING = "Welcome to HPC | account lab; 12 h left\n"
ELEMENT = ArrayTaskId("12", 3)


def answers(monkeypatch, **said: str | None) -> None:
    """Let SLURM's commands say this; None: they fail."""

    def call(command, check=True, environment=None):
        text = said[command[0]]
        if text is None:
            raise SlurmError("no such job")
        return text

    monkeypatch.setattr(slurm_commands, "_call", call)
    monkeypatch.setattr(slurm_commands.shutil, "which", lambda name: name if name in said else None)


@pytest.mark.parametrize("greeting", ["", GREETING])
def test_what_slurm_says_is_read(monkeypatch, greeting):
    listed = "12|3|RUNNING|vdgs-a-1|n07|None\n12|4|PENDING|vdgs-a-1||Priority\n13|N/A|RUNNING|other|n01|None\n"
    answers(monkeypatch, squeue=f"{greeting}CLUSTER: c1\n{listed}")
    assert slurm_commands.list_queue("vdgs-a-") == [
        QueueEntry(ArrayTaskId("12", 3), "RUNNING", "vdgs-a-1", "n07", "None"),
        QueueEntry(ArrayTaskId("12", 4), "PENDING", "vdgs-a-1", "", "Priority"),
    ]
    told = "JobId=15 ArrayJobId=12 JobState=NODE_FAIL Reason=NodeDown NodeList=n07\n"
    answers(monkeypatch, scontrol=greeting + told)
    assert slurm_commands.query_job_state(ELEMENT) == JobState("NODE_FAIL", "n07")
    answers(monkeypatch, scontrol=None, sacct=f"REQUEUED|n01\nCANCELLED by 1000|n07\n{greeting}")
    assert slurm_commands.query_job_state(ELEMENT) == JobState("CANCELLED", "n07")
    answers(monkeypatch, scontrol=None, sacct=greeting)
    assert slurm_commands.query_job_state(ELEMENT) is None
    answers(monkeypatch, scontrol=None)
    assert slurm_commands.query_job_state(ELEMENT) is None


@pytest.mark.parametrize("answer", ["4000\n", "4000;c1\n", f"{GREETING}4000\n", f"4000;c1\n{GREETING}"])
def test_the_number_of_a_job_is_found_among_other_lines(monkeypatch, answer):
    answers(monkeypatch, sbatch=answer)
    assert slurm_commands.submit(Path("job.sh")) == "4000"


@pytest.mark.parametrize("answer", ["", GREETING, "Misuse is not permitted\n"])
def test_an_answer_without_a_number_is_quoted(monkeypatch, answer):
    answers(monkeypatch, sbatch=answer)
    with pytest.raises(UnreadableAnswerError) as raised:
        slurm_commands.submit(Path("job.sh"))
    assert repr(answer.strip()) in str(raised.value)
    assert raised.value.is_uncertain
    assert not raised.value.is_final


@pytest.mark.parametrize(
    ("state", "reason", "is_held", "is_unfit"),
    [
        ("PENDING", "Priority", False, False), ("PENDING", "Resources", False, False),
        ("PENDING", "BeginTime", False, False), ("PENDING", "JobArrayTaskLimit", False, False),
        ("PENDING", "AssocMaxJobsLimit", False, False),  # until others of the account end
        ("PENDING", "QOSMaxCpuPerUserLimit", False, False), ("PENDING", "AssocGrpCPURunMinutesLimit", False, False),
        ("RUNNING", "None", False, False), ("PENDING", "JobHeldUser", True, False),
        ("PENDING", "JobHeldAdmin", True, False), ("REQUEUE_HOLD", "None", True, False),
        ("PENDING", "launch failed requeued held", True, False), ("PENDING", "JobHoldMaxRequeue", True, False),
        ("PENDING", "PartitionTimeLimit", False, True), ("PENDING", "BadConstraints", False, True),
        ("PENDING", "AssocMaxWallDurationPerJobLimit", False, True), ("PENDING", "QOSMaxCpuPerJobLimit", False, True),
        ("PENDING", "AssocGrpCPUMinutesLimit", False, True), ("PENDING", "InvalidQOS", False, True),
    ],
)  # fmt: skip
def test_what_time_does_not_end_is_told_from_what_it_does(state, reason, is_held, is_unfit):
    entry = QueueEntry(ELEMENT, state, "vdgs-a-1", "", reason)
    assert (entry.is_held, entry.is_unfit) == (is_held, is_unfit)
