"""MixGS (Liu et al. 2025): one scene of explicit Gaussians, mixed with Gaussians decoded for each view."""
