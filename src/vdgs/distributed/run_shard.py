"""Do one shard of a job, or continue it; nothing if it is done (`executors.sharded_job`). What schedulers start.

    python -m vdgs.distributed.run_shard FOLDER INDEX [--threads N] [--device D] [--image-cache-gb G]

FOLDER/request.json says what is to be done. Exit codes: 0 done, 1 an error that was printed, 2 usage, 130 stopped and
saved.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from vdgs.kernels import configure_threads


def main(arguments: Sequence[str]) -> int:
    """Do the shard; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m vdgs.distributed.run_shard", description="Do one shard of a job.")
    parser.add_argument("folder", type=Path, help="folder of the job, which holds request.json")
    parser.add_argument("index", type=int, help="which shard")
    parser.add_argument("--threads", type=int, default=0, help="threads of the kernels; 0 for all cores")
    parser.add_argument("--device", default="auto", help="where to compute: auto, cpu, cuda or cuda:0")
    parser.add_argument("--image-cache-gb", type=float, default=0.0, help="memory for photographs; 0: by what is free")
    given = parser.parse_args(arguments)
    configure_threads()  # before anything imports torch

    from vdgs.system.exit_codes import exit_code_of

    return exit_code_of("vdgs shard", lambda: _run(given), "The same command continues: what is finished is kept.")


def _run(given: argparse.Namespace) -> None:
    from rich.console import Console

    from vdgs.distributed.shard import Shard, run_shard
    from vdgs.distributed.task_process import stop_when_parent_dies
    from vdgs.kernels.device_selection import select_device

    device = select_device(given.device).device
    configure_threads(given.threads)
    stop_when_parent_dies()
    folder = Path(os.path.abspath(given.folder))
    run_shard(Shard(folder, given.index, device, given.image_cache_gb, Console(soft_wrap=True)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
