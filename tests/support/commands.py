"""Commands of vdgs as processes of their own: real ones, to be signalled and killed, without the seconds of importing.

    done = vdgs("merge", run)                      # waits; done.returncode, done.stdout, done.stderr
    with begun("train-coarse", capture, "--output", run, pause_at=("*/00000040.json", 1)) as command:
        command.wait_until_paused()
        command.send_signal(signal.SIGKILL)

One server for all workers of the tests imports the package once; every command is forked from it, and so are the
processes that it starts itself, such as those of blocks (`forking`), unless it is asked to start them as people's do
(`start_tasks`) or to do in its own what they would (`do_tasks_here`). `entry_point` is a whole `python -m vdgs`,
`python` any code in such a process.
"""

from __future__ import annotations

import gc
import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial, wraps
from multiprocessing import forkserver, resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from support.forking import fork_tasks, module_of
from support.pausing import Pause, pause_where_asked

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from vdgs.distributed.executor import Task, TaskListener, TaskResult

#: What nothing takes that still goes on, however busy the machine is. The limit of a whole test is larger still.
PATIENCE_SECONDS = 900.0
#: Resolution of the figures that commands draw.
SMALL_DPI = 30
#: Steps that they time to say how long training takes.
FEW_STEPS = 2
#: Seconds between two looks at what is waited for.
GLANCE_SECONDS = 0.01

#: Verbs that start processes, and options with which others do. For the rest nothing waits that could fork some.
STARTING = {"run", "train-blocks", "bench", "--jobs", "--executor"}
#: What the server imports, as far as it is there; the last ones are what commands import when they need it.
IMPORTED = [
    "tests.support.without_collector",  # found where the tests begin in the repository's folder
    "vdgs.cli.main",
    "vdgs.cli",
    "vdgs.cli.capture_cmds",
    "vdgs.cli.export_cmd",
    "vdgs.cli.result_cmds",
    "vdgs.cli.run_cmd",
    "vdgs.cli.stage_cmds",
    "vdgs.cli.tool_cmds",
    "vdgs.kernels.device_selection",
    "vdgs.pipeline.dry_run",
    "vdgs.system.exit_codes",
    "vdgs.pipeline.run_pipeline",
    "vdgs.rendering.render_run",
    "experiments.bench.bench",
    "vdgs.export.export_run",
    "vdgs.pipeline.train_block",
    "vdgs.kernels.cpu",
    "vdgs.kernels.torch_ref",
    "vdgs.kernels.autograd",
    "rich._emoji_codes",
    "contourpy",
    "PIL.GifImagePlugin",
    "PIL.JpegImagePlugin",
    "PIL.PngImagePlugin",
    "pytest",
    "sklearn.cluster",
    "rasterio",
]
#: Begins processes. Only Linux forks safely what has imported this much.
PROCESSES = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
if sys.platform == "linux":
    PROCESSES.set_forkserver_preload(IMPORTED)


def begin_server(variables: Mapping[str, str]) -> str:
    """Start the server here, with more environment variables; returns its address, for `use_server` in other processes,
    or nothing where each has its own."""
    if sys.platform != "linux" or hasattr(forkserver._forkserver, "_forkserver_authkey"):  # from Python 3.14 on
        return ""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update({name: value for name, value in variables.items() if before[name] is None})
    forkserver.ensure_running()
    for name in (name for name, value in before.items() if value is None):
        del os.environ[name]
    return str(forkserver._forkserver._forkserver_address)  # type: ignore[attr-defined]


def use_server(address: str) -> None:
    """Let commands of this process be forked from the server of another, which outlives it."""
    server = forkserver._forkserver
    server._forkserver_address = address  # type: ignore[attr-defined]
    server._forkserver_alive_fd = os.open(os.devnull, os.O_RDONLY)  # type: ignore[attr-defined]
    server.ensure_running = resource_tracker.ensure_running  # type: ignore[method-assign]


