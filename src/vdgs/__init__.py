"""vdgs: visibility-driven 3D Gaussian splatting for whole places seen from the air.

The functions of `vdgs.api` and the module `vdgs.ops` are here under their own names, loaded when first used
(docs/python.md). The import itself loads no torch, and takes milliseconds.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

from vdgs.kernels import configure_threads as configure_threads

__version__ = "0.1.0"

#: Names of the API by the modules that define them; `__init__.pyi` lists them for type checkers.
_PUBLIC = {
    "vdgs.api": (
        "Camera", "Capture", "CaptureOptions", "Render", "Run", "Scene", "assign_cameras",
        "count_visibility", "export", "load_capture", "merge", "open_run", "partition", "preset", "render", "train",
        "view", "visibility_ratio",
    ),
    "vdgs.config.method": ("AssignmentConfig", "CompensationConfig", "MethodConfig", "TrainConfig"),
    "vdgs.errors": ("UnsupportedOption", "VdgsError"),
    "vdgs.ops.arrays": ("cameras_from",),
    "vdgs.training.compensated_growth": ("CompensatedGrowth",),
}  # fmt: skip
_HOMES = {name: module for module, names in _PUBLIC.items() for name in names}
#: Functions of the API that share their name with a folder of the package: the folder can be called.
_CALLABLE_ROOMS = ("export", "partition")

# torch reads how its threads wait when it is imported, which callers may do next.
configure_threads()


class _CallableRoom(ModuleType):
    """A folder of the package that is called as the function of the API of its name."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        return self._function(*args, **options)

    @property
    def _function(self) -> Any:
        return getattr(import_module("vdgs.api"), self.__name__.rpartition(".")[2])

    @property
    def __signature__(self) -> Any:
        from inspect import signature  # takes as long to load as all that is here

        return signature(self._function)


class _Package(ModuleType):
    """The package; Python sets each of its folders as an attribute when it is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _CALLABLE_ROOMS and type(value) is ModuleType:
            value.__class__ = _CallableRoom
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name == "ops" or name in _CALLABLE_ROOMS:
        return import_module(f"vdgs.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'vdgs' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*(name for name in globals() if not name.startswith("_")), *_HOMES, "ops", "__version__"})
