"""`python -m vdgs` is the command line."""

from vdgs.cli.main import main

main()
