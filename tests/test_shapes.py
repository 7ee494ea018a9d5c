"""Shapes are checked while the tests run: no file that names them is left out, and a wrong one is an error."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float, TypeCheckError, jaxtyped

from support.package_files import checked_files, files_with_shapes, module_name
from support.typecheck import checked
from vdgs.captures.camera_height import view_distance
from vdgs.config.method import CompensationConfig
from vdgs.evaluation.metrics import squared_error
from vdgs.kernels import cpu, rotations, torch_ref
from vdgs.kernels.spherical_harmonics import eval_sh_bases
from vdgs.model.initialization.gap_filling import find_gap_points
from vdgs.partition.clustering import fit_principal_plane
from vdgs.training.compensation import low_visibility_mask
from vdgs.visibility.visibility_counts import count_visibility


def imports_jaxtyping(file: Path) -> bool:
    """In any form, anywhere in the file."""
    text = file.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)) if "jaxtyping" in text else ():
        names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        if any(name.partition(".")[0] == "jaxtyping" for name in names):
            return True
    return False


def test_every_file_that_names_shapes_is_among_the_checked():
    assert files_with_shapes() == [file for file in checked_files() if imports_jaxtyping(file)]


def loader_of(name: str) -> str:
    """The package that loaded a module."""
    spec = importlib.import_module(name).__spec__
    return type(spec and spec.loader).__module__.partition(".")[0]


def test_they_were_loaded_with_their_checks():
    """By jaxtyping's loader, and not by an import that came before it was asked to."""
    names = [module_name(file) for file in files_with_shapes()]
    assert [name for name in names if loader_of(name) != "jaxtyping"] == []


def test_other_files_are_loaded_as_always():
    """So the test above can fail."""
    assert loader_of("vdgs.errors") != "jaxtyping"


FLAT = np.zeros((5, 2))
WRONG = {
    "kernels.native": lambda: cpu.count_visibility(torch.zeros(5, 2), []),
    "kernels.native, two that disagree": lambda: cpu.group_max(torch.zeros(5, 2), torch.zeros(4).long(), 1),
    "kernels.reference": lambda: torch_ref.morton_order(torch.zeros(5, 2)),
    "kernels": lambda: rotations.rotation_matrices(torch.zeros(5, 3)),
    "model, torch": lambda: count_visibility(torch.zeros(5, 2), []),
    "model, numpy": lambda: find_gap_points(FLAT, [], 1.0),
    "training": lambda: low_visibility_mask(torch.zeros(5, 1), CompensationConfig()),
    "partition": lambda: fit_principal_plane(np.zeros((5, 3))),
    "captures": lambda: view_distance(FLAT, np.zeros((5, 3)), np.zeros(3)),
    "evaluation, two that disagree": lambda: squared_error(*(np.zeros((n, 4, 3), np.uint8) for n in (4, 5))),
    "evaluation, another type": lambda: squared_error(*(np.zeros((4, 4, 3), np.float32) for _ in range(2))),
    "spherical harmonics": lambda: eval_sh_bases(torch.zeros(5, 2), 1),
}


@pytest.mark.parametrize("where", WRONG)
def test_a_wrong_shape_is_an_error(where):
    with pytest.raises(TypeCheckError):
        WRONG[where]()


@jaxtyped(typechecker=checked)
def first(values: Float[np.ndarray, "n"], count: int, more: object = None) -> Float[np.ndarray, "n"]:
    return more if more is not None else values[:count]


def test_so_is_a_result_that_does_not_fit_the_arguments():
    assert len(first(np.zeros(3), 3)) == 3
    for wrong in ((np.zeros(3), 2), (np.zeros((3, 1)), 3), (np.zeros(3), 3, [0.0] * 3)):
        with pytest.raises(TypeCheckError):
            first(*wrong)
