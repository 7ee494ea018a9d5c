"""The stages of a run: each reads files and writes files; a finished one is skipped, a cut-off one continues."""
