"""Shapes are checked wherever they are annotated: no file is left out, and a wrong shape is an error."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from conftest import PACKAGE, module_name
from vdgs.evaluation.metrics import squared_error
from vdgs.kernels.reference.cull import cull
from vdgs.model.visibility import normalised
from vdgs.partition.cluster import features_of
from vdgs.training.smoothing import psnr_of


def imports_jaxtyping(file: Path) -> bool:
    """Read from the syntax, not as the hook finds its files."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jaxtyping":
            return True
        if isinstance(node, ast.Import) and any(alias.name.split(".")[0] == "jaxtyping" for alias in node.names):
            return True
    return False


def test_no_file_with_shapes_is_left_out():
    files = [file for file in PACKAGE.rglob("*.py") if imports_jaxtyping(file)]
    assert len(files) > 60
    loaders = {file: importlib.import_module(module_name(file)).__loader__ for file in files}
    unchecked = [str(file) for file, loader in loaders.items() if type(loader).__name__ != "_JaxtypingLoader"]
    assert not unchecked


@pytest.mark.parametrize(
    "call",
    [
        lambda: cull(torch.zeros(3, 2), torch.zeros(3, 6), None),
        lambda: normalised(np.zeros((3, 2), np.int64)),
        lambda: features_of(np.zeros((3, 3)), np.zeros(3, np.int64), 1.0),
        lambda: psnr_of(torch.zeros(4, 5), torch.zeros(4, 5, dtype=torch.uint8), None),
        lambda: squared_error(np.zeros((4, 5), np.uint8), np.zeros((4, 5), np.uint8)),
    ],
    ids=["kernels", "model", "partition", "training", "evaluation"],
)
def test_a_wrong_shape_is_an_error(call):
    with pytest.raises(TypeCheckError):
        call()
