"""Explicit Gaussians that are trained in blocks: what CityGaussian, VastGaussian and DOGS have in common."""
