"""Imported by every Python process that is started with this folder in PYTHONPATH: see support/pausing.py."""

from support.pausing import pause_where_asked

pause_where_asked()
