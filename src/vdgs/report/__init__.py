"""The report of a run: one HTML file with its figures, pictures, tables and settings."""
