"""Imported by every Python process that is started with this folder in PYTHONPATH: see pausing.py."""

from pausing import pause_where_asked

pause_where_asked()
