"""pycolmap, which the whole package imports by way of this module.

Its import lets glog handle SIGTERM: the process would end there with a C++ trace and save nothing.
"""

# Before pycolmap: where that is loaded first, both bring a zlib of their own and Pillow's PNG encoder breaks the heap.
import PIL.Image  # noqa: F401

from vdgs.system.stop_signals import preserve_signal_handlers

with preserve_signal_handlers():
    import pycolmap as pycolmap
