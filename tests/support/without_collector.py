"""Importing switches the garbage collector off: what follows is imported in less time. What it compiles is kept."""

import gc
import sys

gc.disable()
sys.dont_write_bytecode = False  # the server of commands is told otherwise where the environment of the tests says so
