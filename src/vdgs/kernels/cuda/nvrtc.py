"""NVRTC, NVIDIA's compiler as a library, through ctypes; it needs neither nvcc nor a host compiler nor CUDA_HOME. It
comes with torch's CUDA builds, as the wheel `nvidia-cuda-nvrtc`, or with a CUDA toolkit.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.util
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from vdgs.errors import VdgsError

#: How the library is called in a folder, by platform, and how the system's loader knows it.
LIBRARY_PATTERN = "nvrtc64_*.dll" if sys.platform == "win32" else "libnvrtc.so*"
SYSTEM_NAMES = ("libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so")
#: Where toolkits are installed, newest first by name; looked at last.
SYSTEM_FOLDERS = ("/usr/local/cuda/lib64", "/usr/local/cuda-*/lib64", "/usr/lib/x86_64-linux-gnu")
INSTALL_HINT = "pip install nvidia-cuda-nvrtc"


class CudaUnavailable(VdgsError):
    """CUDA code cannot be compiled or run here."""


class CompileError(VdgsError):
    """The compiler refused a source; the message ends with its log."""


@dataclass(frozen=True)
class NvrtcLibrary:
    """A library that may be NVRTC: `origin` says in words where it comes from."""

    path: str
    origin: str


@dataclass(frozen=True)
class CompileTarget:
    """What is compiled for a card: machine code (`sm_86`), or PTX (`compute_80`) that its driver compiles on."""

    name: str

    @property
    def is_ptx(self) -> bool:
        return self.name.startswith("compute_")


def find_nvrtc() -> Iterator[NvrtcLibrary]:
    """Every place where NVRTC may be: that of torch's own CUDA, other wheels (newest first), the system."""
    folders = _wheel_folders()
    major = _torch_cuda_major()
    if major is not None:
        own = [found for folder in folders for found in _in_folder(folder) if _major(found) == major]
        import torch

        own += _in_folder(Path(torch.__file__).parent / "lib")
        yield from (NvrtcLibrary(str(path), "torch's CUDA build") for path in own)
    wheels = [found for folder in folders for found in _in_folder(folder)]
    for path in sorted(wheels, key=lambda path: _major(path) or 0, reverse=True):
        yield NvrtcLibrary(str(path), "the wheel nvidia-cuda-nvrtc")
    yield from (NvrtcLibrary(name, "the system") for name in (*SYSTEM_NAMES, ctypes.util.find_library("nvrtc")) if name)
    for pattern in SYSTEM_FOLDERS:
        base, _, rest = pattern.partition("*")
        matches = sorted(Path("/").glob(pattern[1:]), reverse=True) if rest else [Path(base)]
        yield from (NvrtcLibrary(str(path), "the system") for folder in matches for path in _in_folder(folder))


@cache
def get_nvrtc() -> Nvrtc:
    """The compiler of this process. Raises CudaUnavailable if there is none that loads."""
    refused = []
    for found in find_nvrtc():
        try:
            return Nvrtc(_load(Path(found.path)), found)
        except (OSError, AttributeError) as error:
            refused.append(f"{found.path} ({error})")
    tried = f" Tried: {'; '.join(refused)}." if refused else ""
    raise CudaUnavailable(f"NVRTC, the CUDA compiler library, was not found. {INSTALL_HINT}.{tried}")


def _load(library: Path) -> ctypes.CDLL:
    """The library, after the built-in headers beside it: it opens these by name at the first source, and some of its
    wheels (13.0) do not look in their own folder for them."""
    for builtins in library.parent.glob("libnvrtc-builtins.so*") if library.is_absolute() else ():
        ctypes.CDLL(str(builtins))
    return ctypes.CDLL(str(library))


