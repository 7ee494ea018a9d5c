"""`python -m vdgs.cli` is the command line."""

from vdgs.cli.main import main

main()
