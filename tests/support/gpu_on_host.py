"""The composed set of operations on the processor: its CUDA kernels run their own text there (cuda_on_host.h), and of
gsplat only what it compiles is stood in for (fake_gsplat.py)."""

from __future__ import annotations

from pathlib import Path

import pytest

from support import fake_gsplat
from support.cuda_on_host import HostDriver, build_on_host, no_code
from vdgs.kernels.cuda import launch, loss
from vdgs.kernels.cuda.adam import PROGRAM as ADAM
from vdgs.kernels.cuda.cull import PROGRAM as CULL
from vdgs.kernels.cuda.decode import PROGRAM as DECODE
from vdgs.kernels.cuda.decode import packing_order
from vdgs.kernels.cuda.rasterize import PROGRAM as RASTERIZE
from vdgs.kernels.cuda.statistics import PROGRAM as STATISTICS
from vdgs.kernels.cuda.visibility import PROGRAM as VISIBILITY
from vdgs.kernels.gpu import rasterizer as choosing
from vdgs.kernels.torch_ref import adam

PROGRAMS = (ADAM, loss.PROGRAM, RASTERIZE, DECODE, CULL, STATISTICS, VISIBILITY)


def build(folder: Path) -> dict[str, HostDriver]:
    """Drivers that run the kernels of each source, by its name; the folder keeps what is compiled."""
    library = build_on_host(folder)
    return {program.name: HostDriver(library) for program in PROGRAMS}


def install(drivers: dict[str, HostDriver], monkeypatch: pytest.MonkeyPatch, device_type: str, rasterizer: str) -> None:
    """Let tensors of a kind of device be computed on by the composed set, with one of its rasterizers."""
    monkeypatch.setattr(launch, "compile_source", no_code)
    for program in PROGRAMS:
        driver = drivers[program.name]
        driver.device_type = device_type
        for name, value in (("driver", driver), ("_functions", {}), ("_modules", {})):
            monkeypatch.setattr(program, name, value)
    fake_gsplat.install(monkeypatch)
    monkeypatch.setenv(choosing.RASTERIZER_ENV_VAR, rasterizer)
    choosing.select_rasterizer.cache_clear()
    for kept_on_a_card in (adam.bias_correction_tables, packing_order):
        kept_on_a_card.cache_clear()
