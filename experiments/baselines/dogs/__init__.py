"""DOGS (Chen and Lee 2024) in our framework, to compare with."""
