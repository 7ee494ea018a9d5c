"""Evaluation: metrics, color correction, pictures."""
