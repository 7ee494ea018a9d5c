"""What is not used goes back to the system."""

import sys

import pytest

from support.commands import python

HOLED = """
import torch
from vdgs.kernels.idle_memory import trim_heap

def resident():
    with open("/proc/self/status") as status:
        return next(1024 * int(line.split()[1]) for line in status if line.startswith("VmRSS"))

trim_heap()  # of what this process began with
# Freed memory between pieces in use, as growth leaves it: pieces too small for pages of their own from the system.
pieces = [torch.ones(25_000) for _ in range(1000)]
kept = pieces[::10]
del pieces
before = resident()
trim_heap()
print(before - resident(), all(bool((piece == 1).all()) for piece in kept))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="resident size through /proc, trimming with glibc")
def test_freed_memory_between_pieces_in_use_goes_back():
    done = python(HOLED)
    assert done.returncode == 0, done.stderr
    returned, intact = done.stdout.split()
    assert int(returned) > 60e6  # of 90 MB
    assert intact == "True"
