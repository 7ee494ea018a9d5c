"""Importing switches the garbage collector off: what follows is imported in less time."""

import gc

gc.disable()
