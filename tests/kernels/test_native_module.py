"""The native modules: which one runs, their arithmetic, their threads."""

from __future__ import annotations

import os

import numpy as np
import pytest

from support.commands import python
from vdgs.kernels.cpu import extension as native_module
from vdgs.kernels.cpu.extension import NativeUnavailable, get_extension, load_extension, supported_isas

ISAS = supported_isas()


def elementwise(isa: str, name: str, x: np.ndarray) -> np.ndarray:
    out = np.empty_like(x)
    load_extension(isa).check.elementwise(name, x, out)
    return out


def test_best_supported_module_is_chosen() -> None:
    assert "portable" in ISAS
    wanted = os.environ.get("VDGS_ISA") or ISAS[0]
    assert get_extension().isa == wanted == native_module.active_isa()


@pytest.mark.parametrize("isa", ISAS)
def test_every_supported_module_loads_in_one_process(isa: str) -> None:
    assert load_extension(isa).isa == isa


def test_unknown_instruction_set_is_refused_by_name() -> None:
    with pytest.raises(NativeUnavailable, match=r"no kernels for 'sse9'.*avx512, avx2, portable"):
        load_extension("sse9")


def test_environment_chooses_instruction_set_and_threads() -> None:
    code = "from vdgs.kernels.cpu import extension as m; print(m.active_isa(), m.get_num_threads())"
    done = python(code, VDGS_ISA="portable", VDGS_THREADS="3")
    assert done.stdout.split() == ["portable", "3"]


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        ("VDGS_ISA", "sse9", "no kernels for 'sse9'"),
        ("VDGS_THREADS", "many", "whole number from 1 to 1024, not 'many'"),
        ("VDGS_THREADS", "99999", "whole number from 1 to 1024, not '99999'"),
    ],
)
def test_environment_errors_say_what_is_wrong(variable: str, value: str, message: str) -> None:
    done = python("from vdgs.kernels.cpu import extension as m; m.get_extension()", **{variable: value})
    assert done.returncode != 0
    assert message in done.stderr


def test_missing_build_says_how_to_build(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(native_module.importlib, "import_module", absent)
    with pytest.raises(NativeUnavailable, match="pip install -e"):
        native_module._import("portable")


def test_threads_must_be_positive() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        native_module.set_num_threads(0)


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize(
    ("name", "function", "low", "high", "tolerance"),
    [
        ("exp2", np.exp2, -126, 127, 3e-7),
        ("exp", np.exp, -80, 80, 6e-6),
        ("log2", np.log2, 1e-30, 1e30, 2e-7),
        ("log", np.log, 1e-30, 1e30, 2e-7),
        ("reciprocal", np.reciprocal, 1e-30, 1e30, 3e-7),
        ("rsqrt", lambda x: x**-0.5, 1e-30, 1e30, 3e-7),
        ("sqrt", np.sqrt, 0, 1e30, 1e-7),
        ("sigmoid", lambda x: 1 / (1 + np.exp(-x)), -80, 80, 6e-6),
        ("floor", np.floor, -1e6, 1e6, 0),
        ("truncate", np.trunc, -1e6, 1e6, 0),
    ],
)
def test_functions_agree_with_numpy(isa: str, name: str, function, low, high, tolerance) -> None:
    spread = np.geomspace if low > 0 else np.linspace
    x = spread(low, high, 10_007).astype(np.float32)
    exact = function(x.astype(np.float64))
    error = np.abs(elementwise(isa, name, x) - exact)
    scale = 1 + np.abs(exact) if name.startswith("log") else np.abs(exact)
    assert (error <= tolerance * scale).all()


@pytest.mark.parametrize("isa", [isa for isa in ISAS if isa != "avx512"])
def test_nodes_of_all_makers_compute_the_same_reciprocals(isa: str) -> None:
    """By division, whose bits IEEE 754 says: those of the estimate of rcpps are a maker's own."""
    x = np.geomspace(1e-30, 1e30, 10_007).astype(np.float32)
    np.testing.assert_array_equal(elementwise(isa, "reciprocal", x), np.float32(1) / x)


@pytest.mark.parametrize("isa", ISAS)
def test_functions_at_the_limits(isa: str) -> None:
    x = np.array([np.nan, np.inf, -np.inf, 0, -0.0, 200, -200], np.float32)
    np.testing.assert_array_equal(elementwise(isa, "exp2", x), [np.nan, np.inf, 0, 1, 1, np.inf, 0])
    np.testing.assert_array_equal(elementwise(isa, "sigmoid", x), [np.nan, 1, 0, 0.5, 0.5, 1, 0])
    np.testing.assert_array_equal(elementwise(isa, "floor", x), x)
    np.testing.assert_array_equal(elementwise(isa, "positive", x), [0, 1, 0, 0, 0, 1, 0])


@pytest.mark.parametrize("isa", ISAS)
def test_shuffles(isa: str) -> None:
    check = load_extension(isa).check
    generator = np.random.default_rng(0)
    rows = generator.normal(size=(16, 3)).astype(np.float32)
    out = np.empty(96, np.float32)
    check.columns(rows.ravel(), out)
    np.testing.assert_array_equal(out[:48].reshape(3, 16), rows.T)
    np.testing.assert_array_equal(out[48:].reshape(16, 3), rows)

    x = generator.normal(size=16).astype(np.float32)
    packed = np.full(16, -9, np.float32)
    count = check.compress_positive(x, packed)
    np.testing.assert_array_equal(packed[:count], x[x > 0])
    assert (packed[count:] == -9).all(), "nothing beyond the chosen lanes may be written"

    masks = generator.integers(0, 2**16, 64).astype(np.uint16)
    for bit in range(16):
        assert check.column_of_bits(masks, bit) == sum(((int(m) >> bit) & 1) << i for i, m in enumerate(masks))

    total = elementwise(isa, "hsum", x)
    np.testing.assert_allclose(total, x.sum(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_every_task_runs_once(isa: str, threads: int) -> None:
    module = load_extension(isa)
    before = module.threads()
    module.set_threads(threads)
    try:
        for n in (0, 1, 2, 1000):
            assert module.check.sum_of_tasks(n, -1) == n * (n - 1) // 2
    finally:
        module.set_threads(before)


@pytest.mark.parametrize("isa", ISAS)
def test_an_exception_in_a_task_reaches_the_caller(isa: str) -> None:
    check = load_extension(isa).check
    for bad in (0, 500, 999):
        with pytest.raises(RuntimeError, match="on purpose"):
            check.sum_of_tasks(1000, bad)
    assert check.sum_of_tasks(1000, -1) == 499500, "the pool still works afterwards"


FORK = """
import os, sys
from vdgs.kernels.cpu.extension import load_extension, supported_isas
modules = [load_extension(name) for name in supported_isas()]
for m in modules:
    m.set_threads(4)
    assert m.check.sum_of_tasks(1000, -1) == 499500
child = os.fork()
if child == 0:
    os._exit(0 if all(m.check.sum_of_tasks(1000, -1) == 499500 for m in modules) else 1)
assert os.waitpid(child, 0)[1] == 0
assert all(m.check.sum_of_tasks(1000, -1) == 499500 for m in modules)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_threads_work_after_fork_in_parent_and_child() -> None:
    done = python(FORK)
    assert done.returncode == 0, done.stderr
