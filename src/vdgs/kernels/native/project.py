from vdgs.kernels.reference.project import *
from vdgs.kernels.reference.project import project
