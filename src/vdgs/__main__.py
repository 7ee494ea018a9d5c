"""`python -m vdgs`: the command line, where the script `vdgs` is not on the PATH."""

from vdgs.cli.main import main

main()
