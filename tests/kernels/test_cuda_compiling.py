"""CUDA sources become code: found compiler, right target, errors with the log, and a cache that is never wrong."""

from __future__ import annotations

import ctypes
import re
from pathlib import Path

import pytest
import torch

from experiments.microbench.cuda_resources import resources_of
from support.commands import python_begun
from support.cuda_on_host import COMPILER, needs_nvrtc
from vdgs.errors import VdgsError
from vdgs.kernels.cuda import compile_cache, launch, nvrtc
from vdgs.kernels.cuda.nvrtc import CompileError, CompileTarget, CudaUnavailable, Nvrtc, NvrtcLibrary

pytestmark = pytest.mark.slow

#: Of 75, 80, 86, 89, 90, 100 and 120 those whose compilers hand out registers in ways of their own; the others do as
#: the one before them.
UNLIKE = (75, 86, 90, 120)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(compile_cache.CUDA_CACHE_ENV_VAR, str(tmp_path / "code"))


class StandIn:
    """NVRTC 12.4 as far as asking it goes."""

    def __init__(self, *architectures: int):
        self._known = architectures

    def nvrtcVersion(self, major, minor):
        major._obj.value, minor._obj.value = 12, 4
        return 0

    def nvrtcGetNumSupportedArchs(self, count):
        count._obj.value = len(self._known)
        return 0

    def nvrtcGetSupportedArchs(self, array):
        array[:] = self._known
        return 0


#: By source: its shared headers and its kernels.
SOURCES = {
    "adam.cu": ((), {"adam_tensors"}),
    "cull.cu": (("gaussian_math.h", "image_formation.h"), {"mark_anchors", "write_rows"}),
    "decode.cu": (("gaussian_math.h", "image_formation.h"), {"decode_anchors", "name_splats", "move_anchors"}),
    "loss.cu": ((), {"photometric_forward", "photometric_backward", "photometric_total"}),
    "rasterize.cu": (
        ("image_formation.h",),
        {
            "order_splats",
            "splat_tiles",
            "splat_entries",
            "rasterize_forward",
            "rasterize_backward",
            "gather_gradients",
        },
    ),
    "statistics.cu": ((), {"add_view"}),
    "visibility.cu": ((), {"count_visibility", "mark_visible"}),
}


@needs_nvrtc
@pytest.mark.parametrize("architecture", UNLIKE)
@pytest.mark.parametrize("source", SOURCES)
def test_every_source_compiles_and_hardly_spills(source, architecture):
    """Of 64 registers, four blocks of 256 threads fit on every card, of 73 seven of 128, of 128 two of 256; of 16 KiB
    shared memory four. NVRTC 13.0 spills one register of one kernel for the newest cards, 13.5 none."""
    most = {"move_anchors": 128, "rasterize_backward": 73}
    headers, kernels = SOURCES[source]
    found = resources_of(source, CompileTarget(f"sm_{architecture}"), headers, COMPILER)
    assert {each.kernel for each in found} == kernels
    spilled = {(each.kernel, architecture): each.spilled_bytes for each in found if each.spilled_bytes}
    assert spilled in ({}, {("move_anchors", 120): 8})
    assert all(0 < each.registers <= most.get(each.kernel, 64) for each in found)
    assert all(each.shared_bytes <= 16384 for each in found)


def test_shared_headers_lean_on_nothing_of_the_processors():
    """Those who bring vectors of their own include them, not the other way round."""
    shared = Path(launch.__file__).parents[1] / "shared"
    names = {path.name for path in shared.glob("*.h")}
    assert names >= {"gaussian_math.h", "image_formation.h"}
    for name in names:
        assert set(re.findall(r'#include "(.*)"', launch.read_header(name))) <= names


@needs_nvrtc
def test_compiled_code_names_its_kernels():
    code = launch.compile_source("loss.cu", CompileTarget("sm_86"))
    assert code[:4] == b"\x7fELF"
    assert all(kernel.encode() in code for kernel in SOURCES["loss.cu"][1])


@needs_nvrtc
def test_ptx_names_the_kernels():
    code = launch.compile_source("loss.cu", CompileTarget("compute_75"))
    assert b".target sm_75" in code
    assert b".entry photometric_forward" in code


