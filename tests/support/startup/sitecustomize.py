"""Imported by every Python process that is started with this folder in PYTHONPATH: some wait where a test asks them to
(support/pausing.py), and some stand for Ray's own (support/ray_agents.py)."""

from support.pausing import pause_where_asked
from support.ray_agents import stand_in_for_agents

stand_in_for_agents()
pause_where_asked()
