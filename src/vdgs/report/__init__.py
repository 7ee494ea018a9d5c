"""The report of a run: one HTML file with its figures, pictures, tables and settings."""

from vdgs.report.write_report import write_report

__all__ = ["write_report"]
