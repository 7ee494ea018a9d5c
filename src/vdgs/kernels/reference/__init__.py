"""Readable torch implementations: the oracle of the tests, and the fallback."""
