"""Evaluation: metrics, colour correction, pictures."""
