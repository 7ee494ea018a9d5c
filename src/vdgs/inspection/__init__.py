"""`vdgs inspect`: what a capture holds and how well its photographs cover the place."""
