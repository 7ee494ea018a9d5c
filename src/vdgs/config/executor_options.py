"""Options that never change the result: where blocks and shards run, and how training is saved."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Annotated, Literal

from vdgs.config.ranges import MAX_COUNT, MAX_FLOAT, WORKER_COUNT, Range, check_ranges
from vdgs.errors import VdgsError

#: What can run them.
ExecutorName = Literal["local", "ray", "slurm"]


@dataclass(frozen=True, kw_only=True)
class SlurmOptions:
    """How jobs are asked of SLURM."""

    partition: str = ""
    """Partition (queue); empty for the cluster's default."""
    account: str = ""
    """Account that pays."""
    time: str = ""
    """Time limit of a job as SLURM writes it (`8:00:00`, `1-0`); empty for the partition's. A block that needs longer
    is asked to save in time, put back into the queue and continued."""
    grace_seconds: Annotated[int, Range(1, 86_400)] = 120
    """How long before the time limit a block is asked to save."""
    poll_seconds: Annotated[float, Range(0, 3600, exclusive_min=True)] = 5.0
    """How often SLURM is asked what became of the jobs."""
    setup_command: str = ""
    """A shell command run first in every job, such as `module load cuda`."""
    sbatch_args: tuple[str, ...] = ()
    """More options for sbatch, each a word (`--slurm.sbatch-args --qos=long --constraint=avx512`)."""


@dataclass(frozen=True, kw_only=True)
class ExecutorOptions:
    """Where blocks are trained and shards of other stages done, and what each asks of the place."""

    executor: ExecutorName = "local"
    """What runs blocks and shards: local, ray or slurm. Processes of this machine, a Ray cluster, or SLURM
    (docs/clusters.md)."""
    address: str | None = None
    """Ray: where the cluster is (`auto`, or `head:6379`); without it what RAY_ADDRESS says, else a Ray of this machine
    alone that ends with the command."""
    cpus: Annotated[int, WORKER_COUNT] = 0
    """Ray and SLURM: processors of a block or shard; 0 shares out those of the cluster (SLURM: 4)."""
    mem_gb: Annotated[float, Range(0, MAX_FLOAT)] = 0.0
    """Ray and SLURM: memory of a block or shard; 0 takes what it needs by estimate. After an out-of-memory kill half as
    much more is asked for."""
    gpus: Annotated[float, Range(0, 64)] = 0.0
    """Ray and SLURM: GPUs of a block or shard. Ray also knows shares (0.5: two blocks on one)."""
    slurm: SlurmOptions = field(default_factory=SlurmOptions)

    def check(self) -> None:
        """Raise VdgsError for values that do not work, alone or together."""
        check_ranges(self)
        if self.executor == "slurm" and self.gpus != int(self.gpus):
            raise VdgsError(
                f"--gpus {self.gpus:g}: SLURM gives whole GPUs. Where it is set up for shares: --gpus 0 and "
                "--slurm.sbatch-args --gres=shard:1."
            )
        if self.address is not None and self.executor != "ray":
            raise VdgsError(f"--address {self.address}: is of a Ray cluster; add --executor ray.")
        if self.address is not None and self.address.startswith("ray://"):
            raise VdgsError(
                f"--address {self.address}: is for clients outside a cluster. Run vdgs on one of its machines, with "
                "--address auto (`ray job submit` does so)."
            )


@dataclass(frozen=True)
class CheckpointOptions:
    """How training is saved and logged, which never changes the result."""

    save_every: Annotated[int, Range(1, MAX_COUNT)] = 1000
    """Iterations between two checkpoints."""
    image_cache_gb: Annotated[float, Range(0, MAX_FLOAT)] = 0.0
    """Memory for decoded images; 0 takes a quarter of what is free. On a cluster: of one block."""
    tensorboard: bool = False
    """Also write TensorBoard events into the stage's folder (needs the extra `tensorboard`)."""

    def check(self) -> None:
        """Raise VdgsError for values that do not work."""
        check_ranges(self)
        if self.tensorboard and find_spec("tensorboard") is None:  # before the long work
            raise VdgsError('--tensorboard: TensorBoard is not installed: pip install "vdgs[tensorboard]"')