class Nvrtc:
    """The compiler. `library` offers NVRTC's C functions (a ctypes library, or a stand-in)."""

    def __init__(self, library: Any, found: NvrtcLibrary):
        self._library, self.library_info = library, found
        major, minor = ctypes.c_int(), ctypes.c_int()
        self._call("nvrtcVersion", ctypes.byref(major), ctypes.byref(minor))
        self.version = (major.value, minor.value)

    def architectures(self) -> tuple[int, ...]:
        """Compute capabilities that it compiles for, ascending, as 10 * major + minor."""
        count = ctypes.c_int()
        self._call("nvrtcGetNumSupportedArchs", ctypes.byref(count))
        found = (ctypes.c_int * count.value)()
        self._call("nvrtcGetSupportedArchs", found)
        return tuple(sorted(found))

    def target_for(self, capability: tuple[int, int]) -> CompileTarget:
        """Machine code for a card of this compute capability, or the newest PTX that it can take.

        Raises CudaUnavailable where the card is older than everything that this NVRTC compiles for.
        """
        wanted, known = 10 * capability[0] + capability[1], self.architectures()
        if wanted in known:
            return CompileTarget(f"sm_{wanted}")
        older = [each for each in known if each < wanted]
        if not older:
            raise CudaUnavailable(
                f"NVRTC {self.version[0]}.{self.version[1]} ({self.library_info.path}) compiles for cards of compute "
                f"capability {known[0] / 10:.1f} and newer; this one has {capability[0]}.{capability[1]}. "
                "An older one may do: pip install nvidia-cuda-nvrtc-cu12."
            )
        return CompileTarget(f"compute_{older[-1]}")

    def compile(
        self, name: str, source: str, headers: Mapping[str, str], target: CompileTarget, options: Sequence[str]
    ) -> bytes:
        """Cubin or PTX of a source whose `#include`s are among `headers`. Raises CompileError with the log."""
        return self.compile_with_log(name, source, headers, target, options)[0]

    def compile_with_log(
        self, name: str, source: str, headers: Mapping[str, str], target: CompileTarget, options: Sequence[str]
    ) -> tuple[bytes, str]:
        """`compile`, and the compiler's log."""
        program = ctypes.c_void_p()
        count = len(headers)
        self._call(
            "nvrtcCreateProgram", ctypes.byref(program), source.encode(), name.encode(), count,
            (ctypes.c_char_p * count)(*(text.encode() for text in headers.values())),
            (ctypes.c_char_p * count)(*(title.encode() for title in headers)),
        )  # fmt: skip
        try:
            given = [f"--gpu-architecture={target.name}", *options]
            array = (ctypes.c_char_p * len(given))(*(option.encode() for option in given))
            code = self._library.nvrtcCompileProgram(program, len(given), array)
            log = self._read(program, "nvrtcGetProgramLogSize", "nvrtcGetProgramLog").decode(errors="replace")
            if code:
                raise CompileError(
                    f"{name}: NVRTC {self.version[0]}.{self.version[1]} cannot compile it for {target.name} "
                    f"({self._explain(code)}):\n{log.strip(chr(0)).strip()}"
                )
            kind = "PTX" if target.is_ptx else "CUBIN"
            return self._read(program, f"nvrtcGet{kind}Size", f"nvrtcGet{kind}"), log
        finally:
            self._call("nvrtcDestroyProgram", ctypes.byref(program))

    def _read(self, program: ctypes.c_void_p, size_of: str, read: str) -> bytes:
        size = ctypes.c_size_t()
        self._call(size_of, program, ctypes.byref(size))
        content = ctypes.create_string_buffer(size.value)
        self._call(read, program, content)
        return content.raw

    def _call(self, name: str, *arguments: Any) -> None:
        code = getattr(self._library, name)(*arguments)
        if code:
            raise CudaUnavailable(
                f"{self.library_info.path}: {name} failed ({self._explain(code)}). Reinstall: {INSTALL_HINT}."
            )

    def _explain(self, code: int) -> str:
        error_string = self._library.nvrtcGetErrorString
        error_string.restype = ctypes.c_char_p
        text = error_string(code)
        return text.decode() if text else f"error {code}"


def _in_folder(folder: Path) -> list[Path]:
    """NVRTC in a folder: the library itself, not its built-in headers nor its alternative builds."""
    return sorted(path for path in folder.glob(LIBRARY_PATTERN) if not re.search(r"builtins|\.alt\.", path.name))


def _wheel_folders() -> list[Path]:
    """The folders for libraries of NVIDIA's wheels, which share the namespace package `nvidia`."""
    spec = importlib.util.find_spec("nvidia")
    roots = [Path(root) for root in (spec.submodule_search_locations or [])] if spec else []
    within = "bin" if sys.platform == "win32" else "lib"
    return sorted(folder for root in roots for folder in root.glob(f"*/{within}"))


def _major(library: Path) -> int | None:
    """The CUDA version in the name of a library: 13 for libnvrtc.so.13, 12 for nvrtc64_120_0.dll."""
    named = re.search(r"\.so\.(\d+)|nvrtc64_(\d\d)", library.name)
    return int(named.group(1) or named.group(2)) if named else None


def _torch_cuda_major() -> int | None:
    import torch

    return int(torch.version.cuda.split(".")[0]) if torch.version.cuda else None
