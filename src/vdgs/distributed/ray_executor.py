"""Tasks on a Ray cluster: Ray finds each a node with room for what it needs, an actor there runs it (`ray_actor`).

Only paths travel: state is in files that all nodes see. What Ray loses is started again by the scheduler, not by Ray,
so that attempts are counted and worded as everywhere.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import secrets
import socket
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

from vdgs.distributed.executor import (
    EXIT_STOPPED,
    Attempt,
    AttemptResult,
    AttemptStarted,
    Task,
    TaskListener,
    TaskResult,
)
from vdgs.distributed.node_check import NodeRequirements
from vdgs.distributed.ray_actor import NodeRejected, RayTaskActor, RayTaskSpec
from vdgs.distributed.scheduler import ExecutionPolicy, run_tasks
from vdgs.errors import VdgsError
from vdgs.system.documents import FitnessAnswer, FitnessQuestion
from vdgs.system.stop_signals import preserve_signal_handlers

NAMESPACE = "vdgs"
#: Memory for Ray's object store, which holds nothing: the least that Ray takes.
OBJECT_STORE_BYTES = 80 << 20
#: Bytes that the path of a socket may have (Linux), the longest that Ray adds to the folder of its files, and a folder
#: that is never too long.
MAX_SOCKET_PATH_BYTES, SHORT_FOLDER = 107, "/tmp"
LONGEST_SOCKET = "/ray/session_2026-01-01_00-00-00_000000_4194304/sockets/plasma_store"
#: Seconds that a node gets to answer before anything starts.
NODE_CHECK_TIMEOUT_SECONDS = 300.0
#: Seconds that a cluster has to take a connection, and again to answer on it.
KNOCK_SECONDS = 10.0
#: What a client of gRPC says first, and how a server answers: with a frame that has a head of this length and kind.
HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
HTTP2_HEAD_BYTES, HTTP2_SETTINGS = 9, 4
#: How often a node that does not answer any more is asked again, where Ray says that it may come back.
MAX_UNAVAILABLE_POLLS = 20


@dataclass(frozen=True)
class RayNode:
    """What a node of a cluster has."""

    node_id: str
    name: str
    cpus: int
    memory_bytes: int
    gpus: float


@contextmanager
def connect(address: str | None) -> Iterator[None]:
    """Be a driver of the cluster at `address`, else of that in RAY_ADDRESS, else of a Ray of this machine alone.

    Raises VdgsError where there is no Ray, or none that answers.
    """
    where = _resolve_address(address)
    variables, options = {"RAY_USAGE_STATS_ENABLED": "0"}, dict[str, Any]()
    if where == "local":
        options = {"include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES}
        variables["RAY_worker_niceness"] = "0"  # as tasks have it that are processes of this machine
        # Ray listens on all addresses: admit only who has the token, which is nobody else.
        variables |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": _token()}
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        with _socket_folder(where) as folder, _ray_driver(where, options | folder):
            yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _socket_folder(where: str) -> Iterator[dict[str, str]]:
    """The option of a Ray of this machine that keeps its files in a short folder, where the usual one for files that
    are not kept (RAY_TMPDIR, TMPDIR) is too long for sockets. Raises VdgsError where there is no short one."""
    usual = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or tempfile.gettempdir()
    if where != "local" or len(os.fsencode(usual + LONGEST_SOCKET)) <= MAX_SOCKET_PATH_BYTES:
        yield {}
        return
    try:
        folder = tempfile.TemporaryDirectory(prefix="vdgs-ray-", dir=SHORT_FOLDER, ignore_cleanup_errors=True)
    except OSError as error:
        most = MAX_SOCKET_PATH_BYTES - len(LONGEST_SOCKET)
        raise VdgsError(
            f"{usual}: is too long for the sockets of Ray, and {SHORT_FOLDER} cannot be used ({error.strerror}). Set "
            f"RAY_TMPDIR to a folder whose path has at most {most} bytes."
        ) from error
    with folder as short:
        yield {"_temp_dir": short}


@cache
def _token() -> str:
    """The token of every Ray that this process starts: Ray reads it once in the life of a process."""
    return secrets.token_hex(32)


def check_reachable(address: str | None) -> None:
    """Raises VdgsError where there is no Ray, or none that answers at that address. None is started for it."""
    _require_ray()
    if _resolve_address(address) != "local":
        with connect(address):
            pass


def _knock(where: str) -> None:
    """Raise VdgsError where no gRPC server, which the head of a cluster is, answers at `where` within seconds: Ray
    itself would try for many minutes, and hear no signal meanwhile."""
    host, _, port = (_address_on_record() if where == "auto" else where.removeprefix("ray://")).rpartition(":")
    if not host or not port.isdecimal():  # Ray names what it cannot read
        return
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=KNOCK_SECONDS) as connection:
            if os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true"):
                return
            connection.sendall(HTTP2_PREFACE)
            answer = connection.recv(HTTP2_HEAD_BYTES, socket.MSG_WAITALL)
    except (OSError, OverflowError, UnicodeError) as error:
        raise _no_cluster(where, f"{host}:{port}: {error}" if where == "auto" else str(error)) from error
    if len(answer) < HTTP2_HEAD_BYTES or answer[3] != HTTP2_SETTINGS:
        raise _no_cluster(where, f"what listens at {host}:{port} is no Ray")


def _address_on_record() -> str:
    """The `host:port` that Ray takes for `auto`: of a cluster that runs here, or was joined here last and may be gone.
    Empty where it finds none, or does not tell."""
    with suppress(Exception):
        from ray._private.services import canonicalize_bootstrap_address

        return canonicalize_bootstrap_address("auto") or ""
    return ""


def _no_cluster(where: str, reason: str) -> VdgsError:
    return VdgsError(
        f"{where}: no Ray cluster that can be used ({reason}). See `ray status` there; give the address of its head "
        "(--address head:6379) or, on one of its machines, --address auto, with the same versions of Ray and Python on "
        "all."
    )


def _resolve_address(address: str | None) -> str:
    return address or os.environ.get("RAY_ADDRESS") or "local"


def _require_ray() -> None:
    if importlib.util.find_spec("ray") is None:
        raise VdgsError('Ray is not installed: pip install "vdgs[ray]"')


@contextmanager
def _ray_driver(where: str, options: Mapping[str, Any]) -> Iterator[None]:
    _require_ray()
    import ray

    with preserve_signal_handlers():
        if where != "local":
            _knock(where)
        try:
            ray.init(address=where, namespace=NAMESPACE, log_to_driver=False, logging_level="error", **options)
        except Exception as error:  # Ray raises any: a node that is slow to start is a bare one
            message = str(error).strip().splitlines() or [type(error).__name__]
            raise _no_cluster(where, message[0]) from error
    try:
        yield
    finally:
        with preserve_signal_handlers():
            ray.shutdown()


def list_nodes() -> list[RayNode]:
    """The nodes that are there now and have processors."""
    import ray

    alive = ((each, each["Resources"]) for each in ray.nodes() if each["Alive"])
    return [
        RayNode(
            each["NodeID"], each["NodeManagerHostname"], int(has["CPU"]), int(has.get("memory", 0)),
            float(has.get("GPU", 0)),
        )
        for each, has in alive
        if has.get("CPU", 0) >= 1
    ]  # fmt: skip


def check_nodes(requirements: NodeRequirements, ray_nodes: Sequence[RayNode]) -> list[FitnessAnswer]:
    """The answers of all nodes that are still there (`node_check.check_node`). Raises VdgsError, naming nodes and
    problems, if one cannot work on the run."""
    import ray

    with requirements.with_lock_probe() as question:
        pending = [(node, _check_node_remotely(node.node_id, question)) for node in ray_nodes]
        answers, problems = list[FitnessAnswer](), list[str]()
        for node, future in pending:
            try:
                answers.append(ray.get(future, timeout=NODE_CHECK_TIMEOUT_SECONDS))
            except ray.exceptions.RayError as error:
                if node.node_id in {each.node_id for each in list_nodes()}:
                    problems.append(f"node {node.name}: does not answer ({_last_line(error)})")
                continue
            problems += [f"node {answers[-1]['node']}: {each}" for each in answers[-1]["problems"]]
    if problems:
        raise VdgsError("These nodes cannot work on the run:\n  " + "\n  ".join(dict.fromkeys(problems)) + ".")
    return answers


def _check_node_remotely(node: str, requirements: FitnessQuestion) -> Any:
    """Ask one node. The function travels whole, for a node may have no vdgs."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def check() -> FitnessAnswer:
        import socket

        try:
            from vdgs.distributed.node_check import check_node
        except ImportError as error:
            return {"node": socket.gethostname(), "processor": "", "problems": [f"vdgs is not installed ({error})"]}
        return check_node(requirements)

    on_node = NodeAffinitySchedulingStrategy(node, soft=False)
    return ray.remote(check).options(num_cpus=0, max_retries=0, scheduling_strategy=on_node).remote()


