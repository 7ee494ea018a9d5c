"""`python -m experiments.bench TABLE --output FOLDER`, from the root of a checkout; the same as `vdgs bench`."""

from __future__ import annotations

import sys

from vdgs.cli.main import main

if __name__ == "__main__":
    main(["bench", *sys.argv[1:]])