@needs_nvrtc
@pytest.mark.parametrize("architecture", [min(UNLIKE), max(UNLIKE)])
def test_the_mathematics_of_the_processor_compiles_for_every_card(architecture):
    """gaussian_math.h is written once for both: every function of it in one kernel. (In between: decode.cu above.)"""
    headers = {name: launch.read_header(name) for name in ("gaussian_math.h", "image_formation.h")}
    code = COMPILER.compile(
        "gaussian.cu", GAUSSIAN, headers, CompileTarget(f"sm_{architecture}"), launch.COMPILE_OPTIONS
    )
    assert b"there_and_back" in code


GAUSSIAN = r"""
#include "gaussian_math.h"
namespace vdgs {
extern "C" __global__ void there_and_back(const float* camera, const float* anchors, const float* covariances,
                                          float* out, bool* seen, int count) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= count) return;
  const Camera view = unpack_camera(camera);
  const float* a = anchors + 12 * i;
  const Anchor<float> anchor{{a[0], a[1], a[2]}, {exp(a[3]), exp(a[4]), exp(a[5])}, {exp(a[6]), exp(a[7]), exp(a[8])}};
  const Vec3<float> offset{a[9], a[10], a[11]};
  const Gaussian<float> gaussian = spawn(anchor, offset, covariances + 7 * i);
  const Projection<float> p = project(view, gaussian);
  const Gaussian<float> by = project_backward(view, gaussian, p, p.drawn);
  const SpawnGradient<float> g = spawn_backward(anchor, offset, covariances + 7 * i, gaussian, by);
  seen[i] = p.valid && on_image(view, p, sigmoid(a[0]));
  for (int k = 0; k < 7; ++k) out[7 * i + k] = g.covariance[k] + g.offset.x + g.log_extent.y + g.log_size.z;
}
}
"""


def test_machine_code_for_what_the_compiler_knows_and_ptx_for_newer_cards():
    compiler = Nvrtc(StandIn(50, 90, 75, 86), NvrtcLibrary("stand-in", "a test"))
    assert compiler.version == (12, 4)
    assert compiler.target_for((8, 6)) == CompileTarget("sm_86")
    assert compiler.target_for((8, 9)) == CompileTarget("compute_86")
    assert compiler.target_for((12, 0)) == CompileTarget("compute_90")
    assert compiler.target_for((12, 0)).is_ptx
    assert not compiler.target_for((9, 0)).is_ptx
    with pytest.raises(CudaUnavailable, match=r"capability 5\.0 and newer; this one has 3\.7"):
        compiler.target_for((3, 7))


@needs_nvrtc
def test_a_compile_error_comes_with_the_log():
    with pytest.raises(CompileError, match=r'(?s)broken\.cu.*sm_80.*identifier "wrong" is undefined') as raised:
        COMPILER.compile("broken.cu", "__global__ void f() { wrong(); }", {}, CompileTarget("sm_80"), ())
    assert isinstance(raised.value, VdgsError)
    with pytest.raises(CompileError, match=r"absent\.h"):
        COMPILER.compile("broken.cu", '#include "absent.h"', {}, CompileTarget("sm_80"), ())


def test_torchs_own_compiler_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for folder in ("nvidia/cu13/lib/libnvrtc.so.13", "nvidia/cuda_nvrtc/lib/libnvrtc.so.12"):
        (tmp_path / folder).parent.mkdir(parents=True)
        (tmp_path / folder).touch()
    (tmp_path / "nvidia/cu13/lib/libnvrtc-builtins.so.13.5").touch()
    monkeypatch.setattr(nvrtc, "LIBRARY_PATTERN", "libnvrtc*.so*")
    monkeypatch.setattr(nvrtc, "_wheel_folders", lambda: sorted(tmp_path.glob("nvidia/*/lib")))
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    own, *others = nvrtc.find_nvrtc()
    assert (Path(own.path).name, own.origin) == ("libnvrtc.so.12", "torch's CUDA build")
    assert Path(others[0].path).name == "libnvrtc.so.13"
    assert others[-1].origin == "the system"
    monkeypatch.setattr(torch.version, "cuda", None)
    first, second, *_ = nvrtc.find_nvrtc()
    assert [Path(each.path).name for each in (first, second)] == ["libnvrtc.so.13", "libnvrtc.so.12"]
    assert first.origin == "the wheel nvidia-cuda-nvrtc"