@dataclass(frozen=True)
class RayExecutor(ExecutionPolicy):
    """Runs tasks on the cluster that this process is connected to."""

    requirements: NodeRequirements | None = None
    """What a node must see; checked again where each task starts, for nodes may join late."""

    def run(self, tasks: Sequence[Task], listener: TaskListener) -> list[TaskResult]:
        """As `Executor.run`."""
        assert self.requirements is not None
        return run_tasks(tasks, _RayEngine(self.requirements), self, listener)


class _RayEngine:
    def __init__(self, requirements: NodeRequirements):
        self._requirements = requirements.to_dict()
        self._run_id = hashlib.sha256(str(requirements.folder).encode()).hexdigest()[:12]
        #: Identifiers of nodes that cannot work on the run.
        self.rejected_nodes = set[str]()
        import ray

        named = ray.util.list_named_actors(all_namespaces=True)
        #: Names of the actors of vdgs on the cluster that live.
        self._actors = sorted(each["name"] for each in named if each["namespace"] == NAMESPACE)

    @property
    def max_memory_bytes(self) -> int:
        return max((node.memory_bytes for node in list_nodes()), default=0)

    def start(self, tasks: Sequence[tuple[Task, int]]) -> list[Attempt | OSError]:
        return [self._start(task, attempt) for task, attempt in tasks]

    def _start(self, task: Task, attempt: int) -> Attempt:
        import ray

        spec = RayTaskSpec(
            command=tuple(task.command), output=str(task.output), environment=task.remote_environment(),
            attempt=attempt, python=sys.executable, requirements=self._requirements,
        )  # fmt: skip
        resources = task.resources
        options: dict[str, Any] = {"num_cpus": resources.cpus, "num_gpus": resources.gpus}
        if resources.memory_bytes:
            options["memory"] = resources.memory_bytes
        if self.rejected_nodes and any(node.node_id not in self.rejected_nodes for node in list_nodes()):
            options["label_selector"] = {"ray.io/node-id": f"!in({','.join(sorted(self.rejected_nodes))})"}
        actor = ray.remote(RayTaskActor).options(
            name=self._actor_name(task, attempt), namespace=NAMESPACE, lifetime="detached", max_restarts=0,
            max_concurrency=8, **options,
        )  # fmt: skip
        return _RayAttempt(actor.remote(spec), self, frozenset(self.rejected_nodes))

    def find_running(self, task: Task) -> Attempt | None:
        import ray

        names = [name for name in self._actors if name.startswith(self._actor_name(task, ""))]
        with suppress(ValueError, IndexError):  # it may exit just now
            return _RayAttempt(ray.get_actor(names[-1], NAMESPACE), self)
        return None

    def refresh(self) -> None:
        """`poll` asks Ray itself."""

    def _actor_name(self, task: Task, attempt: int | str) -> str:
        """Another name for each attempt: that of a dead actor is free only after a while."""
        unique = f"{attempt}-{secrets.token_hex(4)}" if attempt else ""
        return f"{self._run_id}/{task.name}/{unique}"


