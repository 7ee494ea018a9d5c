"""Captures as other programs write them, one file for each format; all yield a `SourceCapture`."""