def test_without_a_compiler_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nvrtc, "find_nvrtc", lambda: iter([NvrtcLibrary("/nowhere/libnvrtc.so.13", "a test")]))
    with pytest.raises(CudaUnavailable, match=r"pip install nvidia-cuda-nvrtc.*Tried: /nowhere"):
        nvrtc.get_nvrtc.__wrapped__()


def test_a_library_that_is_another_is_refused(monkeypatch: pytest.MonkeyPatch):
    libc = ctypes.util.find_library("c")
    monkeypatch.setattr(nvrtc, "find_nvrtc", lambda: iter([NvrtcLibrary(str(libc), "a test")]))
    with pytest.raises(CudaUnavailable, match="nvrtcVersion"):
        nvrtc.get_nvrtc.__wrapped__()


PARTS = {"source": "a", "target": "sm_80"}


class TestCache:
    def test_made_once_and_found_again(self):
        made = []
        for _ in range(3):
            assert compile_cache.load_or_compile("k", PARTS, lambda: made.append(1) or b"code") == b"code"
        assert len(made) == 1
        (entry,) = compile_cache.cache_folder().iterdir()
        assert entry.name.startswith("k-")

    @pytest.mark.parametrize("part", ["source", "target", "header h", "options", "NVRTC"])
    def test_everything_that_it_is_made_from_counts(self, part):
        assert compile_cache.load_or_compile("k", PARTS, lambda: b"old") == b"old"
        assert compile_cache.load_or_compile("k", PARTS | {part: "other"}, lambda: b"new") == b"new"
        assert compile_cache.load_or_compile("k", PARTS, lambda: b"never") == b"old"

    def test_a_name_is_told_from_a_text(self):
        assert compile_cache.digest_parts({"ab": "c"}) != compile_cache.digest_parts({"a": "bc"})

    @pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b[:20], lambda b: b"", lambda b: b[:-1] + b"?"])
    def test_a_damaged_entry_is_made_again(self, damage):
        compile_cache.load_or_compile("k", PARTS, lambda: b"code")
        (entry,) = compile_cache.cache_folder().iterdir()
        whole = entry.read_bytes()
        entry.write_bytes(damage(whole))
        assert compile_cache.load_or_compile("k", PARTS, lambda: b"code") == b"code"
        assert entry.read_bytes() == whole

    def test_a_folder_that_cannot_be_made_costs_nothing_but_time(self, tmp_path, monkeypatch):
        (tmp_path / "file").touch()
        monkeypatch.setenv(compile_cache.CUDA_CACHE_ENV_VAR, str(tmp_path / "file" / "below"))
        assert compile_cache.load_or_compile("k", PARTS, lambda: b"code") == b"code"

    def test_processes_at_once(self):
        code = "from vdgs.kernels.cuda.compile_cache import load_or_compile\n"
        code += "code = b'x' * 100_000\n"
        code += "for _ in range(3): assert load_or_compile('k', {'source': 'same'}, lambda: code) == code"
        environment = {compile_cache.CUDA_CACHE_ENV_VAR: str(compile_cache.cache_folder())}
        with python_begun(code, **environment) as one, python_begun(code, **environment) as other:
            assert [each.finished().returncode for each in (one, other)] == [0, 0]
        (entry,) = compile_cache.cache_folder().iterdir()  # and no temporary file beside it
        assert entry.stat().st_size > 100_000

    def test_the_folder_follows_the_platform(self, monkeypatch):
        monkeypatch.delenv(compile_cache.CUDA_CACHE_ENV_VAR)
        monkeypatch.setattr(compile_cache.sys, "platform", "linux")
        monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
        assert compile_cache.cache_folder() == Path("/somewhere/vdgs/cuda")
        monkeypatch.setattr(compile_cache.sys, "platform", "win32")
        monkeypatch.setenv("LOCALAPPDATA", "/local")
        assert compile_cache.cache_folder() == Path("/local/vdgs/cuda")

    @needs_nvrtc
    def test_another_header_is_another_entry(self, monkeypatch):
        monkeypatch.setattr(launch, "read_source", lambda name: '#include "h.h"\n__device__ int f() { return N; }')
        made = []
        for text in ("#define N 1", "#define N 2"):
            monkeypatch.setattr(launch, "read_header", lambda name, text=text: text)
            made.append(launch.compile_source("s.cu", CompileTarget("compute_80"), headers=("h.h",)))
        first, second = made
        assert first != second or len(list(compile_cache.cache_folder().iterdir())) == 2
