"""Shared by all tests: shapes are checked at run time, figures need no screen."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("MPLBACKEND", "Agg")

from jaxtyping import install_import_hook

# Every jaxtyping annotation in the package is checked while the tests run.
install_import_hook("vdgs", "beartype.beartype")
