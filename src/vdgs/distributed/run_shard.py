"""Do one shard of a job, or continue it; nothing if it is done (`sharded_job`). Executors start this program.

    python -m vdgs.distributed.run_shard FOLDER INDEX [--threads N] [--device D] [--image-cache-gb G]

FOLDER/request.json says what is to be done. Exit codes: 0 done, 1 an error that was printed, 2 usage, 130 stopped.
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
    args = parser.parse_args(arguments)

    from vdgs.system.exit_codes import exit_code_of
    from vdgs.system.native_messages import quiet_libraries

    quiet_libraries()
    return exit_code_of("vdgs shard", lambda: _run(args), "The same command continues: what is finished is kept.")


def _run(args: argparse.Namespace) -> None:
    from rich.console import Console

    from vdgs.distributed.shard import Shard, run_shard
    from vdgs.distributed.task_process import stop_when_parent_dies
    from vdgs.kernels.device_selection import select_device

    device = select_device(args.device).device
    configure_threads(args.threads)
    stop_when_parent_dies()
    folder = Path(os.path.abspath(args.folder))
    run_shard(Shard(folder, args.index, device, args.image_cache_gb, Console(soft_wrap=True)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
