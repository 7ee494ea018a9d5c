"""Of which format a level-of-detail tree is. Imports nothing heavy."""

from __future__ import annotations

import json
from pathlib import Path

TREE_FILE = "tree.safetensors"
#: Of the table of a tree, and of its nodes: both change together.
LOD_FORMAT, NODE_FORMAT = "vdgs-lod-5", "vdgs-lod-node-4"


def is_present_format(tree: Path) -> bool:
    """Whether the table of a tree is of the format of this version; so is one that has no header that can be read, for
    who opens it says what is wrong with it."""
    try:
        with tree.open("rb") as file:
            header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
        return LOD_FORMAT in header["__metadata__"]
    except (OSError, ValueError, KeyError, TypeError, OverflowError, MemoryError):
        return True
