"""vdgs: visibility-driven 3D Gaussian splatting for whole places seen from the air."""

__version__ = "0.1.0"