@dataclass(frozen=True)
class CommandsHere:
    """An executor that runs modules of vdgs in this process, one after the other: processes without their start."""

    max_concurrent: int
    max_per_device: int = 0

    def run(self, tasks: Sequence[Task], _listener: TaskListener) -> list[TaskResult]:
        from vdgs.distributed.executor import TaskResult

        for task in tasks:
            extension, arguments = module_of(task.command)
            task.output.parent.mkdir(parents=True, exist_ok=True)
            with task.output.open("a") as output, redirect_stdout(output), redirect_stderr(output), threads_as_before():
                code = _exit_code(importlib.import_module(extension).main, arguments)
            assert not code, f"{task.name}: exit code {code}, see {task.output}"
        return [TaskResult(name=task.name, state="done", attempts=1) for task in tasks]


def _exit_code(main: Callable[[list[str]], int | None], arguments: list[str]) -> object:
    try:
        return main(arguments)
    except SystemExit as ended:
        return ended.code


@contextmanager
def threads_as_before() -> Iterator[None]:
    """Undo what a command that runs in this process sets: how many threads compute."""
    import torch

    from vdgs.kernels.cpu import extension

    kernels, of_torch = extension.get_num_threads(), torch.get_num_threads()
    try:
        yield
    finally:
        extension.set_num_threads(kernels)
        torch.set_num_threads(of_torch)


class Command:
    """A function of the command line's that runs in a process of its own, its output going to files in a folder."""

    def __init__(self, main: Callable[[], None], folder: Path, pause: Pause, environment: dict[str, str]):
        self._main, self._pause = main, pause
        self._files = (folder / "stdout", folder / "stderr")
        self._process = PROCESSES.Process(target=_run, args=(main, *map(str, self._files), environment))
        self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def runs(self) -> bool:
        return self._process.is_alive()

    def send_signal(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def paused(self) -> list[int]:
        """Numbers of the processes that wait where `pause_at` asked them to, or did."""
        return self._pause.processes()

    def wait_until_paused(self, processes: int = 1) -> None:
        wait_until(lambda: len(self.paused()) >= processes or not self.runs())
        assert self.runs(), f"ended before it was paused: {self.finished()}"

    def go_on(self) -> None:
        """End all pauses."""
        self._pause.end()

    def kill_paused(self) -> None:
        """Kill the processes that wait; none waits after them."""
        self._pause.end(signal.SIGKILL)

    def finished(self) -> subprocess.CompletedProcess[str]:
        """How the command ended and what it printed; waits for its end."""
        self._process.join(PATIENCE_SECONDS)
        assert not self.runs(), f"{self._main} does not end"
        code = self._process.exitcode
        assert code is not None
        printed = [file.read_text(encoding="utf-8") if file.exists() else "" for file in self._files]
        return subprocess.CompletedProcess(self._main, code, *printed)

    def printed(self) -> str:
        """What it has printed so far."""
        return self._files[0].read_text(encoding="utf-8") if self._files[0].exists() else ""

    def close(self) -> None:
        """Kill the process if it still runs."""
        self._process.kill()
        self._process.join()


@contextmanager
def begun(
    *arguments: object,
    pause_at: tuple[str, int] | None = None,
    prepare: Callable[[], None] | None = None,
    environment: dict[str, str] | None = None,
) -> Iterator[Command]:
    """A `vdgs` that runs meanwhile; killed at the end if it still does.

    `pause_at`: it waits, and so do processes that it starts, before the n-th time that it opens, renames to or removes
    a file whose whole path is like this pattern. `prepare` is called in its process before it begins; `environment` are
    variables on top of those that the tests began with.
    """
    main = partial(_vdgs, [str(each) for each in arguments], prepare)
    with _started(main, pause_at, environment or {}) as command:
        yield command


def vdgs(
    *arguments: object, prepare: Callable[[], None] | None = None, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end. See `begun`."""
    with begun(*arguments, prepare=prepare, environment=environment) as command:
        return command.finished()


@contextmanager
def python_begun(code: str, **environment: str) -> Iterator[Command]:
    """Code that runs in a process which has imported the package and called nothing of it."""
    with _started(partial(_execute, code), None, environment) as command:
        yield command


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code to its end. See `python_begun`."""
    with python_begun(code, **environment) as command:
        return command.finished()


def do_tasks_here() -> None:
    """Let this process do itself what it would start processes for."""
    from experiments.bench import bench
    from vdgs.distributed import backend_selection

    bench.LocalExecutor = backend_selection.LocalExecutor = CommandsHere  # type: ignore[assignment,misc]


def limit_files(most_bytes: int) -> None:
    """Let no file that this process writes be larger."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))


def entry_point(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The same as a person starts it: `python -m vdgs`, with all that it imports."""
    command = [sys.executable, "-m", "vdgs", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_SECONDS)


def wait_until(condition: Callable[[], object]) -> None:
    """Return once the condition holds; fail if that never comes. To look may cost more than what is waited for, and
    what takes long is looked at as seldom."""
    start = began = time.monotonic()
    while not condition():
        looked = time.monotonic()
        assert looked < start + PATIENCE_SECONDS, "waited in vain"
        time.sleep(max(GLANCE_SECONDS, 3 * (looked - began), (looked - start) / 50))
        began = time.monotonic()


def is_free(run: Path) -> bool:
    """Whether no process works on a run."""
    from vdgs.errors import RunError
    from vdgs.runs.run_folder import RunFolder

    try:
        with RunFolder(run).locked():
            return True
    except RunError:
        return False


@contextmanager
def _started(
    main: Callable[[], None], pause_at: tuple[str, int] | None, environment: dict[str, str]
) -> Iterator[Command]:
    with tempfile.TemporaryDirectory() as folder:
        waiting = Path(folder) / "waiting"
        waiting.mkdir()
        pause = Pause(*(pause_at or ("", 0)), str(waiting))
        command = Command(main, Path(folder), pause, environment | (pause.environment() if pause_at else {}))
        try:
            yield command
        finally:
            command.close()


def _run(main: Callable[[], None], stdout: str, stderr: str, environment: dict[str, str]) -> None:
    """In the process of a command."""
    for descriptor, file in ((1, stdout), (2, stderr)):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), descriptor)
    os.environ.update(environment)
    gc.freeze()  # what is imported stays: the collector need not look at it, nor the system copy it
    gc.enable()
    pause_where_asked()
    main()


