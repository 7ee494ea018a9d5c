"""A run on disk: its folder, the keys of its stages, its models and blocks opened."""
