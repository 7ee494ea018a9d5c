"""Imported by every Python process that is started with this folder in PYTHONPATH: some wait where a test asks them to
(support/pausing.py), some stand for Ray's own (support/ray_agents.py) or for a fork (support/shard_server.py)."""

from support.pausing import pause_where_asked
from support.ray_agents import stand_in_for_agents
from support.shard_server import fork_shard_where_asked

stand_in_for_agents()
fork_shard_where_asked()
pause_where_asked()
