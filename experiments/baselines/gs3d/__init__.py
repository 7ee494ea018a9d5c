"""3D Gaussian splatting (Kerbl et al. 2023) in our framework, to compare with."""
