"""A stand-in for SLURM's commands, for machines without it: one node with a few places, its state in a folder.

    python fake_slurm.py sbatch --parsable job.sh

It knows what vdgs uses, and does as the real ones do (the same tests run on both): arrays, one element at a time in
each place, signals to the script of a job, an orderly and a hard end, the queue a second time. A process of its own
goes with every element. $VDGS_TEST_SLURM names the folder.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

STATE = Path(os.environ.get("VDGS_TEST_SLURM", ""))
PLACES = 2
NODE = "stand-in"
GLANCE_SECONDS = 0.02
#: SIGKILL follows SIGTERM after so long when a job is cancelled (SLURM: KillWait, 30 by default). What a job
#: saves may take longer on a busy machine.
KILL_SECONDS = 600.0


def main(verb: str, words: list[str]) -> int:
    return {"sbatch": sbatch, "squeue": squeue, "scancel": scancel, "scontrol": scontrol}[verb](words)


def sbatch(words: list[str]) -> int:
    """Submit an array; every element gets a process that goes with it."""
    script = Path(words[-1]).read_text()
    words = [word for line in script.splitlines() if line.startswith("#SBATCH ") for word in directive_words(line[8:])]
    asked = dict(word.removeprefix("--").partition("=")[::2] for word in words)
    if int(asked["cpus-per-task"]) > PLACES:
        print(
            "sbatch: error: Batch job submission failed: Requested node configuration is not available", file=sys.stderr
        )
        return 1
    with (STATE / "number").open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write("x")
        file.flush()
        number = str(file.tell())
    low, _, high = asked["array"].partition("%")[0].partition("-")
    for index in range(int(low), int(high or low) + 1):
        folder = STATE / f"{number}_{index}"
        folder.mkdir()
        (folder / "script").write_text(script)
        tell(folder, state="PENDING", name=asked["job-name"], turn=0, output=file_name(asked["output"], index))
        quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        subprocess.Popen([sys.executable, "-S", __file__, "go", str(folder)], start_new_session=True, **quiet)  # type: ignore[call-overload]
    print(number)
    return 0


def directive_words(line: str) -> list[str]:
    """The words of a line as sbatch takes them apart: quotes group, a backslash escapes (inside quotes too), `#`
    begins a comment."""
    words, word, quote, escaped = [], None, "", False
    for letter in line:
        if escaped:
            word, escaped = (word or "") + letter, False
        elif letter == "\\":
            escaped = True
        elif quote:
            word, quote = (word, "") if letter == quote else (word + letter, quote)
        elif letter in "\"'":
            word, quote = word or "", letter
        elif letter == "#":
            break
        elif letter.isspace():
            words, word = ([*words, word], None) if word is not None else (words, None)
        else:
            word = (word or "") + letter
    assert not quote, line
    return words if word is None else [*words, word]


def file_name(pattern: str, index: int) -> str:
    """What SLURM makes of the name of a file: `%a` and `%%`, unless it has a backslash."""
    if "\\" in pattern:
        return pattern.replace("\\", "")
    return re.sub("%([a%])", lambda found: "%" if found[1] == "%" else str(index), pattern)


def go(folder: Path) -> None:
    """Take an element through its life."""
    while True:
        with place(folder) as there:
            if not there:
                return tell(folder, state="CANCELLED")
            number, index = folder.name.split("_")
            told = facts(folder)
            variables = {
                "SLURM_JOB_ID": number, "SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": index,
                "SLURM_RESTART_COUNT": str(told["turn"]), "SLURMD_NODENAME": NODE,
            }  # fmt: skip
            with open(told["output"], "ab") as output:
                script = subprocess.Popen(
                    ["bash", str(folder / "script")], env=os.environ | variables, stdin=subprocess.DEVNULL,
                    stdout=output, stderr=output, start_new_session=True,
                )  # fmt: skip
            tell(folder, state="RUNNING", process=script.pid)
            code = wait(folder, script)
            (folder / "signals").unlink(missing_ok=True)
        if (folder / "requeue").exists():
            (folder / "requeue").unlink()
            tell(folder, state="PENDING", turn=told["turn"] + 1)
            continue
        cancelled = (folder / "cancel").exists()
        return tell(folder, state="CANCELLED" if cancelled else "COMPLETED" if code == 0 else "FAILED")


def wait(folder: Path, script: subprocess.Popen[bytes]) -> int:
    """For the end of a script, which may be cancelled or put back into the queue meanwhile."""
    killed_at = 0.0
    while script.poll() is None:
        if (folder / "requeue").exists() or (killed_at and time.monotonic() > killed_at):
            end(script.pid, signal.SIGKILL)
        elif (folder / "cancel").exists() and not killed_at:
            killed_at = time.monotonic() + KILL_SECONDS
            end(script.pid, signal.SIGTERM)
        time.sleep(GLANCE_SECONDS)
    return script.returncode


def end(process: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process, number)


class place:
    """One of the node's places; False where the element was cancelled while it waited."""

    def __init__(self, folder: Path):
        self._folder = folder

    def __enter__(self) -> bool:
        while not (self._folder / "cancel").exists():
            for number in range(PLACES):
                self._file = (STATE / f"place{number}").open("a")
                try:
                    fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    return True
                except BlockingIOError:
                    self._file.close()
            time.sleep(GLANCE_SECONDS)
        self._file = (STATE / "nowhere").open("a")
        return False

    def __exit__(self, *_: object) -> None:
        self._file.close()


def squeue(words: list[str]) -> int:
    assert words == ["--me", "--noheader", "--array", "--format=%F|%K|%T|%j|%N|%r"], words
    for folder in sorted(STATE.glob("*_*")):
        told, (number, index) = facts(folder), folder.name.split("_")
        if told["state"] in ("PENDING", "RUNNING"):
            node = NODE if told["state"] == "RUNNING" else ""
            print("|".join([number, index, told["state"], told["name"], node, "None"]))
    return 0


def scancel(words: list[str]) -> int:
    folder = STATE / words[-1]
    told = facts(folder)
    sent = [word.removeprefix("--signal=") for word in words if word.startswith("--signal=")]
    if sent:
        assert "--batch" in words
        if told["state"] == "RUNNING":
            os.kill(told["process"], signal.Signals[f"SIG{sent[0]}"])
    else:
        (folder / "cancel").touch()
    return 0


def scontrol(words: list[str]) -> int:
    folder = STATE / words[-1]
    if not folder.is_dir():
        print("slurm_load_jobs error: Invalid job id specified", file=sys.stderr)
        return 1
    if words[:-1] == ["requeue"]:
        (folder / "requeue").touch()
        return 0
    assert words[:-1] == ["--oneliner", "show", "job"], words
    print(f"JobId={folder.name} JobName=x JobState={facts(folder)['state']} Reason=None NodeList={NODE} Comment=(null)")
    return 0


def facts(folder: Path) -> dict:
    return dict(json.loads((folder / "facts").read_text()))


def tell(folder: Path, **new: object) -> None:
    old = facts(folder) if (folder / "facts").exists() else {}
    (folder / "facts.new").write_text(json.dumps(old | new))
    (folder / "facts.new").rename(folder / "facts")


if __name__ == "__main__":
    if sys.argv[1] == "go":
        go(Path(sys.argv[2]))
    else:
        sys.exit(main(sys.argv[1], sys.argv[2:]))