def _vdgs(arguments: list[str], prepare: Callable[[], None] | None) -> None:
    if prepare is not do_tasks_here and STARTING & {*arguments}:
        fork_tasks()
    spare_seconds()
    if prepare is not None:
        prepare()
    from vdgs.cli.main import main

    main(arguments)


@contextmanager
def small_figures() -> Iterator[None]:
    """Draw figures of so few pixels as still makes files of them, and no ticks: what they show, others test."""
    restore = _draw_small_figures()
    try:
        yield
    finally:
        restore()


def _draw_small_figures() -> Callable[[], None]:
    """Returns what draws them as before."""
    from vdgs.report import charts
    from vdgs.system import figure_style as style

    sizes, draw = (style.DPI, charts.DPI), style.FigureCanvasAgg.print_png

    @wraps(draw)
    def draw_without_ticks(canvas: FigureCanvasAgg, *arguments: Any, **named: Any) -> None:
        for axes in canvas.figure.axes:
            axes.set_axis_off()
        draw(canvas, *arguments, **named)

    def restore() -> None:
        style.DPI, charts.DPI = sizes
        style.FigureCanvasAgg.print_png = draw  # type: ignore[method-assign]

    style.DPI = charts.DPI = SMALL_DPI
    style.FigureCanvasAgg.print_png = draw_without_ticks  # type: ignore[method-assign]
    return restore


def spare_seconds() -> None:
    """Let this process, which ends with a command, draw small figures and time few steps before it trains: how near
    estimates come, others test."""
    from vdgs.pipeline import time_estimate

    _draw_small_figures()
    time_estimate.MIN_TIMED_STEPS, time_estimate.MAX_TIMED_SECONDS = FEW_STEPS, 0.0


def _execute(code: str) -> None:
    exec(code, {"__name__": "__main__"})
