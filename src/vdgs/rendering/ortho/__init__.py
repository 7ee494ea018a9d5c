"""`vdgs ortho`: orthophoto, surface model and visibility of a scene as maps."""
