"""Octree-GS (Ren et al., TPAMI 2025) and, with one level, Scaffold-GS (Lu et al., CVPR 2024) as published."""