class _RayAttempt:
    def __init__(self, actor: Any, engine: _RayEngine, avoided: frozenset[str] = frozenset()):
        self._actor, self._engine, self._avoided = actor, engine, avoided
        self._begin = actor.begin.remote()
        self._end: Any = None
        self._result: AttemptResult | None = None
        self._unavailable = 0
        self.start_info: AttemptStarted | None = None

    def poll(self) -> AttemptResult | None:
        import ray

        if self._result is None:
            try:
                if self._end is None and _is_ready(self._begin):
                    self._started(ray.get(self._begin))
                if self._end is not None and _is_ready(self._end):
                    self._result = ray.get(self._end)
            except ray.exceptions.ActorUnavailableError as error:
                self._ask_again(error)
            except ray.exceptions.RayTaskError as error:  # there is no such command there, or no space
                self._result = AttemptResult(None, _early_error_text(error.cause or error))
            except ray.exceptions.RayError as error:
                self._result = AttemptResult(None, self._loss_text(error), out_of_memory=_is_out_of_memory(error))
            if self._result is not None:
                self._kill_actor()
        return self._result

    def request_stop(self) -> None:
        if self.poll() is None and self.start_info is None and not _is_ready(self._begin):
            self._result = AttemptResult(EXIT_STOPPED)
            self._kill_actor()
        elif self._result is None:
            self._actor.stop.remote()

    def kill(self) -> None:
        if self._result is None:
            self._actor.kill.remote()

    def _started(self, answer: AttemptStarted | NodeRejected) -> None:
        if isinstance(answer, NodeRejected):
            self._engine.rejected_nodes.add(answer.node_id)
            reason = f"a node that cannot work on the run, {answer.node}: {answer.reason}"
            self._result = AttemptResult(None, reason, node_rejected=answer.node_id not in self._avoided)
            return
        self.start_info, self._end = answer, self._actor.end.remote()

    def _ask_again(self, error: Exception) -> None:
        """The network to the actor's node failed, and may work again."""
        self._unavailable += 1
        if self._unavailable > MAX_UNAVAILABLE_POLLS:
            self._result = AttemptResult(None, self._loss_text(error))
        elif self._end is None:
            self._begin = self._actor.begin.remote()
        else:
            self._end = self._actor.end.remote()

    def _loss_text(self, error: Exception) -> str:
        where = f" {self.start_info.where}" if self.start_info is not None else ""
        if _is_out_of_memory(error):
            return f"Ray, to free memory on its node{where}"
        if any(words in str(error) for words in ("node has died", "node was terminated", "node died")):
            return f"the loss of its node{where}"
        return _early_error_text(error) if self.start_info is None else f"the loss of its worker on node{where}"

    def _kill_actor(self) -> None:
        import ray

        with suppress(ray.exceptions.RayError, ValueError):
            ray.kill(self._actor)


def _is_ready(answer: Any) -> bool:
    import ray

    return bool(ray.wait([answer], timeout=0)[0])


def _is_out_of_memory(error: Exception) -> bool:
    import ray

    return isinstance(error, ray.exceptions.OutOfMemoryError) or "running low on memory" in str(error)


def _early_error_text(error: BaseException) -> str:
    return f"an error before its first line: {_last_line(error)}"


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
