"""HUG (Su et al. 2025): blocks by what photographs show of them, anchors with levels, supervision at every level."""
