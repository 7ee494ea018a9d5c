"""`vdgs view`: a scene in a browser, drawn by our own kernels where the run is."""
