"""2D Gaussian splatting (Huang et al. 2024) on our 3DGS, to compare with."""
