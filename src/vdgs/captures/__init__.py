"""Captures: photographs and cameras on disk become one typed `Capture`."""
