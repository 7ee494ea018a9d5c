"""Operations for programs of one's own: `vdgs.ops.rasterization` with gsplat's signature, on a CPU, and single kernels.

Torch tensors or numpy arrays go in, and the same comes out (numpy arrays of float64 become float32; they carry no
gradients). Errors: ValueError for shapes, TypeError for dtypes, `UnsupportedOption` for what gsplat has and this has
not. Pixel centers are at 0.5; quaternions are wxyz; cameras look along +z (OpenCV); docs/python.md has a guide.
"""

from vdgs.ops.rasterization import rasterization as rasterization
from vdgs.ops.single_kernels import Projection as Projection
from vdgs.ops.single_kernels import cull as cull
from vdgs.ops.single_kernels import decode_anchors as decode_anchors
from vdgs.ops.single_kernels import photometric_loss as photometric_loss
from vdgs.ops.single_kernels import project as project
from vdgs.ops.single_kernels import sparse_adam_ as sparse_adam_
