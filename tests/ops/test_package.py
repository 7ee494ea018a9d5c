"""The package `vdgs` as Python sees it: lazy, in processes, with a stub, reference and help that name what is there."""

from __future__ import annotations

import ast
import inspect
import pickle
import pydoc
import subprocess
import sys
from pathlib import Path

import pytest

import vdgs

pytestmark = pytest.mark.slow
STUB = Path(vdgs.__file__).with_suffix(".pyi")
LAZY = "vdgs.system.lazy_package"


def test_the_import_loads_nothing_heavy():
    code = "import sys, vdgs; print(*sorted(sys.modules)); dir(vdgs); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, torch_too = done.stdout.strip().splitlines()
    own = {name for name in loaded.split() if name.startswith("vdgs")}
    assert own == {"vdgs", "vdgs.errors", "vdgs.kernels", "vdgs.kernels.thread_count", "vdgs.system", LAZY}
    assert not {"torch", "numpy", "inspect", "dataclasses", "scipy"} & set(loaded.split())
    assert torch_too == "False"


def test_threads_are_set_up_before_callers_load_torch_and_numpy():
    names = "OMP_WAIT_POLICY", "OPENBLAS_THREAD_TIMEOUT"
    code = f"import os; [os.environ.pop(n, None) for n in {names}]; import vdgs; print(*map(os.environ.get, {names}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["PASSIVE", "4"]


FORKING = """
import os, sys, numpy as np, vdgs
points = np.random.default_rng(0).uniform(-5, 5, (200_000, 3))
K = np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1.0]])
cameras = vdgs.cameras_from(np.eye(4)[None].repeat(9, 0), K, 320, 240)
vdgs.configure_threads(2)
seen = vdgs.count_visibility(points, cameras)
child = os.fork()
if not child:
    os._exit(0 if (vdgs.count_visibility(points, cameras) == seen).all() else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_forked_child_computes_what_its_parent_computes():
    """OpenMP's threads of the parent, for which torch's would wait without end, are not the child's."""
    subprocess.run([sys.executable, "-c", FORKING], check=True, timeout=60)


def test_importing_a_module_leaves_the_warnings_and_logs_of_its_caller():
    """What a process is to be told is its owner's to set: the command line does so in `quiet_libraries`."""
    of_the_process = {"filterwarnings", "simplefilter", "setLogLevel", "basicConfig", "disable"}
    for file in Path(vdgs.__file__).parent.rglob("*.py"):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            calls = [each.func for each in ast.walk(node) if isinstance(each, ast.Call)]
            assert not {each.attr for each in calls if isinstance(each, ast.Attribute)} & of_the_process, file


def test_the_stub_names_what_is_there():
    tree = ast.parse(STUB.read_text(encoding="utf-8"))
    stubbed = {alias.asname for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert len(stubbed) > 25
    assert stubbed | {"__version__"} <= set(dir(vdgs))
    for name in stubbed:
        value = getattr(vdgs, name)
        assert inspect.getdoc(value), name
        assert value is getattr(vdgs, name)
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        vdgs.rendr  # noqa: B018


def test_the_reference_names_all_of_it():
    page = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
    operations = {name for name, value in vars(vdgs.ops).items() if inspect.isfunction(value)}
    assert len(operations) == 6
    for name in {*vdgs._modules, *(f"ops.{name}" for name in operations)} - {"ops", "configure_threads"}:
        assert f"`{name}`" in page, name


def test_functions_that_are_folders_too_are_both():
    import vdgs.export.bake
    import vdgs.partition.blocks

    assert vdgs.export.bake.bake is not None
    for name in ("export", "partition"):
        assert callable(getattr(vdgs, name))
        assert inspect.signature(getattr(vdgs, name)) == inspect.signature(getattr(vdgs.ops.api, name))


@pytest.mark.parametrize("module", [vdgs, vdgs.export, vdgs.partition], ids=lambda module: module.__name__)
def test_modules_travel_to_other_processes(module):
    """As joblib, dask and ray send functions that use them."""
    assert pickle.loads(pickle.dumps(module)) is module  # noqa: S301


def test_a_star_import_brings_what_is_documented():
    found: dict = {}
    exec("from vdgs import *", found)
    assert {name for name in found if not name.startswith("_")} == set(vdgs._modules)
    assert found["partition"] is vdgs.partition


def test_help_shows_the_function_of_a_folder():
    for name in ("export", "partition"):
        function, shown = getattr(vdgs.ops.api, name), pydoc.plaintext.document(getattr(vdgs, name))
        assert f"{name}{inspect.signature(function)}" in shown
        assert inspect.getdoc(function).splitlines()[-1] in shown
