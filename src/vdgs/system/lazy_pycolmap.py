"""pycolmap, which the whole package imports by way of this module.

It is loaded at its first use: an installation may do without it (`docs/third-party.md`), and most verbs do not need it.
Its import lets glog handle SIGTERM: the process would end there with a C++ trace and save nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pycolmap as pycolmap
else:

    class _LazyModule:
        def __getattr__(self, name: str) -> Any:
            # Before pycolmap: where that is loaded first, both bring a zlib of their own and Pillow's PNG encoder
            # breaks the heap.
            import PIL.Image  # noqa: F401

            from vdgs.system.stop_signals import preserve_signal_handlers

            with preserve_signal_handlers():
                import pycolmap as module
            value = getattr(module, name)
            setattr(self, name, value)
            return value

    pycolmap = _LazyModule()
