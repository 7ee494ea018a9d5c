from vdgs.kernels.reference.cull import *
from vdgs.kernels.reference.cull import cull
