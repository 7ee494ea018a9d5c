from vdgs.kernels.reference.decode import *
from vdgs.kernels.reference.decode import decode
