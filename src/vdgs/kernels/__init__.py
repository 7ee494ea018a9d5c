"""The numerical operations, in interchangeable implementations: `get_backend(device)` returns one.

`cpu` is C++ for the CPU, `torch_ref` readable torch for any device (and the oracle of the tests), `gpu` the set for
NVIDIA GPUs, made of `torch_ref`, own kernels (`cuda`) and `gsplat` (`operations.GPU_BACKENDS`). All offer
`operations.KernelBackend`. Code outside this folder names no implementation.

Dimensions in this folder: n anchors of the model, v anchors visible in the view, k offsets per anchor, m splats
(Gaussians that survive decoding), h and w image height and width in pixels. Importing this module loads nothing heavy.
"""

from __future__ import annotations

import os
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Annotated

from vdgs.errors import VdgsError
from vdgs.kernels.thread_count import cpu_count as cpu_count
from vdgs.kernels.thread_count import default_num_threads as default_num_threads

if TYPE_CHECKING:
    import torch

    from vdgs.kernels.operations import KernelBackend

#: Environment variable that selects another implementation than the device's own, for tests and comparisons.
KERNELS_ENV_VAR = "VDGS_KERNELS"


def get_backend(device: torch.device) -> KernelBackend:
    """The operations for tensors on `device`: `cpu`, `gpu` on NVIDIA GPUs, `torch_ref` elsewhere, or the implementation
    that VDGS_KERNELS names. Raises VdgsError for another value of that variable."""
    return _implementation(device.type, os.environ.get(KERNELS_ENV_VAR, ""))


@cache
def _implementation(device_type: str, name: str) -> KernelBackend:
    if name not in ("", "cpu", "torch_ref", "gpu"):
        raise VdgsError(f"{KERNELS_ENV_VAR} must be cpu, torch_ref, gpu or not set, not {name!r}.")
    name = name if name in ("torch_ref", "gpu") else {"cpu": "cpu", "cuda": "gpu"}.get(device_type, "torch_ref")
    _survive_forks()
    backend: KernelBackend = import_module(f"vdgs.kernels.{name}")  # type: ignore[assignment]
    return backend


@cache
def _survive_forks() -> None:
    """Let forked children of this process compute with one thread of torch: they have none of its OpenMP threads, for
    which the first parallel operation would wait without end. The pool of the kernels begins anew by itself."""
    import torch

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


def get_num_threads() -> int:
    """How many threads the operations use on the CPU."""
    from vdgs.kernels.cpu import extension

    return extension.get_num_threads()


def configure_threads(count: int | None = None) -> None:
    """Set up the threads of this process and, through its environment, of its child processes.

    `import vdgs` calls it, for the command line and for callers of the API alike: torch's OpenMP threads must block,
    not spin, beside the kernels' own pool, and torch reads OMP_WAIT_POLICY once, when it is imported. So must those of
    OpenBLAS, which numpy starts. A value that is set already stays. `count` 0 means `default_num_threads()`; None
    leaves the number of threads and imports nothing heavy. Raises VdgsError for what is no number of threads.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")  # the least: 2^4 cycles
    if count is not None:
        from vdgs.config.ranges import WORKER_COUNT
        from vdgs.config.validation_rules import checked_value

        count = checked_value("count", count, Annotated[int, WORKER_COUNT])
        set_num_threads(count or default_num_threads())


def set_num_threads(count: int) -> None:
    """Let the operations use up to `count` threads of the CPU, the calling one included; torch's own as well.

    Raises ValueError below 1.
    """
    import torch

    from vdgs.kernels.cpu import extension

    extension.set_num_threads(count)
    torch.set_num_threads(count)
