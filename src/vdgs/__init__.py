"""vdgs: visibility-driven 3D Gaussian splatting for whole places seen from the air.

What `__init__.pyi` names is here, loaded when first used (docs/python.md). The import itself loads no torch, and takes
milliseconds.
"""

import sys

from vdgs.kernels import configure_threads as configure_threads
from vdgs.system.lazy_package import LazyPackage

__version__ = "0.1.0"

# torch reads how its threads wait when it is imported, which callers may do next.
configure_threads()
sys.modules[__name__].__class__ = LazyPackage
