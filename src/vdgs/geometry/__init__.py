"""Where a scene lies on Earth: coordinates of the ground frame in the systems that maps are drawn in."""
