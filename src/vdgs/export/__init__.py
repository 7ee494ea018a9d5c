"""Trained scenes for other programs: explicit Gaussians from anchors, and the files that hold them."""
