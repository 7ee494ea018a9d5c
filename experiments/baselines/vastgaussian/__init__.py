"""VastGaussian (Lin et al. 2024) in our framework, to compare with."""
