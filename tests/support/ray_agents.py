"""Ray's nodes without what nothing here asks for, and as slow to start as the machine makes them.

The dashboard, and the two agents of every node, which serve it and packages of environments, take half a second of
processor time each to start.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

#: Ray does without it where it ends.
DASHBOARD = "dashboard/dashboard.py"
#: For a program, the names of the ports that a node waits for. The last two are no agents: they scale clusters, and
#: print elsewhere what is logged.
PORTS: dict[str, tuple[str, ...]] = {
    "dashboard/agent.py": ("metrics_agent_port", "metrics_export_port", "dashboard_agent_listen_port"),
    "runtime_env/agent/main.py": ("runtime_env_agent_port",),
    "autoscaler/_private/monitor.py": (),
    "_private/log_monitor.py": (),
}


def stand_in_for_agents() -> None:
    """If this process is to be the dashboard, end. If it is to be an agent, say that it has no ports, wait for the end
    of its node, and end."""
    if any(word.endswith(f"/{DASHBOARD}") for word in sys.orig_argv[:4]):
        os._exit(1)
    for program, names in PORTS.items():
        if any(word.endswith(f"/{program}") for word in sys.orig_argv[:4]):
            options = dict(word[2:].split("=", 1) for word in sys.orig_argv if word.startswith("--") and "=" in word)
            for name in names:
                file = Path(options["session-dir"], f"{name}_{options['node-id']}")
                (begun := file.with_name(f"{file.name}.begun")).write_text("-1")
                begun.rename(file)  # a node reads it as soon as it is there
            if names:
                sys.stdin.read()
            else:
                signal.pause()
            os._exit(0)


def wait_for_nodes(seconds: float) -> None:
    """Let this process wait so long for a node that it starts: Ray itself waits for thirty seconds."""
    from ray._private import services

    get_node = services.get_node

    def patient(*node: object) -> object:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            with suppress(RuntimeError):  # it has not registered yet
                return get_node(*node)
            time.sleep(0.1)
        return get_node(*node)

    services.get_node = patient
