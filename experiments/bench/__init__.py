"""The evidence: methods × scenes × seeds turned into tables, figures and a verdict (`python -m experiments.bench`)."""
