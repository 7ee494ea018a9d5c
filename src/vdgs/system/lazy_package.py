"""A package whose names are loaded when they are first used, and whose folders can be functions too.

Its type stub, `__init__.pyi`, says which module defines which name, a line each.
"""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any


class _PicklableModule(ModuleType):
    """A module of a class of its own, pickled by its name: `pickle` and `cloudpickle` know plain modules alone."""

    def __reduce__(self) -> tuple[Any, ...]:
        return import_module, (self.__name__,)


class CallableFolder(_PicklableModule):
    """A folder of a package that is called as the package's function of its name."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        return self._function(*args, **options)

    @property
    def _function(self) -> Any:
        package, _, name = self.__name__.rpartition(".")
        return getattr(import_module(sys.modules[package]._modules[name]), name)

    @property
    def __signature__(self) -> Any:
        from inspect import signature  # takes as long to load as all that is here

        return signature(self._function)

    @property
    def __doc__(self) -> str:  # type: ignore[override]
        """Those of the function: `help` shows what it finds here, as of a module."""
        from inspect import getdoc

        name = self.__name__.rpartition(".")[2]
        return f"{name}{self.__signature__}\n\n{getdoc(self._function)}"


class LazyPackage(_PicklableModule):
    """A package that loads what its stub names. Python sets each of its folders as an attribute when it imports it."""

    @property
    def _modules(self) -> dict[str, str]:
        """Public names by the modules that define them; for a folder that is one, the package."""
        if "_stubbed" not in vars(self):
            stub = Path(str(self.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
            found = re.findall(r"^from (\S+) import (\w+) as", stub, re.MULTILINE)
            vars(self)["_stubbed"] = {name: module for module, name in found}
        return vars(self)["_stubbed"]

    @property
    def __all__(self) -> list[str]:
        """What `from PACKAGE import *` brings: the public names, which loads all of them."""
        return sorted(self._modules)

    def __setattr__(self, name: str, value: Any) -> None:
        if type(value) is ModuleType and self._modules.get(name, self.__name__) != self.__name__:
            value.__class__ = CallableFolder
        super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if name not in self._modules:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        if Path(str(self.__file__)).with_name(name).is_dir():
            return import_module(f"{self.__name__}.{name}")
        value = getattr(import_module(self._modules[name]), name)
        setattr(self, name, value)
        return value

    def __dir__(self) -> list[str]:
        return sorted({*(name for name in vars(self) if not name.startswith("_")), *self._modules, "__version__"})
