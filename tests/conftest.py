"""Shared by all tests: shapes are checked at run time, nothing depends on the clock, figures need no screen.

The whole suite runs on all cores (pytest-xdist, one worker more than those, at most four); single files run here and
now, without workers. Modules whose fixtures are expensive are marked as one group each (`xdist_group`): one worker runs
them.
"""

from __future__ import annotations

import gc
import itertools
import os
import re
import signal
import sys
from collections.abc import Generator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

# What one process of the tests has compiled, the others find, also where the environment, as of a container, keeps
# compiled code from being written.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
if "PYTEST_XDIST_WORKER" in os.environ:
    # The workers fill the cores: kernels and torch on more threads would only wait for each other. Tests about threads
    # ask for theirs. Processes that tests start inherit this.
    os.environ.setdefault("VDGS_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
import jaxtyping
import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

from support import typecheck
from support.package_files import files_with_shapes, module_name

if TYPE_CHECKING:
    from support.flights import Flight
    from support.pipeline_run import TwoBlocks
    from support.small_pipeline import NativeRun

#: Memory is what limits their number on machines of many cores (about 1 GB each).
MOST_WORKERS = 4

# The same examples in every run, and as many on a busy machine as on an idle one. Search for new ones with
# `pytest --hypothesis-profile search`.
settings.register_profile("vdgs", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("search", settings.get_profile("vdgs"), derandomize=False, max_examples=1000)
settings.load_profile("vdgs")
# hypothesis also tries numbers and words that it finds in the modules that happen to be loaded: other examples in each
# worker, and after other tests.
providers._get_local_constants = lambda: providers._local_constants  # type: ignore[attr-defined]


# Their annotations are checked while the tests run.
jaxtyping.jaxtyped = typecheck.jaxtyped
jaxtyping.install_import_hook([module_name(file) for file in files_with_shapes()], f"{typecheck.__name__}.checked")


def pytest_configure_node(node: Any) -> None:
    """Tell each worker of the server from which all fork their commands: it takes seconds to start."""
    from support.commands import begin_server

    node.workerinput["commands"] = begin_server({"VDGS_THREADS": "1", "OMP_NUM_THREADS": "1"})


def pytest_configure(config: pytest.Config) -> None:
    """Heed the signals that tests send to commands, which inherit what `nohup` and shells in the background ignore."""
    sys.dont_write_bytecode = False  # of this process, which began with the environment that is changed above
    if address := getattr(config, "workerinput", {}).get("commands"):
        from support.commands import use_server

        use_server(address)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in (signal.SIGHUP, signal.SIGQUIT):
        signal.signal(name, signal.SIG_DFL)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Import and collect without the garbage collector, and let it forget what was imported: stages call it often."""
    gc.disable()
    try:
        if "PYTEST_XDIST_WORKER" in os.environ and session.config.args == session.config.getini("testpaths"):
            import_share(session.config)
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def import_share(config: pytest.Config) -> None:
    """Let each worker import other test modules first: what it compiles (pytest rewrites all assertions), the others
    find when they collect. What cannot be imported, collecting reports."""
    worker, workers = int(config.workerinput["workerid"][2:]), config.workerinput["workercount"]  # type: ignore[attr-defined]
    for file in sorted(Path(__file__).parent.rglob("test_*.py"))[worker::workers]:
        if str(file.parent) not in sys.path:
            sys.path.insert(0, str(file.parent))  # as pytest does
        with suppress(Exception, pytest.skip.Exception):
            import_module(file.stem)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Let runs in this process begin without seconds of timing. Refuse workers that do not keep groups together: each
    would make the expensive fixtures anew."""
    if "vdgs.pipeline.time_estimate" in sys.modules:  # the package is not imported for it
        from support.commands import FEW_STEPS
        from vdgs.pipeline import time_estimate

        time_estimate.MIN_TIMED_STEPS, time_estimate.MAX_TIMED_SECONDS = FEW_STEPS, 0.0
    if "torch.testing" in sys.modules:
        from torch.testing import _comparison

        _comparison._HAS_DTENSOR = False  # or the first comparison imports sympy: over a second in each worker
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    for item in session.items:
        for mark in item.iter_markers("xdist_group"):
            if not item.nodeid.endswith(f"@{mark.args[0]}"):
                raise pytest.UsageError(
                    f"{item.nodeid}: this pytest-xdist keeps no groups with pytest {pytest.__version__}"
                )


_folders = itertools.count()


@pytest.fixture
def tmp_path(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """As pytest's, but beside those of the same file only: pytest lists all that were made before for each new one, and
    every command lists the folders around its output."""
    name = re.sub(r"\W", "_", request.node.name)[:30]
    folder = tmp_path_factory.getbasetemp() / request.path.stem / f"{name}{next(_folders)}"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture(scope="session")
def compiled_code(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where CUDA kernels that tests compile for the processor are kept, once for all workers."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "compiled"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def not_for_a_card(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels are run on the processor by all tests but those that need a GPU: they are compiled for no card."""
    from support.cuda_on_host import no_code
    from vdgs.kernels.cuda import launch

    if not request.node.get_closest_marker("gpu"):
        monkeypatch.setattr(launch, "compile_source", no_code)


@pytest.fixture(scope="session")
def uncut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a coarse model of fifteen photographs, and five others to test with. Not to be changed: others copy
    it (`support.clusters.copy_run`)."""
    from support.captures import tiny_scene, write_colmap
    from support.clusters import COARSE
    from support.commands import vdgs

    folder = tmp_path_factory.mktemp("uncut")
    write_colmap(folder / "capture", tiny_scene(columns=5, rows=4))
    done = vdgs("train-coarse", folder / "capture", "--output", folder / "coarse", *COARSE, "--test-every", "4")
    assert done.returncode == 0, done.stderr + done.stdout
    return folder / "coarse"


@pytest.fixture(scope="session")
def two_blocks(tmp_path_factory: pytest.TempPathFactory) -> TwoBlocks:
    """A whole run of two blocks, which train at once. Not to be changed: `clusters.copy_run`."""
    from support.pipeline_run import run_two_blocks

    return run_two_blocks(tmp_path_factory.mktemp("place"))


@pytest.fixture(scope="session")
def native_small(tmp_path_factory: pytest.TempPathFactory) -> NativeRun:
    """A whole run of six photographs by the native operations. Not to be changed."""
    from support.small_pipeline import native_run

    return native_run(tmp_path_factory.mktemp("native"))


@pytest.fixture(scope="session")
def nine(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Nine photographs of a flight, and what reconstructions leave out beside them. Not to be changed."""
    from support.flights import add_what_is_left_out, fly, grid

    flight = fly(tmp_path_factory.mktemp("nine") / "card", grid(3, 3, 9.0))
    add_what_is_left_out(flight)
    return flight


@pytest.fixture(scope="session")
def nine_begun(nine: Flight, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What the folder of their capture holds when each step begins, and when all are done. Not to be changed:
    `flights.copy_folder`."""
    from support.flights import folders_of_steps

    return folders_of_steps(nine, tmp_path_factory.mktemp("begun"))


@pytest.fixture
def unestimated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reconstructions begin without their estimate."""
    from support import flights
    from vdgs.sfm import reconstruct

    monkeypatch.setattr(reconstruct, "estimate_sfm", flights.unestimated)


@pytest.fixture
def few_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photographs are searched at the size that they have, though they are small and few."""
    from support import flights
    from vdgs.sfm import feature_extraction

    monkeypatch.setattr(feature_extraction, "is_upsampled", flights.not_upsampled)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """What `-n auto` means: no workers (0) where only some files were asked for, for they take seconds to start."""
    if any(argument.partition("::")[0].endswith(".py") for argument in config.args):
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores + 1, MOST_WORKERS)  # one more: some tests wait for processes that start, and for browsers


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that need a GPU are skipped where torch has none."""
    if not any("gpu" in item.keywords for item in items):
        return
    import torch

    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="no GPU that torch can use"))
